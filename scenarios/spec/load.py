"""Load scenarios by name or from files: a `Scenario`, or an error of one sentence."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from importlib import resources
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

from fleet.errors import ScenarioError, nearest, printable
from scenarios.spec.parse import override, parse_toml
from scenarios.spec.schema import SPLITS, Scenario

MOST_BYTES = 10_000_000
"""Of a scenario file."""
INSTANCE = re.compile(rf"({'|'.join(SPLITS)})/\d+")
"""Names of the suite's instances."""


def library() -> dict[str, Path]:
    """Files of the scenarios that come with thermofleet, by name."""
    folder = resources.files("scenarios").joinpath("library")
    return {Path(str(f)).stem: Path(str(f)) for f in sorted(folder.iterdir(), key=str) if f.name.endswith(".toml")}


def own_seed(name_or_path: str | Path) -> int:
    """The seed of an instance of the suite; 0 for every other scenario."""
    if not INSTANCE.fullmatch(str(name_or_path)):
        return 0
    from scenarios.suite.splits import instance  # reads tables that other scenarios do not need

    return instance(str(name_or_path)).seed


def load(name_or_path: str | Path) -> Scenario:
    """The scenario of a library name, of a .toml file, or of an instance of the suite, as `test/0017`.

    Raises:
        ScenarioError: the scenario is unknown or invalid; the message names file, field and allowed values.
    """
    if not isinstance(name_or_path, str | Path):
        raise ScenarioError(f"A scenario is a name or a path (got {type(name_or_path).__name__} {name_or_path!r}).")
    if INSTANCE.fullmatch(str(name_or_path)):
        from scenarios.suite.splits import instance

        return instance(str(name_or_path)).scenario
    known = library()
    path = known.get(str(name_or_path), Path(name_or_path))
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ScenarioError(f"{path.name}: a scenario has at most {MOST_BYTES} bytes (got {path.stat().st_size}).")
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        if path.suffix == ".toml":
            raise ScenarioError(f"There is no scenario file '{path}'.") from error
        raise ScenarioError(f"No scenario '{name_or_path}'{nearest(str(name_or_path), known)}") from error
    except OSError as error:
        raise ScenarioError(f"Cannot read '{path}': {error.strerror}.") from error
    return parse_toml(content, path)


def keywords_of(function: Callable[..., object]) -> list[str]:
    """Names of the keyword-only parameters of a function."""
    return [name for name, p in signature(function).parameters.items() if p.kind is Parameter.KEYWORD_ONLY]


def scenario_with(
    scenario: str | Path | Scenario, overrides: Mapping[str, Any], function: Callable[..., object]
) -> Scenario:
    """The scenario with overrides, which may be values of any field.

    Args:
        function: Called with the overrides; its own options are named in errors, too.

    Raises:
        ScenarioError: an override is neither a field nor an option; names the nearest.
    """
    if not isinstance(scenario, str | Path | Scenario):
        given = printable(repr(scenario), 80)
        if isinstance(getattr(scenario, "scenario", None), Scenario):  # a prepared fleet, or a recorded run
            given = f"a {type(scenario).__name__}; give its .scenario"
        raise ScenarioError(f"scenario must be a library name, a .toml file or a Scenario (got {given}).")
    chosen = scenario if isinstance(scenario, Scenario) else load(scenario)
    fields = [field.name for field in dataclasses.fields(Scenario)]
    for name in overrides:
        if name == "seed":
            raise ScenarioError("make_env() takes no seed: give it to reset(seed=…).")
        if name not in fields:
            allowed = nearest(name, ["scenario", *fields, *keywords_of(function)])
            raise ScenarioError(f"{chosen.name} with overrides: unknown key '{name}'{allowed}")
    return override(chosen, **overrides) if overrides else chosen
