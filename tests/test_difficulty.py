"""What a model says of a plan, and the plans on offer."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.difficulty import KNOWN, Difficulty, Forecast, heat_weights, known_temperatures, stack_forecasts
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, gen3_network, simulate_temperatures, thermal_model
from fleet.motion import drives
from fleet.offered_plans import COOLER_K, offered_plans, predicted_rise

CURVE = np.array([[-4.0, 0.05], [0.0, 0.2], [0.0, 0.4], [3.0, 1.0]])
risks = st.builds(
    lambda seed, pieces, curved: Forecast(
        np.random.default_rng(seed).normal(-3.0, 2.0, pieces),
        np.random.default_rng(seed).exponential(0.05, (pieces, KNOWN)),
        CURVE[: 2 + seed % 3] if curved else None,
    ),
    st.integers(0, 10_000),
    st.integers(1, 4),
    st.booleans(),
)

temps = st.integers(0, 10_000).map(lambda seed: np.random.default_rng(seed).uniform(10.0, 80.0, KNOWN))


def test_a_joint_counts_by_its_share_in_the_heat() -> None:
    d = np.array([0.9, 0.5, 0.0])
    assert Difficulty(d).total == pytest.approx(1.4)  # the paper's sum
    assert Difficulty(d, weight=heat_weights(np.full(3, 4.0))).total == pytest.approx(1.4)  # equal torque: the same
    assert Difficulty(d, weight=heat_weights(np.array([0.0, 9.0, 3.0]))).total == pytest.approx(3 * 0.75 * 0.5)


def test_the_worst_piece_decides_through_the_logistic_function() -> None:
    weight = np.zeros((2, KNOWN))
    weight[0, 1], weight[1, 3] = 0.2, 0.1
    risk = Forecast(np.array([-10.0, -5.0]), weight)
    temp_c = np.full(KNOWN, 30.0)
    # Pieces −10 + 0.2 · 30 = −4 and −5 + 0.1 · 30 = −2.
    assert risk.at(temp_c) == pytest.approx(1 / (1 + np.exp(2.0)))
    temp_c[1] = 50.0
    assert risk.at(temp_c) == pytest.approx(0.5)  # the first piece is now at 0


@given(risk=risks, temp_c=temps, joint=st.integers(0, KNOWN - 1), more_k=st.floats(0.0, 50.0))
def test_warmer_is_never_less_risky_where_no_weight_is_negative(risk, temp_c, joint, more_k) -> None:
    warmer = temp_c.copy()
    warmer[joint] += more_k
    assert 0.0 <= risk.at(temp_c) <= risk.at(warmer) <= 1.0


@given(score=st.floats(-10, 10))
def test_a_curve_reads_as_numpy_interpolates(score) -> None:
    risk = Forecast(np.array([score]), np.zeros((1, KNOWN)), CURVE)
    if score == 0.0:
        assert risk.at(np.zeros(KNOWN)) == 0.4  # at a jump: its upper end
    else:
        assert risk.at(np.zeros(KNOWN)) == pytest.approx(np.interp(score, *CURVE.T))


@given(several=st.lists(risks, min_size=1, max_size=5), temp_c=temps)
def test_stacked_risks_and_many_temperatures_say_what_each_said(several, temp_c) -> None:
    stack = stack_forecasts(several)
    assert stack.at(temp_c) == pytest.approx([float(r.at(temp_c)) for r in several])
    assert several[0].at(np.tile(temp_c, (2, 3, 1))) == pytest.approx(np.full((2, 3), float(several[0].at(temp_c))))
    order = np.arange(len(several))[::-1]
    assert stack[order].at(np.tile(temp_c, (len(several), 1))) == pytest.approx(stack.at(temp_c)[::-1])


@pytest.mark.parametrize(
    ("offset", "weight", "curve", "says"),
    [
        (np.zeros(0), np.zeros((0, KNOWN)), None, "at least one piece"),
        (np.zeros(2), np.zeros((3, KNOWN)), None, "at least one piece"),
        (np.array([np.nan]), np.zeros((1, KNOWN)), None, "must not be NaN"),
        (np.zeros(1), np.full((1, KNOWN), np.inf), None, "must be finite"),
        (np.zeros(1), np.zeros((1, 7)), None, "at least one piece"),
        (np.zeros(1), np.zeros((1, KNOWN)), np.zeros((4, 3)), "knot, 2"),
    ],
)
def test_a_risk_that_makes_no_sense_is_refused(offset, weight, curve, says) -> None:
    with pytest.raises(ValueError, match=says):
        Forecast(offset, weight, curve)


def test_a_probability_has_one_home() -> None:
    risk = Forecast(np.array([-1.0]), np.full((1, KNOWN), 0.01))
    d = np.full(7, 0.1)
    assert Difficulty(d, risk=risk).p_at(np.full(KNOWN, 20.0)) == float(risk.at(np.full(KNOWN, 20.0)))
    assert Difficulty(d, 0.3).p_at(np.full(KNOWN, 20.0)) == 0.3
    assert Difficulty(d).p_at(np.full(KNOWN, 20.0)) is None
    with pytest.raises(ValueError, match="not both"):
        Difficulty(d, 0.3, risk)


def test_the_peak_is_the_hottest_piece_and_its_curve_gives_the_probability() -> None:
    weight = np.zeros((2, KNOWN))
    weight[0, 0] = weight[1, 7] = 1.0  # motor 1 and housing 1
    peak = Forecast(np.array([20.0, 5.0]), weight, np.array([[50.0, 0.0], [70.0, 1.0]]))
    known_c = known_temperatures(np.full(7, 35.0), np.full(7, 52.0), 25.0)
    told = Difficulty(np.full(7, 0.1), peak=peak)
    assert known_c.shape == (KNOWN,)
    assert known_c[-1] == 25.0
    assert told.peak_at(known_c) == 57.0
    assert told.p_at(known_c) == pytest.approx(0.35)
    assert Difficulty(np.full(7, 0.1), 0.2, peak=peak).p_at(known_c) == 0.2
    assert Difficulty(np.full(7, 0.1)).peak_at(known_c) is None


def test_later_moments_do_not_count_when_a_plan_ends_before() -> None:
    peak = Forecast(np.array([50.0, 55.0, 65.0]), np.zeros((3, KNOWN)), time_s=np.array([0.0, 60.0, 120.0]))
    known_c = known_temperatures(np.full(7, 52.0), np.full(7, 40.0), 25.0)
    told = Difficulty(np.full(7, 0.1), peak=peak)
    assert [told.peak_at(known_c, left_s) for left_s in (0.0, 60.0, 119.0, 120.0, np.inf)] == [52, 55, 55, 65, 65]


MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())


def variants(small, *loads):
    """Return plans of one work with these (cycle seconds, torque factor)."""
    content, plans = small.work(payload_kg=4.0), []
    for cycle_s, factor in loads:
        (plan,) = small.arm(0, [content], times=small.Times(3.0, cycle_s, 2.0)).plans[content]
        profile = plan.cycle.profile.copy()
        profile[:, 2] *= factor
        plans.append(replace(plan, cycle=replace(plan.cycle, profile=profile)))
    return plans


def simulated_rise(plan, repetitions: int) -> float:
    """Rise of the hottest motor of a nominal arm above its idle temperature by the end of the job, in small steps."""
    idle_c = THERMAL.steady(np.concatenate([np.zeros(7), MOTORS.idle_w]), 25.0)
    temp_c = idle_c
    for phase, count in zip(plan.phases, (1, repetitions, 1), strict=True):
        load = drives([phase.profile], MOTORS)
        end = simulate_temperatures(
            load, [phase.duration_s * count], motors=MOTORS, thermal=THERMAL, start_c=temp_c, ambient_c=25.0
        )
        temp_c = end.end_c[0]
    assert temp_c.shape == (NODES,)
    return float((temp_c - idle_c)[WINDING].max())


@pytest.mark.parametrize("repetitions", [1, 20, 150])
def test_the_predicted_rise_is_that_of_the_simulation(small, repetitions) -> None:
    plans = variants(small, (10.0, 1.0), (14.0, 0.7), (10.0, 0.3))
    expected = [simulated_rise(plan, repetitions) for plan in plans]
    assert predicted_rise(tuple(plans), repetitions) == pytest.approx(expected, rel=0.12, abs=0.05)


def test_the_coolest_is_offered_beside_the_fastest_if_it_is_clearly_cooler(small) -> None:
    fast, slow_cool, slow_same, middle = plans = variants(small, (10.0, 1.0), (14.0, 0.7), (14.0, 1.0), (12.0, 0.9))
    assert offered_plans(plans, 100) == [fast, slow_cool]
    assert offered_plans([slow_same, fast], 100)[0] is fast
    assert offered_plans([fast, middle], 150) == [fast, middle]
    saved_k = simulated_rise(fast, 150) - simulated_rise(middle, 150)
    assert saved_k > COOLER_K
    assert offered_plans([slow_cool], 5) == [slow_cool]
    assert offered_plans([], 5) == []


def test_a_cooler_plan_that_is_as_fast_is_the_only_one(small) -> None:
    hot, cool = variants(small, (10.0, 1.0), (10.0, 0.99))
    assert offered_plans([hot, cool], 3) == [hot]  # hardly cooler: neither 1 K nor a tenth
