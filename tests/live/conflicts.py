"""Relations of plans that exclude each other."""

import random

from fleet.live.space import ANYWHERE


def random_conflicts(seed: int, share: float):
    """Return a symmetric relation in which this share of all plans exclude each other, and unknown ones all others."""

    def excludes(arm: str, space: str, other: str, other_space: str) -> bool:
        if ANYWHERE in (space, other_space):
            return True
        return random.Random(f"{seed} {sorted([space, other_space])}").random() < share

    return excludes
