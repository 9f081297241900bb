"""What really happens to the motors under a plan: for rehearsals, and for `oracle`, which measures regret.

Both look into the simulator; no arm and no policy may.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.motion import Plan, drive
from fleet.motor import Motors
from fleet.thermal import WINDING, ThermalModel, advance, drive_heat

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
    current_sq = np.array([d.current_sq for d in load])
    friction_w = np.array([d.friction_w for d in load])
    duration = np.asarray(duration_s, dtype=float)
    steps = np.ceil(duration / STEP_S)
    # Equal steps that end when the work does: a job of 12 s must not heat for 20.
    phi, gamma = thermal.step_matrices(duration / np.maximum(steps, 1))
    temp = np.tile(start_c, (len(plans), 1))
    highest = temp[:, WINDING].copy()
    for step in range(int(steps.max(initial=0.0))):
        heat = drive_heat(temp, current_sq, friction_w, motors)
        temp = advance(temp, heat, np.full(len(plans), ambient_c), phi, gamma, thermal.to_ambient)
        going = (step < steps)[:, None]
        highest = np.where(going, np.maximum(highest, temp[:, WINDING]), highest)
    return highest


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
