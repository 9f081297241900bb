"""The cell of a scenario on the bus: its description as a message and back as a model, and the space of its plans."""

from collections.abc import Sequence
from typing import Any  # plain values of JSON

from msgspec.structs import replace

from fleet.arm.space import workspace
from fleet.bus.protocol.auction import MOST_JOBS
from fleet.bus.protocol.cell import Cell, CellArm, CellFixture, CellKind, CellPlace, Limit, PlannedWork, Point
from fleet.bus.protocol.messages import encode
from fleet.files import cache_folder
from fleet.job import BOUNDS, Fixture, Place, Work
from fleet.live.space import CellSpace
from fleet.motion import Plan
from fleet.robot import RATING, Mount, Robot
from scenarios.progress import Progress, quiet
from scenarios.spec.jobs import all_works
from scenarios.spec.schema import Scenario

MAX_BYTES = 60_000
"""Size of the message: a router may drop larger ones."""
KINDS = (
    CellKind("pick_place", 2, "Take the payload from the first place to the second; dwell_s closes or opens the hand."),
    CellKind("hold", 1, "Hold the payload at the place for dwell_s."),
    CellKind("press", 1, "Press down at the place with force_n for dwell_s."),
    CellKind("sort", 2, "As pick_place, with a turn of the hand in between."),
)
JOB_FIELDS = ("payload_kg", "force_n", "dwell_s", "repetitions", "release_s", "due_s", "value")


def cell_of(scenario: Scenario, participant: str, progress: Progress = quiet) -> tuple[Cell, CellSpace]:
    """The cell of a scenario as a participant describes it, and the space of all plans; plans and space are cached.

    A plan along another path or with a heavier payload, for a job that was submitted, is not in the space: it excludes
    all plans of arms within reach.
    """
    from scenarios.prepare.arms import plan_arms
    from scenarios.prepare.fleet import space_of

    robots, folder = [arm.robot() for arm in scenario.arms], cache_folder()
    planned = plan_arms(scenario, range(len(robots)), all_works(scenario), folder, progress)
    cell = Cell(
        auctioneer=participant,
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
    plans = [plan for arm in planned for plan in arm.all_plans]
    table = space_of(scenario, robots, plans, folder, progress)
    space = CellSpace(
        volumes=table.by_path(plans),
        conflicts=table.conflicts,
        workspaces={robot.name: workspace(robot) for robot in robots},
        clearance_m=scenario.clearance_m,
    )
    return cell, space


def described_model(cell: Cell, arms: Sequence[str]) -> dict[str, Any]:
    """The model of a described cell, with some of its arms in this order.

    Raises:
        ValueError: it describes a cell that cannot be, or not all of these arms.
    """
    from fleet.arm.cell import cell_model

    mounts = {arm.name: Mount(position_m=_xyz(arm.position_m), tilt_deg=_xyz(arm.tilt_deg)) for arm in cell.arms}
    if missing := [arm for arm in arms if arm not in mounts]:
        raise ValueError(f"The cell has no arm '{missing[0]}'; it has {', '.join(mounts) or 'none'}.")
    robots = [Robot(name=f"arm_{i}", mount=mounts[arm]) for i, arm in enumerate(arms)]
    model = cell_model(
        robots,
        [Place(name=p.name, position_m=_xyz(p.position_m), tool_deg=_xyz(p.tool_deg)) for p in cell.places],
        [
            Fixture(name=f.name, position_m=_xyz(f.position_m), size_m=_xyz(f.size_m), tilt_deg=_xyz(f.tilt_deg))
            for f in cell.fixtures
        ],
    )
    for shown, arm in zip(model["arms"], arms, strict=True):
        shown["name"] = arm  # any name of the bus, not only one of a scenario
    return model


def _arm(robot: Robot, works: tuple[PlannedWork, ...]) -> CellArm:
    own_kg = float("inf") if robot.payload_limit_kg is None else robot.payload_limit_kg
    near_kg, far_kg = (max(0.0, min(own_kg, kg - robot.tool_kg)) for kg in (RATING.mid_range_kg, RATING.full_reach_kg))
    mount = robot.mount
    return CellArm(robot.name, mount.position_m, mount.tilt_deg, near_kg, far_kg, RATING.full_reach_m, works)


def _work(work: Work, plans: tuple[Plan, ...]) -> PlannedWork:
    places = tuple(place.name for place in work.places)
    cycle_s = min((plan.cycle.duration_s for plan in plans), default=None)
    return PlannedWork(work.kind, places, work.payload_kg, len(plans), cycle_s, work.dwell_s, work.force_n)


def _xyz(point: Point) -> tuple[float, float, float]:
    x, y, z = point
    return x, y, z
