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
from twin.thermal.risk import LinearHeat, peak_forecast

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


SURE_K = 0.15
"""P rises from 0 to 1 within this distance of the warning limit: twice the RMS error of the linearised heat."""


@dataclass(frozen=True, eq=False)
class Oracle:
    """Scores a plan by the true motors: the peak that they reach from the present state.

    With the true parameters the arm's estimate of its housings is true too, see `Arm.known`. P(saturation) is 0 or 1
    but for `SURE_K`. d_k = 1 − exp(−rise_k / (warning − start_k)) of a job from idle-warm.
    """

    motors: Motors
    thermal: ThermalModel
    start_c: Array
    """Idle equilibrium, [node]."""
    ambient_c: float
    """Of the idle equilibrium; the peak follows the present ambient temperature."""
    warning_c: float
    version: str = "oracle"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of doing the plan so many times from idle-warm, and its peak from any state."""
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
        heat = LinearHeat.of(drives([phase.profile for phase in plan.phases], self.motors), self.motors, self.thermal)
        step = np.array([[self.warning_c - SURE_K, 0.0], [self.warning_c + SURE_K, 1.0]])
        return Difficulty(
            per_joint=difficulty_of_error(np.maximum(peak - start, 0.0) / room),
            peak=peak_forecast(heat, plan.duration_s(repetitions) * plan.weights(repetitions), step),
        )
