"""Events of an episode: awards, completions, warnings, faults and recoveries."""

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
    "give_up",
    "give_back",
    "expire",
    "recover",
    "moved",
    "contact",
]
EVENT_KINDS: tuple[str, ...] = get_args(EventKind)
"""release: job may be claimed; award: claim won; lost: claim lost; illegal: claim not allowed, counted as a wait;
torque_warning: the awarded plan exceeds the torque warning; finish: last cycle done; home: arm free again;
warning, fault: motor limit passed; return: job back in the queue; give_up: job that faulted too often; give_back: an
arm returned its job after a cycle; expire: due date passed before an arm began the job; recover: fault
cleared; moved: a person moved the faulted arm home; contact: a link or payload of an arm is inside another arm, the
floor or a fixture (the plant `mujoco` looks for it)."""

EVENTS_PER_BOOT = 1_000_000_000
"""On the bus, the number of an arm's event is its boot number times this, plus a count from 1."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """One event with its exact time."""

    time_s: float
    kind: EventKind
    env: int = 0
    arm: str = ""
    job: str = ""
    joint: int = 0
    """Motor 1..7; 0 if the event has none."""
    value: float = float("nan")
    """Quantity of the kind: temperature °C, torque N·m, difficulty of an award, cycles kept of a return or a
    give_back, depth of a contact in mm."""
    reason: str = ""
    """Why, in words; of an award in a simulated shift, the predicted peak temperature and P(saturation)."""
