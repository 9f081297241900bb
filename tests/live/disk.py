"""A journal in memory that may be full, and relations of plans that exclude each other; for state machines."""

import random
from dataclasses import dataclass, field

from fleet.errors import JournalFull
from fleet.live.space import ANYWHERE


class Crash(Exception):
    """The process is killed during a call."""


@dataclass(eq=False)
class Disk:
    """Records that are on disk, and the faults of the next writes."""

    records: list = field(default_factory=list)
    full: bool = False
    crash: str = ""
    """`before` or `after` the next write; "" for none."""

    def keep(self, *records) -> None:
        """Write records, as `Journal.append`."""
        crash, self.crash = self.crash, ""
        if crash == "before":
            raise Crash
        if self.full:
            raise JournalFull("no room")
        self.records.extend(records)
        if crash == "after":
            raise Crash


def random_conflicts(seed: int, share: float):
    """Return a symmetric relation in which this share of all plans exclude each other, and unknown ones all others."""

    def excludes(arm: str, space: str, other: str, other_space: str) -> bool:
        if ANYWHERE in (space, other_space):
            return True
        return random.Random(f"{seed} {sorted([space, other_space])}").random() < share

    return excludes
