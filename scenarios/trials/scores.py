"""Normalised scores of the rows of a study, by the stored references of their instances."""

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenarios.policy_loader import has_trainings
from scenarios.scenario_hash import scenario_hash
from scenarios.statistics.scores import FEWEST, Normalised
from scenarios.suite.splits import cell_name
from scenarios.trials.plan import Case, Row

if TYPE_CHECKING:  # slow to import
    from scenarios.bounds.references import Reference

Shift = tuple[str, int]
"""Instance and seed."""
FOLDER = "suite/references"
"""Of the references that come with the package, a file for each split."""


def split_file(split: str) -> Path:
    """File of the references of a split; there may be none."""
    return Path(str(resources.files("scenarios").joinpath(FOLDER, f"{split}.jsonl")))


def references_of(cases: Sequence[Case], file: Path | None = None) -> "dict[Shift, Reference]":
    """The references of those shifts that have one.

    Args:
        file: Rows of `thermofleet bounds`; without it those of the splits that come with the package.

    Raises:
        FleetError: the file is no such file.
    """
    from scenarios.bounds.references import load_references

    splits = dict.fromkeys(case.name.partition("/")[0] for case in cases if "/" in case.name)
    files = [file] if file else [path for path in map(split_file, splits) if path.is_file()]
    rows = {(each.instance, each.seed): each for path in files for each in load_references(path)}
    found: dict[Shift, Reference] = {}
    for case in cases:
        content = scenario_hash(case.scenario)
        for seed in case.seeds:
            own = rows.get((case.name if "/" in case.name else f"{case.name}/{seed}", seed))
            if own and own.scenario_hash == content:
                found[case.name, seed] = own
    return found


def normalised(
    by_policy: Mapping[str, Sequence[Row]], references: "Mapping[Shift, Reference]", *, failed_as_random: bool = False
) -> Normalised | None:
    """The scores of policies on the shifts that have a reference; None if there are fewer than `FEWEST`.

    An instance is a scenario and a seed, with the mean reward over trainings of its twins; trainings of a policy, which
    do all instances, are kept apart. References are of the first fleet.

    Args:
        by_policy: Rows of each policy, of the same shifts.
        failed_as_random: Count a failed shift as the mean of random; otherwise no row may have failed.
    """
    first = next(iter(by_policy.values()), ())
    shifts = list(dict.fromkeys((row.key.instance, row.key.seed) for row in first if row.key.fleet == 0))
    scored = [shift for shift in shifts if shift in references]
    spread = [shift for shift in scored if references[shift].hindsight > references[shift].random]
    if len(spread) < FEWEST:
        return None
    known = [references[shift] for shift in spread]
    random, best, upper = (
        np.array([getattr(each, name) for each in known]) for name in ("random", "hindsight", "upper")
    )
    score, to_bound = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for policy, rows in by_policy.items():
        rewards: dict[int, dict[Shift, list[float]]] = {}
        for row in rows:
            shift = row.key.instance, row.key.seed
            if row.key.fleet == 0 and shift in references:
                assert row.outcome is not None or failed_as_random
                own = rewards.setdefault(row.key.training if has_trainings(row.key.policy) else 0, {})
                own.setdefault(shift, []).append(row.outcome.reward if row.outcome else references[shift].random)
        reward = np.array([[np.mean(own[shift]) for shift in spread] for own in rewards.values()])
        score[policy] = (reward - random) / (best - random)
        to_bound[policy] = (upper - reward) / (upper - random)
    return Normalised(
        instances=tuple(each.instance for each in known),
        cells=tuple(cell_name(each.instance) for each in known),
        score=score,
        to_bound=to_bound,
        missing=len({(row.key.fleet, row.key.instance, row.key.seed) for row in first}) - len(scored),
        flat=tuple(references[shift].instance for shift in scored if shift not in set(spread)),
    )
