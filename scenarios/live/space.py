"""Space of a scenario's cell on the bus: which plans of two arms exclude each other."""

from pathlib import Path

from fleet.files import cache_folder
from fleet.live.space import CellSpace
from fleet.planning.space import arms_in_reach, space_name
from scenarios.job_stream import all_works
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario


def cell_space(scenario: Scenario, *, cache: Path | None = None, progress: Progress = quiet) -> CellSpace:
    """Compute the space of all plans of a scenario; plans and space are cached.

    A plan for other work, which outsiders submitted, is not in it: it excludes all plans of arms within reach.
    """
    from scenarios.prepare.fleet import space_of  # loads the planner
    from scenarios.prepare.planned_arm import plan_arms

    folder = cache or cache_folder()
    robots = [arm.robot() for arm in scenario.arms]
    planned = plan_arms(scenario, range(len(robots)), all_works(scenario), folder, progress)
    plans = [plan for arm in planned for plan in arm.all_plans]
    table = space_of(scenario, robots, plans, folder, progress)
    return CellSpace(
        volume={space_name(key): volume for key, volume in table.volume.items()},
        conflicts=table.conflicts,
        reach=arms_in_reach(robots, scenario.clearance_m),
        arms=frozenset(robot.name for robot in robots),
    )
