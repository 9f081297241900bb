"""Positions of a scenario's arms, stations and fixtures."""

import numpy as np

from fleet.env.render.scene import CellMap, mount_kind
from fleet.errors import ScenarioError
from scenarios.spec.schema import Scenario


def cell_of(scenario: Scenario) -> CellMap:
    """The cell of a scenario, with arms, places and fixtures in the order of the scenario."""
    robots = [arm.robot() for arm in scenario.arms]
    return CellMap(
        arms=tuple(robot.name for robot in robots),
        mounts_m=tuple(robot.mount.position_m for robot in robots),
        kinds=tuple(mount_kind(robot.mount) for robot in robots),
        stations=tuple((place.name, place.position_m) for place in scenario.places),
        fixtures=scenario.fixtures,
    )


def near_of(scenario: Scenario, peers: int | None) -> tuple[tuple[int, ...], ...] | None:
    """Indices of the nearest peers of each arm, nearest first; ties keep the order of the scenario.

    Args:
        peers: Number of peers; None returns None, which means no limit.

    Raises:
        ScenarioError: there are fewer peers.
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
