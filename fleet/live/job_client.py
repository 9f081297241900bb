"""Submit jobs to a fleet, follow and cancel them: the basis of every job interface."""

import logging
import math
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from graphlib import CycleError, TopologicalSorter

from msgspec.structs import replace

from fleet.bus.client import BusClient, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    SETTLED,
    Admission,
    JobSpec,
    JobStatus,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import MOST_COUNT, encode
from fleet.bus.protocol.operator import Cancel, Controlled, ControlRequest
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

REPLY_S, ATTEMPTS = 5.0, 3
"""Real seconds to wait for a reply, and number of attempts of `submit_and_wait`: a job submitted twice is one job."""
RETRY_S = 0.5
"""Real seconds between two attempts to submit or cancel."""
STATUS_S = (0.5, 2.0)
"""Real seconds between two status requests: without an auctioneer, so without results; and with one, where they only
report done cycles and lost results."""
JOBS_PER_MESSAGE, MAX_BYTES = 64, 48_000
"""A router may drop messages of more than 64 KiB."""
MAX_PAGES = 256
"""Pages of statuses that are read at most: about 32,000 jobs, more than an auctioneer keeps."""
PAGE_S = 0.1
"""Real seconds to wait for a page at least."""


class JobClient:
    """Submits jobs, and reports every change of their states as soon as a result is published.

    For the thread of its link: call `step` after each `serve` of the link.

    Args:
        by: Who submits, for the records.
        on_change: Called with the new state of a job; a job that is not accepted is `given_up`, with the reason.

    Attributes:
        statuses: Last state of each followed job; None before the first.
        heard_s: Real second of the last message about jobs.
    """

    def __init__(self, link: BusClient, by: str, on_change: Callable[[JobStatus], None]) -> None:
        self.statuses: dict[str, JobStatus | None] = {}
        self.heard_s = time.monotonic()
        self._link, self._by, self._on_change = link, by, on_change
        self._unsubmitted: dict[str, JobSpec] = {}
        self._cancels: dict[str, ControlRequest] = {}
        """Requests without a reply, by job."""
        self._auctioneers: set[str] = set()
        self._result_s: dict[str, float] = {}
        """Real second of the last result of each followed job."""
        self._retry_s = self._status_s = -math.inf
        """Real seconds at which the next attempts and the next status requests are due."""
        link.subscribe(keys.of_every_auction(link.fleet, "result"), Result, self._apply_result)
        link.watch_tokens(keys.of_every_auction(link.fleet, "alive"), self._watch)

    def submit(self, *jobs: JobSpec) -> None:
        """Submit jobs, again until there is a reply, and follow them. The same job twice is one job."""
        for job in jobs:
            self._unsubmitted[job.name] = job
            self.statuses.setdefault(job.name, JobStatus(job.name, "waiting"))
        self._retry_s = -math.inf

    def submit_and_wait(self, jobs: Sequence[JobSpec]) -> list[Admission]:
        """Submit jobs and return the decision on each; accepted jobs are durable and followed.

        Raises:
            Refused: the fleet refuses the submission, with its reason.
            NoReply: no reply.
        """
        key, admissions = keys.of_jobs(self._link.fleet, "submit"), list[Admission]()
        for batch in batches(jobs):
            request = Submission(batch, self._by)
            reply = self._link.ask(key, request, SubmissionReply, timeout_s=REPLY_S, attempts=ATTEMPTS)
            admissions += reply.jobs
        self.follow(admission.job for admission in admissions if admission.accepted)
        return admissions

    def follow(self, names: Iterable[str]) -> None:
        """Follow jobs that are submitted already."""
        for name in names:
            self.statuses.setdefault(name, None)
        self.heard_s, self._status_s = time.monotonic(), -math.inf

    def forget(self, job: str) -> None:
        """Stop following a job."""
        self.statuses.pop(job, None)
        self._unsubmitted.pop(job, None)
        self._result_s.pop(job, None)

    @property
    def open(self) -> list[str]:
        """Names of the followed jobs that have not ended."""
        return [name for name, status in self.statuses.items() if status is None or status.state not in SETTLED]

    def cancel(self, job: str) -> str:
        """Cancel a job; return why that is impossible, or "". The job then ends as any other."""
        if job not in self.statuses:
            return f"There is no job '{job}'."
        self._cancels.setdefault(job, ControlRequest(secrets.token_hex(8), Cancel(job), self._by))
        self._retry_s = -math.inf
        return ""

    def step(self) -> None:
        """Send requests that are due."""
        fleet, real_s = self._link.fleet, time.monotonic()
        if real_s >= self._retry_s:
            self._retry_s = real_s + REPLY_S
            for batch in batches(tuple(self._unsubmitted.values())):
                request = Submission(batch, self._by)
                self._link.query(
                    keys.of_jobs(fleet, "submit"), request, SubmissionReply, self._apply_admissions, timeout_s=REPLY_S
                )
            for job, control in self._cancels.items():
                if job not in self._unsubmitted:
                    done = partial(self._apply_control, job)
                    self._link.query(keys.of_jobs(fleet, "control"), control, Controlled, done, timeout_s=REPLY_S)
        if real_s >= self._status_s:
            self._status_s = real_s + STATUS_S[bool(self._auctioneers)]
            names = [name for name in self.open if name not in self._unsubmitted]
            for start in range(0, len(names), JOBS_PER_MESSAGE):
                done = partial(self._apply_statuses, real_s)
                query_statuses(self._link, done, names[start : start + JOBS_PER_MESSAGE], timeout_s=REPLY_S)

    def _watch(self, auctioneer: str, present: bool) -> None:
        (self._auctioneers.add if present else self._auctioneers.discard)(auctioneer)
        self._status_s = -math.inf  # a result may have been published while it or we were away

    def _apply_admissions(self, replies: Replies[SubmissionReply]) -> None:
        for admission in (each for reply in replies.messages.values() for each in reply.jobs):
            if self._unsubmitted.pop(admission.job, None) and not admission.accepted:
                self._set(JobStatus(admission.job, "given_up", reason=f"not accepted: {admission.reason}"))
        if replies.messages:
            self._status_s = -math.inf
        self._retry_s = min(self._retry_s, time.monotonic() + RETRY_S)
        for reason in replies.refusals:
            _LOG.warning("Not submitted yet: %s", reason)

    def _apply_control(self, job: str, replies: Replies[Controlled]) -> None:
        if replies.messages or replies.refusals:
            self._cancels.pop(job, None)
        self._retry_s = min(self._retry_s, time.monotonic() + RETRY_S)
        for reason in replies.refusals:
            _LOG.warning("Refused: %s", reason)

    def _apply_result(self, _auctioneer: str, result: Result) -> None:
        if result.status.job in self.statuses:
            self._result_s[result.status.job] = time.monotonic()
            self._set(result.status)

    def _apply_statuses(self, asked_s: float, replies: Replies[Status]) -> None:
        for reply in replies.messages.values():
            self.heard_s = time.monotonic()
            for status in reply.jobs:
                if self._result_s.get(status.job, -math.inf) < asked_s:  # otherwise the reply may be the older one
                    self._set(status)

    def _set(self, status: JobStatus) -> None:
        if status.job not in self.statuses:
            return
        known, self.heard_s = self.statuses[status.job], time.monotonic()
        if known is None or (known.state != "finished" and _progress(known) != _progress(status)):
            self.statuses[status.job] = status
            self._on_change(status)


def query_statuses(
    link: BusClient,
    done: Callable[[Replies[Status]], None],
    names: Sequence[str] = (),
    *,
    timeout_s: float,
    most: int = MOST_COUNT,
) -> None:
    """Query the state of jobs, of all if none is named; `done` gets the replies, each with the jobs of all its pages.

    A reply whose `next` is not "" is incomplete: its reader has reached a limit, or a page did not arrive in time. Of
    several participants that reply, which a fleet should not have, only the first is asked for further pages.

    Args:
        timeout_s: Real seconds for all pages.
        most: Number of jobs after which no further page is queried.

    Raises:
        BusError: as `BusClient.query`.
    """
    key, until_s = keys.of_jobs(link.fleet, "status"), time.monotonic() + timeout_s
    firsts, pages, jobs = list[Replies[Status]](), list[Status](), dict[str, JobStatus]()

    def query(after: str = "") -> None:
        left_s = max(PAGE_S, until_s - time.monotonic())
        link.query(key, StatusRequest(tuple(names), after), Status, add, timeout_s=left_s)

    def add(replies: Replies[Status]) -> None:
        firsts.append(replies)
        page = next(iter(replies.messages.values()), None)
        if page is not None:
            pages.append(page)
            jobs.update({status.job: status for status in page.jobs})
            is_wanted = len(pages) < MAX_PAGES and len(jobs) < most and time.monotonic() < until_s
            if page.next and page.jobs and is_wanted:
                try:
                    query(page.next)
                    return
                except BusError as error:
                    _LOG.warning("%s", error)
        if pages:
            messages, last = firsts[0].messages, pages[-1]
            whole = replace(pages[0], jobs=tuple(jobs.values()), counts=last.counts, next=last.next)
            messages[next(iter(messages))] = whole
        done(firsts[0])

    query()


def _progress(status: JobStatus) -> tuple[object, ...]:
    """Fields that are the same in a result and a status."""
    return status.state, status.arm, status.award, status.cycles, status.finished_s, status.reason


def batches(jobs: Sequence[JobSpec]) -> Iterator[tuple[JobSpec, ...]]:
    """Split jobs into messages, each job after those that it waits for."""
    batch, size = list[JobSpec](), 0
    for job in in_order(jobs):
        length = len(encode(job)) + 1
        if len(batch) == JOBS_PER_MESSAGE or (batch and size + length > MAX_BYTES):
            yield tuple(batch)
            batch, size = [], 0
        batch.append(job)
        size += length
    if batch:
        yield tuple(batch)


def in_order(jobs: Sequence[JobSpec]) -> Sequence[JobSpec]:
    """Sort jobs so that each comes after those that it waits for; leave them as they are if that is impossible."""
    try:
        order = list(TopologicalSorter({job.name: job.after for job in jobs}).static_order())
    except CycleError:
        return jobs  # the auctioneer refuses them and names the cycle
    place = {name: i for i, name in enumerate(order)}
    return sorted(jobs, key=lambda job: place[job.name])
