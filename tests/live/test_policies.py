"""Every policy live: the same choice from the same observation as in simulation, and a shift that is completed."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.policy import Policy
from agents.registry import RULES, make_policy
from fleet.bus.protocol.auction import JobEstimate as Estimate
from fleet.bus.protocol.auction import JobSpec, PlanQuote, Quote
from fleet.bus.protocol.messages import State
from fleet.errors import BusError
from fleet.live.auction.knowledge import LiveFleet, claimed_jobs, observe
from fleet.live.auction.rounds import Assignment, Bidding, Choice, offers_of, resolve_claims
from fleet.observation import LONG_S
from fleet.robot import ThermalLimits
from scenarios.live.auctioneer import CentralAllocation
from tests.live.simulated import job
from tests.profiles import examples

CENTRAL = [name for name, rule in RULES.items() if rule.scope == "central" and not rule.plans]


def quote(arm: str, *offers: Estimate, **changes) -> Quote:
    facts = {"mode": "idle", "headroom_k": 20.0, "capacity": 1, **changes}
    return Quote(arm=arm, auction="r", quote="q", valid_s=5.0, twin="t", time_s=0.0, estimates=offers, **facts)


def one_plan(job: str, **figures) -> Estimate:
    return Estimate(job, (PlanQuote(**figures),))


def fresh(name: str) -> Policy:
    policy = make_policy(name)
    policy.reset(np.random.default_rng(0))
    return policy


def test_quotes_become_observations() -> None:
    jobs = (
        JobSpec("a", "hold", ("x",), due_s=150.0, value=2.0, release_s=40.0),
        JobSpec("b", "hold", ("y",), due_s=9e3, expires=True),
    )
    fast = PlanQuote(0, 55.0, 9.0, 0.25, None, 1.5, 60.0, 100.0)
    cool = PlanQuote(1, 50.0, 4.0, 0.125, None, 1.25, 55.0, 95.0)
    quotes = {
        "one": quote("one", Estimate("a", (fast, cool)), Estimate("b", reason="4.6 kg", too_heavy=True)),
        "two": quote("two", one_plan("b", peak_c=61.0), headroom_k=5.0),
    }
    full = {"three": quote("three", one_plan("a", duration_s=50.0), capacity=0, mode="working")}
    begun = {"job_value": 3.0, "job_cycles_left": 4, "job_peak_c": 57.0, "job_p_saturation": 0.25, "busy_s": 80.0}
    states = {
        "two": State("two", 0, 93.0, "idle", (30.0,) * 6 + (55.0,), 5.0, housing_c=(29.0,) * 7, ambient_c=21.0),
        "three": State("three", 0, 98.0, "working", (40.0,) * 7, 20.0, **begun),
    }
    bidding = Bidding("r", 100.0, jobs, quotes, full, states, {"a": (2, 90.0)})
    fleet = LiveFleet(arms=("two", "one", "four"), limits=ThermalLimits(error_c=67.0), horizon_s=400.0)
    seen = observe(bidding, fleet, last={"one": -1})
    assert list(seen) == ["two", "one", "four", "three"]
    one, two, three, four = (seen[name] for name in ("one", "two", "three", "four"))
    assert [o.action_mask.tolist() for o in (one, two, three, four)] == [  # wait; a; b; give back
        [1, 1, 1, 0, 0, 0],
        [1, 0, 0, 1, 0, 0],
        [1, 0, 0, 0, 0, 0],
        [1, 0, 0, 0, 0, 0],
    ]
    assert (one.busy_s, one.last_award, two.last_award) == (0.0, -1.0, 0.0)
    assert [(o.left_s, o.headroom_k, o.error_headroom_k) for o in (one, two)] == [
        (300.0, 20.0, 27.0),
        (300.0, 5.0, 12.0),
    ]
    endless, over = (observe(bidding, LiveFleet(arms=("one",), horizon_s=end_s)) for end_s in (np.inf, 50.0))
    assert (endless["one"].left_s, over["one"].left_s, endless["one"].error_headroom_k) == (LONG_S, 0.0, 35.0)
    assert [float(o.idle) for o in (one, two, three, four)] == [1, 1, 0, 0]
    assert [float(o.working) for o in (one, two, three, four)] == [0, 0, 1, 1]  # four: not heard
    assert one.known.tolist() == [1, 1, 0, 0]
    assert one.difficulty.tolist() == [1.5, 1.25, 0, 0]
    assert one.peak_c.tolist() == [55.0, 50.0, 0, 0]
    assert one.p_saturation.tolist() == [0.25, 0.125, 0, 0]
    assert two.p_saturation.tolist() == [0, 0, 0.5, 0]  # unknown without a model
    assert one.duration_s.tolist() == [60.0, 55.0, 0, 0]
    assert two.duration_s.tolist() == [0, 0, 60.0, 0]  # missing: as the longest
    assert one.slack_s.tolist() == [-10.0, -5.0, 0.0, 0.0]
    assert one.expires.tolist() == [0, 1]
    assert one.age_s.tolist() == [10.0, 100.0]
    assert one.returns.tolist() == [2, 0]
    assert two.temp_c.tolist() == [30.0] * 6 + [55.0]
    assert one.temp_c.tolist() == one.housing_c.tolist() == [40.0] * 7  # without a state
    assert (two.housing_c.tolist(), two.ambient_c) == ([29.0] * 7, 21.0)
    assert (one.ambient_c, three.ambient_c) == (40.0, 40.0)  # unknown
    assert (three.job_value, three.job_cycles, three.job_peak_c, three.job_p) == (3.0, 4.0, 57.0, 0.25)
    assert (two.job_value, two.job_cycles, two.job_peak_c, two.job_p) == (0.0, 0.0, 0.0, 0.0)
    assert one.peer_busy_s.tolist() == [0.0, 0.0, 80.0]
    assert one.group.tolist() == [1, 2]
    assert one.blocked.tolist() == [0, 0]
    assert one.peer_heard.tolist() == [1, 0, 1]  # two, four, three
    assert one.peer_age_s.tolist() == [7.0, LONG_S, 2.0]
    assert one.peer_working.tolist() == [0, 0, 1]
    assert two.peer_known.tolist() == [[1, 0], [0, 0], [0, 0]]
    assert two.peer_difficulty.tolist() == [[1.25, -1], [-1, -1], [-1, -1]]
    assert two.peer_duration_s.tolist() == [[60.0, 55.0, 0, 0], [0, 0, 0, 0], [50.0, 0, 0, 0]]  # one, four, three
    assert two.peer_peak_c.tolist() == [[55.0, 50.0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    assert two.peer_p_saturation.tolist() == [[0.25, 0.125, 0, 0], [0, 0, 0, 0], [0.5, 0, 0, 0]]
    assert one.peer_peak_c[0].tolist() == two.peak_c.tolist()
    assert two.fleet_difficulty.tolist() == [[-1, -1], [1.25, -1], [-1, -1], [-1, -1]]


@pytest.mark.parametrize("name", CENTRAL)
@examples(8)
@given(seed=st.integers(0, 2**32))
def test_every_central_policy_awards_jobs_with_a_bid_once(name, seed) -> None:
    rng = np.random.default_rng(seed)
    jobs = tuple(JobSpec(f"j{i}", "hold", (f"p{rng.integers(3)}",)) for i in range(rng.integers(1, 6)))
    quotes = {
        arm: quote(
            arm,
            *(
                Estimate(
                    job.name,
                    tuple(PlanQuote(n, difficulty=rng.random(), duration_s=60.0) for n in range(rng.integers(3))),
                )
                for job in jobs
            ),
        )
        for arm in ("a", "b", "c")[: rng.integers(1, 4)]
    }
    bidding = Bidding("r", 0.0, jobs, quotes)
    awarded = CentralAllocation(fresh(name), LiveFleet(arms=("a", "b", "c")))(bidding)
    assert all(bidding.offer(arm, job, plan) for job, (arm, plan) in awarded.items())
    assert len({arm for arm, _ in awarded.values()}) == len(awarded)
    taken = [job.places[0] for job in jobs if job.name in awarded]
    assert len(set(taken)) == len(taken)
    cool = name != "wspt_cool"
    assert awarded or not cool or not any(offer.feasible for one in quotes.values() for offer in one.estimates)


@pytest.mark.parametrize("name", CENTRAL)
def test_every_central_policy_completes_the_jobs_of_an_auctioneer(fleet_of, name) -> None:
    allocate = CentralAllocation(fresh(name), LiveFleet(arms=("arm_0", "arm_1", "arm_2")))
    fleet, names = fleet_of(alone=False, allocate=allocate), [f"j{i}" for i in range(5)]
    fleet.submit(*(job(each, 2, place="xyz"[i % 3]) for i, each in enumerate(names)))
    fleet.until(lambda: fleet.finished == dict.fromkeys(names, 1))


def test_without_a_policy_in_another_process_nothing_is_awarded_until_it_replies(fleet_of, caplog) -> None:
    class Returns:
        scope = "central"
        asked = 0

        def act(self, observations):
            self.asked += 1
            if self.asked <= 3 or 5 <= self.asked <= 6:
                raise BusError("No process serves it.")
            return fresh("matching").act(observations)

    policy = Returns()
    fleet = fleet_of(alone=False, arms=1, allocate=CentralAllocation(policy, LiveFleet(arms=("arm_0",))))
    logging.getLogger("fleet").addHandler(caplog.handler)
    logging.getLogger("scenarios").addHandler(caplog.handler)
    logging.disable(logging.NOTSET)
    fleet.submit(*(job(f"j{i}", 2, place="x") for i in range(3)))
    fleet.until(lambda: len(fleet.finished) == 3)
    assert policy.asked > 6
    assert caplog.text.count("Nothing is awarded until the policy replies: No process serves it.") == 2
    assert caplog.text.count("The policy replies again.") == 2


def test_the_lower_difficulty_wins_a_job_or_station_then_the_first_arm() -> None:
    jobs = (JobSpec("j", "hold", ("x",)), JobSpec("k", "hold", ("x",)), JobSpec("l", "hold", ("y",)))

    def bidding(**scores):
        quotes = {arm: quote(arm, *(one_plan(w.name, difficulty=d) for w in jobs)) for arm, d in scores.items()}
        return Bidding("r", 0.0, jobs, quotes)

    def winners(scores, claims):
        chosen = {arm: Choice(job) for arm, job in claims.items()}
        awarded = resolve_claims(bidding(**scores), chosen, ("a", "b", "c"))
        return {job: arm for job, (arm, _) in awarded.items()}

    assert winners({"a": 2.0, "b": 1.0}, {"a": "j", "b": "j"}) == {"j": "b"}
    assert winners({"a": 1.0, "b": 1.0}, {"a": "j", "b": "j"}) == {"j": "a"}
    assert winners({"a": None, "b": 9.0}, {"a": "j", "b": "j"}) == {"j": "b"}
    assert winners({"a": 2.0, "b": 1.0, "c": 5.0}, {"a": "j", "b": "k", "c": "l"}) == {"k": "b", "l": "c"}
    assert winners({"a": 1.0}, {"a": "unknown"}) == {}


def test_the_difficulty_of_the_claimed_plan_counts() -> None:
    jobs = (JobSpec("j", "hold", ("x",)),)
    plans = (PlanQuote(0, difficulty=3.0), PlanQuote(1, difficulty=1.0))
    quotes = {"a": quote("a", Estimate("j", plans)), "b": quote("b", one_plan("j", difficulty=2.0))}
    bidding = Bidding("r", 0.0, jobs, quotes)
    for plan, winner in ((0, Assignment("b")), (1, Assignment("a", 1)), (2, Assignment("b"))):
        assert resolve_claims(bidding, {"a": Choice("j", plan), "b": Choice("j")}, ("a", "b")) == {"j": winner}


def test_the_offers_behind_an_award_are_the_winner_then_the_others_best_first() -> None:
    jobs = (JobSpec("j", "hold", ("x",)), JobSpec("k", "hold", ("y",)))
    joints = (0.1,) * 7

    def costs(*ps):
        return Estimate(
            "j",
            tuple(
                PlanQuote(n, p_saturation=p, difficulty=p, joint_difficulty=joints, space="s") for n, p in enumerate(ps)
            ),
        )

    quotes = {arm: quote(arm, estimate) for arm, estimate in (
        ("cannot", Estimate("j", (), "out of reach")), ("hot", costs(0.9)),
            ("cool", costs(0.3, 0.1)), ("winner", costs(0.2, 0.4)),
    )}  # fmt: skip
    bidding = Bidding("r", 0.0, jobs, quotes, {"full": quote("full", costs(0.0), capacity=0)})
    offers = offers_of(bidding, "j", Assignment("winner", 1))
    assert [(o.arm, o.free, o.plan and o.plan.p_saturation) for o in offers] == [
        ("winner", True, 0.4), ("cool", True, 0.1), ("hot", True, 0.9), ("full", False, 0.0),
        ("cannot", False, None),
    ]  # fmt: skip
    assert all(o.plan is None or (o.plan.joint_difficulty, o.plan.space) == (None, None) for o in offers)
    many = {f"a{n:03d}": quote(f"a{n:03d}", costs(n / 300)) for n in range(256)}
    kept = offers_of(Bidding("r", 0.0, jobs, many), "j", Assignment("a200"))
    assert [o.arm for o in kept] == ["a200", *(f"a{n:03d}" for n in range(7))]


def test_an_illegal_action_is_logged_and_waits(caplog) -> None:
    bidding = Bidding(
        "r", 0.0, (JobSpec("j", "hold", ("x",)),), {"a": quote("a", Estimate("j", (PlanQuote(), PlanQuote(1))))}
    )
    seen = observe(bidding, LiveFleet(arms=("a",)))
    claims = [claimed_jobs(bidding, seen, {"a": action}) for action in (0, 1, 2, 3, -1)]
    assert claims == [{}, {"a": Choice("j")}, {"a": Choice("j", 1)}, {}, {}]
    assert caplog.text.count("The policy chose the illegal action") == 2
