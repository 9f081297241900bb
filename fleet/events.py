"""What happened: one line of the digital thread per award, completion, warning, fault and recovery."""

from dataclasses import dataclass
from typing import Literal, get_args

EventKind = Literal[
    "release",
    "award",
    "lost",
    "illegal",
    "torque_warning",
    "finish",
    "home",
    "warning",
    "fault",
    "return",
    "recover",
]
EVENT_KINDS: tuple[str, ...] = get_args(EventKind)
"""release: job may be claimed; award: claim won, lost: claim lost; illegal: claim not allowed, so a wait;
torque_warning: the awarded plan passes the torque warning; finish: last cycle done; home: arm free again;
warning, fault: motor limit passed; return: job back in the queue; recover: fault cleared."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """One thing that happened, at its exact time."""

    time_s: float
    kind: EventKind
    env: int = 0
    arm: str = ""
    job: str = ""
    joint: int = 0
    """1..7 where a motor is meant, else 0."""
    value: float = float("nan")
    """What the kind measures: temperature °C, torque N·m, difficulty of an award, cycles kept of a return."""
    reason: str = ""
    """In words."""
