"""What really happens to the motors under a plan: for rehearsals, and for `oracle`, which measures regret.

Both look into the simulator; no arm and no policy may.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.motion import Plan, drives
from fleet.motor import Motors
from fleet.thermal import WINDING, ThermalModel, simulate_temperatures

Array = np.ndarray


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
    load = drives([plan.cycle.profile for plan in plans], motors)
    return simulate_temperatures(
        load, duration_s, motors=motors, thermal=thermal, start_c=start_c, ambient_c=ambient_c
    ).highest_c


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
