"""Prices of arms' time: closed forms of few jobs, the largest total gain, and who stays free for what."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.policy import WAIT, Policy
from agents.prices import BidPrice, Bids, best_pairs, bids_of, price_of
from agents.registry import make_policy
from fleet.env.allocation_v2 import parallel_env
from fleet.observation import BIDS, LONG_S, LazyObservation, Observation
from tests.agents.observations import observation
from tests.profiles import examples

SCARCE_S, COMMON_S = 400.0, 300.0


def recent(worth: list[float], count: int, duration_s: float = SCARCE_S) -> Bids:
    """Bids for some equal jobs with these worths for the arms."""
    rows = np.tile(np.array(worth), (count, 1))
    return Bids(rows, np.full(rows.shape, duration_s))


@pytest.mark.parametrize(("count", "missed"), [(4, 4.0), (40, 6.0)])
def test_the_price_of_a_time_is_the_advantage_that_the_arm_misses_in_it(count, missed) -> None:
    """Four jobs in 2400 s are worth 10 to the first arm only: 1/60 a second, without those that wait for 60 s. The
    price is below the worth of the jobs that the arm stays free for: of ten times as many 0.8 · 10 / 400 s."""
    price = price_of(recent([10.0, 0.0], count), np.full(count, 60.0), 2400.0)
    np.testing.assert_allclose(price.of(np.full((2, 1), 300.0)), [[missed], [0.0]])
    assert (price.of(np.full((2, 1), 60.0)) == 0).all()
    assert (price_of(recent([10.0, 0.0], 4), np.full(4, np.inf), 2400.0).of(np.full((2, 1), 300.0)) == 0).all()


def test_the_advantage_is_that_over_the_mean_of_the_others_and_shared_by_those_that_have_it() -> None:
    """Worth 10 to two arms of three, whose others have 5 on average; one of them gets the job."""
    price = price_of(recent([10.0, 10.0, 0.0], 1), np.zeros(1), 1000.0)
    np.testing.assert_allclose(price.of(np.full((3, 1), 100.0)), [[0.25], [0.25], [0.0]])


@pytest.mark.parametrize(("worth", "price"), [([10, 0, 10], 0.25), ([10, 0, np.nan], 0.5), ([10, np.nan, np.nan], 0.0)])
def test_an_arm_with_an_unknown_bid_counts_as_equal_to_each_other(worth, price) -> None:
    """An advantage of 5 in one job of 1000 s, that the first arm shares with the third or not, or none."""
    found = price_of(recent(worth, 1), np.zeros(1), 1000.0).of(np.full((3, 1), 100.0))
    np.testing.assert_allclose(found[0], price)
    assert found[1] == 0


@given(st.integers(1, 6), st.floats(0.1, 100.0), st.integers(0, 5))
def test_the_time_of_equal_arms_has_no_price(arms, worth, count) -> None:
    price = price_of(recent([worth] * max(arms, 2), count), np.full(count, 60.0), 600.0)
    assert (price.of(np.full((max(arms, 2), 3), 900.0)) == 0).all()


@examples(60)
@given(st.integers(0, 2**32))
def test_other_labels_of_arms_give_other_labels_of_prices(seed) -> None:
    rng = np.random.default_rng(seed)
    bids = Bids(rng.uniform(0.0, 5.0, (6, 4)) * (rng.random((6, 4)) < 0.7), rng.uniform(60.0, 900.0, (6, 4)))
    patience_s, order = rng.uniform(0.0, 600.0, 6), rng.permutation(4)
    duration_s = rng.uniform(60.0, 900.0, (4, 3))
    price = price_of(bids, patience_s, 1800.0)
    moved = price_of(Bids(*(each[:, order] for each in bids)), patience_s, 1800.0)
    np.testing.assert_allclose(moved.of(duration_s[order]), price.of(duration_s)[order], rtol=1e-9, atol=1e-12)


@examples(60)
@given(st.integers(0, 2**32))
def test_the_pairs_have_the_largest_total_gain(seed) -> None:
    """By all assignments of three jobs to two places of two arms."""
    gain = np.random.default_rng(seed).uniform(-0.5, 1.0, (2, 2, 3)).clip(0.0)
    rows = gain.reshape(4, 3)
    every = [
        row for row in product(range(-1, 4), repeat=3) if len({r for r in row if r >= 0}) == sum(r >= 0 for r in row)
    ]
    best = max(every, key=lambda row: sum(rows[r, j] for j, r in enumerate(row) if r >= 0))
    assert set(best_pairs(gain)) == {(r, j) for j, r in enumerate(best) if 0 <= r < 2 and rows[r, j] > 0}


def test_a_bid_is_that_of_the_plan_with_the_most_worth() -> None:
    bids = bids_of(np.array([[1.0, 3.0, -2.0, -1.0]]), np.array([[60.0, 90.0, 60.0, 90.0]]), plans=2)
    np.testing.assert_array_equal(bids.worth, [[3.0, 0.0]])
    np.testing.assert_array_equal(bids.duration_s, [[90.0, 90.0]])


def know(time_s: float, jobs: str, *, busy_s=(0.0, 0.0)) -> dict[str, Observation]:
    """What a cool arm that can do all and one that can do common jobs only know of new jobs, s(carce) or c(ommon)."""
    scarce = np.array([job == "s" for job in jobs])

    def seen(able: np.ndarray, busy_s: float) -> Observation:
        duration_s = np.where(able, np.where(scarce, SCARCE_S, COMMON_S), 0.0)
        return observation(
            len(jobs),
            legal=(duration_s > 0) & (busy_s == 0),
            left_s=np.array(10_000.0 - time_s),
            value=np.where(scarce, 10.0, 5.0),
            due_in_s=np.where(scarce, 60.0, 5000.0),
            expires=scarce,
            duration_s=duration_s,
            peak_c=np.full(len(jobs), 21.0),
            temp_c=np.full(7, 20.0),
            headroom_k=np.array(40.0),
            error_headroom_k=np.array(47.0),
            working=float(busy_s > 0),
            busy_s=np.array(busy_s),
        )

    return {"able": seen(np.ones(len(jobs), bool), busy_s[0]), "other": seen(~scarce, busy_s[1])}


def after_scarce_jobs(*, count: int = 4) -> Policy:
    """The policy after one scarce job every 600 s, the first at the beginning."""
    policy = make_policy("bid_price")
    for k in range(count):
        assert policy.act(know(600.0 * k, "s")) == {"able": 1, "other": 0}
    return policy


def test_an_arm_stays_free_for_what_only_it_can_do_while_another_can_do_the_rest() -> None:
    """It would miss 4 of a common job's 5 (see above), and the other arm is free in 60 s."""
    soon, late = (0.0, 60.0), (0.0, 9000.0)
    assert after_scarce_jobs().act(know(1800.0, "c")) == {"able": 0, "other": 1}
    assert after_scarce_jobs().act(know(1800.0, "c", busy_s=soon)) == {"able": 0, "other": 0}
    assert after_scarce_jobs().act(know(1800.0, "c", busy_s=late)) == {"able": 1, "other": 0}
    assert make_policy("wsept").act(know(1800.0, "c", busy_s=soon)) == {"able": 1, "other": 0}


def test_without_scarce_jobs_no_arm_stays_free() -> None:
    policy = make_policy("bid_price")
    assert sorted(policy.act(know(0.0, "cc")).values()) == [1, 2]
    assert policy.act(know(1800.0, "c", busy_s=(0.0, 200.0))) == {"able": 1, "other": 0}


def test_no_arm_stays_free_in_a_crowd() -> None:
    """There is work for both arms however it is shared."""
    claims = after_scarce_jobs().act(know(1800.0, "cccccccc", busy_s=(0.0, 60.0)))
    assert claims["able"] > 0


def test_a_job_counts_once_and_for_an_hour() -> None:
    """Seen again it has an age; an hour later its price is gone."""
    again, once = after_scarce_jobs(count=1), after_scarce_jobs(count=1)
    waiting = {name: LazyObservation(lambda field, seen=seen: getattr(seen, field), age_s=np.array([5.0]))
               for name, seen in know(5.0, "s", busy_s=(0.0, 0.0)).items()}  # fmt: skip
    again.act(waiting)
    for policy in (again, once):
        assert policy.act(know(300.0, "c", busy_s=(0.0, 400.0))) == {"able": 0, "other": 0}
    later = after_scarce_jobs().act(know(1800.0 + 3601.0, "c", busy_s=(0.0, 60.0)))
    assert later == {"able": 1, "other": 0}


def shared(seen: dict[str, Observation], *, age_s: float = 0.0) -> dict[str, Observation]:
    """The same, with messages of this age: an arm knows of the other what that knows of itself."""
    together = {name: np.stack([getattr(each, own) for each in seen.values()]) for name, own in OWN.items()}

    def with_messages(arm_index: int, each: Observation) -> Observation:
        peers = np.array([a for a in range(len(seen)) if a != arm_index])
        ages_s = np.where(np.arange(len(seen)) == arm_index, 0.0, age_s)
        return LazyObservation(lambda name: getattr(each, name), **together, fleet_age_s=ages_s, peers=peers)

    return {name: with_messages(arm_index, each) for arm_index, (name, each) in enumerate(seen.items())}


OWN = {f"fleet_{name}": name for name in ("working", "faulted", "busy_s", "headroom_k", *BIDS.values())} | {
    "fleet_difficulty": "difficulty"
}
"""What an arm shares, by the field of its peers."""


@pytest.mark.parametrize(("age_s", "claim"), [(0.0, WAIT), (59.0, WAIT), (60.0, 1), (LONG_S, 1)])
def test_an_arm_waits_for_a_peer_that_suits_better_while_its_messages_are_not_too_old(age_s, claim) -> None:
    """The other arm, which is home soon, does the job in a tenth of the time."""
    slow, fast = know(0.0, "c").values()
    quick = LazyObservation(lambda name: getattr(fast, name), duration_s=fast.duration_s / 10.0)
    busy = LazyObservation(
        lambda name: getattr(quick, name), working=np.array(1.0), busy_s=np.array(70.0), action_mask=np.array([1, 0, 0])
    )
    policy = make_policy("bid_price_shared")
    assert policy.act(shared({"able": slow, "other": busy}, age_s=age_s)) == {"able": claim, "other": WAIT}


@pytest.mark.parametrize(("age_s", "claim"), [(0.0, WAIT), (LONG_S, 1)])
def test_an_arm_that_hears_of_no_peer_does_not_stay_free_for_what_it_may_not_be_alone_with(age_s, claim) -> None:
    policy = make_policy("bid_price_shared")
    for k in range(4):
        assert policy.act(shared(know(600.0 * k, "s"), age_s=age_s))["able"] == 1
    assert policy.act(shared(know(1800.0, "c", busy_s=(0.0, 60.0)), age_s=age_s))["able"] == claim


def test_a_job_counts_once_when_all_bids_for_it_have_arrived() -> None:
    """Jobs arrive every 7 s; messages take 0 to 30 s, and decisions are made at any full second."""
    rng, policy = np.random.default_rng(2), BidPrice()
    counted, now_s = [], 0.0
    for _ in range(200):
        now_s += float(rng.integers(1, 20))
        settled_s = float(rng.choice([0.0, 10.0, 30.0]))
        least_s, most_s = policy._ages_of_new(10_000.0 - now_s, settled_s, ("a", "b"))
        ages_s = {k: now_s - 7.0 * k - 0.5 for k in range(int((now_s + 6.5) / 7.0))}
        new = [k for k, age_s in ages_s.items() if least_s <= age_s < most_s]
        assert all(ages_s[k] >= settled_s for k in new)
        counted += new
    assert counted == list(range(len(counted)))
    assert len(counted) > 200


def test_without_bids_in_the_observation_the_error_says_how_to_get_them() -> None:
    seen = shared(know(0.0, "c"))
    bare = {
        name: LazyObservation(lambda field, each=each: getattr(each, field), **NO_BIDS) for name, each in seen.items()
    }
    with pytest.raises(ValueError, match="bids=True"):
        make_policy("bid_price_shared").act(bare)


NO_BIDS = {name: np.zeros((0, 1)) for name in BIDS}


@pytest.mark.parametrize("seed", range(2))
def test_with_all_messages_every_arm_claims_what_the_auctioneer_would_give_it(small, seed) -> None:
    env = parallel_env(small.Shifts(arms=4, jobs=24, ticks=120, ambient_c=36.0), ahead_s=np.inf, bids=True)
    env.reset(seed=seed)
    central, alone, claims = make_policy("bid_price"), make_policy("bid_price_shared"), 0
    while env.agents:
        seen = env.knowledge()
        actions = central.act(seen)
        assert alone.act(seen) == actions
        claims += sum(action > 0 for action in actions.values())
        env.step(actions)
    assert claims > 10
