"""Recordings of a live fleet: their format, how they are read, also while they grow, and replay on the bus.

`recording.json` describes the recording. `telemetry-000001.parquet`, `events-…`, `results-…`, `operations-…`,
`alarms-…` and `gaps-…` are its parts; columns are fields of the messages `State`, `ArmEvent`, `Result`, `Operation` and
`Alarm`. A row of `gaps` names missing messages of a sender, and the reason.
"""

import io
import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Literal, NamedTuple, cast

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import inspect, structs
from pyarrow.json import ParseOptions, ReadOptions, read_json

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.cell import Cell
from fleet.bus.protocol.keys import STATE_GAP_S
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Alarm, ControlRequest, Operation
from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import JOINTS

Message = State | ArmEvent | Result | Operation | Alarm
Kind = Literal["telemetry", "events", "results", "operations", "alarms", "gaps"]


class Source(NamedTuple):
    """A key of messages of a kind, and their type."""

    kind: Kind
    role: keys.Role
    topic: str
    message: type[Message]
    numbered: bool = True
    """Whether each sender numbers them."""


SOURCES = (
    Source("telemetry", "arm", "state", State),
    Source("events", "arm", "event", ArmEvent),
    Source("results", "auction", "result", Result),
    Source("operations", "auction", "operation", Operation),
    Source("operations", "arm", "operation", Operation, numbered=False),  # without an auctioneer
    Source("alarms", "monitor", "alarm", Alarm),
)
MESSAGE_KINDS: tuple[Kind, ...] = tuple(dict.fromkeys(source.kind for source in SOURCES))
KINDS: tuple[Kind, ...] = (*MESSAGE_KINDS, "gaps")
RECORDING_FORMAT = 7
CARD = "recording.json"
SENSORS = ("q", "qd", "tau", "current_a", "temp_c", "housing_c", "expected_c")
_COLUMNS = {
    inspect.IntType: pa.int64(),
    inspect.FloatType: pa.float64(),
    inspect.BoolType: pa.bool_(),
    inspect.VarTupleType: pa.list_(pa.string()),
}
_SORTED_BY: dict[Kind, str] = {"telemetry": "tick", "gaps": "first"}
"""Besides the time; `number` for the other kinds."""
TURN_S = 0.2
"""Real seconds between two checks for a stop request."""


class Gap(msgspec.Struct, frozen=True):
    """Messages of a sender that are missing, by their numbers."""

    sender: str
    """As in the card: `telemetry of arm_0`."""
    first: int
    last: int
    after_s: float
    """Fleet time of the message before the gap."""
    time_s: float
    """Fleet time of the message after the gap."""
    reason: str = ""
    """Why they are lost; "" while they are being fetched."""
    epoch: str = ""
    """Epoch of the numbers; "" if unknown."""


@dataclass(eq=False)
class SenderCount:
    """Number of messages of one sender."""

    kept: int = 0
    twice: int = 0
    missed: int = 0
    last: int = -1
    """Number of the last message."""
    time_s: float = -math.inf
    """Latest fleet time of a message since the last start of the sender."""
    epochs: tuple[str, ...] = ()
    """In the order of their first messages."""
    requests: tuple[tuple[float, str], ...] = ()
    """Fleet time and name of the last operations, if the sender does not number them."""


class RecordingCard(msgspec.Struct, frozen=True):
    """Content of `recording.json`."""

    format: int
    status: str
    fleet: str
    parts: int
    """Number of the last complete part."""
    senders: dict[str, SenderCount]
    """In the order of their first messages; an auctioneer counts as another sender in each epoch."""
    missing: tuple[Gap, ...] = ()
    """Messages that are still being fetched."""
    rows: dict[Kind, int] = {}
    """Number of rows in all parts, by kind."""
    cell: Cell | None = None
    """Description by an auctioneer, without the plans of the arms; None if there is none yet."""


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


_STATE = {name: kind for name, kind in _columns(State).items() if name not in SENSORS}
SCHEMAS: dict[Kind, pa.Schema] = {
    "telemetry": pa.schema(
        {"time_s": pa.float64(), **_STATE}
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
    "alarms": pa.schema({"time_s": pa.float64(), **_columns(Alarm)}),
    "gaps": pa.schema({"time_s": pa.float64(), **_columns(Gap)}),
}


def to_row(record: Message | Gap) -> tuple[Kind, dict[str, object]]:
    """Kind and columns of a message or a gap."""
    match record:
        case Gap():
            return "gaps", structs.asdict(record)
        case ArmEvent():
            return "events", structs.asdict(record)
        case Alarm():
            return "alarms", structs.asdict(record)
        case Result():
            fields = structs.asdict(record)
            fields["offers"] = msgspec.json.encode(record.offers).decode() if record.offers else ""
            return "results", fields | structs.asdict(fields.pop("status"))
        case Operation():
            request = record.request
            action = cast(dict[str, object], msgspec.to_builtins(request.action))
            fields = structs.asdict(record) | {name: action.get(name, "") for name in ("action", "job", "arm")}
            fields |= {"request": request.request, "by": request.by, "content": msgspec.json.encode(request).decode()}
            return "operations", fields
        case State():
            row: dict[str, object] = {name: getattr(record, name) for name in _STATE}
            for name in SENSORS:
                row |= {f"{name}_{joint + 1}": value for joint, value in enumerate(getattr(record, name)[:JOINTS])}
            return "telemetry", row


def read_card(folder: Path) -> RecordingCard:
    """Read the description of a recording.

    Raises:
        FleetError: it is no recording, or of another format.
    """
    try:
        text = (folder / CARD).read_bytes()
        version = msgspec.json.decode(text, type=dict)["format"]
        if version == RECORDING_FORMAT:
            return msgspec.json.decode(text, type=RecordingCard)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, KeyError) as error:
        raise FleetError(f"'{folder}' is no recording of the bus: {CARD} is missing or damaged.") from error
    raise FleetError(
        f"'{folder}' is a recording of format {version}, and this version of thermofleet reads format "
        f"{RECORDING_FORMAT}. Read it with the version that wrote it."
    )


def part_file(folder: Path, kind: Kind, number: int) -> Path:
    """Path of one part."""
    return folder / f"{kind}-{number:06d}.parquet"


def part_files(folder: Path, kind: Kind) -> list[Path]:
    """Paths of the complete parts of a kind, in order; a part without messages of a kind has no file of it."""
    paths = (part_file(folder, kind, number) for number in range(1, read_card(folder).parts + 1))
    return [path for path in paths if path.exists()]


def to_table(kind: Kind, rows: list[dict[str, object]]) -> pa.Table:
    """Rows, one or more, as a table with the columns of their kind."""
    lines = io.BytesIO(b"\n".join(map(msgspec.json.encode, rows)))  # `from_pylist` loads pandas: 40 MB
    options = ParseOptions(explicit_schema=SCHEMAS[kind], unexpected_field_behavior="ignore")
    return read_json(lines, ReadOptions(use_threads=False), options)


def read_parts(folder: Path, kind: Kind) -> pa.Table:
    """Read all rows of a kind, in order of time.

    Raises:
        FleetError: it is no recording, or a part is damaged.
    """
    tables = [_read_part(path, kind) for path in part_files(folder, kind)]
    table = pa.concat_tables([*tables, SCHEMAS[kind].empty_table()])
    return table.sort_by([("time_s", "ascending"), (_SORTED_BY.get(kind, "number"), "ascending")])


def _read_part(path: Path, kind: Kind) -> pa.Table:
    try:
        return pq.read_table(path, schema=SCHEMAS[kind], page_checksum_verification=True)
    except (OSError, pa.ArrowException) as error:
        raise FleetError(
            f"Cannot read '{path}': {error} Restore the file, or move it away to read the recording without it."
        ) from error


def lost_rows(folder: Path) -> dict[Kind, int]:
    """Number of rows of parts that were removed since they were written, by kind; `read_parts` finds damaged ones.

    Raises:
        FleetError: it is no recording.
    """
    rows = read_card(folder).rows
    there = {kind: sum(pq.read_metadata(path).num_rows for path in part_files(folder, kind)) for kind in rows}
    return {kind: number - there[kind] for kind, number in rows.items() if number > there[kind]}


@dataclass(frozen=True, eq=False)
class RecordedMessages:
    """The messages of a run or of a recording."""

    fleet: str
    telemetry: pa.Table
    events: pa.Table
    results: pa.Table
    operations: pa.Table
    alarms: pa.Table
    warning_c: float = 60.0
    """Warning limit of the headroom, if no headroom was recorded."""

    def __len__(self) -> int:
        tables = (self.telemetry, self.events, self.results, self.operations, self.alarms)
        return sum(table.num_rows for table in tables)

    def __iter__(self) -> Iterator[Message]:
        """All messages in order of time."""
        streams: tuple[Iterator[Message], ...] = (
            states(self.telemetry, warning_c=self.warning_c),
            _events(self.events),
            map(_result, self.results.to_pylist()),
            map(_operation, self.operations.to_pylist()),
            (msgspec.convert(row, Alarm) for row in self.alarms.to_pylist()),
        )
        return merge(*streams, key=lambda message: message.time_s)


def open_messages(folder: Path) -> RecordedMessages:
    """Read the folder of a run or of a recording, which may still grow.

    Raises:
        FleetError: it is neither, or a damaged run.
    """
    if (folder / CARD).exists():
        return RecordedMessages(read_card(folder).fleet, *(read_parts(folder, kind) for kind in MESSAGE_KINDS))
    if not (folder / "run.json").exists():
        raise FleetError(f"'{folder}' is neither the folder of a run (run.json) nor a recording of the bus ({CARD}).")
    from scenarios.run.log import OF_EVENTS, open_run, record_table  # loads the environment: no part of a recorder

    run, none = open_run(folder), pa.table({})
    events = record_table(Event, run.events, **OF_EVENTS)
    return RecordedMessages(run.scenario.name, run.telemetry, events, none, none, none, run.limits.warning_c)


def alarms_of(folder: Path) -> list[Alarm]:
    """Every change of an alarm in a recording, in order; none of a folder without one yet."""
    if not (folder / CARD).exists():
        return []
    return [msgspec.convert(row, Alarm) for row in read_parts(folder, "alarms").to_pylist()]


def states(table: pa.Table, *, warning_c: float = 60.0) -> Iterator[State]:
    """Yield telemetry of a recording or a run as messages; sensors that were not recorded are left out.

    Args:
        warning_c: Warning limit of the headroom, if no headroom was recorded.
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


def _events(table: pa.Table) -> Iterator[ArmEvent]:
    numbers: dict[str, int] = {}
    for row in table.to_pylist():
        arm = row["arm"]
        if arm:  # otherwise an event of the whole fleet
            numbers[arm] = row.get("number", numbers.get(arm, -1) + 1)
            value = None if row["value"] != row["value"] else row["value"]  # NaN in a run
            yield msgspec.convert({**row, "number": numbers[arm], "value": value}, ArmEvent)


def _result(row: dict[str, object]) -> Result:
    status = {name: row[name] for name in JobStatus.__struct_fields__}
    offers = json.loads(str(row["offers"] or "[]"))
    return msgspec.convert({**row, "status": status, "offers": offers}, Result)


def _operation(row: dict[str, object]) -> Operation:
    request = msgspec.json.decode(str(row["content"]), type=ControlRequest)
    return msgspec.convert({**row, "request": request}, Operation)


class ReplayCount(NamedTuple):
    """Number of messages of a replay."""

    published: int
    left_out: int
    """States that came less than `STATE_GAP_S` after the one before."""
    early: int = 0
    """Published messages of a time before the first state; a recorder gets them from caches when it begins."""


def replay(
    messages: RecordedMessages,
    link: BusClient,
    *,
    connect: Callable[[], BusClient],
    speed: float,
    stopped: Callable[[], bool],
) -> ReplayCount:
    """Publish messages at their own pace times `speed` from the first state on, with the tokens of their arms.

    Messages of a time before the first state are published at once. A router limits the states of each session, so
    every arm has its own, as a running arm.

    Args:
        connect: Makes another client of the fleet, not open yet.

    Raises:
        FleetError: an arm of the recording is present on the bus.
    """
    arms = sorted(set(messages.telemetry["arm"].to_pylist())) if messages.telemetry.num_rows else []
    present = link.tokens(keys.of_every_arm(link.fleet, "alive"))
    if taken := sorted(present & set(arms)):
        raise FleetError(f"Arm '{taken[0]}' of fleet '{link.fleet}' is on the bus already. Give another --fleet.")
    first_s = min(messages.telemetry["time_s"].to_pylist()) if arms else None
    with ExitStack() as resources:
        links = {arm: resources.enter_context(connect()) for arm in arms}
        for arm in arms:
            links[arm].declare_token(keys.of_arm(link.fleet, arm, "alive"))
        publishers: dict[str, Callable[[Message], None]] = {}
        last_due_s: dict[str, float] = {}  # of the states, by arm
        start_s, published, left_out, early = time.monotonic(), 0, 0, 0
        for message in messages:
            first_s = message.time_s if first_s is None else first_s
            due_s = start_s + (message.time_s - first_s) / speed
            while time.monotonic() < due_s and not stopped():
                link.serve(min(due_s, time.monotonic() + TURN_S))
            if stopped():
                break
            match message:
                case Result(auctioneer=sender) | Operation(auctioneer=sender) | Alarm(monitor=sender):
                    pass
                case ArmEvent(arm=sender):
                    pass
                case State(arm=sender):
                    if due_s - last_due_s.get(sender, -math.inf) < STATE_GAP_S:
                        left_out += 1
                        continue
                    last_due_s[sender] = due_s
            sources = [source for source in SOURCES if isinstance(message, source.message)]
            source = next((each for each in sources if (each.role == "arm") == (sender in arms)), sources[0])
            key = str(keys.ParsedKey(link.fleet, source.role, sender, source.topic))
            if key not in publishers:
                publishers[key] = links.get(sender, link).publisher(key, source.message)
            publishers[key](message)
            published += 1
            early += message.time_s < first_s
    return ReplayCount(published, left_out, early)
