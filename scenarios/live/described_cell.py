"""The cell in three dimensions as its auctioneer describes it."""

from collections.abc import Sequence
from typing import Any  # plain values of JSON

from fleet.bus.protocol.cell import Cell, Point
from fleet.job import Fixture, Place
from fleet.physics.cell_model import cell_model
from fleet.robot import Mount, Robot


def described_model(cell: Cell, arms: Sequence[str]) -> dict[str, Any]:
    """The model of a described cell, with some of its arms in this order.

    Raises:
        ValueError: it describes a cell that cannot be, or not all of these arms.
    """
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


def _xyz(point: Point) -> tuple[float, float, float]:
    x, y, z = point
    return x, y, z
