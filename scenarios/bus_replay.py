"""A run or a recording back on the bus: every arm says again what it said, and each is there while it does."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.bus import keys
from fleet.bus.link import REMEMBERED
from fleet.bus.messages import State
from fleet.bus.trade import ArmEvent, JobStatus, Result
from fleet.errors import FleetError
from scenarios.bus_recording import CARD, read_card, read_parts, states

if TYPE_CHECKING:
    from fleet.bus.link import Link

Word = State | ArmEvent | Result
LOOK_S = 0.2
"""How often it is looked whether to stop, real seconds."""


@dataclass(frozen=True, eq=False)
class Replay:
    """What is said again."""

    fleet: str
    telemetry: pa.Table
    events: pa.Table
    results: pa.Table
    warning_c: float
    """From which headroom is counted where none was recorded."""

    def __len__(self) -> int:
        return self.telemetry.num_rows + self.events.num_rows + self.results.num_rows

    @classmethod
    def of(cls, folder: Path) -> "Replay":
        """Of the folder of a run or of a recording; one that is still being written is read as far as it is on disk.

        Raises:
            FleetError: it is neither.
        """
        if (folder / CARD).exists():
            fleet = read_card(folder)["fleet"]
            tables = {kind: read_parts(folder, kind) for kind in ("telemetry", "events", "results")}
            return cls(fleet=fleet, warning_c=60.0, **tables)
        try:
            run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
            telemetry = pq.read_table(folder / "telemetry.parquet")
            events = pq.read_table(folder / "events.parquet")
            scenario = run["scenario"]
            fleet, warning_c = scenario["name"], scenario["limits"]["warning_c"]
        except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
            raise FleetError(
                f"'{folder}' holds neither a run (run.json, telemetry.parquet, events.parquet) nor a recording of the "
                f"bus ({CARD})."
            ) from error
        return cls(fleet=fleet, telemetry=telemetry, events=events, results=pa.table({}), warning_c=warning_c)

    @property
    def arms(self) -> list[str]:
        """Who speaks."""
        return sorted(set(self.telemetry["arm"].to_pylist())) if self.telemetry.num_rows else []

    def words(self) -> Iterator[Word]:
        """All of it in order of time."""
        told: list[Iterator[Word]] = [
            states(self.telemetry, warning_c=self.warning_c),
            _events(self.events),
            _results(self.results),
        ]
        return merge(*told, key=lambda word: word.time_s)

    def play(self, link: "Link", *, speed: float, stopped: Callable[[], bool]) -> int:
        """Say it all at its own pace times `speed`, behind by no more than the machine makes it; how many words.

        Raises:
            FleetError: an arm of that name is on the bus already: two would speak with one voice.
        """
        _refuse_namesakes(link, self.arms)
        for arm in self.arms:
            link.alive(keys.of_arm(link.fleet, arm, "alive"))
        say: dict[str, Callable[[Any], None]] = {}
        begun_s, first_s, said = time.monotonic(), None, 0
        for word in self.words():
            first_s = word.time_s if first_s is None else first_s
            due_s = begun_s + (word.time_s - first_s) / speed
            while time.monotonic() < due_s and not stopped():
                link.serve(min(due_s, time.monotonic() + LOOK_S))
            if stopped():
                break
            key = _key(link.fleet, word)
            if key not in say:
                say[key] = link.publisher(key, type(word), remember=REMEMBERED)
            say[key](word)
            said += 1
        return said


def _key(fleet: str, word: Word) -> str:
    if isinstance(word, Result):
        return keys.of_auction(fleet, word.auctioneer, "result")
    return keys.of_arm(fleet, word.arm, "state" if isinstance(word, State) else "event")


def _events(table: pa.Table) -> Iterator[ArmEvent]:
    numbers: dict[str, int] = {}
    for row in table.to_pylist():
        arm = row["arm"]
        if not arm:  # of the fleet, not of an arm
            continue
        numbers[arm] = number = row.get("number", numbers.get(arm, -1) + 1)
        value = row["value"]
        yield ArmEvent(
            arm=arm,
            number=number,
            time_s=row["time_s"],
            kind=row["kind"],
            job=row["job"],
            joint=row["joint"],
            value=None if value is None or value != value else value,
            reason=row["reason"],
        )


def _results(table: pa.Table) -> Iterator[Result]:
    of_status = JobStatus.__struct_fields__
    for row in table.to_pylist():
        status = {name: row.pop(name) for name in of_status}
        yield msgspec.convert({**row, "status": status}, Result)


def _refuse_namesakes(link: "Link", arms: list[str]) -> None:
    there: set[str] = set()
    link.watch(keys.of_every_arm(link.fleet, "alive"), lambda arm, here: there.add(arm) if here else None)
    deadline_s = time.monotonic() + LOOK_S
    while time.monotonic() < deadline_s:
        link.serve(deadline_s)
    if taken := sorted(there & set(arms)):
        raise FleetError(f"Arm '{taken[0]}' of fleet '{link.fleet}' is on the bus already; give another --fleet.")
