"""Rules about jobs: which are accepted, which can begin, which have left, and the reply to a status request."""

# The stubs of networkx leave the results of its functions unknown.
# pyright: standard

from collections import deque
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from datetime import timedelta
from hashlib import blake2b
from itertools import accumulate
from math import inf, isfinite
from struct import iter_unpack, pack
from typing import NamedTuple, Self, TypeVar

import networkx as nx
from msgspec import UNSET, Struct
from msgspec.structs import replace

from fleet.bus.protocol.auction import Admission, JobSpec, JobState, JobStatus
from fleet.bus.protocol.messages import LISTED_BYTES, State, encode
from fleet.bus.protocol.operator import Change
from fleet.errors import Refused, listed, printable

Item = TypeVar("Item", bound=Struct)

MAX_OPEN_JOBS = 10_000
"""Jobs of one auctioneer that are neither finished nor given up; more are refused."""
REASON_LENGTHS = (300, 80, 0)
"""Characters of a reason in a reply to a submission: the first of these with which the reply fits into one message."""
SHIFT_ENDED = "The shift ended before it was done."

MAX_PAST = 100_000
"""Jobs whose names are known after they have left the book."""


def hash_of(content: bytes) -> int:
    """Return 64 bits, the same in every process."""
    return int.from_bytes(blake2b(content, digest_size=8).digest(), "little")


def content_hash(message: Struct) -> int:
    """Return a hash of the content of a message."""
    return hash_of(encode(message))


def _spec_hash(job: JobSpec) -> int:
    """Hash of a job without the lowest bit, which says whether it was finished."""
    return content_hash(job) & ~1


class PastJobs(Container[str]):
    """Names and outcomes of the last jobs that have left a book: two hashes each, 16 bytes.

    A job that is settled leaves memory and journal; the recording has it. Its name must not be used again: a submission
    that is repeated late would be done twice. At one job in 10 s, `MAX_PAST` names are those of 11 days.

    Attributes:
        limit: How many are known at most.
    """

    def __init__(self, packed: bytes = b"", limit: int = MAX_PAST) -> None:
        """Start with jobs as `packed` returns them."""
        self.limit = limit
        self._jobs: dict[int, int] = {}
        self._order: deque[int] = deque()
        for name, value in iter_unpack("<QQ", packed):
            self._put(name, value)

    def add(self, job: JobSpec | str, *, finished: bool) -> None:
        """Add a job that is finished, or given up; the oldest one is dropped if there are too many.

        Args:
            job: A job, or the name of one of unknown content, which is the same as any other of that name.
        """
        name, content = (job, 0) if isinstance(job, str) else (job.name, _spec_hash(job))
        self._put(hash_of(name.encode()), content | finished)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and hash_of(name.encode()) in self._jobs

    def __len__(self) -> int:
        return len(self._jobs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PastJobs) and self._jobs == other._jobs

    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def is_same(self, job: JobSpec) -> bool:
        """Return whether a job of this name is known, and is this one."""
        return self._jobs.get(hash_of(job.name.encode()), -1) & ~1 in (0, _spec_hash(job))

    def is_finished(self, name: str) -> bool:
        """Return whether a job of this name is known, and was finished."""
        return bool(self._jobs.get(hash_of(name.encode()), 0) & 1)

    def is_given_up(self, name: str) -> bool:
        """Return whether a job of this name is known, and was given up."""
        return not self._jobs.get(hash_of(name.encode()), 1) & 1

    def packed(self) -> bytes:
        """Return all jobs, oldest first."""
        return b"".join(pack("<QQ", name, self._jobs[name]) for name in self._order)

    def _put(self, name: int, value: int) -> None:
        if name not in self._jobs:
            self._order.append(name)
            if len(self._order) > self.limit:
                del self._jobs[self._order.popleft()]
        self._jobs[name] = value


def reason_for_silence(arm: str) -> str:
    """Return why a job is unfinished whose arm stopped renewing its lease after permission to commit."""
    return f"'{arm}' was about to finish it and has not renewed its lease since."


NO_CYCLE = "has reported no cycle of it for"


def reason_for_no_progress(arm: str, limit_s: float) -> str:
    """Return what is wrong with a job whose arm renews its lease, and does nothing for it."""
    return f"'{arm}' {NO_CYCLE} more than {limit_s / 60:.0f} min, though it renews its lease."


def reason_to_follow(before: str) -> str:
    """Return why a job is given up that waits for one that is, or that was cancelled."""
    return f"Given up, because it waits for '{before}', which is given up or cancelled."


NONE_ENDED: Mapping[str, str] = {}
NONE_RESERVED: Mapping[str, JobSpec] = {}


def admit(
    jobs: Sequence[JobSpec],
    known: Mapping[str, JobSpec],
    *,
    reserved: Mapping[str, JobSpec] = NONE_RESERVED,
    places: frozenset[str] | None = None,
    count: int | None = None,
    limit: int = MAX_OPEN_JOBS,
    ended: bool = False,
    given_up: Container[str] = (),
    ended_as: Mapping[str, str] = NONE_ENDED,
    past: PastJobs | None = None,
    time_s: float = -inf,
) -> tuple[Admission, ...]:
    """Return which jobs of one submission can be accepted; they may name one another as predecessors in any order.

    Args:
        known: Jobs that were accepted before, at least those that the submission names. An identical job is accepted
            again and changes nothing.
        reserved: Jobs of the scenario, by name, that are submitted once released: no other job may have their names.
        places: Places of the cell; None allows any name.
        count: Open jobs; by default all known ones.
        ended: Whether the shift is over.
        given_up: Known jobs that are given up: a job that waits for one is accepted, and given up too.
        ended_as: States of known jobs that have ended.
        past: Jobs that were settled long ago; they are known, too.
        time_s: Fleet time: a job whose hard due date has passed is accepted, and given up.
    """
    past = past or PastJobs()
    count = len(known) if count is None else count
    rejected: dict[int, str] = {}
    new: dict[str, JobSpec] = {}
    for index, job in enumerate(jobs):
        same_name = known.get(job.name) or new.get(job.name)
        unknown = [place for names in job.every_places for place in names if places is not None and place not in places]
        if ended:
            rejected[index] = "The shift is over: no more jobs are accepted."
        elif same_name == job or past.is_same(job):
            continue
        elif same_name is not None or job.name in past:
            rejected[index] = f"Another job has the name '{job.name}'; names must be unique."
        elif reserved.get(job.name, job) != job:
            rejected[index] = f"The scenario has another job '{job.name}', released later; give this one another name."
        elif unknown:
            rejected[index] = f"No place '{unknown[0]}' in this cell. Places: {listed(sorted(places or ()))}."
        elif count + len(new) >= limit:
            rejected[index] = f"There are {limit} open jobs already; submit it again when some are finished."
        else:
            new[job.name] = job
    never = _never_ready(new, lambda name: name in known or name in past)
    reasons = [rejected.get(index) or never.get(job.name, "") for index, job in enumerate(jobs)]
    late = "Its hard due date has passed, so it is given up."
    notes = {job.name: late for job in new.values() if is_late(job, time_s)}
    notes |= lost_jobs(new.values(), given_up)
    notes |= {job.name: _ended_note(ended_as[job.name]) for job in jobs if job.name in ended_as}
    notes |= {job.name: _past_note(job.name, past) for job in jobs if job.name in past}
    replies = [
        Admission(job.name, not why, why or notes.get(job.name, "")) for job, why in zip(jobs, reasons, strict=True)
    ]
    return _in_one_message(replies)


def _in_one_message(replies: Sequence[Admission]) -> tuple[Admission, ...]:
    """Return the replies with their reasons as short as one message needs: a router may drop a larger one."""
    for length in REASON_LENGTHS:
        replies = [replace(reply, reason=reply.reason[:length]) for reply in replies]
        if sum(len(encode(reply)) + 1 for reply in replies) <= LISTED_BYTES:
            break
    return tuple(replies)


def _ended_note(state: str) -> str:
    return f"It is {state.replace('_', ' ')} already, and is not done again."


def _past_note(name: str, past: PastJobs) -> str:
    how = "finished" if past.is_finished(name) else "given up"
    return f"It was {how} long ago, and is not done again; the recording has its result."


EXPIRED = "expired: its due date passed while it waited."


def is_late(job: JobSpec, time_s: float) -> bool:
    """Return whether a job that still waits has expired at a fleet time."""
    return job.expires and job.due_s is not None and job.due_s < time_s


def changed_spec(job: JobSpec, change: Change) -> JobSpec:
    """Return a job with the due date and value that a person has requested.

    Raises:
        ValueError: they are not possible for this job.
    """
    given = {"due_s": change.due_s, "value": change.value}
    return replace(job, **{name: value for name, value in given.items() if value is not UNSET})


def is_same_work(one: JobSpec, other: JobSpec) -> bool:
    """Return whether two jobs differ at most in due date and value, which a person may change."""
    return replace(one, due_s=None, value=1.0) == replace(other, due_s=None, value=1.0)


def lost_jobs(jobs: Collection[JobSpec], given_up: Container[str]) -> dict[str, str]:
    """Return why jobs are given up that wait for one that is, directly or not, by name."""
    waiting: dict[str, list[str]] = {}
    for job in jobs:
        for before in job.after:
            waiting.setdefault(before, []).append(job.name)
    reasons: dict[str, str] = {}
    lost = [before for before in waiting if before in given_up]
    for before in lost:  # grows meanwhile
        for name in waiting.get(before, ()):
            if name not in reasons and name not in given_up:
                reasons[name] = reason_to_follow(before)
                lost.append(name)
    return reasons


def _never_ready(new: Mapping[str, JobSpec], is_known: Callable[[str], bool]) -> dict[str, str]:
    """Return why jobs can never begin, by name."""
    waits = nx.DiGraph((job.name, before) for job in new.values() for before in job.after if not is_known(before))
    rings = {
        name: group
        for group in nx.strongly_connected_components(waits)
        for name in group
        if len(group) > 1 or waits.has_edge(name, name)
    }
    stuck = {name for name in waits if name not in new or name in rings}
    stuck.update(*(nx.ancestors(waits, name) for name in list(stuck)))
    reasons: dict[str, str] = {}
    for name in new.keys() & stuck:
        missing = [before for before in new[name].after if not is_known(before) and before not in new]
        if missing:
            reasons[name] = f"It waits for '{missing[0]}', which is unknown or was not accepted."
        elif name in rings:
            cycle = [edge[0] for edge in nx.find_cycle(waits.subgraph(rings[name]), name)]
            reasons[name] = f"Jobs wait for each other in a ring: {' → '.join([*cycle, cycle[0]])}."
        else:
            before = next(before for before in new[name].after if before in stuck)
            reasons[name] = f"It waits for '{before}', which is not accepted either."
    return reasons


def job_order(job: JobSpec) -> tuple[float, str]:
    """Return the key by which jobs are sorted: the oldest are offered first."""
    return job.release_s, job.name


def ready_jobs(
    jobs: Iterable[JobSpec],
    time_s: float,
    limit: int,
    busy: frozenset[str],
    finished: Callable[[str], bool],
    returned_s: Mapping[str, float],
    rank: Callable[[str], int] = lambda job: 0,
) -> list[JobSpec]:
    """Return the jobs that wait for an arm, as they queue: released, predecessors finished.

    A job queues by its release, or by its last return, then by name. Of more than `limit` jobs, those with free
    stations come first.

    Args:
        busy: Stations at which an arm may be at work.
        returned_s: Fleet time of the last return, by job.
        rank: Of more than `limit` jobs, those of a lower rank come first of all.
    """

    def queued_s(job: JobSpec) -> tuple[float, float, str]:
        return max(job.release_s, returned_s.get(job.name, 0.0)), *job_order(job)

    ready = [job for job in jobs if job.release_s <= time_s and all(map(finished, job.after))]
    ready.sort(key=queued_s)
    if len(ready) > limit:
        ready = sorted(ready, key=lambda job: (rank(job.name), not busy.isdisjoint(job.stations)))[:limit]
        ready.sort(key=queued_s)
    return ready


def joined_reasons(before: str, now: str) -> str:
    """Return why a job waits again, and why no arm begins it now, in sentences."""
    if not (before and now):
        return before or now
    return f"{before[0].upper()}{before[1:].rstrip('.')}. {now}"


def why_not_ready(job: JobSpec, time_s: float, finished: Callable[[str], bool], busy: Container[str]) -> str:
    """Return why a waiting job cannot be begun by any arm now; "" if it can. Arguments as of `ready_jobs`."""
    if job.release_s > time_s:
        return f"It is released at {timedelta(seconds=round(job.release_s))} of fleet time."
    for before in job.after:
        if not finished(before):
            return f"It waits for '{before}'."
    for place in job.stations:
        if place in busy:
            return f"Its place '{place}' is in use."
    return ""


def with_terms(status: JobStatus, job: JobSpec | None) -> JobStatus:
    """Return a status with what the job itself says, if that is known."""
    if job is None:
        return status
    return replace(status, repetitions=job.repetitions, due_s=job.due_s, value=job.value, release_s=job.release_s)


def waits_since_s(status: JobStatus) -> float | None:
    """Return the fleet time since which an arm may begin a job: its release or acceptance; None for unknown."""
    return max((each for each in (status.release_s, status.accepted_s) if each is not None), default=None)


def finish_s(status: JobStatus, state: State | None, time_s: float) -> float | None:
    """Return the expected fleet time at which a job is finished, by the last state of its arm; None for unknown.

    Args:
        time_s: Fleet time, infinite while unknown: the clock of the arm may be ahead of it.
    """
    at_work = status.state in ("awarded", "finishing") and state is not None and state.job == status.job
    if not at_work or state is None or not state.busy_s or not isfinite(time_s):
        return None
    return min(state.time_s, time_s) + state.busy_s


def urgency(state: JobState, *, shift_ended: bool) -> int:
    """Return the group of a job where not all have room: 0 needs a person, 1 is in work, 2 waits, 3 has ended."""
    if state == "unfinished":
        return 3 if shift_ended else 0
    return {"awarded": 1, "finishing": 1, "waiting": 2}.get(state, 3)


class Position(NamedTuple):
    """Where the status of a job is in the pages of a reply: it changes only with the state of the job."""

    group: int
    """As of `urgency`."""
    order_s: float
    """Within the group."""
    job: str

    @property
    def text(self) -> str:
        """For `Status.next`."""
        return f"{self.group} {self.order_s} {self.job}"

    @classmethod
    def read(cls, text: str) -> Self:
        """Return the position that has this text; one before all jobs for "".

        Raises:
            Refused: it is none.
        """
        group, _, rest = text.partition(" ")
        order_s, _, job = rest.partition(" ")
        try:
            return cls(int(group), float(order_s), job) if text else cls(-1, 0.0, "")
        except ValueError:
            raise Refused(f"StatusRequest.after must be `next` of a reply (got '{printable(text)}').") from None


def fitting(message: Struct, items: Sequence[Item]) -> tuple[Item, ...]:
    """Return the first of these items, as many as fit into a message."""
    sizes = accumulate((len(encode(item)) + 1 for item in items), initial=len(encode(message)))
    next(sizes)
    return tuple(item for item, size in zip(items, sizes, strict=True) if size <= LISTED_BYTES)
