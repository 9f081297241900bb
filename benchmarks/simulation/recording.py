"""The recorder of a simulated fleet, and the rules of a recording.

A message that was published is in the recording once, as it was published, or a row says that it is missing; a message
that its publisher still has cached is not missing. Operations of arms have no number: their name takes its place, and
one that its publisher has no longer cached may be missing without a row. The recording is read by the product, from a
copy on a real disk.
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
from fleet.bus.protocol.auction import ABANDONED, ArmEvent, Result
from fleet.bus.protocol.operator import Operation
from fleet.events import EVENTS_PER_BOOT
from scenarios.live import recorder as recorder_module
from scenarios.live.recorder import Recorder, RecorderNode
from scenarios.live.recording import Kind, read_card, read_parts

RECORDER = "recorder"
NAMES: dict[Kind, str] = {"results": "auctioneer", "operations": "auctioneer", "events": "arm"}
"""Column with the sender, by kind."""
Number = int | str
"""Number of a message, or the name of an arm's operation."""


def _number_of(key: str, message: Any) -> Number:
    if isinstance(message, Operation) and keys.parse(key).role == "arm":
        return message.request.request
    return message.number


def _number_of_row(row: dict[str, Any]) -> Number:
    return row["request"] if "request" in row and not row["epoch"] else row["number"]  # an auctioneer has an epoch


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
    """What was published, by kind, sender and number, and where it may be cached.

    Attributes:
        renumbered: Senders that have lost their journals, and used numbers again: their recording is not checked.
        abandoned: Jobs that were reported as abandoned.
    """

    def __init__(self, bus: Bus) -> None:
        self.messages: dict[tuple[Kind, str, Number], msgspec.Struct] = {}
        self.renumbered: set[str] = set()
        self.abandoned: set[str] = set()
        self.cached: dict[str, Any] = {}
        bus.on_publish = self._add

    def _add(self, published: Published, message: msgspec.Struct) -> None:
        number = _number_of(published.key, message) if isinstance(message, Result | Operation | ArmEvent) else ""
        if isinstance(message, Result | Operation):
            kind: Kind = "results" if isinstance(message, Result) else "operations"
            key: tuple[Kind, str, Number] = kind, message.auctioneer, number
        elif isinstance(message, ArmEvent):
            key = "events", message.arm, number
        else:
            return
        self.cached[published.key] = published
        if isinstance(message, Result) and message.status.state in ABANDONED:
            self.abandoned.add(message.status.job)
        if key[1] in self.renumbered:
            self.messages[key] = message
        elif self.messages.setdefault(key, message) != message:
            raise Violation(f"Two messages have the number {key}.")

    def renumber(self, sender: str) -> None:
        """Drop what a participant has published, as it may use the numbers again."""
        self.renumbered.add(sender)
        self.messages = {key: message for key, message in self.messages.items() if key[1] != sender}

    def missing(self, node: RecorderNode | None) -> list[str]:
        """Return what a recorder has yet to get, in words."""
        if node is None:
            return ["it is down"]
        recorder = node.recorder
        checked = [key for key in self.messages if key[1] not in self.renumbered]
        gaps = (gap for gap in recorder.missing if gap.sender.partition(" of ")[2] not in self.renumbered)
        seeks = [f"'{gap.sender}' is sought from {gap.first} to {gap.last}" for gap in gaps]
        numbered = sorted((kind, name, number) for kind, name, number in checked if isinstance(number, int))
        last = {f"{kind} of {name}": number for kind, name, number in numbered if kind != "events"}
        with_events = [own for own in self.cached.values() if _has_events(own) and own.name not in self.renumbered]
        last |= {f"events of {own.name}": own.cache[-1][1].number for own in with_events}
        heard = {name.partition(", epoch")[0]: count.last for name, count in recorder.counts.items()}
        seeks += [f"'{name}' {number}" for name, number in last.items() if heard.get(name) != number]
        kept = {(name, request) for name, count in recorder.counts.items() for _, request in count.requests}
        named = [(f"{kind} of {name}", number) for kind, name, number in sorted(self._in_caches(), key=str)]
        return seeks + [f"{each}" for each in named if isinstance(each[1], str) and each not in kept]

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
                rows = [row for row in read_parts(folder, kind).to_pylist() if row[name] not in self.renumbered]
                self._check_kind(kind, rows, name)
                lost: set[tuple[str, Number]] = {
                    (of, n) for what, of, row in gaps if what == kind for n in range(row["first"], row["last"] + 1)
                }
                self._check_missing(kind, {(row[name], _number_of_row(row)) for row in rows}, lost)

    def _in_caches(self) -> set[tuple[Kind, str, Number]]:
        """Kind, sender and number of the messages that their publishers have cached."""
        kinds: dict[str, Kind] = {"result": "results", "operation": "operations", "event": "events"}
        return {
            (kinds[keys.parse(published.key).topic], published.name, _number_of(published.key, message))
            for published in self.cached.values()
            if published.client.open_ and published.name not in self.renumbered
            for _, message in published.cache
        }

    def _check_kind(self, kind: Kind, rows: list[dict[str, Any]], name: str) -> None:
        counts = Counter((row[name], _number_of_row(row)) for row in rows)
        for (sender, number), count in counts.items():
            if count > 1:
                raise Violation(f"{kind} {number} of '{sender}' is recorded {count} times.")
        for row in rows:
            number = _number_of_row(row)
            sent = self.messages.get((kind, row[name], number))
            if sent is None:
                raise Violation(f"{kind} {number} of '{row[name]}' is recorded, and was never published.")
            if isinstance(sent, Result) and (sent.status.job, sent.status.state) != (row["job"], row["state"]):
                raise Violation(f"{kind} {number} of '{row[name]}' is recorded as something else.")

    def _check_missing(self, kind: Kind, kept: set[tuple[str, Number]], lost: set[tuple[str, Number]]) -> None:
        cached = {(of, number) for what, of, number in self._in_caches() if what == kind}
        if both := lost & kept:
            raise Violation(f"{kind} {min(both)} is recorded, and a row says that it is missing.")
        if vain := lost & cached:
            raise Violation(f"{kind} {min(vain)} is called missing, and its publisher has it.")
        last: dict[tuple[str, int], int] = {}
        for of, number in kept:
            if isinstance(number, int):
                boot = (of, number // EVENTS_PER_BOOT)
                last[boot] = max(last.get(boot, -1), number)
        for what, of, number in self.messages:
            if what != kind or of in self.renumbered or (of, number) in kept or (of, number) in lost:
                continue
            noticed = isinstance(number, int) and (
                kind != "events" or number < last.get((of, number // EVENTS_PER_BOOT), -1)
            )
            if noticed or (of, number) in cached:
                raise Violation(f"{kind} {number} of '{of}' is not recorded, and no row says so.")


def _has_events(published: Any) -> bool:
    return published.client.open_ and published.key.endswith("/event") and bool(published.cache)
