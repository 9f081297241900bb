"""Record the messages of arms and auctioneers in Parquet parts, readable while the recording continues.

`recording.json` describes the recording; `telemetry-000001.parquet`, `events-…` and `results-…` are its parts, each
written atomically. Columns are the fields of the messages `State`, `ArmEvent` and `Result`. Every message is kept once
and in order, by the number that its sender gives it: repeated ones, which caches send after a reconnection, are
dropped, and missing ones are counted.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import inspect, structs

from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.messages import State
from fleet.errors import FleetError
from fleet.files import atomic_path
from fleet.robot import JOINTS

Message = State | ArmEvent | Result
Kind = Literal["telemetry", "events", "results"]
KINDS: tuple[Kind, ...] = ("telemetry", "events", "results")
RECORDING_FORMAT = 4
CARD = "recording.json"
SENSORS = ("q", "qd", "tau", "current_a", "temp_c", "housing_c")
MAX_ROWS = 200_000
"""Kept in memory; with more, a part is written before it is due."""
_COLUMNS = {inspect.IntType: pa.int64(), inspect.FloatType: pa.float64()}
_NUMBERS: dict[Kind, str] = {"telemetry": "tick", "events": "number", "results": "number"}
_LABELS: dict[Kind, str] = {"telemetry": "state", "events": "events", "results": "results"}


def _columns(message: type[msgspec.Struct]) -> dict[str, pa.DataType]:
    """Column types of the plain fields of a message, nested messages left out."""
    info = inspect.type_info(message)
    assert isinstance(info, inspect.StructType)
    columns: dict[str, pa.DataType] = {}
    for each in info.fields:
        kinds = each.type.types if isinstance(each.type, inspect.UnionType) else (each.type,)
        kind = next(kind for kind in kinds if not isinstance(kind, inspect.NoneType))
        if not isinstance(kind, inspect.StructType):
            columns[each.name] = _COLUMNS.get(type(kind), pa.string())
    return columns


_STATE = _columns(State)
"""Columns of a state; those of `SENSORS` have one for each joint."""
SCHEMAS: dict[Kind, pa.Schema] = {
    "telemetry": pa.schema(
        {"time_s": pa.float64(), **{name: kind for name, kind in _STATE.items() if name not in SENSORS}}
        | {f"{name}_{joint + 1}": pa.float32() for name in SENSORS for joint in range(JOINTS)}
    ),
    "events": pa.schema({"time_s": pa.float64(), **_columns(ArmEvent), "joint": pa.int8()}),
    "results": pa.schema({"time_s": pa.float64(), **_columns(Result), **_columns(JobStatus)}),
}


@dataclass(eq=False)
class Count:
    """Number of messages of one sender."""

    kept: int = 0
    twice: int = 0
    missed: int = 0
    """Numbers that were skipped: not received, or sent before the recording had joined."""
    last: int = -1
    time_s: float = -math.inf
    """Fleet time of the last message."""


class Card(msgspec.Struct, frozen=True):
    """Content of `recording.json`."""

    format: int
    status: str
    fleet: str
    parts: dict[Kind, int]
    """Number of parts."""
    speakers: dict[str, Count]


@dataclass(eq=False)
class Recorder:
    """Keeps every message once, and writes them in parts.

    Start one by `open`; an interrupted recording in the same folder is continued with its next part.
    """

    folder: Path
    fleet: str
    parts: dict[Kind, int]
    counts: dict[str, Count]
    _rows: dict[Kind, list[dict[str, object]]] = field(default_factory=lambda: {kind: [] for kind in KINDS})

    @classmethod
    def open(cls, folder: Path, fleet: str) -> "Recorder":
        """Start or continue a recording in an existing folder.

        Raises:
            FleetError: the folder cannot be written, holds something else, or a recording of another fleet.
        """
        card = read_card(folder) if (folder / CARD).exists() else None
        if card is None and any(folder.iterdir()):
            raise FleetError(f"'{folder}' holds other files; --out needs a new folder or an earlier recording.")
        if card is not None and card.fleet != fleet:
            raise FleetError(f"'{folder}' is a recording of fleet '{card.fleet}', not of '{fleet}'.")
        parts: dict[Kind, int] = {kind: len(part_files(folder, kind)) for kind in KINDS}
        recorder = cls(folder, fleet, parts, {} if card is None else card.speakers)
        recorder._write_card("recording")
        return recorder

    @property
    def waiting(self) -> int:
        """Number of rows that are not on disk yet."""
        return sum(map(len, self._rows.values()))

    def add(self, sender: str, message: Message) -> None:
        """Keep a message, unless it was kept before."""
        kind, row = _row(message)
        if self._is_new(f"{_LABELS[kind]} of {sender}", getattr(message, _NUMBERS[kind]), message.time_s):
            self._rows[kind].append(row)
            if self.waiting >= MAX_ROWS:
                self.write()

    def write(self, *, status: str = "recording") -> None:
        """Write waiting rows as new parts, and the card.

        Raises:
            FleetError: the disk refuses; no row is lost, and the next call tries again.
        """
        for kind, rows in self._rows.items():
            if not rows:
                continue
            table = pa.Table.from_pylist(rows, schema=SCHEMAS[kind])
            number = self.parts[kind] + 1
            with self._draft(f"{kind}-{number:06d}.parquet") as draft:
                pq.write_table(table, draft)
            self.parts[kind] = number
            rows.clear()
        self._write_card(status)

    def _is_new(self, sender: str, number: int, time_s: float) -> bool:
        count = self.counts.setdefault(sender, Count())
        if number <= count.last and time_s <= count.time_s:
            count.twice += 1
            return False
        if number > count.last and count.kept:  # a restarted sender counts from zero again
            count.missed += number - count.last - 1
        count.kept += 1
        count.last, count.time_s = number, time_s
        return True

    def _write_card(self, status: str) -> None:
        senders = {name: count for name, count in sorted(self.counts.items()) if count.kept}
        card = Card(RECORDING_FORMAT, status, self.fleet, self.parts, senders)
        with self._draft(CARD) as draft:
            draft.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=1) + b"\n")

    @contextmanager
    def _draft(self, name: str) -> Iterator[Path]:
        try:
            with atomic_path(self.folder / name) as draft:
                yield draft
        except OSError as error:
            raise FleetError(f"Cannot write '{self.folder / name}': {error.strerror or error}.") from error


def _row(message: Message) -> tuple[Kind, dict[str, object]]:
    """Kind and columns of a message."""
    if isinstance(message, ArmEvent):
        return "events", structs.asdict(message)
    if isinstance(message, Result):
        fields = structs.asdict(message)
        return "results", fields | structs.asdict(fields.pop("status"))
    row: dict[str, object] = {name: getattr(message, name) for name in _STATE if name not in SENSORS}
    for name in SENSORS:
        row |= {f"{name}_{joint + 1}": value for joint, value in enumerate(getattr(message, name)[:JOINTS])}
    return "telemetry", row


def read_card(folder: Path) -> Card:
    """Read the description of a recording.

    Raises:
        FleetError: it is no recording, or of another format.
    """
    try:
        card = msgspec.json.decode((folder / CARD).read_bytes(), type=Card)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FleetError(f"'{folder}' is no recording of the bus: {CARD} is missing or damaged.") from error
    if card.format != RECORDING_FORMAT:
        raise FleetError(
            f"'{folder}' is a recording of format {card.format}, of an earlier bus (and allocation_v0); this "
            f"version reads {RECORDING_FORMAT}. Record it again."
        )
    return card


def part_files(folder: Path, kind: Kind) -> list[Path]:
    """Paths of the parts of a kind, in order; each is complete."""
    return sorted(folder.glob(f"{kind}-*.parquet"))


def read_parts(folder: Path, kind: Kind) -> pa.Table:
    """Read all parts of a kind that are on disk now, in order of time."""
    tables = [pq.read_table(path, schema=SCHEMAS[kind]) for path in part_files(folder, kind)]
    table = pa.concat_tables(tables) if tables else SCHEMAS[kind].empty_table()
    return table.sort_by([("time_s", "ascending"), (_NUMBERS[kind], "ascending")])


def states(table: pa.Table, *, warning_c: float = 60.0) -> Iterator[State]:
    """Yield telemetry of a recording or a run as messages; sensors that were not recorded are left out.

    Args:
        warning_c: Warning limit of the headroom, where no headroom was recorded.
    """
    ticks: dict[str, int] = {}
    for batch in table.to_batches(max_chunksize=10_000):
        for row in batch.to_pylist():
            arm = row["arm"]
            ticks[arm] = tick = row.get("tick", ticks.get(arm, -1) + 1)
            sensors = {name: _joints(row, name) for name in SENSORS}
            temps_c = sensors["temp_c"]
            headroom_k = row.get("headroom_k", warning_c - max(temps_c) if temps_c else 0.0)
            fields = {name: row[name] for name in _STATE if row.get(name) is not None}
            yield msgspec.convert(fields | {"tick": tick, "headroom_k": headroom_k} | sensors, State)


def _joints(row: dict[str, float | None], name: str) -> tuple[float, ...]:
    """Values of a sensor, [joint]; empty if one is missing."""
    values = [row.get(f"{name}_{joint + 1}") for joint in range(JOINTS)]
    return () if None in values else cast(tuple[float, ...], tuple(values))
