"""Several policies on the same seeds, with paired differences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from scenarios.policy_loader import has_trainings
from scenarios.prepare.fleet import RISK, DifficultyName, RiskName
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, quiet
from scenarios.run.evaluate import COUNTS, FIGURES, POSSIBLE, Outcome
from scenarios.schema import Scenario
from scenarios.statistics.scores import Scores
from scenarios.statistics.tables import Figure, figures_of

if TYPE_CHECKING:
    from scenarios.show.table import Table

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
    "hot_surface_min": "hot surface, min",
}
"""Headings of the figures in the table, with units."""
LEAST_DIGITS = {"availability": 3, "tool_drift_mm": 2}
"""Decimals of a figure; 1 for others."""


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
    def table(self) -> "Table":
        """A group per figure: mean and paired difference, each with its interval; narrow enough for 80 columns."""
        from scenarios.show.comparison_page import comparison_table

        return comparison_table(self)

    def _repr_html_(self) -> str:
        return str(self.table.html())


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
    from scenarios.trials.contest import run_study
    from scenarios.trials.plan import Case, Study
    from scenarios.trials.summary import check_baseline, comparison_of

    study = Study(
        policies=policies,
        cases=[Case(name=scenario.name, scenario=scenario, seeds=tuple(seeds))],
        difficulties=[difficulty],
        risk=risk,
        randomise=randomise,
        channel=scenario.channel(channel),
    )
    check_baseline(study, baseline)
    rows = run_study(study, cache_dir=cache_dir, workers=workers, progress=progress)
    return comparison_of(study, rows, baseline)


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
    return figures_of(values, baseline, counts=COUNTS, possible=POSSIBLE)
