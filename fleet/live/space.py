"""Space of the arms of a live fleet: which plans exclude each other, and which arm is in the way of a plan.

An arm takes the space of a plan from its grant until the arm reports that it is at home again: no lease and no timeout
frees it. On the bus the space of a plan has a name that every participant
computes from the plan (`fleet.arm.space.space_name`). `sphere:X,Y,Z,R` is a sphere in the frame of the cell, m: for
an arm that the scenario does not know. Any other name stands for the whole workspace of the arm.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleet.arm.space import Sphere, path_of

ANYWHERE = "*"
"""Space of an arm at an unknown position: its whole workspace."""
Excludes = Callable[[str, str, str, str], bool]
"""Whether the spaces of two arms exclude each other; arguments: arm, name of its space, other arm, name of its space.
Symmetric."""


MOST_M = 1000.0
"""Largest coordinate and radius of a sphere."""


@lru_cache(maxsize=4096)
def sphere_of(space: str) -> Sphere | None:
    """The sphere that a space names, as `sphere:1.5,0,0.4,0.8`; None if it names none."""
    kind, _, numbers = space.partition(":")
    try:
        values = [float(number) for number in numbers.split(",")]
    except ValueError:
        return None
    fits = kind == "sphere" and len(values) == len(Sphere._fields) and all(abs(value) <= MOST_M for value in values)
    return Sphere(*values) if fits and values[-1] > 0 else None


def no_conflicts(arm: str, space: str, other: str, other_space: str) -> bool:
    """Return False: arms beyond each other's reach have no conflicts."""
    return False


@dataclass(frozen=True, eq=False)
class CellSpace:
    """Which spaces of a cell exclude each other, as `Excludes`."""

    volumes: Mapping[str, tuple[int, float]]
    """Row of `conflicts` and heaviest payload, kg, by path (`fleet.arm.space.path_of`)."""
    conflicts: np.ndarray
    """bool [volume, volume], symmetric."""
    workspaces: Mapping[str, Sphere]
    """All that an arm of the cell can reach, by arm; the position of any other arm is unknown."""
    clearance_m: float
    """Spheres that come closer than this exclude each other."""

    def __call__(self, arm: str, space: str, other: str, other_space: str) -> bool:
        """Return whether two spaces exclude each other.

        Spheres stand for whatever is not a plan of the cell. An arm at an unknown position excludes all.
        """
        row, other_row = self._row(space), self._row(other_space)
        if row is not None and other_row is not None:
            return bool(self.conflicts[row, other_row])
        one = sphere_of(space) or self.workspaces.get(arm)
        two = sphere_of(other_space) or self.workspaces.get(other)
        return one is None or two is None or one.gap_m(two) < self.clearance_m

    def _row(self, space: str) -> int | None:
        path, payload_kg = path_of(space)
        row, heaviest_kg = self.volumes.get(path, (None, 0.0))
        return row if payload_kg <= heaviest_kg else None


def arms_in_the_way(
    arm: str, space: str | None, taken: Mapping[str, Iterable[str]], excludes: Excludes
) -> tuple[str, ...]:
    """Return the other arms that take a space which excludes this one, by name.

    Args:
        space: None for unknown: the whole workspace.
        taken: Names of the spaces that each arm takes.
    """
    wanted = space or ANYWHERE
    return tuple(
        other
        for other, spaces in sorted(taken.items())
        if other != arm and any(excludes(arm, wanted, other, each) for each in spaces)
    )
