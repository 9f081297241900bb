"""What really happens to the motors under a plan: for rehearsals, and for `oracle`, which measures regret.

Both look into the simulator; no arm and no policy may.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.motion import Drive, Plan, drive
from fleet.motor import Motors
from fleet.thermal import NODES, WINDING, ThermalModel, advance, drive_heat

Array = np.ndarray

STEP_S = 10.0
"""Heat is refreshed at least this often."""


def peaks(
    plans: Sequence[Plan],
    duration_s: Sequence[float],
    *,
    motors: Motors,
    thermal: ThermalModel,
    start_c: Array,
    ambient_c: float,
) -> Array:
    """Hottest winding temperature of each joint when one arm repeats each plan's cycle for so long, °C, [plan, joint].

    Args:
        duration_s: [plan].
        start_c: Temperatures at the beginning, [node].
    """
    load = [drive(plan.cycle.profile, motors) for plan in plans]
    return warmed(load, duration_s, motors=motors, thermal=thermal, start_c=start_c, ambient_c=ambient_c).highest_c


@dataclass(frozen=True, eq=False)
class Warmed:
    """What a stretch of time made of an arm's temperatures."""

    end_c: Array
    """°C, [case, node]."""
    highest_c: Array
    """Of each winding, beginning and end included, °C, [case, joint]."""


def warmed(
    load: Sequence[Drive],
    duration_s: Sequence[float] | Array,
    *,
    motors: Motors,
    thermal: ThermalModel,
    start_c: Array,
    ambient_c: Array | float,
) -> Warmed:
    """Temperatures of one powered arm after each load has lasted so long.

    Args:
        load: What drives the heat, [case].
        duration_s: >= 0, [case].
        start_c: Temperatures at the beginning, [node] or [case, node].
        ambient_c: Air, one for all or [case].
    """
    count = len(load)
    current_sq = np.array([d.current_sq for d in load]).reshape(count, len(motors.idle_w))
    friction_w = np.array([d.friction_w for d in load]).reshape(count, len(motors.idle_w))
    duration = np.asarray(duration_s, dtype=float)
    steps = np.ceil(duration / STEP_S)
    # Equal steps that end when the work does: a job of 12 s must not heat for 20.
    phi, gamma = thermal.step_matrices(duration / np.maximum(steps, 1))
    ambient = np.broadcast_to(np.asarray(ambient_c, dtype=float), (count,))
    temp = np.broadcast_to(np.asarray(start_c, dtype=float), (count, NODES)).copy()
    highest = temp[:, WINDING].copy()
    for step in range(int(steps.max(initial=0.0))):
        heat = drive_heat(temp, current_sq, friction_w, motors)
        going = (step < steps)[:, None]
        temp = np.where(going, advance(temp, heat, ambient, phi, gamma, thermal.to_ambient), temp)
        highest = np.maximum(highest, temp[:, WINDING])
    return Warmed(temp, highest)


@dataclass(frozen=True, eq=False)
class Oracle:
    """Scores a plan by the share of the way to the warning limit that the true motors go, from idle-warm.

    d_k = 1 − exp(−rise_k / (warning − start_k)), and P(saturation) is 0 or 1.
    """

    motors: Motors
    thermal: ThermalModel
    start_c: Array
    """Idle equilibrium, [node]."""
    ambient_c: float
    warning_c: float
    version: str = "oracle"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of doing the plan so many times from idle-warm."""
        peak = peaks(
            [plan],
            [plan.duration_s(repetitions)],
            motors=self.motors,
            thermal=self.thermal,
            start_c=self.start_c,
            ambient_c=self.ambient_c,
        )[0]
        start = self.start_c[WINDING]
        room = np.maximum(self.warning_c - start, 1.0)
        return Difficulty(
            per_joint=difficulty_of_error(np.maximum(peak - start, 0.0) / room),
            p_saturation=float(peak.max() >= self.warning_c),
        )
