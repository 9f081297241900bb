"""Requests of operators."""

from typing import Annotated, ClassVar, Literal

import msgspec

from fleet.bus.protocol.auction import JobSpec, JobStatus
from fleet.bus.protocol.messages import Count, FiniteStruct, MalformedMessage, Name, Number, Person, PersonRequest
from fleet.errors import check_names
from fleet.job import check_bounds, check_force, check_hard_due

MAX_REQUEST_NAME = 64
"""Characters of the name of a request."""
JobName = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]


def by_whom(by: str) -> str:
    """Return ` by 'NAME'`; "" for nobody named."""
    return f" by '{by}'" if by else ""


class ClearRequest(PersonRequest, frozen=True):
    """Request to `jobs/clear`: free the space of an absent arm, and end its awards. The same request again changes
    nothing.

    An operator must first have seen that the arm is at home or removed, and switched off.
    """

    arm: Name
    by: Person = ""
    """Who requests it, for the records."""


class Cleared(msgspec.Struct, frozen=True):
    """Reply to a `ClearRequest`: it is durable, and the arm takes no space until it sends messages again."""

    auctioneer: Name
    arm: Name


ALL_ARMS = "*"
"""Instead of the name of an arm."""


class Cancel(msgspec.Struct, frozen=True, tag_field="action", tag="cancel"):
    """Cancel a job. An arm that has it finishes the cycle in progress, goes home and returns it. A job in its last
    cycle is finished, and cancelled only if the arm returns it. Jobs that wait for it become `given_up`."""

    job: JobName


class Settle(msgspec.Struct, frozen=True, tag_field="action", tag="settle"):
    """Resolve an `unfinished` job, after inspecting the cell.

    done: it is finished. redo: it is not, and an arm does the cycles beyond `cycles` of its status, of short ones
    several; refused while an arm that could still do them has the award: stop that arm and free its space with
    `jobs/clear` first.
    """

    job: JobName
    outcome: Literal["done", "redo"]


class Change(msgspec.Struct, frozen=True, tag_field="action", tag="change"):
    """Change due date and value of a job that is not settled; omitted fields stay unchanged."""

    job: JobName
    due_s: Number | msgspec.UnsetType | None = msgspec.UNSET
    """As in `JobSpec`; null for none."""
    value: Number | msgspec.UnsetType = msgspec.UNSET


class Pause(msgspec.Struct, frozen=True, tag_field="action", tag="pause"):
    """Award an arm no further jobs. It returns its job after the cycle in progress; a permitted last cycle is
    finished."""

    arm: Name = ALL_ARMS
    """"*" for all arms, also those that join later."""


class Resume(msgspec.Struct, frozen=True, tag_field="action", tag="resume"):
    """End a pause."""

    arm: Name = ALL_ARMS
    """"*" ends all pauses."""


class Clear(msgspec.Struct, frozen=True, tag_field="action", tag="clear"):
    """The space of an absent arm was freed. Only in an `Operation`: it is requested by a `ClearRequest`."""

    PUBLISHED_ONLY: ClassVar[bool] = True
    arm: Name


Action = Cancel | Settle | Change | Pause | Resume | Clear


class ControlRequest(PersonRequest, frozen=True):
    """Request to `jobs/control`: steer jobs and arms. It is idempotent."""

    request: Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_REQUEST_NAME)]
    """Unique name of this request, for example a UUID; the last 1024 are kept, across restarts. A repeated request gets
    a reply and changes nothing; one of the same name with another `action` or `by` is refused."""
    action: Action
    by: Person = ""
    """Who requests it, for journal, events and status."""


class Controlled(msgspec.Struct, frozen=True):
    """Reply to a `ControlRequest`, which is durable."""

    auctioneer: Name
    request: str
    changed: bool
    """False if nothing had to change, or for a repeated request."""
    note: str = ""
    """What happens next, or why nothing changed."""
    job: JobStatus | None = None
    """The job now; null for a pause, and for a settled job that was evicted."""
    paused: dict[Name, str] = {}
    """As in `Status`."""


def check_request(request: msgspec.Struct) -> None:
    """Check who makes a new request, and what only new requests must have.

    Messages in journals and recordings are not checked: an earlier version may have accepted them.

    Raises:
        MalformedMessage: names the field, the value and the rule.
    """
    action = getattr(request, "action", None)
    try:
        if getattr(request, "by", ""):
            check_names(request, "by", of_jobs=True)
        if isinstance(action, Change):
            given = [name for name in ("due_s", "value") if getattr(action, name) is not msgspec.UNSET]
            if not given:
                raise ValueError("Change needs due_s, value or both (got neither).")
            check_bounds(action, *given)
        if isinstance(request, PersonRequest):
            for job in getattr(request, "jobs", ()):
                _check_new(job)
    except ValueError as error:
        raise MalformedMessage(str(error)) from error


def _check_new(job: JobSpec) -> None:
    """Check what only new jobs must have; raises ValueError."""
    try:
        check_force(job, job.kind, job.force_n)
        check_hard_due(job, job.expires, job.due_s)
    except ValueError as error:
        raise ValueError(f"Job '{job.name}': {error}") from error


class ResetRequest(PersonRequest, frozen=True):
    """Request to `arm/{arm}/reset`: clear the fault of an arm now, instead of waiting for it to clear. The arm then
    ends its cycle and moves home: keep people and objects out of its way. Without a fault nothing changes."""

    by: Person = ""
    """Who requests it, for journal and event."""


def without_reset(arm: str) -> str:
    """Return why an online arm does not reply to a `ResetRequest`."""
    return f"The arm '{arm}' is online and offers no reset: its fault must be cleared at the arm."


class ResetReply(msgspec.Struct, frozen=True):
    """Reply to a `ResetRequest`."""

    arm: Name
    changed: bool
    """False if the arm has no fault. An arm that is too hot refuses, as does one whose fault must be cleared at the
    arm."""


class Operation(FiniteStruct, frozen=True):
    """Published under `auction/{auctioneer}/operation`, without an auctioneer under `arm/{arm}/operation`: an operator
    request was carried out, even if it changed nothing. A repeated request is not published.

    A freed space is published likewise, as a request with the action `clear`.
    """

    auctioneer: Name
    """Without an auctioneer, the arm that replied."""
    time_s: Number
    request: ControlRequest
    number: Count = 0
    """Counts the operations of this auctioneer, across restarts."""
    epoch: str = ""
    """As in `Clock`: `number` restarts with a new epoch."""
    awards: Annotated[tuple[Name, ...], msgspec.Meta(max_length=16)] = ()
    """With `redo`, without an auctioneer: the awards of the job whose last cycle was not done."""
    note: str = ""
    """Why it changed nothing; "" if it did."""


ALARMS_PER_START = 100_000
"""The number of an alarm's message is this times the Unix second at which its monitor started, plus a count."""


class Alarm(FiniteStruct, frozen=True):
    """Published under `monitor/{monitor}/alarm`: an alarm began, ended, or was acknowledged. The last message of an
    alarm has its state."""

    monitor: Name
    """Who raised it, for example a gateway."""
    number: Count
    """Counts the messages of this monitor; after a start it continues at a higher multiple of 10⁵, plus 1."""
    time_s: Number
    """Fleet time of this change."""
    alarm: Name
    """Name of the alarm: the same for every monitor, and again when it comes back after its end."""
    kind: Name
    """What is wrong, for example `fault`, `sensor`, `given_up` or `no_progress`."""
    what: str
    """A sentence."""
    subject: str = ""
    """Arm, job or other thing; "" for the fleet."""
    began_s: Number = 0.0
    """Fleet time at which it began."""
    ended_s: Number | None = None
    """Fleet time at which it ended; null while it lasts."""
    by: Person = ""
    """Who has acknowledged it; "" while nobody has."""
    acknowledged: str = ""
    """When, as `2026-01-31T09:00:00Z`; "" while nobody has."""
