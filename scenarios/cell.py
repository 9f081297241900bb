"""Where a scenario's arms and stations stand, for the picture of its fleet."""

from fleet.env.scene import Cell, mount_kind
from scenarios.scenario import Scenario


def cell_of(scenario: Scenario) -> Cell:
    """The cell of a scenario: arms and places in its order."""
    robots = [arm.robot() for arm in scenario.arms]
    return Cell(
        arms=tuple(robot.name for robot in robots),
        mounts_m=tuple(robot.mount.position_m for robot in robots),
        kinds=tuple(mount_kind(robot.mount) for robot in robots),
        stations=tuple((place.name, place.position_m) for place in scenario.places),
    )
