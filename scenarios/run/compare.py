"""Several policies on the same seeds, with paired differences."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from rich.console import Group
from rich.text import Text

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import FleetError
from fleet.files import cache_folder
from scenarios.policy_loader import label, policy_of, scope_of
from scenarios.prepare.fleet import RISK, DifficultyName, Fleet, RiskName, prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Count, Progress, quiet
from scenarios.report.page import table
from scenarios.run.evaluate import COUNTS, FIGURES, POSSIBLE, Outcome, outcomes
from scenarios.schema import Scenario
from scenarios.statistics.means import unit
from scenarios.statistics.tables import LEGEND, Figure, add_block, empty_table, figures_of, remarks

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
TOGETHER = 16
"""Shifts of a policy that are stepped side by side."""
HERE_S = 5.0
"""About the time that a worker process takes to start; until then this process does the work."""


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

    @property
    def unit(self) -> str:
        """What the intervals speak about."""
        return unit((1, 1, len(self.seeds)))

    def _repr_html_(self) -> str:
        head = ("policy", *(HEADINGS[name] for name in FIGURES))
        rows = [[label(policy), *map(self._cell, figures.values())] for policy, figures in self.figures.items()]
        what = f"mean [interval] and paired difference to {label(self.baseline)}; {LEGEND}"
        more = "".join(f" {each}" for each in remarks(self.figures, len(self.seeds)))
        return table(head, rows, caption=f"{self.scenario}, {self.unit}: {what}.{more}")

    @staticmethod
    def _cell(figure: Figure) -> str:
        bounds = f" [{figure.low:.3g}, {figure.high:.3g}]" if figure.low == figure.low else ""
        difference = f" {figure.difference:+.3g}{figure.stars}" if figure.difference else ""
        return f"{figure.mean:.4g}{bounds}{difference}"


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
    figures = figures_of_shifts(by_policy, baseline)
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


def figures_of_shifts(by_policy: Mapping[str, Sequence[Outcome]], baseline: str) -> dict[str, dict[str, Figure]]:
    """The compared figures of several policies, or of other variants, by its name and that of the figure.

    Args:
        by_policy: On the same seeds, in the same order.
        baseline: The one that differences refer to.
    """
    values = {
        policy: {name: np.array([getattr(row, name) for row in rows], dtype=float) for name in FIGURES}
        for policy, rows in by_policy.items()
    }
    return figures_of(values, baseline, counts=COUNTS, possible=POSSIBLE)


def comparison_table(result: Comparison) -> Group:
    """A block per figure: mean and paired difference, each with its interval; narrow enough for 80 columns."""
    title = (
        f"{result.scenario}, seeds {result.seeds[0]} to {result.seeds[-1]} ({result.unit}): mean, paired difference to "
        f"{result.baseline}, {LEGEND}"
    )
    if result.channel != PERFECT.described():
        title += f"\nChannel: {result.channel_text}."
    table = empty_table()
    table.add_row("[bold]scope[/bold]")
    for policy, scope in result.scopes.items():
        table.add_row(f"  {label(policy)}", scope)
    for name in FIGURES:
        figures = {policy: each[name] for policy, each in result.figures.items()}
        add_block(table, HEADINGS[name], figures, result.baseline, label, LEAST_DIGITS.get(name, 1))
    below = list(remarks(result.figures, len(result.seeds)))
    central = [label(policy) for policy, scope in result.scopes.items() if scope == "central"]
    if result.channel != PERFECT.described() and central:
        below.append(f"Central policies read no messages: {', '.join(central)}.")
    return Group(Text(title), table, *map(Text, below))
