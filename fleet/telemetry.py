"""What an arm's sensors said, over time."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

Array = np.ndarray

Mode = Literal["idle", "working", "faulted"]
MODES: tuple[Mode, ...] = get_args(Mode)
"""Index = the number that stands for the mode in arrays."""
IDLE, WORKING, FAULTED = range(len(MODES))


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Sensor readings of a fleet, equally long arrays with the sample axis first."""

    time_s: Array
    """[sample]."""
    mode: Array
    """Index into `MODES`, int [sample, arm]."""
    q: Array
    """rad, [sample, arm, joint]."""
    qd: Array
    """rad/s, [sample, arm, joint]."""
    tau: Array
    """N·m at the joint output, [sample, arm, joint]."""
    current_a: Array
    """[sample, arm, joint]."""
    temp_c: Array
    """Motor (winding) temperature as read, with sensor noise, [sample, arm, joint]."""


def join(parts: Sequence[Telemetry]) -> Telemetry:
    """Readings one after the other as one."""
    if not parts:
        raise ValueError("There is no telemetry to join.")
    return Telemetry(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Telemetry)))
