"""Planned motion: what an arm will do with its joints, sampled in time, before it moves."""

from dataclasses import dataclass

import numpy as np

from fleet.job import Work
from fleet.motor import Motors, friction_heat, reference_current

Array = np.ndarray

RATE_HZ = 50.0
"""Samples per second of every planned profile."""
CHANNELS = ("q", "qd", "tau")
"""The channel axis of a profile: rad, rad/s, N·m."""


@dataclass(frozen=True, eq=False)
class Phase:
    """A stretch of motion. Sample i stands for the time from i/RATE_HZ to (i+1)/RATE_HZ."""

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
        """How long it lasts, s; zero for an empty phase."""
        return len(self.profile) / RATE_HZ


@dataclass(frozen=True, eq=False)
class Plan:
    """One way (elbow, speed) in which one arm would do one work: from rest, so many cycles, back to rest."""

    arm: str
    work: Work
    elbow: int
    """Index of the inverse kinematics branch, 0 first found."""
    speed: float
    """Share of the joint limits that the motion uses, (0, 1]."""
    approach: Phase
    """From the arm's home posture to where the cycle begins."""
    cycle: Phase
    """One repetition; ends where it begins."""
    retreat: Phase
    """Back to the home posture."""

    @property
    def phases(self) -> tuple[Phase, Phase, Phase]:
        """Approach, cycle, retreat."""
        return (self.approach, self.cycle, self.retreat)

    def duration_s(self, repetitions: int) -> float:
        """From leaving home to being home again, s."""
        return self.approach.duration_s + repetitions * self.cycle.duration_s + self.retreat.duration_s

    def weights(self, repetitions: int) -> Array:
        """Share of the job's time that each phase takes, [phase], sums to one."""
        times = np.array([self.approach.duration_s, repetitions * self.cycle.duration_s, self.retreat.duration_s])
        return times / times.sum()


@dataclass(frozen=True, eq=False)
class Drive:
    """What heats the motors during a stretch of motion, averaged over its time."""

    current_sq: Array
    """Mean squared current at the magnets' reference temperature, A², [..., joint]."""
    friction_w: Array
    """Mean friction heat, W, [..., joint]."""


def drive(profile: Array, motors: Motors) -> Drive:
    """Mean heat drive of a profile [time, channel, joint] with the motors of one arm; zeros for no samples."""
    if len(profile) == 0:
        joints = profile.shape[-1]
        return Drive(np.zeros(joints), np.zeros(joints))
    _, qd, tau = np.asarray(profile, dtype=float).transpose(1, 0, 2)
    amps = reference_current(tau, qd, motors)
    return Drive((amps**2).mean(axis=0), friction_heat(qd, motors).mean(axis=0))
