"""Several policies on the same seeds: figures with paired differences, and scores."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from scenarios.evaluate.rollout import FIGURES, KINDS, Outcome
from scenarios.evaluate.scores import Normalised, Scores, Shift, and_trainings, normalised, scores_of
from scenarios.evaluate.statistics import HEAD, LEGEND, Figure, fewest, figure_rows, figures_of, remarks, unit
from scenarios.evaluate.study import Row, Study, suite_label
from scenarios.policy_loader import has_trainings, label, scope_of
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, quiet
from scenarios.spec.load import scenario_with
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.spec.schema import Scenario
from scenarios.table import Table

if TYPE_CHECKING:  # slow to import
    from scenarios.evaluate.references import Reference

Array = np.ndarray


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


@dataclass(frozen=True)
class Comparison:
    """Policies on the same seeds."""

    scenario: str
    seeds: tuple[int, ...]
    unit: str
    """What the intervals speak about."""
    draws: int
    """Independent draws that the intervals rest on: the smallest number of fleets, trainings, seeds or instances."""
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
    scores: Scores | None = None
    """Normalised scores; None without references of the shifts."""
    randomise: Randomisation = field(default_factory=Randomisation)
    """Of every shift, the same for every policy."""

    @property
    def title(self) -> str:
        """What was compared, with the seeds if they follow each other."""
        first, last = self.seeds[0], self.seeds[-1]
        consecutive = self.seeds == tuple(range(first, first + len(self.seeds)))
        seeds = f", seeds {first} to {last}" if consecutive else ""
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


def compare(
    scenario: str | Path | Scenario,
    policies: Sequence[str],
    *,
    seeds: Sequence[int] = range(20),
    baseline: str | None = None,
    difficulty: DifficultyName = "twin",
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
        policies: Names, FILE.py:CLASS, or folders of trained policies.
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
    from scenarios.evaluate.study import Case, Study

    chosen = scenario_with(scenario, {}, compare)
    if not policies or not seeds:
        raise FleetError(f"A comparison needs a policy and a seed (got {len(policies)} policies, {len(seeds)} seeds).")
    study = Study(
        policies=policies,
        cases=[Case(name=chosen.name, scenario=chosen, seeds=tuple(seeds))],
        difficulties=[difficulty],
        risk=risk,
        randomise=randomise,
        channel=chosen.channel(channel),
    )
    base = baseline or next(iter(study.competitors.values()))
    check_baseline(study, base)
    rows = run_study(study, cache_dir=cache_dir, workers=workers, progress=progress)
    return comparison_of(study, rows, base)


def figures_of_shifts(
    by_policy: Mapping[str, Sequence[Outcome]], baseline: str, shape: tuple[int, int, int, int] = (1, 1, 1, -1)
) -> dict[str, dict[str, Figure]]:
    """The compared figures of several policies, or of other variants, by its name and that of the figure.

    Args:
        by_policy: On the same seeds, in the same order.
        baseline: The one that differences refer to.
        shape: Instances, fleets, trainings and seeds. Of several instances each counts once, by its mean; trainings of
            a policy, which do all instances, are a sample, too.
    """

    def values_of(policy: str, rows: Sequence[Outcome], name: str) -> Array:
        values = np.array([getattr(row, name) for row in rows], dtype=float).reshape(shape)
        if shape[0] == 1:
            return values[0]
        by_training = values.mean(axis=(1, 3)).T[:, None]  # [training, 1, instance]
        return by_training if has_trainings(policy) else by_training.mean(axis=0, keepdims=True)

    values = {policy: {name: values_of(policy, rows, name) for name in FIGURES} for policy, rows in by_policy.items()}
    return figures_of(values, baseline, KINDS)


def check_baseline(study: Study, baseline: str) -> None:
    """Check that the baseline is compared.

    Raises:
        FleetError: it is not; names what is.
    """
    names = study.competitors.values()
    if baseline not in names:
        raise FleetError(f"The baseline '{baseline}' is not among the policies compared: {', '.join(names)}.")


def comparison_of(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    name: str | None = None,
    references: "Mapping[Shift, Reference] | None" = None,
) -> Comparison:
    """The figures of each policy over the fleets, trainings and seeds of all instances of the rows, and its differences
    to the baseline.

    Args:
        rows: In the order of the study.
        baseline: One of `Study.competitors`.
        name: Of the instances together; default: that of the only one.
        references: Of the shifts, for normalised scores.
    """
    names, shifts = study.competitors, rows_of_competitors(study, rows)
    failures = [
        Failed(each, k.instance, k.fleet, k.training, k.seed, row.error, row.trace or "")
        for each, of in shifts.items()
        for row in of
        if row.error is not None
        for k in [row.key]
    ]
    failed, count = {each.policy for each in failures}, len({row.key.instance for row in rows})
    whole = {each: repeated(study, of) for each, of in shifts.items() if each not in failed}
    values = _scores(study, {each: shifts[each] for each in whole}, references) if baseline in whole else None
    fleets, trainings, per_fleet = study.shape
    several = (count, study.most_trainings) if count > 1 else (fleets if fleets > 1 else trainings, per_fleet)
    return Comparison(
        scenario=name or rows[0].key.instance,
        seeds=tuple(dict.fromkeys(row.key.seed for row in rows)),
        unit=unit(study.shape) if count == 1 else f"{count} instances{and_trainings(study.most_trainings)}",
        draws=fewest(several),
        baseline=baseline,
        figures=figures_of_shifts(whole, baseline, (count, *study.shape)) if baseline in whole else {},
        scopes={names[p, d]: scope_of(p) if names[p, d] in whole else "failed" for p, d in names},
        channel=study.channel.described(),
        channel_text=study.channel_text,
        illegal={each: sum(row.illegal for row in of) for each, of in shifts.items()},
        failures=tuple(failures),
        scores=scores_of(values, baseline) if values else None,
        randomise=study.randomise or Randomisation(),
    )


def rows_of_competitors(study: Study, rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each of `Study.competitors`, in their order."""
    names = study.competitors
    shifts: dict[str, list[Row]] = {each: [] for each in names.values()}
    for row in rows:
        shifts[names[row.key.policy, row.key.difficulty]].append(row)
    return shifts


def scores_over_all(study: Study, rows: Sequence[Row], references: "Mapping[Shift, Reference]") -> Normalised | None:
    """Scores of the policies without a failure over all instances; None without references of the shifts."""
    return _scores(study, rows_without_failures(study, rows), references)


def _scores(
    study: Study, by_policy: Mapping[str, Sequence[Row]], references: "Mapping[Shift, Reference] | None"
) -> Normalised | None:
    """As `normalised`; None with a randomisation, because references are of the shifts without one."""
    return None if study.randomise else normalised(by_policy, references or {})


def rows_without_failures(study: Study, rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of those competitors that failed in no shift."""
    shifts = rows_of_competitors(study, rows)
    return {each: of for each, of in shifts.items() if not any(row.error is not None for row in of)}


def repeated(study: Study, rows: Iterable[Row]) -> list[Outcome]:
    """The outcomes of one policy, those without trainings once for each training: in the order of `Study.shape`."""
    of: dict[tuple[str, int, int], list[Outcome]] = {}
    for row in rows:
        assert row.outcome is not None
        of.setdefault((row.key.instance, row.key.fleet, row.key.training), []).append(row.outcome)
    found: list[Outcome] = []
    for instance, fleet in dict.fromkeys((instance, fleet) for instance, fleet, _ in of):
        for training in range(study.shape[1]):
            own = of.get((instance, fleet, training))
            if own is None and (instance, fleet, 1) in of:
                raise FleetError(f"A training of the rows is missing: {training} of instance {instance}.")
            found += own or of[instance, fleet, 0]
    return found


def comparisons(
    study: Study,
    rows: Sequence[Row],
    baseline: str,
    suite: str | None = None,
    references: "Mapping[Shift, Reference] | None" = None,
) -> list[Comparison]:
    """One comparison of all instances of a suite, or one for each instance."""
    check_baseline(study, baseline)
    if suite:
        return [comparison_of(study, rows, baseline, suite_label(suite), references)]
    of = {case.name: [row for row in rows if row.key.instance == case.name] for case in study.cases}
    return [comparison_of(study, own, baseline, references=references) for own in of.values()]
