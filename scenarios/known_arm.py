"""One arm of a scenario with its twin and the cool motion it knows: what generation and recovery begin from."""

from dataclasses import dataclass
from pathlib import Path

from fleet.errors import FleetError
from fleet.motion import Plan
from fleet.sim.world import Arm
from scenarios.build import Progress, body_of, cache_folder, plan_works, quiet
from scenarios.generate import Verification
from scenarios.jobs import rehearsal_works
from scenarios.perform import alone
from scenarios.rehearse import cool_motion, twins
from scenarios.scenario import Scenario
from twin.score import Twin


@dataclass(frozen=True, eq=False)
class KnownArm:
    """An arm, its twin, and its motions that stay cool over the whole horizon of a rehearsal."""

    arm: Arm
    twin: Twin
    sources: tuple[Plan, ...]
    verification: Verification
    """By a nominal Gen3's heat, in the rehearsal's air, for its horizon and limit."""


def known_arm(
    scenario: Scenario,
    name: str | None = None,
    *,
    twin: Twin | None = None,
    cache: Path | None = None,
    progress: Progress = quiet,
) -> KnownArm:
    """An arm of a scenario by name; without one, the first.

    Args:
        twin: Its twin; by default that with which the arm works in the scenario's fleet, trained or from the cache.

    Raises:
        FleetError: no such arm, a twin of another arm, or no motion of this arm stays cool.
    """
    name = scenario.arms[0].name if name is None else name
    index = scenario.index_of(name)
    if twin is not None and twin.arm != name:
        raise FleetError(f"This is the twin of arm '{twin.arm}', not of '{name}'; give the one that belongs to it.")
    body, folder = body_of(scenario, index), cache or cache_folder()
    robot, motors, thermal = body
    possible, _ = plan_works(
        robot, rehearsal_works(scenario), scenario, folder, lambda share: progress("planning", share)
    )
    if twin is None:
        (twin,) = twins(scenario, [body], [possible], folder, progress, arms=[index])
    sources = cool_motion(possible, body, scenario)
    spec = scenario.twin
    verification = Verification.nominal(robot, spec.ambient_c, cool_c=spec.cool_c, horizon_s=spec.horizon_s)
    return KnownArm(alone(robot, motors, thermal), twin, sources, verification)
