"""Several policies on the same seeds: figures with paired differences, and scores."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.env.validation import seed_of
from fleet.errors import FleetError
from scenarios.evaluate.rollout import FIGURES, KINDS, Outcome
from scenarios.evaluate.scores import (
    Normalised,
    Shift,
    SuiteScores,
    and_trainings,
    groups_of,
    normalised,
    scores_of,
    unit_of,
)
from scenarios.evaluate.statistics import HEAD, LEGEND, Figure, Interval, draws, figure_rows, figures_of, remarks, unit
from scenarios.evaluate.study import Case, Row, Study, suite_label
from scenarios.policy_loader import check_name, has_trainings, label, scope_of
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, check_progress, quiet
from scenarios.spec.load import scenario_with
from scenarios.spec.options import RISK, RiskName
from scenarios.spec.schema import Scenario
from scenarios.suite.splits import cell_name
from scenarios.table import Table

if TYPE_CHECKING:  # slow to import
    from scenarios.evaluate.references import ShiftReference

Array = np.ndarray

SCORE_HEADINGS = {
    "mean": "normalised score",
    "hot": "normalised score, heat binds",
    "cool": "normalised score, it does not",
    "iqm": "normalised score, IQM",
    "improvement": "normalised score, better in",
}
"""In a file of figures, by field of `Score`."""


@dataclass(frozen=True)
class Failed:
    """A shift in which a policy failed."""

    policy: str
    instance: str
    fleet: int
    training: int
    seed: int
    error: str
    trace: str
    """Last lines of the traceback."""

    @property
    def text(self) -> str:
        """The shift and the error."""
        return f"{self.instance}, fleet {self.fleet}, training {self.training}, seed {self.seed}: {self.error}"


def failures_by_policy(failures: Sequence[Failed]) -> list[tuple[str, int, Failed]]:
    """Each policy that failed, the number of its failures and the first one; the most failures first."""
    first = {each.policy: each for each in reversed(failures)}
    return [(policy, count, first[policy]) for policy, count in Counter(each.policy for each in failures).most_common()]


@dataclass(frozen=True)
class Comparison:
    """Policies on the same seeds."""

    scenario: str
    seeds: tuple[int, ...]
    unit: str
    """What the intervals speak about."""
    draws: int
    """Independent draws that the intervals rest on: the smallest number of fleets, trainings and seeds, or of cells (of
    instances if each is of another cell)."""
    baseline: str
    figures: dict[str, dict[str, Figure]]
    """By policy and name of the figure."""
    scopes: dict[str, str]
    """By policy: central or arm, see `agents.policy`."""
    channel: dict[str, Any]
    """`Channel.described`."""
    channel_text: str
    illegal: dict[str, int] = field(default_factory=dict)
    """By policy: illegal actions in all its shifts."""
    failures: tuple[Failed, ...] = ()
    """Shifts in which a policy failed. A policy with one has no figures."""
    lead: Interval | None = None
    """Paired difference in reward of the first to the second of `by_reward`; None with fewer than two."""
    scores: SuiteScores | None = None
    """Normalised scores; None without references of the shifts."""
    randomise: Randomisation = field(default_factory=Randomisation)
    """Of every shift, the same for every policy."""
    sources: tuple[str, ...] = ()
    """Of the predictions."""
    referenced: int = 0
    """Shifts with a reference."""
    failed_baseline: str = ""
    """The baseline that was asked for, if it failed: another one takes its place."""

    @property
    def title(self) -> str:
        """What was compared, with the seeds if they follow each other."""
        first, last = self.seeds[0], self.seeds[-1]
        consecutive = self.seeds == tuple(range(first, first + len(self.seeds)))
        seeds = f", seed {first}" if first == last else f", seeds {first} to {last}" if consecutive else ""
        return f"{self.scenario}{seeds} ({self.unit})"

    @property
    def table(self) -> Table:
        """A group per figure: mean and paired difference, each with its interval; narrow enough for 80 columns."""
        caption = f"{self.title}: mean, paired difference to {self.baseline}, {LEGEND}"
        perfect = self.channel == PERFECT.described()
        if not perfect:
            caption += f"\nChannel: {self.channel_text}."
        if self.randomise:
            caption += f"\nRandomisation: {self.randomise.text}."
        scopes: list[tuple[str, ...]] = [
            (label(policy), scope, "", "", "", "") for policy, scope in self.scopes.items()
        ]
        groups = {"scope": scopes}
        for name, kind in KINDS.items():
            figures = {policy: each[name] for policy, each in self.figures.items()}
            groups[kind.heading] = figure_rows(figures, self.baseline, label, kind.digits)
        notes = list(remarks(self.figures, self.draws))
        central = [label(policy) for policy, scope in self.scopes.items() if scope == "central"]
        if not perfect and central:
            notes.append(f"Central policies read no messages: {', '.join(central)}.")
        return Table.grouped(HEAD, groups, caption=caption, notes=notes)

    def _repr_html_(self) -> str:
        return str(self.table.html())


def figures_table(results: Sequence[Comparison], scores: SuiteScores | None = None) -> Table:
    """Every figure of every policy as a number in its own cell, for a file of a spreadsheet; "" where there is none.

    A policy that failed has its number of failed shifts instead, with the first failure in the last column.

    Args:
        scores: Normalised scores over all results; of several results their scenario is "all".
    """
    names = ("mean", "low", "high", "difference", "difference_low", "difference_high", "p", "p_holm")
    rows = [
        (
            *(result.scenario, kind.heading, label(policy), label(result.baseline)),
            *_numbers(*(getattr(figures[name], each) for each in names)),
            "",
        )
        for result in results
        for name, kind in KINDS.items()
        for policy, figures in result.figures.items()
    ]
    rows += [
        (result.scenario, "failed shifts", label(policy), label(result.baseline), str(count))
        + ("",) * (len(names) - 1)
        + (f"{first.text}\n{first.trace}".rstrip(),)
        for result in results
        for policy, count, first in failures_by_policy(result.failures)
    ]
    if scores:
        where, base = results[0].scenario if len(results) == 1 else "all", label(scores.baseline)
        for policy, score in scores.policies.items():
            change = score.difference
            of_mean = (change.mean, change.low, change.high, change.p, score.p_holm)
            for field_name, heading in SCORE_HEADINGS.items():
                if each := getattr(score, field_name):
                    more = of_mean if field_name == "mean" else (np.nan,) * len(of_mean)
                    numbers = _numbers(each.mean, each.low, each.high, *more)
                    rows.append((where, heading, label(policy), base, *numbers, ""))
    return Table(head=("scenario", "figure", "policy", "baseline", *names, "first_failure"), rows=tuple(rows))


def _numbers(*values: float) -> Iterator[str]:
    """Cells of numbers; "" for NaN."""
    return ("" if np.isnan(value) else f"{value:.6g}" for value in values)


def compare(
    scenario: str | Path | Scenario,
    policies: Sequence[str],
    *,
    seeds: Sequence[int] | Array = range(20),
    baseline: str | None = None,
    difficulty: str = "twin",
    risk: RiskName = RISK,
    randomise: Randomisation | None = None,
    channel: Channel = PERFECT,
    cache_dir: Path | None = None,
    workers: int = -1,
    progress: Progress = quiet,
) -> Comparison:
    """Run every policy on every seed, in memory and on the profile plant.

    Args:
        scenario: A library name, a .toml file, or a `Scenario`.
        policies: Names, FILE.py:CLASS, or folders of trained policies; POLICY@SOURCE for one with another difficulty.
        seeds: Of the shifts. `thermofleet compare` takes ten by default, and round_robin as baseline if it is compared.
        difficulty: Source of the predictions: one of `thermofleet compare --difficulty`.
        risk: Source of P(saturation), as in `make_env`.
        baseline: The policy that differences refer to; default: the first.
        randomise: Varies the shifts beyond what the scenario draws, the same for every policy.
        channel: Topology, delay and loss of the arms' messages, the same for every policy.
        workers: Processes, if there is work for more than some seconds; -1 for one per core. The result does not
            depend on it.

    Raises:
        FleetError: no such scenario, no policies, an unknown one, one given twice, or a baseline that is not among
            them.
    """
    from scenarios.evaluate.runner import run_study

    chosen = scenario_with(scenario, {}, compare)
    if isinstance(policies, str) or not isinstance(policies, Sequence):
        raise FleetError(f"policies must be a list of names, for example ['wspt', 'mine.py:Mine'] (got {policies!r}).")
    for policy in policies:
        check_name(policy)
    if isinstance(seeds, np.ndarray) and seeds.ndim == 1:
        seeds = seeds.tolist()
    if isinstance(seeds, str) or not isinstance(seeds, Sequence):
        raise FleetError(f"seeds must be a list of integers, for example range(3) (got {seeds!r}).")
    try:
        for seed in seeds:
            seed_of(seed)
    except ValueError as error:
        raise FleetError(str(error)) from error
    if twice := [seed for seed, count in Counter(seeds).items() if count > 1]:
        raise FleetError(f"Seed {twice[0]} is given twice: a repeated shift is no new evidence. Give each seed once.")
    if not policies or not seeds:
        raise FleetError(
            f"A comparison needs a policy and a seed (got policies: {len(policies)}, seeds: {len(seeds)})."
        )
    if not isinstance(workers, int) or isinstance(workers, bool) or (workers < 1 and workers != -1):
        raise FleetError(f"workers must be an integer >= 1, or -1 for one per core (got {workers!r}).")
    check_progress(progress)
    study = Study(
        policies=policies,
        cases=[Case(name=chosen.name, scenario=chosen, seeds=tuple(map(int, seeds)))],
        difficulties=[difficulty],
        risk=risk,
        randomise=randomise,
        channel=chosen.channel(channel),
    )
    base = baseline or next(iter(study.competitors.values()))
    check_baseline(study, base)
    rows = run_study(study, cache_dir=cache_dir, workers=workers, progress=progress)
    return comparisons(study, rows, base)[0]


def figures_of_shifts(
    by_policy: Mapping[str, Sequence[Outcome]],
    baseline: str,
    shape: tuple[int, int, int, int] = (1, 1, 1, -1),
    groups: Array | None = None,
) -> dict[str, dict[str, Figure]]:
    """The compared figures of several policies, or of other variants, by its name and that of the figure.

    Args:
        by_policy: On the same seeds, in the same order.
        baseline: The one that differences refer to.
        shape: Instances, fleets, trainings and seeds. Of several instances each counts once, by its mean; trainings of
            a policy, which do all instances, are a sample, too.
        groups: Number of the cell of each instance; None if instances are independent.
    """

    def values_of(policy: str, rows: Sequence[Outcome], name: str) -> Array:
        values = np.array([getattr(row, name) for row in rows], dtype=float).reshape(shape)
        if shape[0] == 1:
            return values[0]
        by_training = values.mean(axis=(1, 3)).T[:, None]  # [training, 1, instance]
        return by_training if has_trainings(policy) else by_training.mean(axis=0, keepdims=True)

    values = {policy: {name: values_of(policy, rows, name) for name in FIGURES} for policy, rows in by_policy.items()}
    return figures_of(values, baseline, KINDS, groups)


def by_reward(figures: Mapping[str, Mapping[str, Figure]]) -> list[str]:
    """The policies, the one with the highest mean reward first."""
    return sorted(figures, key=lambda name: -figures[name]["reward"].mean)


def check_baseline(study: Study, baseline: str) -> None:
    """Raise a FleetError, which names what is compared, if the baseline is not."""
    names = study.competitors.values()
    if baseline not in names:
        raise FleetError(f"The baseline '{baseline}' is not among the policies compared: {', '.join(names)}.")


def comparisons(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    suite: str | None = None,
    references: "Mapping[Shift, ShiftReference] | None" = None,
) -> list[Comparison]:
    """One comparison of all instances of a suite, or one for each instance.

    Args:
        rows: In the order of the study.
        baseline: One of `Study.competitors`; if it failed, the first of those that did not takes its place.
        references: Of the shifts, for normalised scores.
    """
    check_baseline(study, baseline)
    failed = {study.competitors[row.key.policy, row.key.difficulty] for row in rows if row.error is not None}
    whole = [each for each in study.competitors.values() if each not in failed]
    base = baseline if baseline in whole else next(iter(whole), baseline)
    if suite:
        results = [comparison_of(study, rows, base, suite_label(suite), references)]
    else:
        of = {case.name: [row for row in rows if row.key.instance == case.name] for case in study.cases}
        results = [comparison_of(study, own, base, references=references) for own in of.values()]
    return [replace(each, failed_baseline=baseline if baseline in failed else "") for each in results]


def comparison_of(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    name: str | None = None,
    references: "Mapping[Shift, ShiftReference] | None" = None,
) -> Comparison:
    """One comparison of all instances of the rows.

    Args:
        name: Of the instances together; default: that of the only one.
    """
    shifts = rows_by_competitor(study, rows)
    failures = [
        Failed(each, row.key.instance, row.key.fleet, row.key.training, row.key.seed, row.error, row.trace or "")
        for each, own in shifts.items()
        for row in own
        if row.error is not None
    ]
    failed = {each.policy for each in failures}
    cells = [cell_name(each) for each in dict.fromkeys(row.key.instance for row in rows)]
    count, groups = len(cells), groups_of(cells)
    figures, lead, scores = {}, None, None
    if baseline not in failed:
        whole = {each: _repeated(study, own) for each, own in shifts.items() if each not in failed}
        figures = figures_of_shifts(whole, baseline, (count, *study.shape), groups)
        best, *others = by_reward(figures)
        if others:
            pair = {name: whole[name] for name in (best, others[0])}
            lead = figures_of_shifts(pair, others[0], (count, *study.shape), groups)[best]["reward"].to_base
        values = scores_over_all(study, rows, references or {})
        scores = scores_of(values, baseline) if values else None
    *_, per_fleet = study.shape
    sampled = count if groups is None else len(set(cells))
    each_seeds = f", {per_fleet} seeds each" if per_fleet > 1 else ""
    return Comparison(
        scenario=name or rows[0].key.instance,
        seeds=tuple(dict.fromkeys(row.key.seed for row in rows)),
        unit=unit(study.shape) if count == 1 else unit_of(cells) + and_trainings(study.most_trainings) + each_seeds,
        draws=draws(study.shape if count == 1 else (study.most_trainings, 1, sampled)),
        baseline=baseline,
        figures=figures,
        scopes={each: "failed" if each in failed else scope_of(p) for (p, _), each in study.competitors.items()},
        channel=study.channel.described(),
        channel_text=study.channel_text,
        illegal={each: sum(row.illegal for row in own) for each, own in shifts.items()},
        failures=tuple(failures),
        lead=lead,
        scores=scores,
        randomise=study.randomise or Randomisation(),
        sources=study.sources,
        referenced=len({(row.key.instance, row.key.seed) for row in rows} & (references or {}).keys()),
    )


def rows_by_competitor(study: Study, rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each of `Study.competitors`, in their order."""
    shifts: dict[str, list[Row]] = {each: [] for each in study.competitors.values()}
    for row in rows:
        shifts[study.competitors[row.key.policy, row.key.difficulty]].append(row)
    return shifts


def scores_over_all(
    study: Study, rows: Sequence[Row], references: "Mapping[Shift, ShiftReference]"
) -> Normalised | None:
    """Scores of the policies without a failure over all instances; None without references of the shifts, or with a
    randomisation, because references are of the shifts without one."""
    shifts = rows_by_competitor(study, rows)
    whole = {each: own for each, own in shifts.items() if not any(row.error is not None for row in own)}
    return None if study.randomise else normalised(whole, references)


def _repeated(study: Study, rows: Iterable[Row]) -> list[Outcome]:
    """The outcomes of one policy, those without trainings once for each training: in the order of `Study.shape`."""
    by_training: dict[tuple[str, int, int], list[Outcome]] = {}
    for row in rows:
        assert row.outcome is not None
        by_training.setdefault((row.key.instance, row.key.fleet, row.key.training), []).append(row.outcome)
    outcomes: list[Outcome] = []
    for instance, fleet in dict.fromkeys((instance, fleet) for instance, fleet, _ in by_training):
        for training in range(study.shape[1]):
            own = by_training.get((instance, fleet, training))
            if own is None and (instance, fleet, 1) in by_training:
                raise FleetError(f"A training of the rows is missing: {training} of instance {instance}.")
            outcomes += own or by_training[instance, fleet, 0]
    return outcomes
