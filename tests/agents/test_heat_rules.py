"""Rules that weigh heat against value, on observations with two plans per slot."""

from dataclasses import replace

import numpy as np
import pytest

from agents.heat import Wsept
from agents.pairs import Worth, worth_per_second
from agents.policy import WAIT
from agents.registry import make_policy
from fleet.observation import Layout, Observation

SLOW, FAST = 1200.0, 800.0


def seen(value: list[float], peak_c: list[float], *, temp_c=40.0, error_c=75.0, legal=None, **fields) -> Observation:
    """What a free arm knows that has a fast and a slow plan for each slot; peaks by option."""
    slots = len(value)
    layout = Layout(1, slots, plans=2)
    mask = np.concatenate([[1], np.ones(2 * slots) if legal is None else legal, [0]]).astype(np.int8)
    blank = layout.read(np.zeros(layout.size, np.float32), mask)
    known = {
        "value": np.array(value),
        "peak_c": np.array(peak_c),
        "temp_c": np.full(7, temp_c),
        "headroom_k": np.array(60.0 - temp_c),
        "error_headroom_k": np.array(error_c - temp_c),
        "duration_s": np.tile([FAST, SLOW], slots),
        "p_saturation": np.full(2 * slots, 0.5),
        "offered": np.ones(slots),
    }
    return replace(blank, **{**known, **fields})


def action(name: str, observation: Observation) -> int:
    return make_policy(name).act({"arm": observation})["arm"]


def test_a_sure_fault_costs_the_job_and_the_price() -> None:
    assert action("wsept", seen([4.0], [95.0, 95.0])) == WAIT
    assert action("wsept", seen([4.0], [50.0, 50.0])) == 1


def test_of_two_plans_the_cool_one_is_taken_only_where_the_fast_one_would_fault() -> None:
    assert action("wsept", seen([4.0], [55.0, 50.0])) == 1
    assert action("wsept", seen([4.0], [85.0, 50.0])) == 2
    # At the error limit half of the fast trials fault: 0.5 · 4 − 0.5 · price < 0, and the slow plan is worth 4.
    assert action("wsept", seen([4.0], [75.0, 50.0])) == 2


def test_a_claim_of_positive_worth_is_made_and_its_worth_is_the_expectation() -> None:
    """A peak two deviations below the error limit faults with 2.3 %; the time above 60 °C is (70 − 60) / (70 − 40)."""
    peak_c = 75.0 - 2.0 * Wsept.peak_sd_k
    assert peak_c == 70.0
    heat = 0.0227501 * (1.0 + Wsept.fault_price) + 0.05 * (10.0 / 30.0) * FAST / 60.0
    rates = -Wsept().cost([seen([1.0], [peak_c, 95.0])])[0]
    assert rates[0] == pytest.approx((1.0 - heat) / FAST, rel=1e-4)
    assert action("wsept", seen([heat * 1.01], [peak_c, 95.0])) == 1
    assert action("wsept", seen([heat * 0.9], [peak_c, 95.0])) == WAIT


@pytest.mark.parametrize(("error_c", "p_fault", "claims"), [(67.0, 0.6554217, False), (75.0, 0.0025551, True)])
def test_the_probability_of_a_fault_is_that_of_a_peak_above_the_error_limit(error_c, p_fault, claims) -> None:
    """Φ(0.4) and Φ(−2.8): a peak predicted as 68 °C, 1 K above or 7 K below the limit, with a deviation of 2.5 K."""
    observation = seen([40.0], [68.0, 95.0], error_c=error_c)
    worth = 40.0 - p_fault * (40.0 + Wsept.fault_price) - 0.05 * (8.0 / 28.0) * FAST / 60.0
    assert -Wsept().cost([observation])[0, 0] == pytest.approx(worth / FAST, rel=1e-5)
    batch = replace(observation, **{name: np.asarray(each)[None, None] for name, each in vars(observation).items()})
    untrained = Worth(*np.zeros((len(Worth._fields), 1)))
    first = (np.array([0]), np.array([0]), np.array([0]))
    assert worth_per_second(batch, first, untrained) == pytest.approx(worth / FAST, rel=1e-5)
    assert (action("wsept", seen([4.0], [68.0, 95.0], error_c=error_c)) == 1) == claims


def test_without_scores_heat_is_ignored() -> None:
    """Peaks of 0 are unknown; P(saturation) of 0.5 too. The most value per time wins."""
    blind = seen([1.0, 3.0], [0.0] * 4)
    assert action("wsept", blind) == action("quickest_matching", seen([3.0, 3.0], [0.0] * 4, legal=[0, 0, 1, 1])) == 3
    unlikely = seen([1.0, 3.0], [0.0] * 4, p_saturation=np.array([0.0, 0.0, 1.0, 1.0]))
    assert action("wsept", unlikely) == 1


@pytest.mark.parametrize(("temp_c", "claims"), [(56.0, True), (58.0, False)])
def test_the_thermometer_wants_headroom_for_the_load(temp_c, claims) -> None:
    """3 kg for 800 s of 900 s need 2.67 K; the slow plan needs 3 K."""
    observation = seen([4.0], [0.0, 0.0], temp_c=temp_c, payload_kg=np.array([3.0]))
    assert action("thermometer", observation) == (1 if claims else WAIT)


def test_the_thermometer_does_not_read_the_wrists() -> None:
    hot_wrist = np.array([40.0] * 4 + [59.5] * 3)
    observation = seen([4.0], [0.0, 0.0], temp_c=40.0, payload_kg=np.array([3.0]))
    assert action("thermometer", replace(observation, temp_c=hot_wrist, headroom_k=np.array(0.5))) == 1


def test_claims_of_two_arms_are_matched_by_total_worth() -> None:
    """The first arm alone would take the second job, which only it can leave to the other."""
    one, other = seen([3.9, 4.0], [50.0] * 4), seen([3.9, 4.0], [90.0, 90.0, 50.0, 50.0])
    assert list(make_policy("wsept").act({"a": one, "b": other}).values()) == [1, 3]


def test_without_other_arms_the_rule_of_one_arm_is_the_central_one() -> None:
    """Without a matching both arms take the first job; no arm reads its peers."""
    one, other = seen([4.0, 3.9], [50.0] * 4), seen([4.0, 3.8], [50.0] * 4)
    assert list(make_policy("wsept").act({"a": one, "b": other}).values()) == [3, 1]
    assert list(make_policy("wsept_local").act({"a": one, "b": other}).values()) == [1, 1]
    for rule in ("wsept", "wsept_learned"):
        for alone in (one, other):
            assert make_policy(f"{rule}_local").act({"a": alone}) == make_policy(rule).act({"a": alone})
