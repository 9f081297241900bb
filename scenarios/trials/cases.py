"""Instances by name: scenarios of the library, files, and splits of the suite."""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Protocol

from fleet.errors import FleetError
from scenarios.load import load
from scenarios.schema import Scenario
from scenarios.trials.plan import Case, seeds_of_instance

SPLITS = ("train", "validation", "test")


class Instance(Protocol):
    """One instance of a split, see `scenarios.suite`."""

    @property
    def name(self) -> str: ...
    @property
    def scenario(self) -> Scenario: ...
    @property
    def seed(self) -> int: ...


def cases_of(names: Sequence[str], seeds: int, first_seed: int = 0) -> list[Case]:
    """Scenarios by library name or file, each with the same seeds.

    Raises:
        FleetError: there is no such scenario, or two have one name.
    """
    loaded = [load(name) for name in names]
    return [Case(name=each.name, scenario=each, seeds=tuple(range(first_seed, first_seed + seeds))) for each in loaded]


def suite_of(name: str, seeds: int, first_seed: int = 0) -> list[Case]:
    """The instances of a split, each with its own seed and others drawn from it; or scenarios separated by commas.

    Raises:
        FleetError: there is no such split or scenario.
    """
    if name not in SPLITS:
        return cases_of([each.strip() for each in name.split(",")], seeds, first_seed)
    if find_spec("scenarios.suite") is None:
        raise FleetError(f"This version has no suite '{name}'; name scenarios, separated by commas.")
    instances: Sequence[Instance] = import_module("scenarios.suite.splits").split(name)
    return [Case(name=i.name, scenario=i.scenario, seeds=seeds_of_instance(i.seed, seeds)) for i in instances]
