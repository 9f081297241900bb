"""Requests of people who operate a fleet."""

from typing import Annotated, Literal

import msgspec

from fleet.bus.protocol.auction import JobStatus
from fleet.bus.protocol.messages import Count, Name, Number, Person, finite

JobName = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]


class ClearRequest(msgspec.Struct, frozen=True):
    """Request to `jobs/clear`: free the space of an absent arm, and end its awards. The same request again changes
    nothing.

    Only a person who has seen that the arm is at home or removed, and switched off, may request it.
    """

    arm: Name
    by: Person = ""
    """Who requests it, for the records."""


class Cleared(msgspec.Struct, frozen=True):
    """Reply to a `ClearRequest`: it is on disk, and the arm takes no space until it sends messages again."""

    auctioneer: Name
    arm: Name


ALL_ARMS = "*"
"""Instead of the name of an arm."""


class Cancel(msgspec.Struct, frozen=True, tag_field="action", tag="cancel"):
    """Cancel a job. An arm that has it finishes the cycle in progress, goes home and returns it. A job in its last
    cycle is finished, and cancelled only if the arm returns it. Jobs that wait for it are given up."""

    job: JobName


class Settle(msgspec.Struct, frozen=True, tag_field="action", tag="settle"):
    """Say what became of an `unfinished` job: a person has looked.

    done: it is finished. redo: its last cycle was not done, and an arm does it again; refused while an arm that may
    still do it has the award: stop that arm and free its space with `jobs/clear` first.
    """

    job: JobName
    outcome: Literal["done", "redo"]


class Change(msgspec.Struct, frozen=True, tag_field="action", tag="change"):
    """Change due date and value of a job that is not settled; what is left out stays as it is."""

    job: JobName
    due_s: Number | msgspec.UnsetType | None = msgspec.UNSET
    """As in `JobSpec`; null for none."""
    value: Number | msgspec.UnsetType = msgspec.UNSET


class Pause(msgspec.Struct, frozen=True, tag_field="action", tag="pause"):
    """Give an arm no more jobs. Its job goes back after the cycle in progress, and to another arm; a last cycle that
    was permitted is finished."""

    arm: Name = ALL_ARMS
    """"*" for all arms, also those that join later."""


class Resume(msgspec.Struct, frozen=True, tag_field="action", tag="resume"):
    """End a pause."""

    arm: Name = ALL_ARMS
    """"*" ends all pauses."""


Action = Cancel | Settle | Change | Pause | Resume


class ControlRequest(msgspec.Struct, frozen=True):
    """Request to `jobs/control`: change what the fleet does. One that was carried out is not carried out again."""

    request: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    """Unique name of this request, for example a UUID; the last 1024 are known, also after a restart. The same request
    again is answered and not carried out; another one of its name is refused."""
    action: Action
    by: Person = ""
    """Who requests it, for journal, events and status."""


class Controlled(msgspec.Struct, frozen=True):
    """Reply to a `ControlRequest`: it is on disk."""

    auctioneer: Name
    request: str
    changed: bool
    """False if there was nothing to change, or the request was carried out before."""
    note: str = ""
    """What happens next, or why nothing changed."""
    job: JobStatus | None = None
    """The job now; null for a pause, and for a job that was settled long ago."""
    paused: dict[Name, str] = {}
    """As in `Status`."""


class ResetRequest(msgspec.Struct, frozen=True):
    """Request to `arm/{arm}/reset`: clear the fault of an arm now, instead of waiting for it to clear. The arm then
    ends its cycle and goes home by itself, so nobody may be in its way. Without a fault nothing changes."""

    by: Person = ""
    """Who requests it, for journal and event."""


class ResetReply(msgspec.Struct, frozen=True):
    """Reply to a `ResetRequest`."""

    arm: Name
    changed: bool
    """False if the arm has no fault. An arm that is too hot refuses, as does one whose fault only a person at the arm
    can clear."""


class Operation(msgspec.Struct, frozen=True):
    """Published under `auction/{auctioneer}/operation`, without an auctioneer under `arm/{arm}/operation`: a request of
    a person was carried out, also one that changed nothing; not the same request again."""

    auctioneer: Name
    """Or the arm that replied, without an auctioneer."""
    time_s: Number
    request: ControlRequest
    number: Count = 0
    """Counts the requests that this auctioneer has carried out, across restarts."""
    epoch: str = ""
    """As in `Clock`: `number` begins again with another epoch."""
    awards: Annotated[tuple[Name, ...], msgspec.Meta(max_length=16)] = ()
    """With `redo`, without an auctioneer: the awards of the job whose last cycle was not done."""

    def __post_init__(self) -> None:
        finite("Operation", "time_s", (self.time_s,))
