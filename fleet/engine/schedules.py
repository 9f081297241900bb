"""Schedules of the jobs of a shift: who does which job, by which plan, in which order."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Schedules:
    """Schedules of the jobs of one shift; arrays [schedule, job].

    A free arm claims, of its jobs that it may claim, the one that comes first.
    """

    arm: Array
    """int."""
    option: Array
    """Index of the plan among those on offer, int."""
    order: Array
    """Jobs with smaller numbers come first; inf for a job that is left out."""
    not_before_s: Array
    """No arm claims the job earlier."""

    def __len__(self) -> int:
        return len(self.arm)

    def at(self, rows: Sequence[int] | Array) -> "Schedules":
        """Copies of some schedules."""
        chosen = np.asarray(rows, dtype=int)
        return Schedules(*(getattr(self, name)[chosen].copy() for name in self.__dataclass_fields__))


def stack(schedules: Sequence[Schedules]) -> Schedules:
    """Schedules one after the other."""
    names = Schedules.__dataclass_fields__
    return Schedules(*(np.concatenate([getattr(each, name) for each in schedules]) for name in names))


@dataclass(frozen=True, eq=False)
class Executed:
    """What came of schedules."""

    reward: Array
    """Discounted, [schedule]."""
    start_s: Array
    """When each job was last awarded, inf if never, [schedule, job]."""
    claims: Array
    """The claims that were won, in the order of time: decision interval, arm and action, int [schedule, claim, 3]."""
    count: Array
    """Their number, int [schedule]."""
