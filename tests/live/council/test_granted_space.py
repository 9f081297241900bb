"""Space that an arm grants to its peers: freed by a claim or by a person, never by a timeout or a restart."""

import pytest

from fleet.bus.protocol.auction import JobEstimate, JobSpec, PlanQuote
from fleet.bus.protocol.consensus import Bid, Claim, ClaimEntry, JobOutcome
from fleet.errors import Refused
from fleet.live.auction.rounds import Timing
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.jobs import Register

TIMING = Timing(lease_s=3.0, margin_s=0.05)
ROSTER = ("a", "b", "c")
LATER_S = 1e6


def same_name(arm: str, space: str, other: str, other_space: str) -> bool:
    """Two plans exclude each other if their names begin with the same letter; an arm that may be anywhere, all."""
    return "*" in (space, other_space) or space[0] == other_space[0]


class Granting:
    """Arm `c`, its disk, and claims of its peers."""

    def __init__(self):
        self.records, self.number = [], 0
        self.start(0.0)
        for arm in ROSTER:
            self.claim(arm)

    def start(self, real_s: float) -> None:
        register = Register().replay(self.records)
        self.records[:] = register.compact()
        self.granter = Granter(
            "c",
            ROSTER,
            register,
            lambda *records: self.records.extend(records),
            real_s=real_s,
            timing=TIMING,
            excludes=same_name,
        )

    def claim(self, arm: str, *jobs: str, space=(), at_s: float = 0.0, phase="requested", outcomes=()) -> list[str]:
        """Claim jobs, each with a plan of its name; return the reasons for which they are denied."""
        self.number += 1
        entries = tuple(ClaimEntry(f"{arm}: {job}", job, (f"at {job}",), 0, phase, job) for job in jobs)
        claim = Claim(arm, self.number, entries, tuple(outcomes), space=space)
        return [denied.reason for denied in self.granter.answer_claim(claim, at_s).denied]


@pytest.fixture
def granting():
    return Granting()


def test_of_two_plans_that_exclude_each_other_one_is_granted(granting):
    assert granting.claim("a", "p1", "q1") == []
    assert granting.claim("b", "p2", "r1") == ["'a' is in the way"]
    assert granting.claim("a", "q1") == []
    assert granting.claim("b", "p2", "r1") == []


@pytest.mark.parametrize("restart", [False, True])
def test_space_stays_taken_after_the_lease_and_after_a_restart(granting, restart):
    assert granting.claim("a", "p1", phase="working") == []
    if restart:
        granting.start(LATER_S)
    assert granting.claim("b", "p2", at_s=LATER_S) == ["'a' is in the way"]
    assert granting.claim("a", space=("p1",), at_s=LATER_S) == []  # it is on its way home
    assert granting.claim("b", "p2", at_s=LATER_S) == ["'a' is in the way"]
    granting.claim("a", at_s=LATER_S)
    assert granting.claim("b", "p2", at_s=LATER_S) == []


def test_space_of_a_finished_job_stays_taken_until_the_arm_is_home(granting):
    granting.claim("a", "p1", phase="finishing")
    outcome = JobOutcome("p1", "a: p1", "a", "finished", 1, 9.0)
    granting.claim("a", space=("p1",), outcomes=[outcome])
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("a")
    assert granting.claim("b", "p2") == []


def test_an_arm_without_a_claim_or_that_does_not_say_where_it_is_may_be_anywhere():
    granting = Granting()
    granting.records.clear()
    granting.start(0.0)
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("c")
    granting.claim("a", space=None)
    assert granting.claim("b", "p2") == ["'a' is in the way"]
    granting.claim("a")
    assert granting.claim("b", "p2") == []


def test_a_person_frees_the_space_of_an_arm_that_is_not_heard(granting):
    granting.claim("a", "p1", phase="finishing")
    for present, at_s, reason in (({"a"}, LATER_S, "present"), (set(), 0.0, "lease of 'a' has not ended")):
        with pytest.raises(Refused, match=reason):
            granting.granter.clear("a", "me", frozenset(present), at_s, 0.0)
    with pytest.raises(Refused, match=r"no arm of this fleet. Arms: a, b, c."):
        granting.granter.clear("z", "me", frozenset(), LATER_S, 0.0)
    granting.granter.clear("a", "me", frozenset(), LATER_S, 0.0)
    count = len(granting.records)
    granting.granter.clear("a", "me", frozenset(), LATER_S, 0.0)
    assert len(granting.records) == count  # the same request again changes nothing
    granting.start(LATER_S)
    assert granting.claim("b", "p2", at_s=LATER_S + TIMING.lease_s + 1) == []
    granting.claim("b", at_s=LATER_S + TIMING.lease_s + 1)
    for restart in (False, True):  # it is heard again, away from home
        if restart:
            granting.start(LATER_S)
        again = granting.claim("a", "p1", space=("p1",), at_s=2 * LATER_S, phase="finishing")
        assert again == ["the space of 'a' was cleared"]
    assert granting.claim("c", "p3", at_s=2 * LATER_S) == ["'a' is in the way"]


class Second:
    """Every arm chooses the second plan for the job of the slot with its own number."""

    scope = "arm"

    def reset(self, rng):
        """Nothing to reset."""

    def choose(self, observation, place):
        option = 2 * place + 1
        legal = observation.action_mask[1:-1]
        return option + 1 if option < len(legal) and legal[option] else 0


def test_a_claim_covers_the_space_of_the_plan_that_was_chosen(council):
    """No arm receives the choice of another: the grants alone keep two second plans apart, which exclude each other."""
    jobs = [JobSpec(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=3) for i in range(3)]
    fleet = council.Fleet([1.0] * 3, jobs, Second, lambda a, one, b, other: one.endswith("1") and other.endswith("1"))

    def offer(arm, job):
        return JobEstimate(job.name, tuple(PlanQuote(n, space=fleet.arms[arm].space_of(job, n)) for n in range(2)))

    fleet.offer, most = offer, 0
    for _ in range(200):
        for arm in fleet.arms.values():
            arm.step()
        while fleet.packets:
            call = fleet.packets[0][2]
            if isinstance(call.args[2], Bid) and call.args[2].choice:
                del fleet.packets[0]
            else:
                fleet.deliver(0)
        fleet.true_s += 0.1
        fleet.check()
        most = max(most, sum(bool(arm.out) for arm in fleet.arms.values()))
    assert most == 1
    assert fleet.settled()
