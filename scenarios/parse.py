"""Parse the content of scenario files: a `Scenario`, or an error of one sentence."""

import dataclasses
import tomllib
from collections.abc import Mapping
from itertools import combinations, pairwise
from math import dist, isfinite
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from fleet.errors import ScenarioError, nearest, printable
from scenarios.schema import Scenario
from scenarios.schema_errors import check_finite, plain_kind, readable_error

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
        return parse_scenario({"name": path.stem, **raw}, path)
    except RecursionError as error:
        raise ScenarioError(f"{path.name}: its tables are nested too deeply; a scenario needs 4 levels.") from error


def parse_scenario(raw: Mapping[str, object], path: Path) -> Scenario:
    """The scenario of a parsed TOML file; `path` names the file in errors and locates the files it refers to."""
    _known_keys(raw, Scenario, path.name, "")
    check_finite(raw, path.name)
    raw = {"arms": (), "places": (), "jobs": (), **raw}  # an absent list and an empty one give the same error
    try:
        scenario = msgspec.convert(raw, Scenario, strict=True)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{path.name}: {readable_error(error, raw, Scenario)}") from error
    _check(scenario, path)
    return _with_traces(scenario, path)


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
    hints = get_type_hints(kind)
    allowed = [f.name for f in dataclasses.fields(kind)]
    for key, value in raw.items():
        if key not in allowed:
            where = f"{file}: {place}" if place else file
            raise ScenarioError(f"{where}: unknown key '{key}'{nearest(key, allowed)}")
        _known_keys(value, hints[key], file, f"{place}.{key}" if place else key)


def _check(scenario: Scenario, path: Path) -> None:
    """Check rules across fields: unique names, references, distances."""
    file = path.name
    if not scenario.arms:
        raise ScenarioError(f"{file}: arms: there are no arms; give at least one [[arms]].")
    if not scenario.jobs:
        raise ScenarioError(f"{file}: jobs: there are no jobs; give at least one [[jobs]].")
    for kind in ("arms", "places", "jobs", "fixtures"):
        names = [item.name for item in getattr(scenario, kind)]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise ScenarioError(f"{file}: {kind}[{i}].name: '{name}' is given twice; names must be unique.")
    for (i, one), (j, other) in combinations(enumerate(scenario.arms), 2):
        apart = dist(one.position_m, other.position_m)
        if apart < APART_M:
            raise ScenarioError(
                f"{file}: arms[{j}].position_m: '{other.name}' is {apart:.2f} m from '{one.name}' (arms[{i}]); "
                f"bases must be at least {APART_M} m apart."
            )
    places = [place.name for place in scenario.places]
    streams = [stream.name for stream in scenario.jobs]
    for i, stream in enumerate(scenario.jobs):
        for name in stream.places:
            if name not in places:
                raise ScenarioError(f"{file}: jobs[{i}].places: no place '{name}'{nearest(name, places)}")
        for name in stream.after:
            if name not in streams[:i]:
                known = nearest(name, streams[:i]) if i else "."
                raise ScenarioError(f"{file}: jobs[{i}].after: there is no stream '{name}' above this one{known}")
    try:
        scenario.bus.channel().check([arm.name for arm in scenario.arms])
    except ValueError as error:
        raise ScenarioError(f"{file}: bus.partitions: {error}") from error
    total = sum(stream.arrivals.expected(scenario.horizon_s) for stream in scenario.jobs)
    if total > MOST_JOBS:
        raise ScenarioError(
            f"{file}: jobs: about {total:.3g} jobs would arrive in a shift; at most {MOST_JOBS} are allowed."
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
    try:
        lines = where.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise ScenarioError(f"{place}: there is no file '{where}'.") from error
    except OSError as error:
        raise ScenarioError(f"{place}: cannot read '{where}': {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{place}: '{where.name}' is not a UTF-8 text file.") from error
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
