"""Where a scenario's arms and stations stand, for the picture of its fleet."""

import numpy as np

from fleet.env.scene import Cell, mount_kind
from fleet.errors import ScenarioError
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


def near_of(scenario: Scenario, peers: int | None) -> tuple[tuple[int, ...], ...] | None:
    """The peers that are mounted nearest to each arm, nearest first, those as near in the scenario's order.

    Args:
        peers: How many; None for all others in the scenario's order, which is no limit.

    Raises:
        ScenarioError: a number there are not so many peers for.
    """
    most = len(scenario.arms) - 1
    if peers is None:
        return None
    if isinstance(peers, bool) or not isinstance(peers, int | np.integer) or not 0 <= peers <= most:
        raise ScenarioError(f"peers must be None or an integer from 0 to {most} (got {peers!r}).")
    mounts_m = np.array(cell_of(scenario).mounts_m)
    far_m = np.linalg.norm(mounts_m[:, None] - mounts_m, axis=-1)
    np.fill_diagonal(far_m, np.inf)
    return tuple(tuple(row[:peers]) for row in np.argsort(far_m.round(9), axis=1, kind="stable").tolist())
