"""Everything in a scenario that cannot work."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fleet.difficulty import Blind
from fleet.engine.world import Arm, warm_start
from fleet.planning.plan_cache import rest_torque
from fleet.planning.space import collisions_of_homes
from fleet.thermal import WINDING
from scenarios.job_stream import works_of
from scenarios.prepare.planned_arm import PlannedArm, air_offsets, homes_in_fixtures
from scenarios.schema import Scenario

REASONS = 4
"""Maximum number of reasons in one error message."""


def problems_of(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path) -> list[str]:
    """Everything in a scenario that cannot work, one sentence each.

    Args:
        arms: With plans for all works; the work of a stream that none can do is a problem. If there are none, only
            the arms at home are compared.
        folder: Of the cache.
    """
    file = f"{scenario.name}.toml"
    robots = [spec.robot() for spec in scenario.arms]
    near = collisions_of_homes(robots, scenario.clearance_m, folder / "plans")
    advice = "move or turn an arm, or give it another `home`"
    if scenario.clearance_m:
        advice = "move or turn an arm, give it another `home`, or lower clearance_m"
    problems = [f"{file}: arms: {sentence}; {advice}." for sentence in near]
    problems += [
        f"{file}: {sentence}; move the arm or the fixture, or give the arm another `home`."
        for sentence in homes_in_fixtures(scenario)
    ]
    problems += [f"{file}: {sentence}." for sentence in _outside_limits_at_home(scenario, arms, folder)]
    infeasible = [error for arm in arms for error in arm.infeasible]
    possible = {work for arm in arms for work in arm.plans}
    for i, stream in enumerate(scenario.jobs if arms else ()):
        loads = [f"{work.payload_kg:g}" for work in works_of(scenario, stream) if work not in possible]
        if not loads:
            continue
        here = [error for error in infeasible if error.place in stream.places]
        reasons = list(dict.fromkeys(f"{error.arm} at '{error.place}': {error.reason}" for error in here))
        if near and any(reason.endswith("at home") for reason in reasons):
            continue  # it may be possible once the homes are apart
        more = f"; and {len(reasons) - REASONS} more" if len(reasons) > REASONS else ""
        problems.append(
            f"{file}: jobs[{i}].places: no arm can do '{stream.name}' with {' or '.join(loads)} kg "
            f"({'; '.join(reasons[:REASONS])}{more}); move the places or an arm, or make the load lighter."
        )
    return problems


def _outside_limits_at_home(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path) -> list[str]:
    """A sentence for each arm that begins too cold, or that never settles at home though the shift begins settled."""
    cell_c, offsets_k = float(scenario.ambient.at(np.zeros(1))[0]), air_offsets(scenario)
    lower_c, found = scenario.limits.lower_c, []
    for arm in arms:
        ambient_c = coldest_c = cell_c + float(offsets_k[arm.index])
        if scenario.start == "idle_warm":
            robot, motors, thermal = arm.hardware
            rest_tau = rest_torque(robot, folder / "plans")
            still = Arm(robot=robot, motors=motors, thermal=thermal, rest_tau=rest_tau, model=Blind(), plans={})
            try:
                coldest_c = float(warm_start(still, ambient_c)[WINDING].min())
            except ValueError as error:
                reason = str(error).rstrip(".")
                advice = 'give it more cooling or cooler air, or begin with start = "cold"'
                found.append(f"arms[{arm.index}]: {reason}; {advice}")
        if coldest_c < lower_c:
            advice = "give it warmer air" + (', or begin with start = "idle_warm"' if scenario.start == "cold" else "")
            name = scenario.arms[arm.index].name
            found.append(
                f"arms[{arm.index}]: a motor of '{name}' begins at {coldest_c:.1f} °C, below limits.lower_c "
                f"({lower_c:g} °C); {advice}"
            )
    return found
