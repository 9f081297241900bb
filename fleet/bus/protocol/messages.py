"""Messages that arms publish about themselves, and how every message is encoded: JSON with a versioned schema.

A message is validated when it is constructed, so by its sender and by its reader: NaN and infinity are refused (a JSON
writer would silently turn them into `null`), an unknown score is `null`. Unknown fields are ignored, so a later version
may add some, but not in a `PersonRequest`: there they are refused, as they may be mistyped. A change that a reader of
this version could misread takes a new version in the schema name.
"""

import re
from collections.abc import Iterable, Iterator
from functools import cache
from math import isfinite
from typing import (
    Annotated,
    Any,  # a type
    TypeVar,
    cast,
)

import msgspec
from msgspec import inspect

from fleet.errors import BusError, nearest, printable
from fleet.telemetry import Mode

VERSION = 4
CHANGED = {"ActRequest": 5}
"""Version of each message that has changed since, by name."""
MOST_BYTES = 65_536
"""Largest message with its attachment, in bytes; a request to a policy may be larger."""
LISTED_BYTES = 60_000
"""Size to which a list in a message is cut, below `MOST_BYTES`."""
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=512)]
Person = Annotated[str, msgspec.Meta(max_length=128)]
"""Who requests something: "", or a name as of a job."""
LEAST, MOST, MOST_COUNT = -1e12, 1e12, 10**15
Count = Annotated[int, msgspec.Meta(ge=0, le=MOST_COUNT)]
Number = Annotated[float, msgspec.Meta(ge=LEAST, le=MOST)]
"""Any quantity without bounds of its own: no sum or product of a few of them overflows."""
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Duration = Annotated[float, msgspec.Meta(ge=0, le=MOST)]
Difficulty = Annotated[float, msgspec.Meta(ge=0, le=MOST)]
Celsius = Annotated[float, msgspec.Meta(ge=-273.15, le=1000)]


class MalformedMessage(BusError, ValueError):
    """A message that does not fit its key or its schema."""


class FiniteStruct(msgspec.Struct, frozen=True):
    """A message that refuses NaN and infinity, which JSON cannot express, when it is constructed."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value: float | tuple[float, ...] | str | None = getattr(self, name)  # and others
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not isfinite(number):
                    raise ValueError(f"{type(self).__name__}.{name} must be finite (got {number}).")


class PersonRequest(msgspec.Struct, frozen=True):
    """A request that people send: `decode` refuses fields that it does not have."""


def _check_length(message: msgspec.Struct, field: str, item: str, count: int) -> None:
    values = getattr(message, field)
    if len(values) != count:
        raise ValueError(f"{type(message).__name__}.{field} needs one value per {item} ({count}, got {len(values)}).")


class State(FiniteStruct, frozen=True, omit_defaults=True):
    """Telemetry of an arm; only the newest is valid. Quantities that are not measured are omitted."""

    arm: Name
    tick: Count
    """Counts the states of this arm; in a simulated shift, state and difficulty of one step have the same tick."""
    time_s: Number
    mode: Mode
    temp_c: tuple[Number, ...]
    """Measured motor temperatures, [joint]."""
    headroom_k: Number
    """Warning limit minus hottest motor."""
    job: str = ""
    """The current job; "" for none."""
    space: str = ""
    """Name of the space that the arm takes while it is away from home; "" at home, or if not reported."""
    busy_s: Duration = 0.0
    """Time until it is home with its current job done; 0 for unknown while it has a job, whose status then has no
    `finish_s`."""
    housing_c: tuple[Celsius, ...] = ()
    """Estimated housing temperatures, which have no sensor, [joint]."""
    ambient_c: Celsius | None = None
    """Measured ambient temperature at the arm."""
    job_value: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 0.0
    """Value of the current job."""
    job_cycles_left: Count = 0
    """Cycles of the current job that are not done."""
    job_peak_c: Celsius | None = None
    """Predicted temperature of the hottest motor in the rest of the current job."""
    job_p_saturation: Share | None = None
    """Probability that a motor passes the warning limit in the rest of the current job."""
    q: tuple[Number, ...] = ()
    """rad, [joint]."""
    qd: tuple[Number, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[Number, ...] = ()
    """N·m at the joint output, [joint]."""
    current_a: tuple[Number, ...] = ()
    """[joint]."""
    epoch: str = ""
    """As in `Clock`, of its time; "" for unknown."""
    motion_difficulty: Number | None = None
    """d of the last executed motion, of any job or of none, by the arm's twin."""
    break_in_s: Duration | None = None
    """Time until the arm's next break begins, 0 during one; left out without any. In a break it takes no jobs."""
    expected_c: tuple[Celsius, ...] = ()
    """Motor temperatures that the arm's thermal network yields for the heat that it measures, [joint]."""
    leaving: bool = False
    """The arm ends in order and takes no more jobs. If it has neither job nor space, this may be its last state."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("housing_c", "expected_c", "q", "qd", "tau", "current_a"):
            if getattr(self, name):
                _check_length(self, name, "joint", len(self.temp_c))


class DifficultyScores(FiniteStruct, frozen=True, omit_defaults=True):
    """Difficulty of the open jobs for an arm, by its twin, and its bids for them.

    A bid is what a peer needs to compute the worth of each plan for the arm: it knows the value of the job, and the
    headroom of the arm by its `State`. What a worth weighs against heat is up to each policy, so no worth is sent.
    """

    arm: Name
    tick: Count
    """Counts the scores of this arm; in a simulated shift, state and difficulty of one step have the same tick."""
    time_s: Number
    twin: str
    """Version of the twin that predicted."""
    jobs: tuple[Name, ...]
    """Names of the open jobs, each once; the columns of the lists below."""
    difficulty: tuple[Difficulty | None, ...]
    """d, [job]; null where the arm has no score or cannot do the job."""
    p_saturation: tuple[Share | None, ...]
    """Probability that a motor passes the warning limit, [job]; null where unknown."""
    peak_c: tuple[Celsius | None, ...] = ()
    """Predicted temperature of the hottest motor during the job, [job]; null where unknown, empty if all are."""
    bid_duration_s: tuple[Duration | None, ...] = ()
    """Bids: time that each plan for each job takes, the plans of the first job first, as many for each job; null where
    there is none. Empty, like the next one, if the arm shares no bids."""
    bid_peak_c: tuple[Celsius | None, ...] = ()
    """Predicted temperature of the hottest motor in each of these plans; null where unknown."""
    bid_p_saturation: tuple[Share | None, ...] = ()
    """Probability that a motor passes the warning limit in each of these plans; null where unknown. Empty if the peaks
    of all plans are known: the probability follows from them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        bids = len(self.bid_duration_s)
        if bids and (not self.jobs or bids % len(self.jobs)):
            raise ValueError(
                f"DifficultyScores.bid_duration_s needs equally many plans for each of {len(self.jobs)} job(s) (got "
                f"{bids} values)."
            )
        _check_length(self, "bid_peak_c", "plan", bids)
        if self.bid_p_saturation:
            _check_length(self, "bid_p_saturation", "plan", bids)
        for name in ("difficulty", "p_saturation", *(["peak_c"] if self.peak_c else [])):
            _check_length(self, name, "job", len(self.jobs))
        if len(set(self.jobs)) != len(self.jobs):
            raise ValueError(f"DifficultyScores.jobs names a job twice (got {self.jobs}).")


class Info(msgspec.Struct, frozen=True):
    """Constants of an arm: published at its start, and again when they change."""

    arm: Name
    joints: Annotated[int, msgspec.Meta(ge=1, le=64)]
    twin: str
    """Version of its twin."""


class Refusal(msgspec.Struct, frozen=True):
    """Refused request: a reply under the key of the replier instead of the regular one.

    An ordinary reply. Zenoh's error replies have the key of the query; if it has a wildcard, a router with access
    control drops them.
    """

    reason: str
    """A sentence."""
    temporary: bool = False
    """Whether the same request may be accepted later, without a change by its sender."""


Message = TypeVar("Message", bound=msgspec.Struct)


@cache
def _decoder(kind: type[Message]) -> msgspec.json.Decoder[Message]:
    return msgspec.json.Decoder(kind)


def schema(kind: type[msgspec.Struct]) -> str:
    """Name and version of a message's schema, for example `thermofleet.State.v4`."""
    return f"thermofleet.{kind.__name__}.v{CHANGED.get(kind.__name__, VERSION)}"


@cache
def encoding(kind: type[msgspec.Struct]) -> str:
    """The encoding that travels with every message, for example `application/json;thermofleet.State.v4`."""
    return f"application/json;{schema(kind)}"


encode = msgspec.json.Encoder().encode
"""The message as JSON; floats come back exactly."""


def decode(kind: type[Message], payload: bytes, sent_encoding: str | None = None) -> Message:
    """The message of this type in a payload.

    Args:
        sent_encoding: The encoding that it was sent with; None for a payload from elsewhere, of any size.

    Raises:
        MalformedMessage: larger than `MOST_BYTES`, another encoding, not JSON, not of this type, or a `PersonRequest`
            with an unknown field.
    """
    if sent_encoding is not None:
        if len(payload) > MOST_BYTES:
            raise MalformedMessage(f"It has {len(payload):,} bytes, and at most {MOST_BYTES:,} are allowed.")
        if sent_encoding != encoding(kind):
            raise MalformedMessage(f"It is encoded as '{sent_encoding}', not as '{encoding(kind)}'.")
    try:
        message: Message = _decoder(kind).decode(payload)
        unknown = unknown_field(kind, payload) if issubclass(kind, PersonRequest) else ""
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MalformedMessage(f"Not a {schema(kind)}: {_problem(kind, payload, str(error))}") from error
    if unknown:
        raise MalformedMessage(f"Not a {schema(kind)}: {unknown}")
    return message


MOST_BEFORE = 2000
"""Bytes before a wrong number in which the name of its field is sought."""
_NO_NUMBER = re.compile(rb"(?<=[\s:,\[])-?(?:nan|inf(?:inity)?)\b", re.IGNORECASE)
_AT_BYTE = re.compile(r"\(byte (\d+)\)$")
_LAST_FIELD = re.compile(rb'"((?:[^"\\]|\\.){1,100})"\s*:[^":{}]*$')


def _problem(kind: type, payload: bytes, error: str) -> str:
    """An error of decoding, with the allowed values, or the field of a number that JSON cannot express."""
    at = int(match[1]) if (match := _AT_BYTE.search(error)) else -1
    for number in _NO_NUMBER.finditer(payload, max(0, at - 5), at + 10) if at >= 0 else ():
        if number.start() <= at <= number.end() + 1:
            field = _LAST_FIELD.search(payload, max(0, number.start() - MOST_BEFORE), number.start())
            where = f"'{field[1].decode(errors='replace')}'" if field else "a number"
            return f"{where} is {number[0].decode()} (byte {at}), which JSON does not have; send a finite number"
    return f"{error}{_allowed(kind, error)}"


def _allowed(kind: type, error: str) -> str:
    """The values that are allowed where an error of decoding found another one; "" for errors of other kinds."""
    _, _, path = error.partition(" - at `$.")
    if not (error.startswith("Invalid ") and path):
        return ""
    at: list[inspect.Type] = [inspect.type_info(kind)]
    for name in path.rstrip("`").split("."):
        name, _, of_list = name.partition("[")
        structs = [each for each in _alternatives(at) if isinstance(each, inspect.StructType)]
        tags = [each.tag for each in structs if each.tag_field == name and not hasattr(each.cls, "PUBLISHED_ONLY")]
        if tags:
            return f". Allowed: {', '.join(sorted(map(str, tags)))}"
        at = [field.type for each in structs for field in each.fields if field.encode_name == name]
        if of_list:
            lists = [each for each in _alternatives(at) if isinstance(each, inspect.VarTupleType | inspect.DictType)]
            at = [each.value_type if isinstance(each, inspect.DictType) else each.item_type for each in lists]
    values = [value for each in _alternatives(at) if isinstance(each, inspect.LiteralType) for value in each.values]
    return f". Allowed: {', '.join(sorted(map(str, values)))}" if values else ""


def unknown_field(kind: Any, payload: bytes) -> str:
    """Sentence that names a field which a JSON value of this type does not have, and the allowed ones; "" for none.

    Args:
        kind: Any type that msgspec decodes.
    """
    return _unknown_field([inspect.type_info(kind)], msgspec.json.decode(payload), "")


def _unknown_field(types: Iterable[inspect.Type], value: object, path: str) -> str:
    parts: Iterable[tuple[inspect.Type, object, str]] = ()
    for each in _alternatives(types):
        if isinstance(each, inspect.StructType) and isinstance(value, dict):
            fields = cast("dict[str, object]", value)
            if each.tag_field and fields.get(each.tag_field) != each.tag:
                continue
            inner = {field.encode_name: field.type for field in each.fields}
            allowed = [*inner, each.tag_field] if each.tag_field else [*inner]
            for name in fields:
                if name not in allowed:
                    where = f" in {path}" if path else ""
                    return f"Unknown field '{printable(name)}'{where}{nearest(name, allowed)}"
            at = f"{path}." if path else ""
            parts = [(inner[name], part, f"{at}{name}") for name, part in fields.items() if name in inner]
        elif isinstance(each, inspect.ListType | inspect.VarTupleType) and isinstance(value, list):
            parts = [(each.item_type, part, f"{path}[{i}]") for i, part in enumerate(cast("list[object]", value))]
    return next(filter(None, (_unknown_field([kind], part, where) for kind, part, where in parts)), "")


def _alternatives(types: Iterable[inspect.Type]) -> Iterator[inspect.Type]:
    """The types themselves, with those of unions one by one, and without their limits."""
    for each in types:
        if isinstance(each, inspect.UnionType):
            yield from _alternatives(each.types)
        elif isinstance(each, inspect.Metadata):
            yield from _alternatives([each.type])
        else:
            yield each


def check_name(message: msgspec.Struct, name: str, field: str) -> None:
    """Refuse a message whose field `field` is not the name in its key.

    Raises:
        MalformedMessage: it names another.
    """
    claimed = getattr(message, field)
    if claimed != name:
        raise MalformedMessage(f"A {schema(type(message))} under the key of '{name}' claims to be by '{claimed}'.")
