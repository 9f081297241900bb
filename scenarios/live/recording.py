"""Format of a recording of the bus, and how it is read, also while it grows.

`recording.json` describes the recording. `telemetry-000001.parquet`, `events-…`, `results-…`, `operations-…` and
`gaps-…` are its parts; columns are fields of the messages `State`, `ArmEvent`, `Result` and `Operation`. What is not in
a part yet is in `open.journal`. A row of `gaps` names missing messages of a sender, and the reason.
"""

import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import inspect, structs

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ControlRequest, Operation
from fleet.errors import FleetError
from fleet.live.journal import Journal
from fleet.robot import JOINTS

Message = State | ArmEvent | Result | Operation
Kind = Literal["telemetry", "events", "results", "operations", "gaps"]
MESSAGES: tuple[Kind, ...] = ("telemetry", "events", "results", "operations")
KINDS: tuple[Kind, ...] = (*MESSAGES, "gaps")
SOURCES: Mapping[str, tuple[keys.Role, str, type[Message]]] = {
    "state": ("arm", "state", State),
    "events": ("arm", "event", ArmEvent),
    "results": ("auction", "result", Result),
    "operations": ("auction", "operation", Operation),
}
"""Keys that are recorded, and what is published there, by the name of the series in the card."""
RECORDING_FORMAT = 6
CARD, JOURNAL = "recording.json", "open.journal"
SENSORS = ("q", "qd", "tau", "current_a", "temp_c", "housing_c")
_COLUMNS = {
    inspect.IntType: pa.int64(),
    inspect.FloatType: pa.float64(),
    inspect.BoolType: pa.bool_(),
    inspect.VarTupleType: pa.list_(pa.string()),
}
_SORTED_BY: dict[Kind, str] = {"telemetry": "tick", "gaps": "first"}
"""Besides the time; `number` for the other kinds."""
_READS = 5
"""Attempts to read a recording between two commits of its recorder."""


class Gap(msgspec.Struct, frozen=True, tag="gap"):
    """Messages of a sender that are missing, by their numbers."""

    sender: str
    """As in the card: `state of arm_0`."""
    first: int
    last: int
    after_s: float
    """Fleet time of the message before the gap, and of the one after it."""
    time_s: float
    reason: str = ""
    """Why they are lost; "" while they are being fetched."""
    epoch: str = ""
    """In which the numbers were given; "" for unknown."""


class ReceivedState(msgspec.Struct, frozen=True, tag="telemetry"):
    """A message in the journal, as are the next three."""

    message: State


class ReceivedEvent(msgspec.Struct, frozen=True, tag="events"):
    message: ArmEvent


class ReceivedResult(msgspec.Struct, frozen=True, tag="results"):
    message: Result


class ReceivedOperation(msgspec.Struct, frozen=True, tag="operations"):
    message: Operation


class PartOpened(msgspec.Struct, frozen=True, tag="part"):
    """First record of the journal: what follows becomes the part of this number."""

    number: int


Received = ReceivedState | ReceivedEvent | ReceivedResult | ReceivedOperation
Record = Received | Gap | PartOpened


@dataclass(eq=False)
class Count:
    """Number of messages of one sender."""

    kept: int = 0
    twice: int = 0
    missed: int = 0
    """Messages that are known to be missing."""
    last: int = -1
    time_s: float = -math.inf
    """Fleet time of the last message."""
    epochs: tuple[str, ...] = ()
    """In which the sender gave its numbers."""


class Card(msgspec.Struct, frozen=True):
    """Content of `recording.json`."""

    format: int
    status: str
    fleet: str
    parts: int
    """Number of the last complete part."""
    speakers: dict[str, Count]
    sought: tuple[Gap, ...] = ()
    """Missing messages that are still being fetched."""
    rows: dict[Kind, int] = {}
    """Number of rows in all parts, by kind; none in recordings of earlier versions."""
    cell: Cell | None = None
    """As an auctioneer described it, without the work of the arms; None while none has."""


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
    "results": pa.schema(
        {"time_s": pa.float64(), **_columns(Result), **_columns(JobStatus), "offers": pa.string()}  # JSON
    ),
    "operations": pa.schema(
        {"time_s": pa.float64(), **_columns(Operation), **_columns(ControlRequest)}
        | {name: pa.string() for name in ("action", "job", "arm", "content")}
    ),
    "gaps": pa.schema({"time_s": pa.float64(), **_columns(Gap)}),
}


def to_record(message: Message) -> Received:
    """Wrap a message for the journal."""
    match message:
        case State():
            return ReceivedState(message)
        case ArmEvent():
            return ReceivedEvent(message)
        case Result():
            return ReceivedResult(message)
        case Operation():
            return ReceivedOperation(message)


def to_row(record: Received | Gap) -> tuple[Kind, dict[str, object]]:
    """Kind and columns of a record."""
    match record:
        case Gap():
            return "gaps", structs.asdict(record)
        case ReceivedEvent(message):
            return "events", structs.asdict(message)
        case ReceivedResult(message):
            fields = structs.asdict(message)
            fields["offers"] = msgspec.json.encode(message.offers).decode() if message.offers else ""
            return "results", fields | structs.asdict(fields.pop("status"))
        case ReceivedOperation(message):
            request = message.request
            action = cast(dict[str, object], msgspec.to_builtins(request.action))
            fields = structs.asdict(message) | {name: action.get(name, "") for name in ("action", "job", "arm")}
            fields |= {"request": request.request, "by": request.by, "content": msgspec.json.encode(request).decode()}
            return "operations", fields
        case ReceivedState(message):
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
        version = msgspec.json.decode((folder / CARD).read_bytes(), type=dict)["format"]
        card = msgspec.json.decode((folder / CARD).read_bytes(), type=Card) if version == RECORDING_FORMAT else None
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, KeyError) as error:
        raise FleetError(f"'{folder}' is no recording of the bus: {CARD} is missing or damaged.") from error
    if card is None:
        raise FleetError(
            f"'{folder}' is a recording of format {version}, of another version of thermofleet; this version reads "
            f"{RECORDING_FORMAT}. Record it again."
        )
    return card


def part_files(folder: Path, kind: Kind) -> list[Path]:
    """Paths of the complete parts of a kind, in order; a part without messages of a kind has no file of it."""
    paths = (part_file(folder, kind, number) for number in range(1, read_card(folder).parts + 1))
    return [path for path in paths if path.exists()]


def part_file(folder: Path, kind: Kind, number: int) -> Path:
    """Path of one part."""
    return folder / f"{kind}-{number:06d}.parquet"


def to_table(kind: Kind, rows: list[dict[str, object]]) -> pa.Table:
    """Rows as a table with the columns of their kind."""
    return pa.Table.from_pylist(rows, schema=SCHEMAS[kind])


def read_parts(folder: Path, kind: Kind) -> pa.Table:
    """Read all rows of a kind so far, in order of time.

    Raises:
        FleetError: it is no recording, or its journal or a part is damaged.
    """
    rows, tables = list[dict[str, object]](), list[pa.Table]()
    for _ in range(_READS):
        parts = read_card(folder).parts
        rows = [row for own, row in map(to_row, _open_records(folder, parts + 1)) if own == kind]
        tables = [_read_part(path, kind) for path in part_files(folder, kind)]
        if read_card(folder).parts == parts:
            break
    table = pa.concat_tables([*tables, to_table(kind, rows)])
    return table.sort_by([("time_s", "ascending"), (_SORTED_BY.get(kind, "number"), "ascending")])


def lost_rows(folder: Path) -> dict[Kind, int]:
    """Number of rows of parts that were removed since they were written, by kind; `read_parts` finds damaged ones.

    Raises:
        FleetError: it is no recording.
    """
    rows = read_card(folder).rows
    there = {kind: sum(pq.read_metadata(path).num_rows for path in part_files(folder, kind)) for kind in rows}
    return {kind: number - there[kind] for kind, number in rows.items() if number > there[kind]}


def _read_part(path: Path, kind: Kind) -> pa.Table:
    try:
        return pq.read_table(path, schema=SCHEMAS[kind], page_checksum_verification=True)
    except (OSError, pa.ArrowException) as error:
        raise FleetError(
            f"Cannot read '{path}': {error} Restore the file, or move it away to read the recording without it."
        ) from error


def _open_records(folder: Path, number: int) -> list[Received | Gap]:
    """Records of the part that is not complete yet, from a copy of its journal: the recorder has locked the file."""
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / JOURNAL
        try:
            shutil.copyfile(folder / JOURNAL, copy)
        except FileNotFoundError:
            return []
        with Journal(copy, Record) as journal:
            return records_of(journal, number)


def records_of(journal: Journal[Record], number: int) -> list[Received | Gap]:
    """Records of the part of this number in a journal; none if it is of an earlier part."""
    records = list(journal.records())
    if not records or records[0] != PartOpened(number):
        return []
    return [record for record in records[1:] if not isinstance(record, PartOpened)]


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
