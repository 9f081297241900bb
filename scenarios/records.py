"""What of a plan goes into the record that a twin learns from."""

from collections.abc import Iterable

import numpy as np

from fleet.motion import RATE_HZ, Plan

STANDING_S = 12.0
"""Of a phase, at most so long goes into the record: a hold of a minute shows nothing new after that."""


def records(plans: Iterable[Plan]) -> list[np.ndarray]:
    """Phases [time, 3, joint] of the plans; phase by phase, so that windows are cut and padded as in scoring."""
    most = int(STANDING_S * RATE_HZ)
    return [phase.profile[:most] for plan in plans for phase in plan.phases]
