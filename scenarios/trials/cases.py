"""Instances by name: scenarios of the library, files, and splits of the suite."""

from collections.abc import Sequence

from fleet.errors import FleetError, nearest
from scenarios.load import INSTANCE, library, load
from scenarios.schema import SPLITS
from scenarios.suite.splits import Instance, instance, split
from scenarios.trials.plan import Case, seeds_of_instance

MOST_NAMES = 3
"""Instances of a suite that a title names each."""


def cases_of(names: Sequence[str], seeds: int, first_seed: int = 0) -> list[Case]:
    """Scenarios by library name or file, each with the same seeds, and instances, as `test/0017`, each with its own.

    Raises:
        FleetError: there is no such scenario, or two have one name.
    """
    found: list[Case] = []
    for name in names:
        if INSTANCE.fullmatch(name):
            found.append(_case(instance(name), seeds))
        else:
            scenario = load(name)
            found.append(
                Case(name=scenario.name, scenario=scenario, seeds=tuple(range(first_seed, first_seed + seeds)))
            )
    return found


def _case(instance: Instance, seeds: int) -> Case:
    return Case(name=instance.name, scenario=instance.scenario, seeds=seeds_of_instance(instance.seed, seeds))


def suite_of(name: str, seeds: int, first_seed: int = 0) -> list[Case]:
    """The instances of a split, each with its own seed and others drawn from it; or names separated by commas.

    Raises:
        FleetError: there is no such split, instance or scenario.
    """
    if name in SPLITS:
        return [_case(each, seeds) for each in split(name)]
    names = [each.strip() for each in name.split(",")]
    for each in names:
        if not (INSTANCE.fullmatch(each) or each in library() or each.endswith(".toml")):
            near = nearest(each, [*SPLITS, *library()])
            raise FleetError(
                f"No instances '{each}'{near} An instance of a split is named as test/0017; a split stands alone."
            )
    return cases_of(names, seeds, first_seed)


def suite_label(name: str) -> str:
    """What a table calls a suite: its name, or the first and the last of many instances."""
    names = [each.strip() for each in name.split(",")]
    return ", ".join(names) if len(names) <= MOST_NAMES else f"{names[0]} to {names[-1]}"
