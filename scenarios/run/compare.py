"""Several policies on the same seeds, with paired differences."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.stats import bootstrap, trim_mean

from fleet.bus.exchange.channel import PERFECT, Channel
from scenarios.policy_loader import label
from scenarios.prepare.fleet import RISK, DifficultyName, RiskName
from scenarios.progress import Progress, quiet
from scenarios.report.page import table
from scenarios.run.evaluate import FIGURES, Outcome
from scenarios.schema import Scenario

Array = np.ndarray

HEADINGS = {
    "reward": "reward",
    "value": "value",
    "finished": "jobs finished",
    "on_time": "jobs on time",
    "faults": "faults",
    "above_warning_min": "min above warning",
    "peak_c": "hottest motor, °C",
    "availability": "availability, 0–1",
    "insulation_ppb": "insulation, ppb",
    "tool_drift_mm": "tool drift, mm",
    "hot_surface_min": "min hot surface",
}
"""Headings of the figures in the table, with units."""
LEAST_DIGITS = {"availability": 3, "tool_drift_mm": 2}
"""Decimals of a figure; 1 for others."""
MORE_DIGITS = 3
RESAMPLES = 2000


@dataclass(frozen=True)
class Figure:
    """One figure of one policy over the seeds."""

    mean: float
    iqm: float
    """Interquartile mean (Agarwal et al., NeurIPS 2021)."""
    low: float
    high: float
    """95 % bootstrap interval of the mean."""
    difference: float
    """Mean paired difference to the baseline."""
    difference_low: float
    difference_high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval of the difference excludes 0."""
        return self.difference_low > 0 or self.difference_high < 0


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

    def _repr_html_(self) -> str:
        head = ("policy", *(HEADINGS[name] for name in FIGURES))
        rows = [[label(policy), *map(self._cell, figures.values())] for policy, figures in self.figures.items()]
        what = f"mean (difference to {label(self.baseline)}; * its 95 % interval excludes 0)"
        return table(head, rows, caption=f"{self.scenario}, {len(self.seeds)} seeds: {what}")

    @staticmethod
    def _cell(figure: Figure) -> str:
        difference = f" ({figure.difference:+.3g}{'*' * figure.excludes_zero})" if figure.difference else ""
        return f"{figure.mean:.4g}{difference}"


def compare(
    scenario: Scenario,
    policies: Sequence[str],
    *,
    seeds: Sequence[int],
    baseline: str,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    channel: Channel = PERFECT,
    cache_dir: Path | None = None,
    workers: int = -1,
    progress: Progress = quiet,
) -> Comparison:
    """Run every policy on every seed, in memory and on the profile plant.

    Args:
        channel: Topology, delay and loss of the arms' messages, the same for every policy.
        workers: Processes, if there is work for more than some seconds; -1 for one per core. The result does not
            depend on it.

    Raises:
        FleetError: unknown policy, one given twice, or a baseline that is not among the policies.
    """
    from scenarios.trials.contest import run_study
    from scenarios.trials.plan import Case, Study
    from scenarios.trials.summary import check_baseline, comparison_of

    case = Case(name=scenario.name, scenario=scenario, seeds=tuple(seeds))
    study = Study(policies=policies, cases=[case], difficulties=[difficulty], risk=risk, channel=channel)
    check_baseline(study, baseline)
    rows = run_study(study, cache_dir=cache_dir, workers=workers, progress=progress)
    return comparison_of(study, rows, baseline)


def figure_of(name: str, rows: Sequence[Outcome], base: Sequence[Outcome]) -> Figure:
    """One figure over seeds: mean, and paired difference to the rows of a baseline.

    Args:
        rows, base: On the same seeds, in the same order.
    """
    values = np.array([getattr(each, name) for each in rows], dtype=float)
    paired = values - np.array([getattr(each, name) for each in base], dtype=float)
    mean, iqm = float(values.mean()), float(trim_mean(values, 0.25))
    return Figure(mean, iqm, *interval(values), float(paired.mean()), *interval(paired))


def interval(values: Array) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean over seeds, [seed]; depends on these values alone."""
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])
    rng = np.random.default_rng(np.random.SeedSequence(0))
    result = bootstrap((values,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=rng, vectorized=True)
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _digits(figures: Sequence[Figure], least: int) -> int:
    """Decimals, up to `MORE_DIGITS` more than the least, with which no interval that excludes 0 seems to include it."""
    nearest = [min(abs(f.difference_low), abs(f.difference_high)) for f in figures if f.excludes_zero]
    enough = (n for n in range(least, least + MORE_DIGITS) if all(round(bound, n) for bound in nearest))
    return next(enough, least + MORE_DIGITS)


def comparison_table(result: Comparison) -> Group:
    """A block per figure: mean and paired difference, each with its interval; narrow enough for 80 columns."""
    title = (
        f"{result.scenario}, seeds {result.seeds[0]} to {result.seeds[-1]}: mean, paired difference to "
        f"{result.baseline}, 95 % intervals; * excludes 0"
    )
    if result.channel != PERFECT.described():
        title += f"\nChannel: {result.channel_text}."
    table = Table(box=None, pad_edge=False)
    table.add_column("", overflow="fold")
    for name in ("mean", "interval", "difference", "interval", ""):
        table.add_column(name, justify="right")
    table.add_row("[bold]scope[/bold]")
    for policy, scope in result.scopes.items():
        table.add_row(f"  {label(policy)}", scope)
    for name in FIGURES:
        table.add_row(f"[bold]{HEADINGS[name]}[/bold]")
        digits = _digits([figures[name] for figures in result.figures.values()], LEAST_DIGITS.get(name, 1))
        for policy, figures in result.figures.items():
            f = figures[name]
            mean, low, high = (f"{value:z.{digits}f}" for value in (f.mean, f.low, f.high))
            cells = [f"  {label(policy)}", mean, f"{low} … {high}"]
            if policy != result.baseline:
                difference, low, high = (
                    f"{value:+z.{digits}f}" for value in (f.difference, f.difference_low, f.difference_high)
                )
                star = "*" if float(low) > 0 or float(high) < 0 else ""
                cells += [difference, f"{low} … {high}", star]
            table.add_row(*cells)
    central = [label(policy) for policy, scope in result.scopes.items() if scope == "central"]
    if result.channel != PERFECT.described() and central:
        return Group(Text(title), table, Text(f"Central policies read no messages: {', '.join(central)}."))
    return Group(Text(title), table)
