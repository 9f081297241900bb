"""Events of an episode: awards, completions, warnings, faults and recoveries."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

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
    "failure",
    "break",
    "break_end",
]
EVENT_KINDS: tuple[str, ...] = get_args(EventKind)


class Meaning(NamedTuple):
    """Description of an event kind, for documentation and the bus."""

    text: str
    value: str = ""
    """Content of `value`; "" if it is unused."""
    live: bool = False
    """Whether live arms report it; the other kinds occur in simulated shifts only."""


MEANINGS: dict[EventKind, Meaning] = {
    "release": Meaning("The job may be claimed."),
    "award": Meaning("The arm got the job.", "difficulty of the job for the arm", live=True),
    "lost": Meaning("The arm claimed the job, and another arm got it."),
    "illegal": Meaning("The claim was not allowed, and counts as a wait."),
    "torque_warning": Meaning("The plan of the job exceeds the torque warning of `joint`.", "torque, N·m", live=True),
    "finish": Meaning("The last cycle of the job is done.", "lateness, s; 0 if on time", live=True),
    "home": Meaning("The arm is at home and free again.", live=True),
    "warning": Meaning("The motor of `joint` passed its warning limit.", "temperature, °C", live=True),
    "fault": Meaning("The motor of `joint` passed its error limit: the arm stopped.", "temperature, °C", live=True),
    "return": Meaning(
        "The job is open again: the arm faulted, or had to return it.", "cycles that are kept", live=True
    ),
    "give_up": Meaning(
        "The job is abandoned: arms faulted in it too often, or a job that it waited for was abandoned."
    ),
    "give_back": Meaning("The arm returned its job after a cycle.", "cycles that are kept"),
    "expire": Meaning("The due date passed while the job waited, begun before or not: it is abandoned."),
    "recover": Meaning("The fault is cleared.", live=True),
    "moved": Meaning("A person moved the faulted arm home.", live=True),
    "contact": Meaning(
        "A link or payload of the arm is inside another arm, the floor or a fixture (plant `mujoco`).", "depth, mm"
    ),
    "failure": Meaning("The arm failed, not by heat: it stopped.", "time until it is repaired, s"),
    "break": Meaning("A break of the arm began.", "its length, s", live=True),
    "break_end": Meaning("A break of the arm ended.", live=True),
}

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
    """Joint 1..7; 0 if the event has none."""
    value: float = float("nan")
    """Quantity of the kind, as in `MEANINGS`; NaN for none."""
    reason: str = ""
    """Why, in words; of an award in a simulated shift, the predicted peak temperature and P(saturation), and live, the
    number of the plan and the version of the twin."""
