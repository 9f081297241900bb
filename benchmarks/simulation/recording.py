"""The recorder of a simulated fleet, and the rules of a recording.

A message that was published is in the recording once, as it was published, or a row says that it is missing; a message
that its publisher still has cached is not missing. The recording is read by the product, from a copy on a real disk.
"""

import io
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pyarrow.parquet as pq

from benchmarks.simulation.bus import Bus, Published, SimulatedClient
from benchmarks.simulation.disk import DiskCalls
from benchmarks.simulation.world import Process, Violation
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Result
from fleet.bus.protocol.operator import Operation
from fleet.events import EVENTS_PER_BOOT
from scenarios.live import recorder as recorder_module
from scenarios.live.recorder import Recorder, RecorderNode
from scenarios.live.recording import Kind, read_card, read_parts

RECORDER = "recorder"
NAMES: dict[Kind, str] = {"results": "auctioneer", "operations": "auctioneer", "events": "arm"}
"""Column with the sender, by kind."""


def recorder_process(rotate_s: float) -> Callable[[Process], RecorderNode]:
    """Return what starts the recorder."""

    def build(process: Process) -> RecorderNode:
        folder: Any = process.disk.path("")
        link: Any = SimulatedClient(process)
        connect: Any = partial(SimulatedClient, process, further=True)
        return RecorderNode(link, Recorder.open(folder, link.fleet), connect, rotate_s=rotate_s)

    return build


@contextmanager
def simulated_files(disk: Callable[[], Any]) -> Iterator[None]:
    """Have the recorder use the disk of the running process."""

    def write_table(table: Any, path: Any, **options: Any) -> None:
        content = io.BytesIO()
        pq.write_table(table, content, **options)
        path.write_bytes(content.getvalue())

    module: Any = recorder_module
    before = module.os, module.pq
    module.os, module.pq = DiskCalls(disk), SimpleNamespace(write_table=write_table)
    try:
        yield
    finally:
        module.os, module.pq = before


class Sent:
    """What was published, by kind, sender and number, and where it may be cached."""

    def __init__(self, bus: Bus) -> None:
        self.messages: dict[tuple[Kind, str, int], msgspec.Struct] = {}
        self.cached: dict[str, Any] = {}
        bus.on_publish = self._add

    def _add(self, published: Published, message: msgspec.Struct) -> None:
        if isinstance(message, Operation) and keys.parse(published.key).role == "arm":
            return  # not recorded, and not counted
        if isinstance(message, Result | Operation):
            kind: Kind = "results" if isinstance(message, Result) else "operations"
            key: tuple[Kind, str, int] = kind, message.auctioneer, message.number
        elif isinstance(message, ArmEvent):
            key = "events", message.arm, message.number
        else:
            return
        self.cached[published.key] = published
        if self.messages.setdefault(key, message) != message:
            raise Violation(f"Two messages have the number {key}.")

    def missing(self, node: RecorderNode | None) -> list[str]:
        """Return what a recorder has yet to get, in words."""
        if node is None:
            return ["it is down"]
        recorder = node.recorder
        seeks = [f"'{gap.sender}' is sought from {gap.first} to {gap.last}" for gap in recorder.missing]
        last = {f"{kind} of {name}": number for kind, name, number in sorted(self.messages) if kind != "events"}
        last |= {f"events of {own.name}": own.cache[-1][1].number for own in self.cached.values() if _has_events(own)}
        heard = {name.partition(", epoch")[0]: count.last for name, count in recorder.counts.items()}
        return seeks + [f"'{name}' {number}" for name, number in last.items() if heard.get(name) != number]

    def check(self, process: Process) -> None:
        """Check the recording of an ended recorder.

        Raises:
            Violation: a rule is broken.
        """
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            for name, file in process.disk.names.items():
                (folder / name).write_bytes(file.data)
            if read_card(folder).status != "finished":
                raise Violation("The recording is not ended.")
            gaps = [(*row["sender"].split(" of "), row) for row in read_parts(folder, "gaps").to_pylist()]
            for kind, name in NAMES.items():
                rows = read_parts(folder, kind).to_pylist()
                self._check_kind(kind, rows, name)
                lost = {(of, n) for what, of, row in gaps if what == kind for n in range(row["first"], row["last"] + 1)}
                self._check_missing(kind, {(row[name], row["number"]) for row in rows}, lost)

    def _check_kind(self, kind: Kind, rows: list[dict[str, Any]], name: str) -> None:
        counts = Counter((row[name], row["number"]) for row in rows)
        for (sender, number), count in counts.items():
            if count > 1:
                raise Violation(f"{kind} {number} of '{sender}' is recorded {count} times.")
        for row in rows:
            sent = self.messages.get((kind, row[name], row["number"]))
            if sent is None:
                raise Violation(f"{kind} {row['number']} of '{row[name]}' is recorded, and was never published.")
            if isinstance(sent, Result) and (sent.status.job, sent.status.state) != (row["job"], row["state"]):
                raise Violation(f"{kind} {row['number']} of '{row[name]}' is recorded as something else.")

    def _check_missing(self, kind: Kind, kept: set[tuple[str, int]], lost: set[tuple[str, int]]) -> None:
        cached = {
            (published.name, message.number)
            for published in self.cached.values()
            if published.client.open_ and published.key.endswith(f"/{kind[:-1]}")
            for _, message in published.cache
        }
        if both := lost & kept:
            raise Violation(f"{kind} {min(both)} is recorded, and a row says that it is missing.")
        if vain := lost & cached:
            raise Violation(f"{kind} {min(vain)} is called missing, and its publisher has it.")
        last: dict[tuple[str, int], int] = {}
        for of, number in kept:
            boot = (of, number // EVENTS_PER_BOOT)
            last[boot] = max(last.get(boot, -1), number)
        for what, of, number in self.messages:
            if what != kind or (of, number) in kept or (of, number) in lost:
                continue
            if kind != "events" or (of, number) in cached or number < last.get((of, number // EVENTS_PER_BOOT), -1):
                raise Violation(f"{kind} {number} of '{of}' is not recorded, and no row says so.")


def _has_events(published: Any) -> bool:
    return published.client.open_ and published.key.endswith("/event") and bool(published.cache)
