"""Normalised scores of policies over instances: from rewards and references to means and differences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fleet.errors import FleetError
from scenarios.evaluate.statistics import Interval, aggregates, by_group, holm, improvement, interval, paired
from scenarios.evaluate.study import Case, Row
from scenarios.policy_loader import has_trainings
from scenarios.spec.parse import scenario_hash
from scenarios.suite.splits import cell_name, heat_binds

if TYPE_CHECKING:
    from scenarios.evaluate.references import ShiftReference

Array = np.ndarray

FEWEST = 2
"""Instances that intervals over instances need."""
FEWEST_CELLS = 3
"""Cells that intervals over cells need; fewer are given, not a sample."""


@dataclass(frozen=True, eq=False)
class Normalised:
    """Scores of the same instances under several policies; see `ShiftReference.normalised`."""

    instances: tuple[str, ...]
    """A scenario and a seed each."""
    cells: tuple[str, ...]
    """Cell of each instance; instances of one cell have the same arms, stations and tasks."""
    score: Mapping[str, Array]
    """By policy, [training of the policy, instance]; a single training counts as given, not as a sample."""
    hindsight: Array
    """Score of the best schedule that a search found, [instance]; below 1 where the unit is a share of its reward."""
    missing: int = 0
    """Shifts of each policy that have no reference."""

    def only(self, chosen: Array) -> "Normalised":
        """Some of the instances, bool [instance]."""
        names, cells = (tuple(np.array(each)[chosen].tolist()) for each in (self.instances, self.cells))
        score = {name: x[:, chosen] for name, x in self.score.items()}
        return replace(self, instances=names, cells=cells, score=score, hindsight=self.hindsight[chosen])

    @cached_property
    def hot(self) -> Array | None:
        """Whether heat binds in each instance, bool [instance]; None if some are no instances of the suite, or if it is
        the same in all."""
        hot = [heat_binds(name) for name in self.instances]
        return np.array(hot, dtype=bool) if None not in hot and len(set(hot)) > 1 else None

    @cached_property
    def groups(self) -> Array | None:
        """As `groups_of`."""
        return groups_of(self.cells)

    @property
    def reachable(self) -> str:
        """Mean score of the hindsight, in all instances and where heat binds or not."""
        mean = f"{self.hindsight.mean():.2f}"
        if self.hot is None:
            return mean
        hot, cool = (self.hindsight[part].mean() for part in (self.hot, ~self.hot))
        return f"{mean} ({hot:.2f} where heat binds, {cool:.2f} where it does not)"

    @property
    def unit(self) -> str:
        """As `unit_of`."""
        return unit_of(self.cells)

    def interval(self, values: Array) -> Interval:
        """The interval of the mean of values [training, instance] over the sample."""
        return interval(self._sample(values))

    def difference(self, policy: str, other: str) -> Interval:
        """Of the mean scores of two policies, paired by instance, and by training if both have several."""
        return paired(self._sample(self.score[policy]), self._sample(self.score[other]))

    def _sample(self, values: Array) -> Array:
        """As `means.interval` takes them."""
        return values[:, None] if self.groups is None else by_group(values, self.groups)


def groups_of(cells: Sequence[str]) -> Array | None:
    """Number of the cell of each instance, from the cells; None if cells are no sample or each has one instance."""
    names, groups = np.unique(cells, return_inverse=True)
    return groups if FEWEST_CELLS <= len(names) < len(cells) else None


def unit_of(cells: Sequence[str]) -> str:
    """What intervals over instances of these cells are about, as `200 instances of 9 cells`."""
    several, count = len(set(cells)), f"{len(cells)} instances"
    if groups_of(cells) is not None:
        return f"{count} of {several} cells"
    if FEWEST_CELLS <= several == len(cells):
        return count
    return f"{count}, {f'these {several} cells' if several > 1 else 'this cell'} only"


@dataclass(frozen=True, kw_only=True)
class Score:
    """The normalised score of one policy; intervals are over cells and instances, and over trainings if there are
    several."""

    mean: Interval
    difference: Interval
    """Of means, paired, to the baseline."""
    p_holm: float
    """Of no difference, adjusted for all policies."""
    iqm: Interval
    optimality_gap: Interval
    """By how much scores are below 1 in the mean; those above count as 1."""
    improvement: Interval
    """Probability of a better score than the baseline's on an instance; an equal score counts one half."""
    hot: Interval | None = None
    """Mean score in the instances in which heat binds; None as in `Normalised.hot`."""
    cool: Interval | None = None
    """Mean score in the others."""


@dataclass(frozen=True, kw_only=True)
class SuiteScores:
    """Normalised scores of several policies."""

    baseline: str
    instances: int
    unit: str
    """As of `Normalised`."""
    missing: int
    reachable: str
    """As of `Normalised`."""
    trainings: int = 1
    """Most trainings of a policy."""
    policies: dict[str, Score]

    @property
    def remarks(self) -> list[str]:
        """What a reader must know of the instances."""
        remarks = [
            f"Unit: {self.unit}{and_trainings(self.trainings)}. Score: 0 = mean of random, 1 = hindsight, the best "
            "schedule that a search found. Scale: hindsight − random, at least a tenth of the hindsight's reward. "
            f"Mean score of the hindsight: {self.reachable}."
        ]
        if self.missing:
            remarks.append(f"Shifts of each policy without a reference, which are not scored: {self.missing}.")
        return remarks


def scores_of(values: Normalised, baseline: str) -> SuiteScores:
    """The figures of every policy; baseline is one of them.

    Raises:
        ValueError: fewer than two instances.
    """
    if len(values.instances) < FEWEST:
        raise ValueError(f"Scores need {FEWEST} instances or more (got {len(values.instances)}).")
    base, names = values.score[baseline], list(values.score)
    groups = values.groups
    suite = aggregates(values.score, groups=groups)
    differences = [Interval(0.0, 0.0, 0.0) if name == baseline else values.difference(name, baseline) for name in names]
    adjusted = holm([each.p for each in differences]).tolist()
    return SuiteScores(
        baseline=baseline,
        instances=len(values.instances),
        unit=values.unit,
        missing=values.missing,
        reachable=values.reachable,
        trainings=max(map(len, values.score.values())),
        policies={
            name: Score(
                mean=values.interval(values.score[name]),
                difference=difference,
                p_holm=p_holm,
                iqm=suite[name].iqm,
                optimality_gap=suite[name].optimality_gap,
                improvement=improvement(values.score[name], base, groups=groups),
                **_parts(values, name),
            )
            for name, difference, p_holm in zip(names, differences, adjusted, strict=True)
        },
    )


def and_trainings(count: int) -> str:
    """What a unit says of the trainings of policies."""
    return f" × {count} trainings of a policy" if count > 1 else ""


def ranked(scores: SuiteScores) -> list[str]:
    """The policies, the best mean first."""
    return sorted(scores.policies, key=lambda name: -scores.policies[name].mean.mean)


def _parts(values: Normalised, name: str) -> dict[str, Interval]:
    """Mean scores of a policy where heat binds and where it does not, by the fields of `Score`."""
    if values.hot is None:
        return {}
    parts = {"hot": values.only(values.hot), "cool": values.only(~values.hot)}
    return {field: own.interval(own.score[name]) for field, own in parts.items()}


HEADS = ("policy", "mean", "difference", "", "heat binds", "it does not", "IQM", "better in")


def score_cells(scores: SuiteScores, name: str) -> tuple[str, ...]:
    """A row of `HEADS` but for the name."""
    each, base = scores.policies[name], name == scores.baseline
    return (
        each.mean.text(),
        "" if base else each.difference.text(),
        "" if base else each.difference.stars(each.p_holm),
        each.hot.text() if each.hot else "",
        each.cool.text() if each.cool else "",
        each.iqm.text(),
        "" if base else each.improvement.text(),
    )


Shift = tuple[str, int]
"""Instance and seed."""


def split_file(split: str) -> Path:
    """File of the references of a split that come with the package; there may be none."""
    return Path(str(resources.files("scenarios").joinpath("suite/references", f"{split}.jsonl")))


def references_of(
    cases: Sequence[Case], file: Path | None = None, sources: Sequence[str] = ()
) -> "dict[Shift, ShiftReference]":
    """The references of those shifts that have one.

    Args:
        file: Rows of `thermofleet bounds`; without it those of the splits that come with the package.
        sources: Of the predictions: of several references of a shift that with one of these counts.

    Raises:
        FleetError: the file is no such file, or has several references of a shift, of which none or several count.
    """
    from scenarios.evaluate.references import load_references

    splits = dict.fromkeys(case.name.partition("/")[0] for case in cases if "/" in case.name)
    files = [file] if file else [path for path in map(split_file, splits) if path.is_file()]
    rows: dict[tuple[str, int, str], dict[str, ShiftReference]] = {}
    for each in (each for path in files for each in load_references(path)):
        rows.setdefault((each.instance, each.seed, each.scenario_hash), {})[each.difficulty] = each
    found: dict[Shift, ShiftReference] = {}
    for case in cases:
        content = scenario_hash(case.scenario)
        for seed in case.seeds:
            name = case.name if "/" in case.name else f"{case.name}/{seed}"
            of_source = rows.get((name, seed, content), {})
            known = {source: each for source, each in of_source.items() if len(of_source) == 1 or source in sources}
            if len(known) == 1:
                found[case.name, seed] = next(iter(known.values()))
            elif of_source:
                raise FleetError(
                    f"'{file}' has references of {name} with several --difficulty ({', '.join(of_source)}), whose zero "
                    "differs. Compare with one of these, or give a file with one: thermofleet bounds --out FILE."
                )
    return found


def normalised(
    by_policy: Mapping[str, Sequence[Row]],
    references: "Mapping[Shift, ShiftReference]",
    *,
    failed_as_random: bool = False,
) -> Normalised | None:
    """The scores of policies on the shifts that have a reference; None if there are fewer than `FEWEST`.

    An instance is a scenario and a seed, with the mean reward over trainings of its twins; trainings of a policy, which
    do all instances, are a sample. References are of the first fleet.

    Args:
        by_policy: Rows of each policy, of the same shifts.
        failed_as_random: Count a failed shift as the mean of random; otherwise no row may have failed.
    """
    first = next(iter(by_policy.values()), ())
    shifts = list(dict.fromkeys((row.key.instance, row.key.seed) for row in first if row.key.fleet == 0))
    scored = [shift for shift in shifts if shift in references]
    if len(scored) < FEWEST:
        return None
    known = [references[shift] for shift in scored]
    random, unit, best = (np.array([getattr(each, name) for each in known]) for name in ("random", "unit", "hindsight"))
    score = dict[str, np.ndarray]()
    for policy, rows in by_policy.items():
        rewards: dict[int, dict[Shift, list[float]]] = {}
        for row in rows:
            shift = row.key.instance, row.key.seed
            if row.key.fleet == 0 and shift in references:
                assert row.outcome is not None or failed_as_random
                own = rewards.setdefault(row.key.training if has_trainings(row.key.policy) else 0, {})
                own.setdefault(shift, []).append(row.outcome.reward if row.outcome else references[shift].random)
        reward = np.array([[np.mean(own[shift]) for shift in scored] for own in rewards.values()])
        score[policy] = (reward - random) / unit
    return Normalised(
        instances=tuple(each.instance for each in known),
        cells=tuple(cell_name(each.instance) for each in known),
        score=score,
        hindsight=(best - random) / unit,
        missing=len({(row.key.fleet, row.key.instance, row.key.seed) for row in first}) - len(scored),
    )
