"""Planned joint motion, sampled in time, and the mean heat drive that it causes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleet.heat.motor import Motors, friction_heat, reference_current
from fleet.job import Work

Array = np.ndarray

RATE_HZ = 50.0
"""Samples per second of every planned profile."""
CHANNELS = ("q", "qd", "tau")
"""Channel axis of a profile: rad, rad/s, N·m."""


@dataclass(frozen=True, eq=False)
class Phase:
    """A part of a plan. Sample i holds from i/RATE_HZ to (i+1)/RATE_HZ."""

    profile: Array
    """float32 [time, channel, joint]: q rad, qd rad/s, tau N·m at the joint output (friction not included)."""
    payload_kg: Array
    """Carried mass at each sample, float32 [time]."""

    def __post_init__(self) -> None:
        if self.profile.ndim != 3 or self.profile.shape[1] != len(CHANNELS):
            raise ValueError(f"Phase.profile must be [time, 3, joint] (got shape {self.profile.shape}).")
        if self.payload_kg.shape != self.profile.shape[:1]:
            raise ValueError(f"Phase.payload_kg must be [time] (got shape {self.payload_kg.shape}).")

    @property
    def duration_s(self) -> float:
        """Duration, s; zero for an empty phase."""
        return len(self.profile) / RATE_HZ


@dataclass(frozen=True, eq=False)
class Plan:
    """One variant (elbow, speed) of an arm's motion for a task: from home, through repeated cycles, back home."""

    arm: str
    work: Work
    elbow: int
    """Index of the elbow posture, 0 is the fastest."""
    speed: float
    """Share of the joint limits that the motion uses, (0, 1]."""
    approach: Phase
    """From the home posture to the start of the cycle."""
    cycle: Phase
    """One repetition; ends where it starts."""
    retreat: Phase
    """Back to the home posture."""

    @property
    def phases(self) -> tuple[Phase, Phase, Phase]:
        """Approach, cycle, retreat."""
        return (self.approach, self.cycle, self.retreat)

    @cached_property
    def stops(self) -> Array:
        """Postures at which the arm stops, float32 [stop, joint]; joint paths between them are straight."""
        profiles = [distinct(phase.profile) for phase in self.phases]
        stops = np.concatenate([profile[(profile[:, 1] == 0).all(axis=1), 0] for profile in profiles])
        return stops[np.append(True, (np.diff(stops, axis=0) != 0).any(axis=1))]

    def duration_s(self, repetitions: int) -> float:
        """Time from leaving home to being home again, s."""
        return self.approach.duration_s + repetitions * self.cycle.duration_s + self.retreat.duration_s

    def weights(self, repetitions: int) -> Array:
        """Share of each phase in the job's time, [phase], sums to one."""
        times = np.array([self.approach.duration_s, repetitions * self.cycle.duration_s, self.retreat.duration_s])
        return times / times.sum()


@dataclass(frozen=True, eq=False)
class Drive:
    """Causes of motor heat during a motion, averaged over its time."""

    current_sq: Array
    """Mean squared current at the magnets' reference temperature, A², [..., joint]."""
    friction_w: Array
    """Mean friction heat, W, [..., joint]."""


def distinct(profile: Array) -> Array:
    """Return the first sample of a standstill that is stored once, whatever its duration; other profiles unchanged."""
    return profile[:1] if len(profile) and profile.strides[0] == 0 else profile


def stored_once(phase: Phase) -> Phase:
    """Return the same phase; if all its samples are equal, with one of them stored."""
    profile, payload_kg = phase.profile, phase.payload_kg
    if len(profile) < 2 or (profile != profile[0]).any() or (payload_kg != payload_kg[0]).any():
        return phase
    return Phase(
        np.broadcast_to(profile[0].copy(), profile.shape), np.broadcast_to(payload_kg[0].copy(), payload_kg.shape)
    )


def drive(profile: Array, motors: Motors) -> Drive:
    """Mean heat drive of a profile [time, channel, joint] for the motors of one arm; zeros for no samples."""
    profile = distinct(profile)
    if len(profile) == 0:
        joints = profile.shape[-1]
        return Drive(np.zeros(joints), np.zeros(joints))
    _, qd, tau = np.asarray(profile, dtype=float).transpose(1, 0, 2)
    amps = reference_current(tau, qd, motors)
    return Drive((amps**2).mean(axis=0), friction_heat(qd, motors).mean(axis=0))


def static_drive(tau: Array, motors: Motors) -> Drive:
    """Heat drive at rest with joint torques, N·m, [..., joint]."""
    still = np.zeros_like(tau)
    return Drive(reference_current(tau, still, motors) ** 2, still)


def drives(profiles: Sequence[Array], motors: Motors) -> Drive:
    """Mean heat drive of several profiles, arrays [profile, joint]."""
    each = [drive(profile, motors) for profile in profiles]
    shape = (len(each), len(motors.eta))
    return Drive(
        np.array([one.current_sq for one in each]).reshape(shape),
        np.array([one.friction_w for one in each]).reshape(shape),
    )
