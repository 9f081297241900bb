"""Parse the content of scenario files: a `Scenario`, or an error of one sentence; and hash scenarios.

`kind` is a type annotation such as `float | None`, for which Python has no type (hence Any).
"""

import dataclasses
import hashlib
import json
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from itertools import chain, combinations, pairwise
from math import dist, inf, isclose, isfinite, nan
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from fleet.errors import ScenarioError, distinguish, listed, nearest, printable
from scenarios.spec.calendar import check_breaks, with_calendar, zone_of
from scenarios.spec.job_table import cycle_of, read_bytes, read_job_table, shift_begin, stream_fields, text_of
from scenarios.spec.mesh_file import with_meshes
from scenarios.spec.schema import JobStream, Scenario
from scenarios.spec.units import check_ambient, check_times, check_units

_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "datetime": "a date with a time",
    "date": "a date",
    "time": "a time of day",
    "null": "nothing",
}
"""Plain words for msgspec's type names."""
_LENGTH = re.compile(r"Expected `array` of length (\d+), got (\d+)")
_TYPE = re.compile(r"Expected `([^`]+)`, got `([^`]+)`")
_MISSING = re.compile(r"Object missing required field `([^`]+)`")
_OWN_FIELD = re.compile(r"[A-Z]\w*\.(\w.*)", re.DOTALL)
"""`Robot.tool_kg must be >= 0 (got -1.0).`"""
_OWN = re.compile(r"[A-Z]\w* (needs? .*)", re.DOTALL)
"""`Arrivals needs 0 <= start_s <= stop_s (got 5.0, 1.0).`"""
_STEP = re.compile(r"\[(\d+)\]|\.?(\w+)")


def readable_error(error: msgspec.ValidationError, raw: object, schema: Any) -> str:
    """One sentence that begins with the place: `arms[0].tool_kg: expected a number, got a text ('heavy').`

    Args:
        error: Raised by `msgspec.convert(raw, schema)`.
        raw: Parsed TOML.
        schema: Annotation of the type to convert to.
    """
    text, _, place = str(error).partition(" - at `$")
    place = place.strip("`").lstrip(".")
    text = text.rstrip(".")
    if match := _OWN_FIELD.fullmatch(text):
        return f"{place}.{match[1]}{'' if match[1].endswith('?') else '.'}".lstrip(".")
    if match := _OWN.fullmatch(text):
        return f"{place} {match[1]}.".lstrip()
    lead = f"{place}: " if place else ""
    value, kind = _follow(raw, schema, place)
    if match := _MISSING.fullmatch(text):
        return f"{lead}'{match[1]}' is missing."
    if match := _LENGTH.fullmatch(text):
        return f"{lead}expected {match[1]} values, got {match[2]}."
    if match := _TYPE.fullmatch(text):
        wanted = [_WORDS.get(name, name) for name in match[1].split(" | ") if name != "null"]
        return f"{lead}expected {' or '.join(wanted)}, got {_WORDS.get(match[2], match[2])}{_shown(value)}."
    if text.startswith("Invalid enum value"):
        if place.endswith(".unit"):  # the most similar unit has another length
            return (
                f"{lead}'{value}' is not allowed. Allowed: {', '.join(get_args(kind))}. Export the file in one of them."
            )
        return f"{lead}'{value}' is not allowed{nearest(str(value), get_args(kind))}"
    return f"{lead}{text[:1].lower()}{text[1:]}."


def check_finite(raw: object, file: str, place: str = "") -> None:
    """Check that no number, at any depth, is `nan` or `inf`, which TOML allows.

    Raises:
        ScenarioError: names the place.
    """
    if isinstance(raw, Mapping):
        for key, value in raw.items():
            check_finite(value, file, f"{place}.{key}" if place else key)
    elif isinstance(raw, list | tuple):
        for i, value in enumerate(raw):
            check_finite(value, file, f"{place}[{i}]")
    elif isinstance(raw, float) and not math.isfinite(raw):
        raise ScenarioError(f"{file}: {place}: expected a finite number, got {raw}.")


def choose(what: str, name: str, kind: Any) -> Any:
    """Return the name if it is one of a Literal type.

    Raises:
        ScenarioError: names the nearest allowed one.
    """
    if name not in get_args(kind):
        raise ScenarioError(f"No {what} '{name}'{nearest(str(name), get_args(kind))}")
    return name


def plain_kind(kind: Any) -> Any:
    """A type without its `| None`."""
    if get_origin(kind) in (Union, UnionType):
        rest = [arg for arg in get_args(kind) if arg is not type(None)]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _follow(raw: object, kind: Any, place: str) -> tuple[object, Any]:
    """Value and type at a place such as `arms[0].tool_kg`; None if there is no such place."""
    for index, name in _STEP.findall(place):
        kind = plain_kind(kind)
        if name:
            raw = raw.get(name) if isinstance(raw, Mapping) else None
            kind = get_type_hints(kind).get(name) if is_dataclass(kind) else None
        else:
            inside = get_args(kind)
            raw = raw[int(index)] if isinstance(raw, list | tuple) and int(index) < len(raw) else None
            each = inside[:1] if inside[-1:] == (Ellipsis,) else inside[int(index) :]
            kind = each[0] if each else None
    kind = plain_kind(kind)
    return raw, kind if get_origin(kind) is Literal else None


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return f" ({str(value).lower()})"
    if isinstance(value, str | int | float):
        return f" ({value!r})"
    return ""


MOST_S = 1e9
"""Longest shift with a job table."""
MOST_JOBS = 100_000
"""Largest number of expected jobs in a shift: a mistyped gap would give billions."""
APART_M = 0.2
"""Smallest distance of two bases: a Gen3 base is 0.09 m wide, and its first joint must turn freely."""


def parse_toml(content: bytes, path: Path) -> Scenario:
    """The scenario in the content of a file; `path` names it in errors and locates the files it refers to.

    Raises:
        ScenarioError: place, what was given and what is allowed.
    """
    try:
        try:
            raw = tomllib.loads(content.decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            raise ScenarioError(f"{path.name}: not a UTF-8 text file.") from error
        except ValueError as error:  # also an integer with too many digits
            reason = str(error).partition(";")[0]
            raise ScenarioError(f"{path.name}: not valid TOML: {printable(reason)}.") from error
        scenario = parse_scenario({"name": path.stem, **raw}, path)
    except RecursionError as error:
        raise ScenarioError(f"{path.name}: its tables are nested too deeply; a scenario needs 4 levels.") from error
    check_ambient(scenario.ambient.points, scenario.horizon_s, f"{path.name}: ambient.points")
    for i, stream in enumerate(scenario.jobs):
        if stream.numbered and stream.arrivals.times_s is not None:
            times = [time + stream.arrivals.start_s for time in stream.arrivals.times_s]
            check_times(times, scenario.horizon_s, f"{path.name}: jobs[{i}].arrivals of '{stream.name}'")
    return scenario


def parse_cell(content: bytes, path: Path) -> Scenario:
    """Arms, places and fixtures of a scenario file, with one hold at each place in place of its jobs.

    Raises:
        ScenarioError: these parts are invalid, too.
    """
    try:
        raw = tomllib.loads(content.decode("utf-8-sig"))
        holds = [
            {
                "name": place["name"],
                "kind": "hold",
                "places": [place["name"]],
                "arrivals": {"kind": "batch", "count": 1},
            }
            for place in raw["places"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise ScenarioError(f"{path.name} has no valid places.") from error
    cell = {key: raw[key] for key in ("arms", "places", "fixtures", "clearance_m") if key in raw}
    return parse_scenario({"name": path.stem, "description": "", "horizon_s": 3600, **cell, "jobs": holds}, path)


def parse_scenario(raw: Mapping[str, object], path: Path) -> Scenario:
    """The scenario of a parsed TOML file; `path` names the file in errors and locates the files it refers to."""
    raw = _with_tables(raw, path)
    _known_keys(raw, Scenario, path.name, "")
    check_finite(raw, path.name)
    check_units(raw, path.name)
    raw = {"arms": (), "places": (), "jobs": (), **raw}  # an absent list and an empty one give the same error
    try:
        scenario = msgspec.convert(raw, Scenario, strict=True)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{path.name}: {readable_error(error, raw, Scenario)}") from error
    _check(scenario, path)
    return with_meshes(_with_traces(scenario, path), path)


def _number(value: object) -> float:
    """A value of a file; NaN if it is no number."""
    return value if isinstance(value, int | float) else nan


def _with_tables(raw: Mapping[str, object], path: Path) -> Mapping[str, object]:
    """The parsed file with times in seconds, a stream for each row of its job tables, and the begin as a text."""
    zone = zone_of(raw.get("time_zone"), f"{path.name}: time_zone")
    begin = shift_begin(raw.get("shift_begin"), f"{path.name}: shift_begin", zone)
    places, horizon_s = raw.get("places"), _number(raw.get("horizon_s"))
    least_s = _number(raw.get("decision_interval_s", Scenario.decision_interval_s))
    # Their own errors are reported when the scenario is made.
    horizon_s = float(horizon_s) if 0 < horizon_s < MOST_S and least_s <= horizon_s else 0.0
    raw = with_calendar(raw, begin, horizon_s, path.name) | {"shift_begin": begin and begin.isoformat()}
    jobs = raw.get("jobs")
    if not isinstance(jobs, list) or not any(isinstance(each, Mapping) and "table" in each for each in jobs):
        return raw
    tables = [place for place in places if isinstance(place, Mapping)] if isinstance(places, list) else []
    names = [place["name"] for place in tables if isinstance(place.get("name"), str)]
    streams, more, errors = list(jobs), list[object](), list[str]()
    for i, each in enumerate(jobs):
        if not isinstance(each, Mapping) or "table" not in each:
            continue
        where = f"{path.name}: jobs[{i}]"
        if len(each) > 1 or not isinstance(each["table"], str):
            raise ScenarioError(f'{where}: a job table is table = "FILE", without other keys (got {listed(each)}).')
        file = path.parent / each["table"]
        where = f"{where}.table: '{file.name}'"
        try:
            rows = read_job_table(file, where, begin=begin, horizon_s=horizon_s or inf, places=names, closed=True)
        except ScenarioError as error:
            errors.append(str(error))
            continue
        # The others follow at the end, so that each entry of the file keeps its index.
        streams[i], *rest = [stream_fields(row, horizon_s, f"'{file.name}', row {n}") for n, row in rows.items()]
        more += rest
    if errors:
        raise ScenarioError("\n".join(errors))
    return {**raw, "jobs": streams + more}


def override(scenario: Scenario, **changes: object) -> Scenario:
    """A copy of the scenario with some top-level fields changed.

    Raises:
        ScenarioError: there is no such field, or its value is not allowed.
    """
    where = f"{scenario.name} with overrides"
    try:
        plain = plain_values(changes)
    except TypeError as error:
        raise ScenarioError(f"{where}: {error}.") from error
    return parse_scenario({**msgspec.to_builtins(scenario), **plain}, Path(where))


def plain_values(fields: Mapping[str, object]) -> dict[str, Any]:
    """The values of a mapping as those of a TOML or JSON file.

    Raises:
        TypeError: a value is neither a number, a text, a list nor a table.
    """
    return msgspec.to_builtins(dict(fields), enc_hook=_plain)


def _plain(value: object) -> object:
    """A NumPy scalar or array as Python's own."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"expected numbers, texts, lists and tables, got {value!r}")


def _known_keys(raw: object, kind: Any, file: str, place: str) -> None:
    """Check that the dataclass `kind` (an annotation, hence Any) has all the keys, at every depth."""
    kind = plain_kind(kind)
    if get_origin(kind) is tuple and isinstance(raw, list):
        for i, item in enumerate(raw):
            _known_keys(item, get_args(kind)[0], file, f"{place}[{i}]")
    if not dataclasses.is_dataclass(kind) or not isinstance(raw, Mapping):
        return
    hints = _hints(kind)
    allowed = [*hints, "table"] if kind is JobStream else list(hints)
    for key, value in raw.items():
        if key not in allowed:
            where = f"{file}: {place}" if place else file
            raise ScenarioError(f"{where}: unknown key '{key}'{nearest(key, allowed)}")
        _known_keys(value, hints[key], file, f"{place}.{key}" if place else key)


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Type of each field of a dataclass (Any: Python has no type of annotations)."""
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


def _check(scenario: Scenario, path: Path) -> None:
    """Check rules across fields: unique names, references, distances."""
    file = path.name
    if not scenario.arms:
        raise ScenarioError(f"{file}: arms: there are no arms; give at least one [[arms]].")
    if not scenario.jobs:
        raise ScenarioError(f"{file}: jobs: there are no jobs; give at least one [[jobs]].")
    errors = list[str]()
    for kind in ("arms", "places", "fixtures", "jobs"):
        first = dict[str, str]()
        for i, item in enumerate(getattr(scenario, kind)):
            place = item.place_of(i, "name") if isinstance(item, JobStream) else f"{kind}[{i}].name"
            if item.name in first:
                errors.append(f"{place}: '{item.name}' is given twice, as in {first[item.name]}; names must be unique.")
            first.setdefault(item.name, place)
        if errors and kind != "jobs":
            raise ScenarioError(f"{file}: {errors[0]}")
    for (i, one), (j, other) in combinations(enumerate(scenario.arms), 2):
        apart_m = dist(one.position_m, other.position_m)
        if apart_m < APART_M:
            given, least = distinguish(apart_m, APART_M, 2)
            raise ScenarioError(
                f"{file}: arms[{j}].position_m: '{other.name}' is {given} m from '{one.name}' (arms[{i}]); "
                f"bases must be at least {least} m apart."
            )
    places = {place.name: place.position_m for place in scenario.places}
    streams = [stream.name for stream in scenario.jobs]
    rows, known_streams = {stream.name for stream in scenario.jobs if not stream.numbered}, frozenset(streams)
    for i, stream in enumerate(scenario.jobs):
        for name in chain.from_iterable(stream.alternatives):
            if name not in places:
                errors.append(f"{stream.place_of(i, 'places')}: no place '{name}'{nearest(name, places)}")
        for names in stream.alternatives:
            if len({places.get(name, name) for name in names}) < len(set(names)):
                errors.append(f"{stream.place_of(i, 'places')}: {' and '.join(names)} are at one point.")
        for name in stream.after:
            if name not in ({*streams[:i], *rows} if stream.numbered else known_streams):
                known = nearest(name, streams[:i]) if i else "."
                errors.append(f"{stream.place_of(i, 'after')}: there is no stream '{name}' above this one{known}")
    if not errors and (cycle := cycle_of({stream.name: stream.after for stream in scenario.jobs})):
        errors.append(f"jobs: jobs wait for each other in a cycle: {' → '.join(cycle)}.")
    numbered = {stream.name for stream in scenario.jobs if stream.numbered}
    for i, name in enumerate(streams if numbered else ()):
        stream, _, number = name.rpartition("-")
        if name not in numbered and stream in numbered and len(number) >= 3 and number.isdecimal():
            place = scenario.jobs[i].place_of(i, "name")
            errors.append(f"{place}: '{name}' is also a job of the stream '{stream}'; rename one of them.")
    if errors:
        raise ScenarioError("\n".join(f"{file}: {error}" for error in errors))
    check_breaks(scenario, file)
    _check_intervals(scenario, file)
    try:
        scenario.bus.check([arm.name for arm in scenario.arms])
    except ValueError as error:
        raise ScenarioError(f"{file}: bus.partitions: {error}") from error
    names = {"arm": {arm.name: arm for arm in scenario.arms}, "jobs": dict.fromkeys(streams)}
    for i, surprise in enumerate(scenario.surprises):
        for field, known in names.items():
            name = getattr(surprise, field)
            if name and name not in known:
                raise ScenarioError(f"{file}: surprises[{i}].{field}: there is no '{name}'{nearest(name, known)}")
        if surprise.kind == "fan" and names["arm"][surprise.arm].cooling != "forced_air":
            raise ScenarioError(
                f"{file}: surprises[{i}].arm: '{surprise.arm}' has no fan; its cooling must be forced_air."
            )
    total = sum(stream.arrivals.expected(scenario.horizon_s) for stream in scenario.jobs)
    if total > MOST_JOBS:
        count, most = distinguish(total, MOST_JOBS, 6)
        raise ScenarioError(f"{file}: jobs: about {count} jobs would arrive in a shift; at most {most} are allowed.")


def _check_intervals(scenario: Scenario, file: str) -> None:
    """Check that the shift ends with a decision interval.

    Raises:
        ScenarioError: it does not; names the nearest horizons that do.
    """
    horizon_s, interval_s = scenario.horizon_s, scenario.decision_interval_s
    if isclose(scenario.ticks * interval_s, horizon_s, rel_tol=1e-9):
        return
    before = horizon_s // interval_s
    nearest_s = " or ".join(f"{count * interval_s:.12g}" for count in (before, before + 1) if count)
    raise ScenarioError(
        f"{file}: horizon_s must be a multiple of decision_interval_s (got {horizon_s:.12g}, {interval_s:.12g}): give "
        f"{nearest_s}."
    )


def _with_traces(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the arrival times of its trace files."""
    streams = []
    for i, stream in enumerate(scenario.jobs):
        spec = stream.arrivals
        if spec.file is not None:
            where = path.parent / spec.file
            times = _trace(where, f"{path.name}: jobs[{i}].arrivals.file")
            stream = dataclasses.replace(stream, arrivals=dataclasses.replace(spec, file=None, times_s=times))
        streams.append(stream)
    return dataclasses.replace(scenario, jobs=tuple(streams))


def _trace(where: Path, place: str) -> tuple[float, ...]:
    lines = text_of(read_bytes(where, place), f"{place}: '{where.name}'").splitlines()
    times: list[float] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            times.append(float(line))
        except ValueError as error:
            raise ScenarioError(
                f"{place}: line {number} of '{where.name}' is not a number of seconds: {line!r}."
            ) from error
    if not times:
        raise ScenarioError(f"{place}: '{where.name}' holds no times; give one arrival time in seconds per line.")
    for before, time in pairwise([0.0, *times]):
        if not (isfinite(time) and before <= time):
            raise ScenarioError(f"{place}: the times in '{where.name}' must be >= 0 and in order ({time} s is not).")
    return tuple(times)


def scenario_hash(scenario: Scenario) -> str:
    """Hash of what is no default in a scenario, so that a new field with a default does not change it."""
    return hash_of(scenario_content(scenario))


def scenario_content(value: Any) -> Any:
    """What is no default in a dataclass, at every depth (hence Any): a new field with a default changes no hash."""
    if isinstance(value, tuple):
        return [scenario_content(item) for item in value]
    if not is_dataclass(value):
        return value
    content: dict[str, Any] = {}
    for field in fields(value):
        if not field.compare:
            continue
        given = getattr(value, field.name)
        default = field.default_factory() if field.default_factory is not MISSING else field.default
        if given != default:
            content[field.name] = scenario_content(given)
    return content


def hash_of(content: Any) -> str:
    """Hash of JSON values (hence Any)."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
