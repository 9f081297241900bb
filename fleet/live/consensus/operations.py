"""Requests of people, as an arm without an auctioneer knows them.

For each thing that a request can set, the latest request counts: by fleet time, then by name. So arms that know the
same requests agree, in whatever order they have received them.
"""

from collections.abc import Container, Mapping

from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.operator import ALL_ARMS, Cancel, Change, ControlRequest, Operation, Pause, Resume, Settle
from fleet.live.auction.control import job_of
from fleet.live.auction.job_rules import MAX_OPEN_JOBS, changed_spec
from fleet.live.auction.ledger import MAX_REQUESTS
from fleet.live.auction.past_jobs import hash_of

Slot = tuple[str, str]
"""What a request sets, and of which job or arm."""
MAX_SLOTS = 4 * MAX_OPEN_JOBS
"""Of all requests that count; the first ones are dropped if there are more."""
MAX_AWARDS = 16
"""Awards of one job that were redone, in one request."""


def _slots(request: ControlRequest) -> tuple[Slot, ...]:
    match request.action:
        case Cancel(job):
            return (("cancel", job),)
        case Settle(job, outcome):
            return (("redo", job),) if outcome == "redo" else ()
        case Change(job) as change:
            return tuple((field, job) for field in ("due_s", "value") if field in _given(change))
        case Pause(arm):
            return (("pause", arm),)
        case Resume(arm):
            return (("pause", arm), ("resume", arm)) if arm == ALL_ARMS else (("pause", arm),)


def _given(change: Change) -> dict[str, float | None]:
    fields = {"due_s": change.due_s, "value": change.value}
    return {name: value for name, value in fields.items() if value is None or isinstance(value, float | int)}


def _stamp(operation: Operation | None) -> tuple[float, str]:
    return (float("-inf"), "") if operation is None else (operation.time_s, operation.request.request)


class Operations:
    """Requests of people that were carried out.

    Attributes:
        latest: The request that counts, by slot.
        names: Names of the last requests that this arm knows, oldest first.
        digest: Equal for arms that know the same requests.
    """

    def __init__(self) -> None:
        self.latest: dict[Slot, Operation] = {}
        self.names: dict[str, None] = {}
        self.digest = 0

    def is_new(self, operation: Operation) -> bool:
        """Return whether a request changes what counts."""
        return any(_stamp(operation) > _stamp(self.latest.get(slot)) for slot in _slots(operation.request))

    def add(self, operation: Operation) -> None:
        """Add a request."""
        self.add_names((operation.request.request,))
        for slot in _slots(operation.request):
            if _stamp(operation) > _stamp(self.latest.get(slot)):
                self._drop(slot)
                self.latest[slot] = operation
                self.digest ^= _hash(slot, operation)
        while len(self.latest) > MAX_SLOTS:
            self._drop(next(iter(self.latest)))

    def add_names(self, names: tuple[str, ...]) -> None:
        """Add names of requests that were carried out."""
        self.names |= dict.fromkeys(names)
        while len(self.names) > MAX_REQUESTS:
            del self.names[next(iter(self.names))]

    def forget(self, job: str) -> None:
        """Drop the requests for a job that is settled."""
        for slot in ("cancel", "redo", "due_s", "value"):
            self._drop((slot, job))

    @property
    def all(self) -> tuple[Operation, ...]:
        """All requests that count."""
        return tuple({operation.request.request: operation for operation in self.latest.values()}.values())

    @property
    def paused(self) -> dict[str, str]:
        """Who paused an arm, by arm; "*" for all arms."""
        resumed = _stamp(self.latest.get(("resume", ALL_ARMS)))
        return {
            name: operation.request.by
            for (slot, name), operation in self.latest.items()
            if slot == "pause" and isinstance(operation.request.action, Pause) and _stamp(operation) > resumed
        }

    def is_paused(self, arm: str) -> bool:
        """Return whether an arm takes no jobs."""
        return bool(self.latest) and not self.paused.keys().isdisjoint((arm, ALL_ARMS))

    def cancelled(self, job: str) -> Operation | None:
        """Return the request that has cancelled a job; None if none has, or a person has it redone since."""
        cancel = self.latest.get(("cancel", job))
        return cancel if _stamp(cancel) > _stamp(self.latest.get(("redo", job))) else None

    @property
    def all_cancelled(self) -> Mapping[str, Operation]:
        """The request that has cancelled a job, by job."""
        jobs = [job for slot, job in self.latest if slot == "cancel"]
        return {job: operation for job in jobs if (operation := self.cancelled(job)) is not None}

    def redone(self, job: str) -> Container[str]:
        """Return the awards of a job whose last cycle a person has called not done."""
        operation = self.latest.get(("redo", job))
        return () if operation is None else operation.awards

    def changed(self, job: JobSpec) -> JobSpec:
        """Return a job with the due date and value that people have requested."""
        for field in ("due_s", "value"):
            operation = self.latest.get((field, job.name))
            if operation is not None and isinstance(change := operation.request.action, Change):
                try:
                    job = changed_spec(job, Change(job.name, **{field: getattr(change, field)}))
                except ValueError:
                    continue  # two changes that are possible one by one only
        return job

    def _drop(self, slot: Slot) -> None:
        if (operation := self.latest.pop(slot, None)) is not None:
            self.digest ^= _hash(slot, operation)


def is_for(operation: Operation, roster: Container[str]) -> bool:
    """Return whether a request is for a job, or for arms of this fleet."""
    action = operation.request.action
    return bool(job_of(operation.request)) or (
        isinstance(action, Pause | Resume) and (action.arm == ALL_ARMS or action.arm in roster)
    )


def _hash(slot: Slot, operation: Operation) -> int:
    return hash_of(repr((slot, _stamp(operation))).encode())
