"""What stays cool: motion that may repeat over a whole horizon from a cold start, chosen by the true motors.

An arm knows this of what it has done. It goes by the horizon, never by the temperature at the moment: a heavy job too
begins cool.
"""

from collections.abc import Sequence

import numpy as np

from fleet.errors import FleetError
from fleet.motion import Plan
from fleet.motor import Motors
from fleet.robot import Robot
from fleet.sim.oracle import peaks
from fleet.thermal import NODES, ThermalModel
from scenarios.scenario import Scenario, TwinSpec

Array = np.ndarray

Body = tuple[Robot, Motors, ThermalModel]
"""An arm and the heat that is its own."""


def cold_peaks(
    plans: Sequence[Plan], motors: Motors, thermal: ThermalModel, *, ambient_c: float, horizon_s: float
) -> Array:
    """Hottest winding temperatures when each cycle repeats over the horizon, begun at ambient, °C, [plan, joint]."""
    cold_c = np.full(NODES, ambient_c)
    horizons = [horizon_s] * len(plans)
    return peaks(plans, horizons, motors=motors, thermal=thermal, start_c=cold_c, ambient_c=ambient_c)


def cool_plans(plans: Sequence[Plan], body: Body, spec: TwinSpec) -> tuple[Plan, ...]:
    """Those of the plans in which no motor of this arm passes `cool_c` over the horizon of a rehearsal."""
    _, motors, thermal = body
    highest = cold_peaks(plans, motors, thermal, ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    stays = highest.max(axis=1, initial=-np.inf) <= spec.cool_c
    return tuple(plan for plan, cool in zip(plans, stays, strict=True) if cool)


def some_cool_plans(plans: Sequence[Plan], body: Body, scenario: Scenario) -> tuple[Plan, ...]:
    """The same of a scenario's arm, which cannot know what is normal without any.

    Raises:
        FleetError: no plan stays cool.
    """
    spec = scenario.twin
    cool = cool_plans(plans, body, spec)
    if not cool:
        raise FleetError(
            f"{scenario.name}: arm '{body[0].name}' has no motion that stays below {spec.cool_c:g} °C for "
            f"{spec.horizon_s:g} s, so there is nothing to learn or to begin from. Raise twin.cool_c, or give "
            "twin.payload_kg lighter loads."
        )
    return cool
