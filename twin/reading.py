"""One reading of a job's time for every score: windows of its phases, each sample with its share of the job."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.motion import RATE_HZ, Plan
from twin.model import TwinConfig
from twin.score import PHASES
from twin.window import check_profile, cover, cut, resample

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Reading:
    """Jobs as windows, with the weights that make a mean over each job's time."""

    windows: Array
    """SI units, [batch, time, joint, channel]."""
    weight: Array
    """Share of its job's time that each sample stands for, [batch, time]; sums to one over the windows of a job."""
    job: Array
    """Which job a window belongs to, [batch]."""
    jobs: int
    """How many jobs were read."""

    def mean(self, values: Array) -> Array:
        """Time mean over each job of what was found at each sample, [batch, time, ...] to [job, ...]."""
        return self._sum(np.einsum("bt,bt...->b...", self.weight, values))

    def mean_of_windows(self, values: Array) -> Array:
        """Time mean over each job of what was found of each window, [batch, ...] to [job, ...]."""
        return self._sum(np.einsum("b,b...->b...", self.weight.sum(axis=1), values))

    def _sum(self, of_window: Array) -> Array:
        total = np.zeros((self.jobs, *of_window.shape[1:]))
        np.add.at(total, self.job, of_window)
        return total


def read_jobs(plans: Sequence[Plan], repetitions: Sequence[int], config: TwinConfig) -> Reading:
    """Windows of every phase of the jobs, cut as a twin of this configuration cuts them for its score.

    Args:
        repetitions: Cycles of each job, [job].

    Raises:
        ValueError: no jobs, another number of repetitions than of plans, repetitions < 1, or a plan that has no
            motion in it or is not finite.
    """
    check_jobs(plans, repetitions)
    parts, weights, owners = [], [], []
    for i, (plan, times) in enumerate(zip(plans, repetitions, strict=True)):
        for name, phase, share in zip(PHASES, plan.phases, plan.weights(times), strict=True):
            profile = check_profile(phase.profile, f"{name.capitalize()} of arm '{plan.arm}'")
            samples = resample(profile, RATE_HZ, config.rate_hz)
            parts.append(cut(samples, config.window, config.score_stride))
            weights.append(share * cover(len(samples), config.window, config.score_stride))
            owners.append(np.full(len(parts[-1]), i))
    return Reading(np.concatenate(parts), np.concatenate(weights), np.concatenate(owners), len(plans))


def check_jobs(plans: Sequence[Plan], repetitions: Sequence[int]) -> None:
    """Raise the ValueError that says what is wrong with jobs that have no time to take a mean over."""
    if len(plans) == 0:
        raise ValueError("There is no job to score.")
    if len(plans) != len(repetitions):
        raise ValueError(f"Each job needs its repetitions: {len(plans)} plans, {len(repetitions)} repetitions.")
    for plan, times in zip(plans, repetitions, strict=True):
        if times < 1:
            raise ValueError(f"A job has at least one repetition (got {times}).")
        if plan.duration_s(times) == 0:
            raise ValueError(f"The plan of arm '{plan.arm}' has no motion in it.")
