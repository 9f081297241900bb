"""One arm of a scenario with its twin and its cool motion, for generation and recovery."""

from dataclasses import dataclass
from pathlib import Path

from fleet.engine.world import Arm
from fleet.errors import FleetError
from fleet.files import cache_folder
from fleet.motion import Plan
from scenarios.job_stream import rehearsal_works
from scenarios.motion.generate import Verification
from scenarios.motion.perform import bare_arm
from scenarios.prepare.cool_motion import require_cool_plans
from scenarios.prepare.planned_arm import plan_arms
from scenarios.prepare.train_twins import train_twins
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario
from twin.vae.twin import Twin


@dataclass(frozen=True, eq=False)
class KnownArm:
    """An arm, its twin, and its motions that stay cool over the horizon of a rehearsal."""

    arm: Arm
    twin: Twin
    sources: tuple[Plan, ...]
    verification: Verification
    """With a nominal Gen3's thermal parameters, at the rehearsal's ambient temperature, horizon and limit."""


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
    folder = cache or cache_folder()
    (planned,) = plan_arms(scenario, [index], rehearsal_works(scenario), folder, progress)
    robot, motors, thermal = planned.hardware
    if twin is None:
        (twin,) = train_twins(scenario, [planned], folder, progress)
    sources = require_cool_plans(planned.all_plans, planned.hardware, scenario)
    spec = scenario.twin
    verification = Verification.nominal(robot, spec.ambient_c, cool_c=spec.cool_c, horizon_s=spec.horizon_s)
    return KnownArm(bare_arm(robot, motors, thermal), twin, sources, verification)
