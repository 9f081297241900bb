"""Rules that weigh heat against value, and guards round any policy: closed forms, and what they forbid in a shift."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.heat import FuzzySpeed, GuardedArm, GuardedFleet, Shutdown, TorqueLimiter, Wsept
from agents.pairs import PARAMETERS, LearnedPrices, Prices
from agents.policy import WAIT, for_all_arms, one_fleet
from agents.registry import WRAPPERS, claims_no_late_jobs, make_policy
from fleet.arm.model import ArmModel
from fleet.env.allocation_v2 import parallel_env
from fleet.errors import FleetError
from fleet.observation import Observation
from fleet.robot import POSTURES, RATING, Mount, Robot
from scenarios.policy_loader import arm_policy_of, label, policy_of, scope_of
from tests.agents.observations import observation

SLOW, FAST = 1200.0, 800.0


def seen(value: list[float], peak_c: list[float], *, temp_c=40.0, error_c=75.0, legal=None, **fields) -> Observation:
    """What a free arm knows that has a fast and a slow plan for each slot; peaks by option."""
    slots = len(value)
    known = {
        "value": np.array(value),
        "due_in_s": np.full(slots, 5000.0),
        "peak_c": np.array(peak_c),
        "temp_c": np.full(7, temp_c),
        "headroom_k": 60.0 - temp_c,
        "error_headroom_k": error_c - temp_c,
        "duration_s": np.tile([FAST, SLOW], slots),
        "p_saturation": np.full(2 * slots, 0.5),
    }
    return observation(slots, plans=2, legal=1 if legal is None else legal, **{**known, **fields})


def action(name: str, seen: Observation) -> int:
    return make_policy(name).act({"arm": seen})["arm"]


@pytest.mark.parametrize(("late_min", "claims"), [(95.0, True), (100.5, False)])
@pytest.mark.parametrize("name", ["wsept", "wsept_ahead", "wsept_local", "bid_price", "bid_price_shared", "auction"])
def test_no_policy_by_worth_claims_a_job_that_would_end_100_min_late(name: str, late_min: float, claims: bool) -> None:
    """Tardiness costs 1 % of the value a minute, so then nothing is left; docs/policies.md says so."""
    late = seen([1.0], [41.0, 41.0], left_s=1e6, due_in_s=np.array([FAST - 60.0 * late_min]))
    assert (action(name, late) != WAIT) == claims
    assert claims_no_late_jobs(name)
    assert claims_no_late_jobs(f"limited:{name}")


def test_of_two_plans_the_cool_one_is_taken_only_where_the_fast_one_would_fault() -> None:
    assert action("wsept", seen([4.0], [55.0, 50.0])) == 1
    assert action("wsept", seen([4.0], [85.0, 50.0])) == 2
    # At the error limit half of the fast trials fault: 0.5 · 4 − 0.5 · price < 0, and the slow plan is worth 4.
    assert action("wsept", seen([4.0], [75.0, 50.0])) == 2


@pytest.mark.parametrize(
    ("error_c", "p_fault", "p_learned", "claims"),
    [(67.0, 0.3085375, 0.4012937, False), (75.0, 0.0062097, 0.1056498, True)],
)
def test_the_probability_of_a_fault_is_that_of_a_peak_above_the_error_limit(
    error_c, p_fault, p_learned, claims
) -> None:
    """Φ(−0.5) and Φ(−2.5): a peak predicted as 68 °C, 1 K above or 7 K below the limit, is 3 K lower, ± 4 K. With twice
    the deviation, learned: Φ(−0.25) and Φ(−1.25)."""
    one = seen([40.0], [68.0, 95.0], error_c=error_c)

    def rate(p_fault: float) -> float:
        return (40.0 - p_fault * (40.0 + Wsept.fault_price) - 0.05 * (8.0 / 28.0) * FAST / 60.0) / FAST

    assert -Wsept().cost(one_fleet([one]))[0, 0, 0] == pytest.approx(rate(p_fault), rel=1e-5)
    wider = np.zeros(PARAMETERS)
    wider[Prices._fields.index("spread")] = np.log(2.0)
    worths = LearnedPrices.worths([LearnedPrices(wider)], one_fleet([one]))
    assert worths[0, 0, 0] / FAST == pytest.approx(rate(p_learned), rel=1e-5)
    assert (action("wsept", seen([4.0], [68.0, 95.0], error_c=error_c)) == 1) == claims


def test_a_job_that_cannot_end_in_the_shift_is_not_claimed() -> None:
    assert action("wsept", seen([4.0], [50.0] * 2, left_s=np.array(FAST))) == 1
    assert action("wsept", seen([4.0], [50.0] * 2, left_s=np.array(FAST - 1.0))) == WAIT
    # The fast plan of the first job would fault, and its slow one ends too late.
    assert action("wsept", seen([9.0, 4.0], [85.0] + [50.0] * 3, left_s=np.array(1000.0))) == 3


def test_tardiness_costs_one_percent_of_the_value_a_minute() -> None:
    one = seen([4.0], [50.0, 95.0], due_in_s=np.array([FAST - 600.0]))
    assert -Wsept().cost(one_fleet([one]))[0, 0, 0] == pytest.approx(4.0 * 0.9 / FAST, rel=1e-5)


@pytest.mark.parametrize(("until_s", "claim"), [(0.0, 1), (600.0, 1), (1200.0, 3)])
def test_a_job_that_expires_soon_counts_up_to_twice(until_s, claim) -> None:
    """1 + exp(−t / 20 min) is 2, 1.61 and 1.37; the other job is worth 1.5 times as much."""
    due_in_s, expires = np.array([until_s, 3000.0]), np.array([1.0, 0.0])
    late = 1.0 - 0.01 * (FAST - until_s) / 60.0 * (until_s < FAST)
    assert action("wsept", seen([4.0 / late, 6.0], [50.0] * 4, due_in_s=due_in_s, expires=expires)) == claim
    assert action("wsept", seen([4.0 / late, 6.0], [50.0] * 4, due_in_s=due_in_s)) == 3


def test_without_scores_heat_is_ignored() -> None:
    """Peaks of 0 are unknown; P(saturation) of 0.5 too. The most value per time wins."""
    blind = seen([1.0, 3.0], [0.0] * 4)
    assert action("wsept", blind) == action("quickest_matching", seen([3.0, 3.0], [0.0] * 4, legal=[0, 0, 1, 1])) == 3
    unlikely = seen([1.0, 3.0], [0.0] * 4, p_saturation=np.array([0.0, 0.0, 1.0, 1.0]))
    assert action("wsept", unlikely) == 1


@pytest.mark.parametrize(("temp_c", "claims"), [(56.0, True), (58.0, False)])
def test_the_thermometer_wants_headroom_for_the_load(temp_c, claims) -> None:
    """3 kg for 800 s of 900 s need 2.67 K; the slow plan needs 3 K."""
    one = seen([4.0], [0.0, 0.0], temp_c=temp_c, payload_kg=np.array([3.0]))
    assert action("thermometer", one) == (1 if claims else WAIT)


def test_the_thermometer_does_not_read_the_wrists() -> None:
    hot_wrist = np.array([40.0] * 4 + [59.5] * 3)
    one = seen([4.0], [0.0, 0.0], temp_c=40.0, payload_kg=np.array([3.0]))
    assert action("thermometer", replace(one, temp_c=hot_wrist, headroom_k=np.array(0.5))) == 1


def test_claims_of_two_arms_are_matched_by_total_worth() -> None:
    """The first arm alone would take the second job, which only it can leave to the other."""
    one, other = seen([3.9, 4.0], [50.0] * 4), seen([3.9, 4.0], [90.0, 90.0, 50.0, 50.0])
    assert list(make_policy("wsept").act({"a": one, "b": other}).values()) == [1, 3]


def test_without_other_arms_the_rule_of_one_arm_is_the_central_one() -> None:
    """Without a matching both arms take the first job; no arm reads its peers."""
    one, other = seen([4.0, 3.9], [50.0] * 4), seen([4.0, 3.8], [50.0] * 4)
    assert list(make_policy("wsept").act({"a": one, "b": other}).values()) == [3, 1]
    assert list(make_policy("wsept_local").act({"a": one, "b": other}).values()) == [1, 1]
    for alone in (one, other):
        assert make_policy("wsept_local").act({"a": alone}) == make_policy("wsept").act({"a": alone})


WARNING_C = 60.0


def guarded(
    temp_c: float, payload_kg=(0.5, 3.5), *, excess_k: float = 0.0, idle: bool = True, error_c: float = 75.0
) -> Observation:
    """What an arm knows with two plans for each job; at work it may only give its job back."""
    slots = len(payload_kg)
    return observation(
        slots,
        plans=2,
        legal=idle,
        gives_back=not idle,
        working=float(not idle),
        temp_c=np.full(7, temp_c),
        housing_c=np.full(7, temp_c - excess_k),
        headroom_k=WARNING_C - temp_c,
        error_headroom_k=error_c - temp_c,
        payload_kg=np.array(payload_kg),
        value=np.ones(slots),
        duration_s=np.tile([100.0, 150.0], slots),
    )


def test_the_limiter_knows_the_weight_of_the_arm() -> None:
    """Torque of joint 2 of the stretched arm, from MuJoCo: it is linear in the payload, with this offset."""
    arm, q = ArmModel(Robot(name="arm", mount=Mount())), np.array(POSTURES["outstretched"])
    empty, full = (abs(arm.gravity_torque(q, kg)[1]) for kg in (0.0, RATING.mid_range_kg))
    assert float(TorqueLimiter().torque(0.0)) == pytest.approx(empty / full, abs=0.005)
    assert float(TorqueLimiter().torque(RATING.mid_range_kg)) == 1.0


@pytest.mark.parametrize(
    ("error_c", "temp_c", "limit"),
    [(75.0, t, x) for t, x in ((20.0, 1.0), (50.0, 1.0), (60.0, 0.6), (75.0, 0.0), (90.0, 0.0))]
    + [(67.0, t, x) for t, x in ((50.0, 1.0), (58.5, 0.5), (67.0, 0.0))],
)
def test_the_torque_limit_falls_linearly_from_below_the_warning_to_the_error_limit(error_c, temp_c, limit) -> None:
    assert TorqueLimiter().limit(guarded(temp_c, error_c=error_c)) == pytest.approx(limit)


def test_a_warm_arm_claims_light_jobs_only_and_puts_a_heavy_one_down() -> None:
    guard = TorqueLimiter()
    assert guard.claims(guarded(40.0)).tolist() == [True] * 4
    assert guard.claims(guarded(58.0)).tolist() == [True, True, False, False]
    assert guard.claims(guarded(70.0)).tolist() == [False] * 4
    assert [guard.gives_back(guarded(58.0), kg) for kg in (0.5, 3.5)] == [False, True]


@pytest.mark.parametrize("scope", ["arm", "central"])
def test_a_switch_opens_at_the_warning_limit_and_closes_after_cooling_by_the_hysteresis(scope) -> None:
    """Also when the arm was at work or had no choice while it was hot."""
    policy = policy_of("shutdown:wspt" if scope == "central" else "shutdown:random")
    policy.reset(np.random.default_rng(0))

    def claims(temp_c: float, idle: bool = True) -> bool:
        return policy.act({"arm": guarded(temp_c, idle=idle)})["arm"] != WAIT

    assert [claims(c) for c in (40.0, 59.9)] == [True] * 2
    assert [claims(c) for c in (60.1, 55.0, 50.1)] == [False] * 3
    assert [claims(c) for c in (49.9, 59.0)] == [True] * 2
    assert not claims(61.0, idle=False)
    assert not claims(55.0)
    policy.reset(np.random.default_rng(0))
    assert claims(55.0)
    assert not Shutdown().gives_back(guarded(90.0), 4.0)


temperatures = st.floats(-20.0, 40.0)
excesses = st.floats(0.0, 20.0)


@given(temperatures, temperatures, excesses, excesses)
def test_the_fuzzy_speed_is_a_share_and_never_rises_with_heat(headroom_k, other_k, excess_k, more_k) -> None:
    speed = FuzzySpeed().speed
    assert 0.0 <= speed(headroom_k, excess_k) <= 1.0
    low, high = sorted((headroom_k, other_k))
    assert speed(low, excess_k) <= speed(high, excess_k) + 1e-12
    assert speed(headroom_k, excess_k + more_k) <= speed(headroom_k, excess_k) + 1e-12


def test_a_single_true_rule_gives_its_speed() -> None:
    for headroom_k, name in ((25.0, "cool"), (10.0, "warm"), (-5.0, "hot")):
        assert [FuzzySpeed().speed(headroom_k, e) for e in (0.0, 15.0)] == list(FuzzySpeed.rules[name])
    assert FuzzySpeed().speed(15.0, 0.0) == pytest.approx((1.0 + 0.8) / 2)


def test_a_warm_arm_takes_the_cooler_plans_and_a_hot_one_stops() -> None:
    guard = FuzzySpeed()
    assert guard.claims(guarded(35.0)).tolist() == [True] * 4
    assert guard.claims(guarded(50.0, excess_k=9.0)).tolist() == [False, True, False, True]
    assert guard.claims(guarded(60.0)).tolist() == [False] * 4
    single = guarded(50.0, excess_k=9.0)
    single.action_mask[2] = 0  # the first job has one plan
    assert guard.claims(single).tolist() == [True, False, False, True]
    assert [guard.gives_back(guarded(62.0, excess_k=e), 1.0) for e in (0.0, 10.0)] == [False, True]


def test_the_job_that_is_given_back_is_the_one_that_was_claimed() -> None:
    """With the heavy job the limit is reached at 50 °C, with the light one above 60 °C."""

    class Slot:
        scope = "arm"

        def __init__(self, slot: int) -> None:
            self.slot = slot

        def reset(self, rng) -> None:
            """Nothing to reset."""

        def choose(self, observation, arm_index) -> int:
            return 1 + 2 * self.slot if observation.action_mask[1 + 2 * self.slot] else WAIT

    for slot, given_back in ((0, WAIT), (1, 5)):
        policy = GuardedArm(TorqueLimiter, Slot(slot))  # pyright: ignore[reportArgumentType]
        assert policy.choose(guarded(40.0), 0) == 1 + 2 * slot
        assert policy.choose(guarded(58.0, idle=False), 0) == given_back


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("name", ["random", "round_robin", "least_difficulty", "least_loaded", "wsept", "wsept_local"])
def test_a_rule_in_a_wrapper_keeps_its_scope_and_is_legal_all_shift(small, wrapper, name) -> None:
    full = f"{wrapper}:{name}"
    policy = policy_of(full)
    assert scope_of(full) == scope_of(name) == policy.scope
    assert label(full) == full
    env = parallel_env(small.Shifts(arms=2, jobs=8, ticks=50, ambient_c=38.0))
    env.reset(seed=1)
    policy.reset(np.random.default_rng(1))
    while env.agents:
        env.step(policy.act(env.knowledge()))
    assert env.truth.illegal.sum() == 0


def test_a_wrapped_arm_policy_can_be_had_alone_and_wrappers_nest() -> None:
    assert isinstance(arm_policy_of("limited:least_difficulty"), GuardedArm)
    assert isinstance(policy_of("fuzzy:limited:wsept"), GuardedFleet)
    assert label("fuzzy:limited:agents.rules:Wspt") == "fuzzy:limited:Wspt"
    with pytest.raises(FleetError, match="at most 8 wrappers"):
        policy_of("limited:" * 3000 + "wsept")
    with pytest.raises(FleetError, match="'limited:wsept' is a central policy"):
        arm_policy_of("limited:wsept")
    with pytest.raises(FleetError, match="did you mean 'wsept'"):
        policy_of("limited:wsep")


def test_a_guard_that_allows_all_changes_nothing(small) -> None:
    class Open:
        def claims(self, seen):
            return np.ones(len(seen.action_mask) - 2, dtype=bool)

        def gives_back(self, seen, payload_kg):
            return False

    env = parallel_env(small.Shifts(arms=3, jobs=12))
    for name in ("wspt", "least_difficulty", "random"):
        bare = policy_of(name)
        if scope_of(name) == "central":
            wrapped = GuardedFleet(Open, policy_of(name))
        else:
            wrapped = for_all_arms(lambda name=name: GuardedArm(Open, arm_policy_of(name)))  # pyright: ignore
        env.reset(seed=4)
        for policy in (bare, wrapped):
            policy.reset(np.random.default_rng(4))
        while env.agents:
            known = env.knowledge()
            actions = bare.act(known)
            assert wrapped.act(known) == actions
            env.step(actions)
