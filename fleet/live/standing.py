"""Where jobs stand, as one word tells it."""

from itertools import accumulate

from fleet.bus.messages import encode
from fleet.bus.trade import MOST_JOBS, JobStatus
from fleet.live.granting import Grantor

MOST_BYTES = 60_000
"""Of the jobs in one answer: a router may drop larger words."""


def first(statuses: tuple[JobStatus, ...]) -> tuple[JobStatus, ...]:
    """As many as one word may hold; those that may still change come first."""
    if len(statuses) > MOST_JOBS:
        statuses = tuple(sorted(statuses, key=lambda said: said.state in ("finished", "unfinished")))[:MOST_JOBS]
    room = accumulate(len(encode(said)) + 1 for said in statuses)
    return tuple(said for said, used in zip(statuses, room, strict=True) if used <= MOST_BYTES)


def by_grants(job: str, grantor: Grantor, real_s: float) -> JobStatus:
    """Where a job stands, as far as an arm knows by what it has granted and was told."""
    register = grantor.register
    settled, gift, cycles = register.settled.get(job), register.gifts.get(job), register.cycles.get(job, 0)
    if settled is not None and settled.outcome == "finished":
        return JobStatus(job, "finished", settled.arm, settled.award, cycles, settled.time_s)
    if settled is not None:
        return JobStatus(job, "unfinished", settled.arm, settled.award, cycles, None, settled.reason)
    if gift is None or not grantor.bars(job, real_s):
        return JobStatus(job, "waiting", cycles=cycles)
    silent = gift.leave and real_s >= gift.until_s
    state = "unfinished" if silent else "finishing" if gift.leave else "awarded"
    reason = f"'{gift.arm}' was about to finish it and has not been heard of since." if silent else ""
    return JobStatus(job, state, gift.arm, gift.award, cycles, None, reason)
