"""Why a job waits: one sentence for each cause, and always the true one."""

from dataclasses import replace
from typing import Any

import pytest
from msgspec import structs

from fleet.bus.protocol.auction import NOT_PLANNED, JobEstimate, JobSpec, PlanQuote, Quote, QuoteRequest
from fleet.bus.protocol.messages import State
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.rounds import MAX_REASON, Assignment, Bidding, no_arm_can, reason_to_wait
from fleet.live.book import JobBook
from fleet.live.job_rules import why_not_ready
from fleet.live.journal import JobsAccepted
from fleet.live.leases import expire
from fleet.live.records import SpaceTaken
from tests.live.records import awarded, closed

JOB = JobSpec(name="j", kind="hold", places=("bench",))
NEAR = PlanQuote(plan=0, space="near", duration_s=10.0)


def quote(arm: str, *, plans: tuple[PlanQuote, ...] = (NEAR,), reason: str = "", **more: Any) -> Quote:
    estimate = JobEstimate("j", plans, reason)
    fields = {"mode": "idle", "headroom_k": 9.0, "capacity": 1, "space": ()} | more
    return Quote(arm, "r", "q", 3.0, "t", 0.0, estimates=(estimate,), **fields)


def state(arm: str, **more: Any) -> State:
    return State(arm, 1, 0.0, "idle", (30.0,) * 7, 30.0, **more)


def bidding(*quotes: Quote, **more: Any) -> Bidding:
    return Bidding(
        "r", 0.0, (JOB,), {each.arm: each for each in quotes if each.capacity},
        {each.arm: each for each in quotes if not each.capacity},
        excludes=lambda arm, space, other, other_space: "far" not in (space, other_space), **more,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (bidding(quote("a"), quote("b", capacity=0)), "The policy lets it wait: a could begin it."),
        (
            replace(bidding(quote("a")), time_s=7030.0, jobs=(structs.replace(JOB, due_s=1000.0),)),
            "The policy lets it wait: it would end 101 min late; a could begin it.",
        ),
        (
            bidding(
                quote("a"), quote("b", plans=(), reason="too far"),
                taken={"c": frozenset(["near"])}, absent=frozenset(["c", "d"]),
            ),
            "It waits until c is out of the way. c is not present.",
        ),
        (
            bidding(quote("a"), quote("b", capacity=0), taken={"b": frozenset(["near"])}),
            "It waits until b is out of the way. b has a job.",
        ),
        (
            bidding(quote("a"), taken={"b": frozenset(["near"]), "c": frozenset(["near"])}),
            "It waits until b, c are out of the way.",
        ),
        (
            bidding(
                quote("a", capacity=0, mode="faulted"), quote("b", capacity=0, headroom_k=-0.5),
                quote("c", capacity=0), quote("d", plans=(), reason="too far"),
                states={"c": state("c", break_in_s=0.0)},
            ),
            "a is faulted, b is above its warning limit, c has a break.",
        ),
        (bidding(quote("a", plans=(), reason="too far")), "No arm can do it: a: too far."),
        (
            bidding(quote("a", plans=(), reason="too far"), unasked={"b": "is paused by 'ann'"}, absent=frozenset("c")),
            "No arm that was asked can do it, and b is paused by 'ann', c is not present.",
        ),
        (
            bidding(quote("a", plans=(), reason="too far"), absent=frozenset("bcdef"), unasked={"z": "is paused"}),
            "No arm that was asked can do it, and z is paused, b, c, d and 2 others are not present.",
        ),
        (
            bidding(
                quote("a", plans=()), quote("b", plans=(), reason="too far"),
                excluded={"j": {"a": "has refused it: no gripper"}},
            ),
            "No other arm that was asked can do it, and a has refused it: no gripper.",
        ),
        (
            bidding(
                quote("a", plans=()), quote("b", capacity=0), quote("c", capacity=0), quote("d", capacity=0),
                quote("e", capacity=0, headroom_k=-1.0),
                excluded={"j": {"a": "has refused it: no gripper"}}, at_work=frozenset("b"),
                unfit={"c": "is paused by 'ann'", "e": "has impossible temperatures"},
                states={each: state(each, space="s" * (each == "d")) for each in "bcd"},
            ),
            "b has a job, c is paused by 'ann', d is on its way home, e has impossible temperatures, "
            "a has refused it: no gripper.",
        ),
        (
            bidding(quote("a", plans=(), reason=NOT_PLANNED), quote("b", plans=(), reason="too far")),
            "Arms are planning its motion.",
        ),
        (bidding(), "No arm has answered whether it can do it."),
        (bidding(quote("a"), busy=frozenset(["bench"])), "Its place was in use when it was last offered."),
    ],
)  # fmt: skip
def test_the_reason_names_what_is_in_the_way(given, expected) -> None:
    assert reason_to_wait(given, "j") == expected


def test_a_job_that_is_passed_over_for_another_names_what_that_takes() -> None:
    """The same round awards `k` to an arm, or at a station or in a space, that `j` needs."""

    def of_k(plan: PlanQuote) -> JobEstimate:
        return JobEstimate("k", (plan,))

    both = [structs.replace(each, estimates=(*each.estimates, of_k(NEAR))) for each in (quote("a"), quote("b"))]
    far = PlanQuote(plan=1, space="far", duration_s=10.0)
    k = JobSpec(name="k", kind="hold", places=("rack",))

    def why(*quotes: Quote, plan: int = 0, job: JobSpec = k) -> str:
        given = replace(bidding(*quotes), jobs=(JOB, job))
        return reason_to_wait(given.after({"k": Assignment("a", plan)}), "j")

    assert why(both[0]) == "a has a job."
    assert why(*both) == "It waits until a is out of the way. a has a job."
    apart = structs.replace(both[0], estimates=(JobEstimate("j", (NEAR,)), of_k(far)))
    assert why(apart, both[1], plan=1) == "The policy lets it wait: b could begin it."
    assert why(apart, both[1], plan=1, job=structs.replace(k, places=("bench",))).startswith("Its place was in use")


def test_a_job_that_cannot_be_begun_yet_says_why() -> None:
    job = JobSpec(name="j", kind="pick_place", places=("u", "v"), release_s=90.0, after=("one", "two"))

    def why(time_s: float, finished: set[str], busy: set[str]) -> str:
        return why_not_ready(job, time_s, finished.__contains__, busy)

    assert why(89.0, set(), {"u"}) == "It is released at 0:01:30 of fleet time."
    assert why(90.0, {"one"}, {"u"}) == "It waits for 'two'."
    assert why(90.0, {"one", "two"}, {"v"}) == "Its place 'v' is in use."
    assert why(90.0, {"one", "two"}, set()) == ""


def test_idle_arms_are_asked_for_their_space_before_there_was_any_job() -> None:
    ledger = JobBook(arms=("a", "b"))
    auctioneer = Auctioneer("x", ledger, allocate=lambda _: {}, keep=lambda *_: None, boot="1", real_s=0.0)
    auctioneer.set_present(frozenset(["a", "b"]))
    auctioneer.tick(1.0, 1.0)
    (asked,) = (each for each in auctioneer.out if isinstance(each, QuoteRequest))
    assert asked.dry_run
    for arm in ("a", "b"):
        auctioneer.add_quote(Quote(arm, asked.auction, "", 3.0, "t", 0.0, "idle", 9.0, 1, (), ()))
    auctioneer.tick(1.1, 1.1)
    assert not any(ledger.taken_space().values())


def test_an_arm_that_names_another_space_each_time_does_not_flood_the_fleet() -> None:
    ledger = JobBook(arms=("a",))
    auctioneer = Auctioneer("x", ledger, allocate=lambda _: {}, keep=lambda *_: None, boot="1", real_s=0.0)
    auctioneer.set_present(frozenset(["a"]))
    asked = 0
    for step in range(200):  # 10 s
        auctioneer.tick(1.0 + 0.05 * step, 1.0)
        for each in [each for each in auctioneer.out if isinstance(each, QuoteRequest)]:
            asked += 1
            space = (f"s{step}",)
            auctioneer.add_quote(Quote("a", each.auction, "", 3.0, "t", 0.0, "idle", 9.0, 1, (), space))
        auctioneer.out.clear()
    assert asked <= 10


@pytest.mark.parametrize(
    ("late_s", "reason"),
    [
        (0.1, "'arm_0' did not renew its lease."),
        (60.0, "The lease of 'arm_0' ended while nobody could renew it: the process that awards was stopped."),
    ],
)
def test_a_lease_that_ends_while_the_auctioneer_is_stopped_is_not_blamed_on_its_arm(late_s: float, reason: str) -> None:
    book = JobBook().replay([JobsAccepted((JOB,)), awarded("w:j", "j")])
    book.attach(lambda *_: None, 100.0)
    assert expire(book, 100.0 + late_s, 5.0)
    assert book.status_of(book.jobs["j"]).reason == reason
    book.record(closed("w:j", "returned", 0, 6.0, "the award was revoked"))  # the arm knows no more
    assert book.status_of(book.jobs["j"]).reason == reason


def test_what_few_of_many_arms_say_of_a_job_is_not_cut_off() -> None:
    reasons = {
        f"arm_{i}": f"at 'clamp': reach: {2 + i / 7:.2f} m from the base of the arm, which reaches 0.90 m"
        for i in range(16)
    }
    reasons["arm_6"] = reasons["arm_7"] = "9 kg is beyond the rating of 4.5 kg"
    assert no_arm_can(reasons) == (
        "No arm can do it: arm_6: 9 kg is beyond the rating of 4.5 kg (1 more alike); "
        "arm_0: at 'clamp': reach: 2.00 m from the base of the arm, which reaches 0.90 m (13 more alike)."
    )
    many = no_arm_can({f"arm_{i}": "x" * i for i in range(16, 64)})
    assert len(many) == MAX_REASON
    assert many.endswith("…")


def test_a_reason_names_the_absent_arms_of_the_cell_and_those_that_may_take_space() -> None:
    """b is of the cell and left in order; two other arms left: "acme" in order, "rover" in its space."""
    book = JobBook(arms=("a", "b"))
    book.record(JobsAccepted((JOB,)), *(SpaceTaken(arm, space, 0.0) for arm, space in
                                        (("a", ()), ("b", ()), ("acme", ()), ("rover", ("*",)))))  # fmt: skip
    auctioneer = Auctioneer("x", book, allocate=lambda _: {}, keep=lambda *_: None, boot="1", real_s=0.0)
    auctioneer.set_present(frozenset(["a"]))
    auctioneer.tick(1.0, 1.0)
    (asked,) = (each for each in auctioneer.out if isinstance(each, QuoteRequest))
    auctioneer.add_quote(structs.replace(quote("a", plans=(), reason="too far"), auction=asked.auction))
    auctioneer.tick(1.1, 1.1)
    (status,) = auctioneer.status(["j"])
    assert status.reason == "No arm that was asked can do it, and b, rover are not present."
