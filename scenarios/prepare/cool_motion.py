"""Which motion stays cool, judged by the true motors, and what of it a twin is trained on.

Motion is cool if it can repeat over a whole horizon from a cold start. The temperature of the moment does not count:
a heavy job begins cool, too.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from fleet.errors import FleetError
from fleet.motion import RATE_HZ, Plan
from fleet.motor import Motors
from fleet.thermal import NODES, ThermalModel
from scenarios.prepare.oracle import peaks
from scenarios.prepare.planned_arm import ArmHardware
from scenarios.schema import Scenario, TwinSpec

Array = np.ndarray

RECORDED_S = 12.0
"""Recorded part of a phase: later samples of a hold that lasts a minute show nothing new."""


def records(plans: Iterable[Plan]) -> list[Array]:
    """Training data of a twin, [time, 3, joint] for each phase of each plan, so that windows are cut as in scoring."""
    samples = int(RECORDED_S * RATE_HZ)
    return [phase.profile[:samples] for plan in plans for phase in plan.phases]


def cold_peaks(
    plans: Sequence[Plan], motors: Motors, thermal: ThermalModel, *, ambient_c: float, horizon_s: float
) -> Array:
    """Hottest winding temperatures when each plan's cycle repeats over the horizon from ambient, °C, [plan, joint]."""
    cold_c = np.full(NODES, ambient_c)
    horizons = [horizon_s] * len(plans)
    return peaks(plans, horizons, motors=motors, thermal=thermal, start_c=cold_c, ambient_c=ambient_c)


def cool_plans(plans: Sequence[Plan], hardware: ArmHardware, spec: TwinSpec) -> tuple[Plan, ...]:
    """The plans in which no motor of this arm passes `cool_c` over the horizon."""
    highest = cold_peaks(plans, hardware.motors, hardware.thermal, ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    cool = highest.max(axis=1, initial=-np.inf) <= spec.cool_c
    return tuple(plan for plan, stays_cool in zip(plans, cool, strict=True) if stays_cool)


def require_cool_plans(plans: Sequence[Plan], hardware: ArmHardware, scenario: Scenario) -> tuple[Plan, ...]:
    """The cool plans of a scenario's arm; without any it cannot know what is normal.

    Raises:
        FleetError: no plan stays cool.
    """
    spec = scenario.twin
    cool = cool_plans(plans, hardware, spec)
    if not cool:
        raise FleetError(
            f"{scenario.name}: arm '{hardware.robot.name}' has no motion that stays below {spec.cool_c:g} °C for "
            f"{spec.horizon_s:g} s, so its twin has no training data. Raise twin.cool_c, or give twin.payload_kg "
            "lighter loads."
        )
    return cool
