"""Job statuses in one message."""

from itertools import accumulate

from fleet.bus.protocol.auction import MOST_JOBS, JobStatus
from fleet.bus.protocol.messages import encode

MOST_BYTES = 60_000
"""Of the statuses in one answer: a router may drop larger messages."""


def statuses_that_fit(statuses: tuple[JobStatus, ...]) -> tuple[JobStatus, ...]:
    """As many as one message may hold; of more, those that may still change come first."""
    if len(statuses) > MOST_JOBS:
        statuses = tuple(sorted(statuses, key=lambda status: status.state in ("finished", "unfinished")))[:MOST_JOBS]
    sizes = accumulate(len(encode(status)) + 1 for status in statuses)
    return tuple(status for status, size in zip(statuses, sizes, strict=True) if size <= MOST_BYTES)
