"""The cell of a scenario as a message: places, arms, kinds of jobs and limits."""

from pathlib import Path

from msgspec.structs import replace

from fleet.bus.protocol.auction import MOST_JOBS
from fleet.bus.protocol.cell import Cell, CellArm, CellFixture, CellKind, CellPlace, Limit, PlannedWork
from fleet.bus.protocol.messages import encode
from fleet.files import cache_folder
from fleet.job import BOUNDS, Work
from fleet.motion import Plan
from fleet.robot import RATING, Robot
from scenarios.job_stream import all_works
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario

MAX_BYTES = 60_000
"""Size of the message: a router may drop larger ones."""
KINDS = (
    CellKind("pick_place", 2, "Take the payload from the first place to the second; dwell_s closes or opens the hand."),
    CellKind("hold", 1, "Hold the payload at the place for dwell_s."),
    CellKind("press", 1, "Press down at the place with force_n for dwell_s."),
    CellKind("sort", 2, "As pick_place, with a turn of the hand in between."),
)
JOB_FIELDS = ("payload_kg", "force_n", "dwell_s", "repetitions", "release_s", "due_s", "value")


def cell_message(scenario: Scenario, auctioneer: str, *, cache: Path | None = None, progress: Progress = quiet) -> Cell:
    """Describe the cell of a scenario; plans are cached."""
    from scenarios.prepare.planned_arm import plan_arms  # loads the planner

    robots = [arm.robot() for arm in scenario.arms]
    planned = plan_arms(scenario, range(len(robots)), all_works(scenario), cache or cache_folder(), progress)
    cell = Cell(
        auctioneer=auctioneer,
        scenario=scenario.name,
        places=tuple(CellPlace(p.name, p.position_m, p.tool_deg, p.retreat_m) for p in scenario.places),
        arms=tuple(
            _arm(robot, tuple(_work(work, plans) for work, plans in arm.plans.items()))
            for robot, arm in zip(robots, planned, strict=True)
        ),
        kinds=KINDS,
        limits={name: Limit(*BOUNDS[name]) for name in JOB_FIELDS},
        warning_c=scenario.limits.warning_c,
        error_c=scenario.limits.error_c,
        jobs_in_message=MOST_JOBS,
        fixtures=tuple(CellFixture(f.name, f.position_m, f.size_m, f.tilt_deg) for f in scenario.fixtures),
    )
    if len(encode(cell)) > MAX_BYTES:
        cell = replace(cell, arms=tuple(replace(arm, works=()) for arm in cell.arms))
    return cell


def _arm(robot: Robot, works: tuple[PlannedWork, ...]) -> CellArm:
    own_kg = float("inf") if robot.payload_limit_kg is None else robot.payload_limit_kg
    near_kg, far_kg = (max(0.0, min(own_kg, kg - robot.tool_kg)) for kg in (RATING.mid_range_kg, RATING.full_reach_kg))
    mount = robot.mount
    return CellArm(robot.name, mount.position_m, mount.tilt_deg, near_kg, far_kg, RATING.full_reach_m, works)


def _work(work: Work, plans: tuple[Plan, ...]) -> PlannedWork:
    places = tuple(place.name for place in work.places)
    cycle_s = min((plan.cycle.duration_s for plan in plans), default=None)
    return PlannedWork(work.kind, places, work.payload_kg, len(plans), cycle_s, work.dwell_s, work.force_n)
