"""A recording of the bus: what every arm and auctioneer said, in Parquet parts that can be read while it goes on.

`recording.json` is the card; `telemetry-000001.parquet`, `events-…` and `results-…` are the parts, each written under a
temporary name and renamed, so a part that is there is whole. Words are kept once and in order, by the number that each
speaker gives them: what comes twice, as it does from caches after a break, is dropped, and what is missing is counted.
"""

import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.bus.messages import State
from fleet.bus.trade import ArmEvent, Result
from fleet.errors import FleetError
from fleet.robot import JOINTS

RECORDING_FORMAT = 1
CARD = "recording.json"
READINGS = ("q", "qd", "tau", "current_a", "temp_c")
MOST_ROWS = 200_000
"""Kept in memory at most; then a part is written before it is due."""

_FLOATS = [(f"{name}_{joint + 1}", pa.float32()) for name in READINGS for joint in range(JOINTS)]
SCHEMAS: dict[str, pa.Schema] = {
    "telemetry": pa.schema(
        [
            ("time_s", pa.float64()),
            ("arm", pa.string()),
            ("mode", pa.string()),
            ("tick", pa.int64()),
            ("headroom_k", pa.float32()),
            *_FLOATS,
        ]
    ),
    "events": pa.schema(
        [
            ("time_s", pa.float64()),
            ("number", pa.int64()),
            ("kind", pa.string()),
            ("arm", pa.string()),
            ("job", pa.string()),
            ("joint", pa.int8()),
            ("value", pa.float64()),
            ("reason", pa.string()),
        ]
    ),
    "results": pa.schema(
        [
            ("time_s", pa.float64()),
            ("number", pa.int64()),
            ("auctioneer", pa.string()),
            ("auction", pa.string()),
            ("job", pa.string()),
            ("state", pa.string()),
            ("arm", pa.string()),
            ("award", pa.string()),
            ("cycles", pa.int64()),
            ("finished_s", pa.float64()),
            ("d", pa.float64()),
            ("p_saturation", pa.float64()),
            ("reason", pa.string()),
        ]
    ),
}


@dataclass(eq=False)
class Count:
    """How many words of one speaker there were."""

    kept: int = 0
    twice: int = 0
    missed: int = 0
    """Numbers that were passed over: said and never heard, or said before the recording's link was there."""
    last: int = -1
    time_s: float = -math.inf
    """Of the last word."""


@dataclass(eq=False)
class Recorder:
    """Takes words, keeps each once, and writes them down in parts.

    Use `open` to begin one. A recording that was broken off goes on in the same folder with the next part.
    """

    folder: Path
    fleet: str
    parts: dict[str, int]
    counts: dict[str, Count] = field(default_factory=dict)
    _rows: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {kind: [] for kind in SCHEMAS})

    @classmethod
    def open(cls, folder: Path, fleet: str) -> "Recorder":
        """Begin, or go on with, a recording.

        Raises:
            FleetError: the folder cannot be written, holds something else, or a recording of another fleet.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FleetError(f"Cannot write to '{folder}': {error.strerror}.") from error
        card = read_card(folder) if (folder / CARD).exists() else None
        if card is None and any(folder.iterdir()):
            raise FleetError(f"'{folder}' holds other things; --out needs a new folder or an earlier recording.")
        if card is not None and card["fleet"] != fleet:
            raise FleetError(f"'{folder}' is a recording of fleet '{card['fleet']}', not of '{fleet}'.")
        recorder = cls(folder, fleet, {kind: len(part_files(folder, kind)) for kind in SCHEMAS})
        for name, numbers in (card or {}).get("speakers", {}).items():
            recorder.counts[name] = Count(**numbers)
        recorder._write_card("recording")
        return recorder

    @property
    def waiting(self) -> int:
        """Rows that are not on disk yet."""
        return sum(map(len, self._rows.values()))

    def state(self, arm: str, word: State) -> None:
        """Keep an arm's telemetry."""
        if not self._is_new(f"state of {arm}", word.tick, word.time_s):
            return
        row: dict[str, Any] = {name: getattr(word, name) for name in ("time_s", "arm", "mode", "tick", "headroom_k")}
        for name in READINGS:
            values = getattr(word, name)
            row |= {f"{name}_{joint + 1}": value for joint, value in enumerate(values[:JOINTS])}
        self._keep("telemetry", row)

    def event(self, arm: str, word: ArmEvent) -> None:
        """Keep what happened to an arm."""
        if self._is_new(f"events of {arm}", word.number, word.time_s):
            self._keep("events", msgspec.structs.asdict(word))

    def result(self, auctioneer: str, word: Result) -> None:
        """Keep what became of a job."""
        if self._is_new(f"results of {auctioneer}", word.number, word.time_s):
            flat = msgspec.structs.asdict(word)
            status = msgspec.structs.asdict(flat.pop("status"))
            self._keep("results", flat | status)

    def write(self, *, status: str = "recording") -> None:
        """Write what waits as new parts, and the card.

        Raises:
            FleetError: the disk refuses; nothing is lost, the next call tries again.
        """
        for kind, rows in self._rows.items():
            if not rows:
                continue
            table = pa.Table.from_pylist(rows, schema=SCHEMAS[kind])
            number = self.parts[kind] + 1
            self._put(f"{kind}-{number:06d}.parquet", lambda path, table=table: pq.write_table(table, path))
            self.parts[kind] = number
            rows.clear()
        self._write_card(status)

    def _is_new(self, speaker: str, number: int, time_s: float) -> bool:
        count = self.counts.setdefault(speaker, Count())
        if number <= count.last and time_s <= count.time_s:
            count.twice += 1
            return False
        if number > count.last and count.kept:  # a speaker that began anew counts from zero again
            count.missed += number - count.last - 1
        count.kept += 1
        count.last, count.time_s = number, time_s
        return True

    def _keep(self, kind: str, row: dict[str, Any]) -> None:
        self._rows[kind].append(row)
        if self.waiting >= MOST_ROWS:
            self.write()

    def _write_card(self, status: str) -> None:
        card = {
            "format": RECORDING_FORMAT,
            "status": status,
            "fleet": self.fleet,
            "parts": self.parts,
            "speakers": {name: vars(count) for name, count in sorted(self.counts.items()) if count.kept},
        }
        text = json.dumps(card, indent=1) + "\n"
        self._put(CARD, lambda path: path.write_text(text, encoding="utf-8"))

    def _put(self, name: str, write: Any) -> None:
        temporary = self.folder / f".{name}.part"
        try:
            write(temporary)
            os.replace(temporary, self.folder / name)
        except OSError as error:
            raise FleetError(f"Cannot write '{self.folder / name}': {error.strerror or error}.") from error


def read_card(folder: Path) -> dict[str, Any]:
    """What a recording says of itself.

    Raises:
        FleetError: it is none, or of another format.
    """
    try:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
        found, _, _ = card["format"], card["fleet"], card["parts"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FleetError(f"'{folder}' is no recording of the bus: {CARD} is missing or damaged.") from error
    if found != RECORDING_FORMAT:
        raise FleetError(f"'{folder}' is a recording of format {found}; this version reads {RECORDING_FORMAT}.")
    return card


def part_files(folder: Path, kind: str) -> list[Path]:
    """The parts of a kind that are there now, in order; each is whole."""
    return sorted(folder.glob(f"{kind}-*.parquet"))


def read_parts(folder: Path, kind: str) -> pa.Table:
    """All that is on disk of `telemetry`, `events` or `results` now, in order of time."""
    tables = [pq.read_table(path, schema=SCHEMAS[kind]) for path in part_files(folder, kind)]
    table = pa.concat_tables(tables) if tables else SCHEMAS[kind].empty_table()
    number = "tick" if kind == "telemetry" else "number"
    return table.sort_by([("time_s", "ascending"), (number, "ascending")])


def states(table: pa.Table, *, warning_c: float = 60.0) -> Iterator[State]:
    """The words that rows of telemetry were, of a recording or of a run; readings that were not there are left out.

    Args:
        warning_c: From which headroom is counted where none was recorded.
    """
    ticks: dict[str, int] = {}
    for batch in table.to_batches(max_chunksize=10_000):
        for row in batch.to_pylist():
            arm = row["arm"]
            ticks[arm] = tick = row.get("tick", ticks.get(arm, -1) + 1)
            readings: dict[str, Any] = {name: _joints(row, name) for name in READINGS}
            temps = readings["temp_c"]
            headroom_k = row.get("headroom_k", warning_c - max(temps) if temps else 0.0)
            yield State(arm=arm, tick=tick, time_s=row["time_s"], mode=row["mode"], headroom_k=headroom_k, **readings)


def _joints(row: dict[str, Any], name: str) -> tuple[float, ...]:
    values = [row.get(f"{name}_{joint + 1}") for joint in range(JOINTS)]
    known = tuple(value for value in values if value is not None)
    return known if len(known) == len(values) else ()
