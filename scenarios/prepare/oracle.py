"""The true models of an arm, which only the simulator knows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fleet.difficulty import Difficulty, difficulty_of_error
from fleet.heat.motor import Motors
from fleet.heat.thermal import WINDING, ThermalModel, simulate_temperatures
from fleet.motion import Plan, drives
from twin.thermal.thermal_twin import LinearHeat, peak_forecast

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
    """Hottest winding temperature of each joint while one arm repeats the cycle of each plan, °C, [plan, joint].

    Args:
        duration_s: Time during which the cycle repeats, [plan].
        start_c: Initial temperatures, [node].
    """
    load = drives([plan.cycle.profile for plan in plans], motors)
    return simulate_temperatures(
        load, duration_s, motors=motors, thermal=thermal, start_c=start_c, ambient_c=ambient_c
    ).highest_c


SURE_K = 0.15
"""P rises from 0 to 1 between the warning limit minus and plus this: twice the RMS error of the linearised heat."""


@dataclass(frozen=True, eq=False)
class Oracle:
    """Scores a plan with the true motor parameters: the peak that follows from the present temperatures.

    The arm's housing observer then has the true parameters too (`fleet.engine.world.Arm.known`). P(saturation) is 0 or
    1, except within `SURE_K` of the warning limit. d_k = 1 − exp(−rise_k / (warning − start_k)), from idle equilibrium.
    """

    motors: Motors
    thermal: ThermalModel
    start_c: Array
    """Idle equilibrium, [node]."""
    ambient_c: float
    """Ambient temperature of the idle equilibrium; the peak uses the present one."""
    warning_c: float
    executed: Mapping[Plan, Plan] = field(default_factory=dict)
    """Plans that need other torques than planned, with these torques."""
    version: str = "oracle"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of the repeated plan from idle equilibrium, and its peak as a function of known temperatures."""
        plan = self.executed.get(plan, plan)
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
