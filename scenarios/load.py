"""From a TOML file to a `Scenario`, or to one sentence that says what is wrong with it."""

import dataclasses
import tomllib
from collections.abc import Mapping
from importlib import resources
from itertools import combinations
from math import dist
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec

from fleet.errors import ScenarioError, nearest
from scenarios.scenario import Scenario

APART_M = 0.2
"""Two bases closer than this would stand in one place: a Gen3 base is 0.09 m wide and needs its first joint free."""


def library() -> dict[str, Path]:
    """Scenarios that come with thermofleet, by name."""
    folder = resources.files("scenarios").joinpath("library")
    return {Path(str(f)).stem: Path(str(f)) for f in sorted(folder.iterdir(), key=str) if f.name.endswith(".toml")}


def load(name_or_path: str | Path) -> Scenario:
    """The scenario of a library name or of a .toml file.

    Raises:
        ScenarioError: file, place, what was given and what is allowed.
    """
    known = library()
    path = known.get(str(name_or_path), Path(name_or_path))
    if not path.is_file():
        if path.suffix == ".toml":
            raise ScenarioError(f"There is no scenario file '{path}'.")
        raise ScenarioError(f"No scenario '{name_or_path}'{nearest(str(name_or_path), known)}")
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path.name}: not valid TOML: {error}.") from error
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path.name}: not a UTF-8 text file.") from error
    raw = {"name": path.stem, **raw}
    return checked(raw, path)


def checked(raw: Mapping[str, Any], path: Path) -> Scenario:
    """The scenario of a parsed file; `path` names it in errors and locates what it refers to."""
    _known_keys(raw, Scenario, path.name, "")
    try:
        scenario = msgspec.convert(raw, Scenario, strict=True)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{path.name}: {_place(str(error))}.") from error
    _check(scenario, path)
    return _with_traces(scenario, path)


def override(scenario: Scenario, **changes: Any) -> Scenario:
    """The scenario with some of its top-level fields changed.

    Raises:
        ScenarioError: no such field, or a value it cannot take.
    """
    raw = msgspec.to_builtins(scenario)
    return checked({**raw, **msgspec.to_builtins(changes)}, Path(f"{scenario.name} with overrides"))


def _known_keys(raw: Any, kind: Any, file: str, place: str) -> None:
    """Refuse keys that the dataclass `kind` does not have, all the way down."""
    if get_origin(kind) in (Union, UnionType):
        kind = next((arg for arg in get_args(kind) if dataclasses.is_dataclass(arg)), kind)
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


def _place(message: str) -> str:
    """msgspec's message with the place first and in our words: `arms[0].tool_kg: Expected ...`."""
    text, _, where = message.partition(" - at `$")
    where = where.strip("`").lstrip(".")
    text = text.rstrip(".")
    return f"{where}: {text}" if where else text


def _check(scenario: Scenario, path: Path) -> None:
    """What no single field can know: names that must be different, exist, or lie apart."""
    file = path.name
    if not scenario.arms:
        raise ScenarioError(f"{file}: arms: the cell has no arm; at least one [[arms]] is needed.")
    if not scenario.jobs:
        raise ScenarioError(f"{file}: jobs: there is nothing to do; at least one [[jobs]] is needed.")
    for kind in ("arms", "places", "jobs"):
        names = [item.name for item in getattr(scenario, kind)]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise ScenarioError(f"{file}: {kind}[{i}].name: '{name}' is taken; names must differ.")
    for (i, one), (j, other) in combinations(enumerate(scenario.arms), 2):
        apart = dist(one.position_m, other.position_m)
        if apart < APART_M:
            raise ScenarioError(
                f"{file}: arms[{j}].position_m: '{other.name}' stands {apart:.2f} m from '{one.name}' (arms[{i}]); "
                f"bases must be at least {APART_M} m apart."
            )
    places = [place.name for place in scenario.places]
    streams = [stream.name for stream in scenario.jobs]
    for i, stream in enumerate(scenario.jobs):
        wanted = 2 if stream.kind in ("pick_place", "sort") else 1
        if len(stream.places) != wanted:
            raise ScenarioError(f"{file}: jobs[{i}].places: a {stream.kind} needs {wanted} (got {len(stream.places)}).")
        for name in stream.places:
            if name not in places:
                raise ScenarioError(f"{file}: jobs[{i}].places: no place '{name}'{nearest(name, places)}")
        if stream.force_n and stream.kind != "press":
            raise ScenarioError(
                f"{file}: jobs[{i}].force_n: only a press has a contact force (got {stream.force_n} N)."
            )
        for name in stream.after:
            if name not in streams[:i]:
                raise ScenarioError(
                    f"{file}: jobs[{i}].after: '{name}' is no stream above this one{nearest(name, streams[:i])}"
                )


def _with_traces(scenario: Scenario, path: Path) -> Scenario:
    """Arrival times that the scenario keeps in files, read in."""
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
    except OSError as error:
        raise ScenarioError(f"{place}: cannot read '{where}': {error.strerror}.") from error
    times: list[float] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            times.append(float(line))
        except ValueError as error:
            raise ScenarioError(f"{place}: line {number} of '{where.name}' is no time in seconds: {line!r}.") from error
    if times != sorted(times) or any(t < 0 for t in times):
        raise ScenarioError(f"{place}: the times in '{where.name}' must be >= 0 and in order.")
    return tuple(times)
