"""Space of the arms of a live fleet: which plans exclude each other, and which arm is in the way of a plan.

An arm takes the space of a plan from its grant until the arm reports that it is at home again: no lease and no timeout
frees it. On the bus the space of a plan has a name that every participant
computes from the plan (`fleet.arm.space.space_name`). An unknown name stands for the whole workspace of the arm.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

ANYWHERE = "*"
"""Space of an arm at an unknown position: its whole workspace."""
Excludes = Callable[[str, str, str, str], bool]
"""Whether the spaces of two arms exclude each other; arguments: arm, name of its space, other arm, name of its space.
Symmetric."""


def no_conflicts(arm: str, space: str, other: str, other_space: str) -> bool:
    """Return False: arms beyond each other's reach have no conflicts."""
    return False


@dataclass(frozen=True, eq=False)
class CellSpace:
    """Which spaces of a cell exclude each other, as `Excludes`."""

    volume: Mapping[str, int]
    """Row of `conflicts` by name of the space."""
    conflicts: np.ndarray
    """bool [volume, volume], symmetric."""
    reach: frozenset[frozenset[str]]
    """All pairs of arms within reach of each other."""
    arms: frozenset[str]
    """Arms of the cell; the position of any other arm is unknown."""

    def __call__(self, arm: str, space: str, other: str, other_space: str) -> bool:
        """Return whether two spaces exclude each other; unknown ones do if their arms can touch."""
        rows = self.volume.get(space), self.volume.get(other_space)
        if None not in rows:
            return bool(self.conflicts[rows])
        return frozenset((arm, other)) in self.reach or not {arm, other} <= self.arms


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
