"""Several policies on the same seeds, with paired differences."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.stats import bootstrap, trim_mean

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from fleet.files import cache_folder
from scenarios.policy_loader import label, policy_of, scope_of
from scenarios.prepare.fleet import RISK, DifficultyName, Fleet, RiskName, prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Count, Progress, quiet
from scenarios.report.page import table
from scenarios.run.evaluate import FIGURES, Outcome, outcomes
from scenarios.schema import Scenario

Array = np.ndarray
Models = tuple[DifficultyName, RiskName, Randomisation | None]
Part = tuple[str, Sequence[int]]
"""A policy, and some of the seeds."""

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
TOGETHER = 16
"""Shifts of a policy that are stepped side by side."""
HERE_S = 5.0
"""About the time that a worker process takes to start; until then this process does the work."""


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
    randomise: Randomisation | None = None,
    channel: Channel = PERFECT,
    cache_dir: Path | None = None,
    workers: int = -1,
    progress: Progress = quiet,
) -> Comparison:
    """Run every policy on every seed, in memory and on the profile plant.

    Args:
        randomise: Varies the shifts beyond what the scenario draws, the same for every policy.
        channel: Topology, delay and loss of the arms' messages, the same for every policy.
        workers: Processes, if there is work for more than some seconds; -1 for one per core. The result does not
            depend on it.

    Raises:
        FleetError: unknown policy, one given twice, or a baseline that is not among the policies.
    """
    for i, policy in enumerate(policies):
        policy_of(policy)
        if policy in policies[:i]:
            raise FleetError(f"The policy '{policy}' is given twice; names must be unique.")
    if baseline not in policies:
        raise FleetError(f"The baseline '{baseline}' is not among the policies compared: {', '.join(policies)}.")
    folder = cache_dir or cache_folder()  # here: a worker may have started with another one
    models = (difficulty, risk, randomise)
    fleet = _prepared(scenario, models, folder, progress)
    channel = scenario.channel(channel)
    together = TOGETHER if channel.perfect else 1
    parts = [(policy, seeds[i : i + together]) for policy in policies for i in range(0, len(seeds), together)]
    by_policy: dict[str, list[Outcome]] = {policy: [] for policy in policies}
    results = _run_parts(fleet, models, channel, folder, parts, workers)
    for n, ((policy, _), result) in enumerate(zip(parts, results, strict=True)):
        by_policy[policy] += result
        progress("comparing", Count((n + 1) * len(seeds) * len(policies) // len(parts), len(seeds) * len(policies)))
    figures = {
        p: {name: figure_of(name, rows, by_policy[baseline]) for name in FIGURES} for p, rows in by_policy.items()
    }
    scopes = {policy: scope_of(policy) for policy in policies}
    return Comparison(scenario.name, tuple(seeds), baseline, figures, scopes, channel.described(), channel.text)


def _run_parts(
    fleet: Fleet, models: Models, channel: Channel, folder: Path, parts: Sequence[Part], workers: int
) -> Iterator[list[Outcome]]:
    """The outcomes of each part in order, from this process in the first seconds, then from workers."""
    began_s, todo = time.monotonic(), list(parts)
    while todo and (workers == 1 or time.monotonic() - began_s < HERE_S):
        yield outcomes(fleet, *todo.pop(0), channel)
    if not todo:
        return
    with Parallel(n_jobs=workers, return_as="generator") as pool:
        for result in pool(delayed(_run_in_worker)(fleet.scenario, models, folder, *part, channel) for part in todo):
            assert result is not None
            yield result


@cache
def _fleet(scenario: Scenario, models: Models, folder: Path) -> Fleet:
    return _prepared(scenario, models, folder)


def _prepared(scenario: Scenario, models: Models, folder: Path, progress: Progress = quiet) -> Fleet:
    difficulty, risk, randomise = models
    return prepare(scenario, difficulty=difficulty, risk=risk, randomise=randomise, cache=folder, progress=progress)


def _run_in_worker(
    scenario: Scenario, models: Models, folder: Path, policy: str, seeds: Sequence[int], channel: Channel
) -> list[Outcome]:
    return outcomes(_fleet(scenario, models, folder), policy, seeds, channel)


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
