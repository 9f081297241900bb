"""Submit jobs to a fleet and follow them: what adapters of other job interfaces have in common."""

import logging
import math
import secrets
import time
from collections.abc import Callable
from functools import partial

from fleet.bus.client.client import BusClient
from fleet.bus.client.replies import Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    SETTLED,
    JobSpec,
    JobStatus,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.operator import Action, Cancel, Controlled, ControlRequest, Pause, Resume

_LOG = logging.getLogger(__name__)

POLL_S, REPLY_S = 0.5, 2.0
"""Real seconds between two status requests, and for a reply."""
MOST_FOLLOWED = 128
"""Jobs in one request."""


class JobClient:
    """Submits jobs until there is a reply, and reports every change of their states; for the thread of its link.

    Args:
        by: Who submits, for the records.
        on_change: Called with the new state of a job; a job that is not accepted is `given_up`, with the reason.

    Attributes:
        statuses: Last known state of each followed job.
    """

    def __init__(self, link: BusClient, by: str, on_change: Callable[[JobStatus], None]) -> None:
        self.statuses: dict[str, JobStatus] = {}
        self._link, self._by, self._on_change = link, by, on_change
        self._unsubmitted: dict[str, JobSpec] = {}
        self._requests: dict[str, ControlRequest] = {}
        """Requests without a reply, by name."""
        self._due_s = -math.inf
        link.subscribe(keys.of_every_auction(link.fleet, "result"), Result, lambda _, result: self._set(result.status))

    def submit(self, spec: JobSpec) -> None:
        """Submit a job, again until there is a reply, and follow it. The same job twice is one job."""
        self._unsubmitted[spec.name] = spec
        self.statuses.setdefault(spec.name, JobStatus(spec.name, "waiting"))
        self._due_s = -math.inf

    def cancel(self, job: str) -> str:
        """Ask the fleet to cancel a job; return why that is impossible, or "". The job then ends as any other."""
        if job not in self.statuses:
            return f"There is no job '{job}'."
        self._request(Cancel(job))
        return ""

    def pause(self, paused: bool) -> str:
        """Ask the fleet to begin no further cycle, or to go on; return why that is impossible, or ""."""
        later = {name: r for name, r in self._requests.items() if not isinstance(r.action, Pause | Resume)}
        self._requests = later
        self._request(Pause() if paused else Resume())
        return ""

    def forget(self, job: str) -> None:
        """Follow a job no longer."""
        self.statuses.pop(job, None)
        self._unsubmitted.pop(job, None)

    def _request(self, action: Action) -> None:
        request = ControlRequest(secrets.token_hex(8), action, self._by)
        self._requests[request.request] = request
        self._due_s = -math.inf

    def step(self) -> None:
        """Send requests that are due."""
        if (real_s := time.monotonic()) < self._due_s:
            return
        self._due_s = real_s + POLL_S
        for spec in self._unsubmitted.values():
            request = Submission((spec,), self._by)
            key = keys.of_jobs(self._link.fleet, "submit")
            self._link.query(key, request, SubmissionReply, self._apply_admission, timeout_s=REPLY_S)
        known = self._unsubmitted
        for request in self._requests.values():
            if not (isinstance(request.action, Cancel) and request.action.job in known):
                key, done = keys.of_jobs(self._link.fleet, "control"), partial(self._apply_control, request)
                self._link.query(key, request, Controlled, done, timeout_s=REPLY_S)
        open_jobs = [job for job, status in self.statuses.items() if job not in known and status.state not in SETTLED]
        if open_jobs:
            request = StatusRequest(tuple(open_jobs[:MOST_FOLLOWED]))
            key = keys.of_jobs(self._link.fleet, "status")
            self._link.query(key, request, Status, self._apply_statuses, timeout_s=REPLY_S)

    def _apply_admission(self, replies: Replies[SubmissionReply]) -> None:
        for admission in (each for reply in replies.messages.values() for each in reply.jobs):
            if self._unsubmitted.pop(admission.job, None) and not admission.accepted:
                self._set(JobStatus(admission.job, "given_up", reason=f"not accepted: {admission.reason}"))
        for reason in filter(None, replies.refused.values()):
            _LOG.warning("Not submitted yet: %s", reason)

    def _apply_control(self, request: ControlRequest, replies: Replies[Controlled]) -> None:
        refusals = list(filter(None, replies.refused.values()))
        if replies.messages or refusals:
            self._requests.pop(request.request, None)
        for reason in refusals:
            _LOG.warning("Refused: %s", reason)

    def _apply_statuses(self, replies: Replies[Status]) -> None:
        for status in (each for reply in replies.messages.values() for each in reply.jobs):
            self._set(status)

    def _set(self, status: JobStatus) -> None:
        known = self.statuses.get(status.job)
        if known is not None and known != status and known.state != "finished":
            self.statuses[status.job] = status
            self._on_change(status)
