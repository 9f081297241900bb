"""Messages of a policy in another process: the observations of all arms, and the actions that it chooses for them."""

from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from fleet.bus.protocol.auction import MOST_PLANS
from fleet.bus.protocol.messages import Count, Name
from fleet.observation import FIELDS, MOST_SLOTS, Axis, Field
from fleet.robot import JOINTS

MOST_REQUEST_BYTES = 4_194_304
"""Of one `ActRequest`: it has the observations of all arms, so it may exceed the limit of other messages."""
MOST_ARMS = 1024
MOST_OPTIONS = MOST_SLOTS * MOST_PLANS
_LENGTHS: dict[Axis, tuple[int, int]] = {
    "joint": (JOINTS, JOINTS),
    "slot": (0, MOST_SLOTS),
    "option": (0, MOST_OPTIONS),
    "member": (0, MOST_ARMS),
}
Action = Annotated[int, msgspec.Meta(ge=0, le=MOST_OPTIONS + 1)]
_Mask = Annotated[
    list[Annotated[int, msgspec.Meta(ge=0, le=1)]],
    msgspec.Meta(min_length=2, max_length=MOST_OPTIONS + 2, description="1 for each legal action, [option + 2]"),
]


_Peers = Annotated[list[Annotated[int, msgspec.Meta(ge=0, lt=MOST_ARMS)]], msgspec.Meta(max_length=MOST_ARMS)]


def _type_of(field: Field) -> Any:
    """The type of a field of the observation: numbers within its bounds, in a list for each axis. Any: a type form."""
    kind: Any = Annotated[float, msgspec.Meta(ge=field.low, le=field.high)]
    for axis in reversed(field.axes):
        least, most = _LENGTHS[axis]
        kind = Annotated[list[kind], msgspec.Meta(min_length=least or None, max_length=most)]
    unit = "" if field.unit == "1" else f", {field.unit}"
    axes = f", [{', '.join(field.axes)}]" if field.axes else ""
    return Annotated[kind, msgspec.Meta(description=f"{field.text}{unit}{axes}")]


if TYPE_CHECKING:
    ArmObservation = msgspec.Struct
else:
    ArmObservation = msgspec.defstruct(
        "ArmObservation",
        [
            ("arm", Name),
            *((field.name, _type_of(field)) for field in FIELDS),
            ("peers", _Peers),
            ("action_mask", _Mask),
        ],
        module=__name__,
        frozen=True,
        namespace={
            "__doc__": """The observation of one arm: the fields of `fleet.observation.Observation` by name.

            option = slot · plans + plan, with len(difficulty) / len(group) plans; members are all arms, in the order of
            the request, or only the nearest peers. `peers` are the numbers of those that are not this arm."""
        },
    )


class ActRequest(msgspec.Struct, frozen=True):
    """Request to `policy/{policy}/act`: choose the actions of all arms for one decision."""

    shift: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    """Unique name of this shift; several may run at the same time."""
    seed: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
    """Of the policy in this shift. If all its random numbers follow from it, the shift can be repeated."""
    decision: Count
    """Counts the decisions of the shift; 0 begins it. A decision without a valid reply may be requested again."""
    observations: Annotated[list[ArmObservation], msgspec.Meta(min_length=1, max_length=MOST_ARMS)]
    """In the order of the fleet."""


class ActReply(msgspec.Struct, frozen=True):
    """Reply to an `ActRequest`."""

    actions: Annotated[dict[Name, Action], msgspec.Meta(max_length=MOST_ARMS)]
    """By arm: 0 waits, 1 + option claims the option, and the last action returns the current job. An omitted arm waits;
    so does one with an illegal action by its `action_mask`, which is counted."""
