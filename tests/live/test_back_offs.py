"""Arms that refuse awards, do not answer them, or give no usable quotes: others get the jobs, and reasons say so."""

import logging
from itertools import pairwise
from typing import Any

import pytest

from fleet.bus.protocol.auction import Ack, JobEstimate, JobSpec, PlanQuote, Quote, QuoteRequest, Report, Submission
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.rounds import MAX_BACK_OFFS, Assignment, BackOffs, Bidding
from fleet.live.book import JobBook
from fleet.live.leases import Timing
from fleet.live.records import SendAward

TIMING = Timing(lease_s=2.0, margin_s=0.05, refused_s=(1.0, 8.0))
JOB = JobSpec(name="j", kind="hold", places=("bench",), repetitions=3)
OTHER = JobSpec(name="k", kind="hold", places=("rack",), repetitions=3)


def first_bid(bidding: Bidding) -> dict[str, Assignment]:
    """The first job goes to the first arm with a plan for it."""
    for job in bidding.jobs:
        for arm in sorted(bidding.quotes):
            if bidding.plans(arm, job.name):
                return {job.name: Assignment(arm)}
    return {}


class Shop:
    """An auctioneer and arms that quote every job at once, in steps of 0.05 s."""

    def __init__(self, *arms: str, jobs: tuple[JobSpec, ...] = (JOB,)) -> None:
        self.arms, self.real_s = arms, 0.0
        self.busy: set[str] = set()
        self.awards: list[tuple[float, SendAward]] = []
        """Real second and message of every award when it is first sent."""
        self.answers: dict[str, str | None] = {}
        """Reason for which an arm refuses every award, None for no answer; other arms accept them."""
        book = JobBook()
        options: Any = {"keep": lambda *_: None, "boot": "1", "real_s": 0.0, "timing": TIMING}
        self.auctioneer = Auctioneer("x", book, allocate=first_bid, **options)
        self.auctioneer.set_present(frozenset(arms))
        self.auctioneer.submit(Submission(jobs), 0.0)

    def run(self, seconds: float) -> None:
        end_s = self.real_s + seconds
        while self.real_s < end_s:
            self.real_s += 0.05
            self.auctioneer.tick(self.real_s, self.real_s)
            while self.auctioneer.out:
                message = self.auctioneer.out.popleft()
                if isinstance(message, QuoteRequest):
                    for arm in self.arms:
                        self.auctioneer.add_quote(self.quote(arm, message))
                elif isinstance(message, SendAward):
                    self.answer(message)

    def quote(self, arm: str, request: QuoteRequest) -> Quote:
        estimates = tuple(
            JobEstimate(job.name, (PlanQuote(duration_s=9.0, space=f"{arm} space"),)) for job in request.jobs
        )
        return Quote(arm, request.auction, "q", 5.0, "t", 0.0, "idle", 9.0, int(arm not in self.busy), estimates, ())

    def answer(self, message: SendAward) -> None:
        award = message.award
        if all(award.award != before.award.award for _, before in self.awards):
            self.awards.append((self.real_s, message))
        reason = self.answers.get(message.arm, "")
        if reason is None:
            return
        if not reason:
            self.busy.add(message.arm)
        self.auctioneer.apply_ack(Ack(message.arm, award.award, not reason, reason), self.real_s, self.real_s)

    def reason(self, job: str = "j") -> str:
        (status,) = self.auctioneer.status((job,))
        return status.reason

    @property
    def awarded(self) -> list[tuple[str, str]]:
        return [(message.arm, message.award.job.name) for _, message in self.awards]

    @property
    def pauses_s(self) -> list[float]:
        times_s = [at_s for at_s, _ in self.awards]
        return [round(after - before, 1) for before, after in pairwise(times_s)]


def test_a_job_that_an_arm_refuses_goes_to_another_at_once() -> None:
    shop = Shop("a", "b")
    shop.answers["a"] = "gripper not mounted"
    shop.run(0.5)
    assert shop.awarded == [("a", "j"), ("b", "j")]


def test_the_only_arm_that_can_do_a_job_is_tried_again_after_pauses_that_double() -> None:
    shop = Shop("a")
    shop.answers["a"] = "gripper not mounted"
    shop.run(0.5)
    assert shop.reason().endswith("a has refused it: gripper not mounted.")
    shop.run(40.0)
    assert all(
        doubled <= pause_s <= doubled + 2.2 for pause_s, doubled in zip(shop.pauses_s, (1, 2, 4, 8, 8), strict=False)
    )
    assert len(shop.awards) >= 5
    shop.answers["a"] = ""
    shop.run(11.0)
    assert shop.busy == {"a"}


def test_a_job_whose_award_is_not_answered_goes_to_another_arm() -> None:
    shop = Shop("a", "b")
    shop.answers["a"] = None
    shop.run(3.0)
    assert shop.awarded == [("a", "j"), ("b", "j")]


def test_an_arm_that_answers_no_award_gets_no_job_for_a_while_and_reasons_name_it() -> None:
    jobs = tuple(JobSpec(name=name, kind="hold", places=(name,)) for name in "jklm")
    shop = Shop("a", jobs=jobs)
    shop.answers["a"] = None
    back_offs = shop.auctioneer.rounds.back_offs
    while not back_offs.unanswering:
        shop.run(0.05)
    assert len(shop.awards) == 3
    assert back_offs.unanswering == {"a": "has not answered the last 3 awards"}
    assert "a has not answered the last 3 awards." in shop.reason("m")
    since_s = shop.real_s
    while len(shop.awards) == 3:
        shop.run(0.05)
    assert 4.0 <= shop.real_s - since_s <= 6.2
    shop.answers["a"] = ""
    shop.run(12.0)
    assert not back_offs.unanswering
    assert shop.awarded[-1][0] == "a"


def test_an_arm_that_comes_back_is_tried_at_once_and_memory_is_bounded() -> None:
    back_offs = BackOffs(1.0, 8.0)
    for number in range(2 * MAX_BACK_OFFS):
        back_offs.add_refusal("a", f"j{number}", "no", 0.0)
    assert len(back_offs.why_by_job(0.5)) == MAX_BACK_OFFS
    assert not back_offs.why_by_job(1.0)
    back_offs.forget("a")
    assert not back_offs.why_by_job(0.5)


@pytest.mark.parametrize(("cycles", "counted"), [(1, 1), (7, 3)])
def test_a_report_of_a_finished_job_with_other_cycles_is_logged_and_counts_at_most_all(cycles, counted, caplog) -> None:
    shop = Shop("a")
    shop.run(0.5)
    award = shop.awards[0][1].award.award
    with caplog.at_level(logging.WARNING):
        shop.auctioneer.apply_report(Report("a", award, "j", "finished", cycles, 1.0), 1.0, 1.0)
    assert f"'a' reports 'j' finished after {cycles} cycles, but it has 3" in caplog.text
    (status,) = shop.auctioneer.status(("j",))
    assert (status.state, status.cycles) == ("finished", counted)
    assert status.reason.startswith(
        "'a' finished 'j' without permission to commit: it may have been done twice. 'a' rep"
    )


def test_an_arm_without_a_usable_quote_is_named_with_what_is_wrong() -> None:
    shop = Shop("a", "b", "c")
    round_s = shop.real_s + 0.05
    shop.auctioneer.tick(round_s, round_s)
    (request,) = (each for each in shop.auctioneer.out if isinstance(each, QuoteRequest))
    shop.auctioneer.add_quote(Quote("a", request.auction, "q", 5.0, "t", 0.0, "idle", 9.0, 1, (), ()))
    shop.auctioneer.note_unusable_quote(request.auction, "b", "quoted for another round")
    shop.auctioneer.note_unusable_quote("before", "c", "quoted for another round")
    shop.auctioneer.tick(round_s + 1.0, round_s + 1.0)
    assert shop.reason() == "a did not quote this job, b quoted for another round, c has not answered in time."
