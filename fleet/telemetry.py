"""Sensor readings of the arms over time."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

Array = np.ndarray

Mode = Literal["idle", "working", "faulted"]
MODES: tuple[Mode, ...] = get_args(Mode)
"""Arrays hold the index of a mode in this tuple."""
IDLE, WORKING, FAULTED = range(len(MODES))


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Sensor readings of a fleet; equally long arrays, sample axis first."""

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
    """Motor (winding) temperature with sensor noise, [sample, arm, joint]."""


def join(parts: Sequence[Telemetry]) -> Telemetry:
    """Readings joined in time."""
    if not parts:
        raise ValueError("Telemetry to join must have at least one part (got none).")
    return Telemetry(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Telemetry)))
