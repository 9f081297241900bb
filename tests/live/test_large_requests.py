"""Requests that are allowed, and as large as one message may be: the answer comes soon, and fits into one message."""

import time

import msgspec
import pytest

from fleet.bus.protocol.auction import MOST_JOBS, JobSpec, Submission
from fleet.bus.protocol.messages import MOST_BYTES, MalformedMessage, decode, encode
from fleet.bus.protocol.operator import Cancel, ClearRequest, ControlRequest
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.book import JobBook

SOON_S = 2.0
"""Of the processor: far below the 6 s after which an arm loses its lease, and far above what a slow one takes."""


def job(name: str, *after: str) -> JobSpec:
    return JobSpec(name, "hold", ("clamp",), after=after)


@pytest.fixture
def auctioneer() -> Auctioneer:
    ledger = JobBook(frozenset({"clamp"}), ("arm_0",))
    return Auctioneer(
        "auctioneer", ledger, allocate=lambda *_: {}, keep=lambda *_: None, boot="b", real_s=0.0
    )  # fmt: skip


def test_a_cancelled_job_gives_up_a_long_chain_that_waits_for_it_soon(auctioneer):
    """Each submission names its jobs last first, so that no job comes after the one that it waits for."""
    auctioneer.submit(Submission((job("0"),)), 0.0, 0.0)
    last = 40 * MOST_JOBS
    for first in range(1, last, MOST_JOBS):
        chain = tuple(job(str(i), str(i - 1)) for i in range(first, first + MOST_JOBS))
        auctioneer.submit(Submission(chain[::-1]), 0.0, 0.0)
    began_s = time.process_time()
    auctioneer.control(ControlRequest("r", Cancel("0")), 1.0)
    assert time.process_time() - began_s < SOON_S
    assert {status.state for status in auctioneer.status(map(str, range(1, last)))} == {"given_up"}
    end = auctioneer.status((str(last),))[0]  # the first ones have left the ledger
    assert end.reason == f"Given up, because it waits for '{last - 1}', which is given up or cancelled."


def ring() -> tuple[JobSpec, ...]:
    names = [f"{i:03}".rjust(128, "é") for i in range(30)]
    return tuple(job(name, before) for name, before in zip(names, names[1:] + names[:1], strict=True))


def long_names() -> tuple[JobSpec, ...]:
    return tuple(job(f"{i:03}".rjust(128, "\U0001f600")) for i in range(100))


@pytest.mark.parametrize("jobs", [ring(), long_names()])
def test_why_jobs_are_not_accepted_fits_into_one_message(auctioneer, jobs):
    """The router drops what is larger, and who submits would never hear of it."""
    first = Submission(tuple(msgspec.structs.replace(each, after=()) for each in long_names()))
    auctioneer.submit(first, 0.0, 0.0)
    request = Submission(tuple(msgspec.structs.replace(each, dwell_s=7.0) for each in jobs))
    assert len(encode(request)) <= MOST_BYTES
    reply = auctioneer.submit(request, 0.0, 0.0)
    assert len(encode(reply)) <= MOST_BYTES
    assert not any(each.accepted for each in reply.jobs)


@pytest.mark.parametrize("request_", [Submission((job("j"),)), ClearRequest("arm_0")])
def test_a_requester_has_a_short_name(request_):
    """It comes back in every result, which a router would drop if it were larger than the request was."""
    kind = type(request_)
    assert decode(kind, encode(msgspec.structs.replace(request_, by="x" * 128))).by == "x" * 128
    with pytest.raises(MalformedMessage):
        decode(kind, encode(msgspec.structs.replace(request_, by="x" * 129)))
