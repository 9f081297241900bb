"""Windows of motion: one sample rate, one length, and z-scores.

Joints 1, 3, 5 and 7 of a Gen3 have no end stops, so the same posture has many angles. Angles are unwrapped in time, and
each window is shifted by whole turns until its mean lies nearest the training data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from fleet.motion import CHANNELS, RATE_HZ, Plan, distinct
from twin.logs.recording import CONTINUOUS
from twin.vae.config import TwinConfig

Array = np.ndarray

Value = TypeVar("Value")


class PlanCache(WeakKeyDictionary[Plan, Value]):
    """Values by plan, kept while the plan is alive; empty in a copy and in another process."""

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return PlanCache, ()


Q = CHANNELS.index("q")
PHASES = ("approach", "cycle", "retreat")
STD_FLOOR = (0.02, 0.02, 0.2)
"""Least standard deviation per channel, rad, rad/s, N·m: smaller differences are sensor noise."""


def resample(profile: Array, from_hz: float, to_hz: float) -> Array:
    """The profile at another sample rate; each new sample is the mean over its time, so mean load is kept.

    Args:
        profile: [time, channel, joint]; sample i stands for the time from i/from_hz to (i+1)/from_hz.

    Returns:
        float64 [time, channel, joint] with continuous joints unwrapped; the last sample may stand for a shorter time.
    """
    samples = np.array(profile, dtype=float)
    continuous = [j for j in CONTINUOUS if j < samples.shape[-1]]
    turns = np.round(np.diff(samples[:, Q, continuous], axis=0) / (2 * np.pi))
    if turns.any():
        samples[1:, Q, continuous] -= 2 * np.pi * np.cumsum(turns, axis=0)
    if len(samples) == 0 or from_hz == to_hz:
        return samples
    length = len(samples)
    count = int(np.ceil(length * to_hz / from_hz - 1e-9))
    edges = np.minimum(np.arange(count + 1) * (from_hz / to_hz), length)
    integral = np.zeros((length + 1, *samples.shape[1:]))
    np.cumsum(samples, axis=0, out=integral[1:])
    whole = np.minimum(edges.astype(int), length - 1)
    at_edges = integral[whole] + (edges - whole)[:, None, None] * samples[whole]
    return np.diff(at_edges, axis=0) / np.diff(edges)[:, None, None]


def starts(length: int, window: int, stride: int) -> Array:
    """First samples of the windows that cover `length` samples, every `stride`; the last window ends at the end."""
    if length <= window:
        return np.zeros(min(length, 1), dtype=int)
    return np.append(np.arange(0, length - window, stride), length - window)


def cut(samples: Array, window: int, stride: int) -> Array:
    """Windows of samples [time, channel, joint], [batch, time, joint, channel]; no samples give no windows.

    Motion shorter than a window is padded with its last sample: an arm that has arrived stays there.
    """
    index = starts(len(samples), window, stride)[:, None] + np.arange(window)
    return samples[np.minimum(index, max(len(samples) - 1, 0))].transpose(0, 1, 3, 2)


def cover(length: int, window: int, stride: int) -> Array:
    """Weight of each window sample in the time mean over all `length` samples, [batch, time]; sums to one.

    Every sample counts once however many windows overlap on it; padding counts nothing.
    """
    index = starts(length, window, stride)[:, None] + np.arange(window)
    inside = index < length
    overlaps = np.bincount(index[inside], minlength=length)
    return np.where(inside, 1.0 / (overlaps[np.minimum(index, max(length - 1, 0))] * max(length, 1)), 0.0)


def windows_of(records: Sequence[Array], config: TwinConfig) -> Array:
    """Training windows of records [time, channel, joint], [batch, time, joint, channel].

    Raises:
        ValueError: no record, a record of another shape, or one that is not finite.
    """
    for i, record in enumerate(records):
        check_profile(record, f"Record {i}")
    parts = [
        cut(resample(record, config.record_hz, config.rate_hz), config.window, config.stride)
        for record in records
        if len(record)
    ]
    if not parts:
        raise ValueError("Training needs at least one record with samples (got none).")
    if len({part.shape[2] for part in parts}) > 1:
        raise ValueError("All records must have the same number of joints.")
    return np.concatenate(parts)


def draw_windows(windows: Array, most: int, seed: np.random.SeedSequence) -> Array:
    """At most `most` of the windows, sampled without replacement, in their order."""
    if len(windows) <= most:
        return windows
    return windows[np.sort(np.random.default_rng(seed).choice(len(windows), most, replace=False))]


def check_profile(profile: Array, name: str) -> None:
    """Raise ValueError unless the profile, of this name in the error, is finite and [time, 3, joint]."""
    if profile.ndim != 3 or profile.shape[1] != len(CHANNELS):
        raise ValueError(f"{name} must be [time, 3, joint] (got shape {profile.shape}).")
    if not np.isfinite(profile).all():
        time, channel, joint = np.argwhere(~np.isfinite(profile))[0]
        raise ValueError(f"{name} is not finite: {CHANNELS[channel]} of joint {joint + 1} at sample {time}.")


@dataclass(frozen=True, eq=False)
class JobWindows:
    """Jobs (or phases) as windows, with the weights of a mean over each job's time."""

    windows: Array
    """SI units, [batch, time, joint, channel]."""
    weight: Array
    """Share of its job's time that each sample stands for, [batch, time]; sums to one over the windows of a job."""
    job: Array
    """Index of the job that each window belongs to, [batch]."""
    jobs: int
    """Number of jobs."""

    def mean(self, values: Array) -> Array:
        """Time mean over each job of values per sample, [batch, time, ...] or [batch, 1, ...] to [job, ...]."""
        return self.total(np.einsum("bt,bt...->b...", self.weight, values))

    def total(self, values: Array) -> Array:
        """Sum over the windows of each job, [batch, ...] to [job, ...]."""
        total = np.zeros((self.jobs, *values.shape[1:]))
        np.add.at(total, self.job, values)
        return total


def cut_phases(plans: Sequence[Plan], config: TwinConfig) -> JobWindows:
    """Windows of each phase of at least one plan as a twin scores them; phase k of plan i is job 3·i + k.

    Raises:
        ValueError: a profile that is not finite.
    """
    parts, weights, owners = [], [], []
    for plan in plans:
        for name, phase in zip(PHASES, plan.phases, strict=True):
            profile = phase.profile
            if len(distinct(profile)) < len(profile):  # all windows of a standstill are equal: one is enough
                profile = profile[: int(np.ceil(config.window * RATE_HZ / config.rate_hz))]
            check_profile(profile, f"{name.capitalize()} of arm '{plan.arm}'")
            samples = resample(profile, RATE_HZ, config.rate_hz)
            parts.append(cut(samples, config.window, config.score_stride))
            weights.append(cover(len(samples), config.window, config.score_stride))
            owners.append(np.full(len(parts[-1]), len(owners)))
    return JobWindows(np.concatenate(parts), np.concatenate(weights), np.concatenate(owners), len(owners))


def cut_jobs(plans: Sequence[Plan], repetitions: Sequence[int], config: TwinConfig) -> JobWindows:
    """Windows of jobs, each a repeated plan, as a twin of this configuration cuts them.

    Raises:
        ValueError: as `check_jobs`, or a profile that is not finite.
    """
    check_jobs(plans, repetitions)
    phases = cut_phases(plans, config)
    shares = np.concatenate([plan.weights(times) for plan, times in zip(plans, repetitions, strict=True)])
    weight = shares[phases.job][:, None] * phases.weight
    return JobWindows(phases.windows, weight, phases.job // len(PHASES), len(plans))


def check_jobs(plans: Sequence[Plan], repetitions: Sequence[int], *, least: int = 1) -> None:
    """Raise ValueError for fewer than `least` jobs, unequal numbers of plans and repetitions, repetitions < 1, or a
    plan without motion.
    """
    if len(plans) < least:
        raise ValueError("There is no job to score.")
    if len(plans) != len(repetitions):
        raise ValueError(f"Each job needs its repetitions: {len(plans)} plans, {len(repetitions)} repetitions.")
    for plan, times in zip(plans, repetitions, strict=True):
        if times < 1:
            raise ValueError(f"A job has at least one repetition (got {times}).")
        if plan.duration_s(times) == 0:
            raise ValueError(f"The plan of arm '{plan.arm}' has no motion in it.")


@dataclass(frozen=True, eq=False)
class Scaler:
    """Z-scores per joint and channel, fitted on training windows alone."""

    turn_q: Array
    """Continuous joints are shifted by whole turns to near this angle, rad, [joint]."""
    mean: Array
    """[joint, channel]."""
    std: Array
    """[joint, channel], at least `STD_FLOOR`."""
    still: Array
    """Joints of which no channel varied more than the floor in training, bool [joint]."""

    @classmethod
    def fit(cls, windows: Array) -> "Scaler":
        """The scaler of training windows [batch, time, joint, channel]."""
        turn_q = np.angle(np.exp(1j * windows[..., Q]).mean(axis=(0, 1)))
        near = _nearest_turn(windows, turn_q)
        std, floor = near.std(axis=(0, 1)), np.array(STD_FLOOR)
        return cls(turn_q, near.mean(axis=(0, 1)), np.maximum(std, floor), (std < floor).all(axis=-1))

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.turn_q)

    def to_z(self, windows: Array) -> Array:
        """Windows [batch, time, joint, channel] in training standard deviations, float32."""
        return ((_nearest_turn(windows, self.turn_q) - self.mean) / self.std).astype(np.float32)

    def to_si(self, z: Array) -> Array:
        """Back to rad, rad/s, N·m, [batch, time, joint, channel]; angles near the training data."""
        return z.astype(float) * self.std + self.mean


def _nearest_turn(windows: Array, turn_q: Array) -> Array:
    near = np.array(windows, dtype=float)
    joints = [j for j in CONTINUOUS if j < near.shape[2]]
    away = near[:, :, joints, Q].mean(axis=1) - turn_q[joints]
    near[:, :, joints, Q] -= 2 * np.pi * np.round(away / (2 * np.pi))[:, None]
    return near
