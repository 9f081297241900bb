"""Estimates of an arm: best variant, reason of an infeasible job, and a peak that scipy confirms."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.bus.protocol.auction import JobSpec
from fleet.difficulty import KNOWN, Blind, Difficulty, Forecast, known_temperatures
from fleet.errors import InfeasibleJob
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import WINDING, drive_heat, gen3_network, thermal_model
from fleet.job import Place
from fleet.live.arm.estimator import MAX_WORKS, NOT_PLANNED, Estimator, NominalPeaks
from fleet.motion import drive

PLACES = {"bench": Place(name="bench", position_m=(0.5, 0.0, 0.2))}
WARM_C = np.full(7, 31.0)
KNOWN_C = known_temperatures(WARM_C, WARM_C, 25.0)


def spec(**changes):
    return JobSpec(**{"name": "j", "kind": "hold", "places": ("bench",), "repetitions": 3, **changes})


@pytest.fixture
def arm(small):
    return small.arm(0, [small.work("bench", 4.0)])


def estimator_of(arm, *, model=None, peaks=None):
    asked = []

    def plan(work):
        asked.append(work)
        if work.payload_kg > 5:
            raise InfeasibleJob(arm.robot.name, "bench", "torque: too much")
        return tuple(p for plans in arm.plans.values() for p in plans)

    made = Estimator(model or arm.model, plan, PLACES, peaks or NominalPeaks())
    return made, asked


@pytest.mark.parametrize("minutes", [1, 20, 90])
def test_the_predicted_peak_is_that_of_the_nominal_network(arm, minutes):
    """Second method: scipy integrates the same heat law finely."""
    ((plan,),) = arm.plans.values()
    repetitions = 6 * minutes
    motors, model = gen3_motors(), thermal_model(gen3_network())
    drives = [drive(phase.profile, motors) for phase in plan.phases]
    weights = plan.weights(repetitions)
    current_sq, friction_w = (
        sum(w * getattr(d, name) for w, d in zip(weights, drives, strict=True)) for name in ("current_sq", "friction_w")
    )

    def slope(_, temp_c):
        heat = drive_heat(temp_c, current_sq, friction_w, motors)
        return (heat + model.to_ambient * 25.0 - model.laplacian @ temp_c) / model.capacity

    start = np.tile(WARM_C, 2)
    fine = solve_ivp(slope, (0.0, plan.duration_s(repetitions)), start, rtol=1e-8, atol=1e-8, method="BDF")
    (peak,) = NominalPeaks().peaks_c([plan], [repetitions], KNOWN_C)
    expected = fine.y[WINDING].max()
    assert peak == pytest.approx(expected, abs=0.02 * (expected - 31.0) + 0.01)


def test_an_estimate_has_all_fields(arm):
    estimator, _ = estimator_of(arm)
    estimator.prepare(spec(payload_kg=4.0))
    ((plan,),) = arm.plans.values()
    (estimate,) = estimator.estimate([spec(payload_kg=4.0)], KNOWN_C, 100.0)
    score = arm.model.score(plan, 3)
    assert estimate.feasible
    (quote,) = estimate.plans
    assert quote.difficulty == pytest.approx(score.total)
    assert quote.joint_difficulty == pytest.approx(tuple(score.per_joint))
    assert quote.p_saturation == score.p_saturation
    assert quote.duration_s == pytest.approx(3.0 + 30.0 + 2.0)
    assert quote.finish_in_s == pytest.approx(100.0 + 33.0)
    assert quote.peak_c > 31.0
    assert quote.gained_k == pytest.approx(quote.peak_c - 31.0)


def test_a_blind_arm_estimates_without_a_score(arm):
    estimator, _ = estimator_of(arm, model=Blind())
    estimator.prepare(spec())
    (estimate,) = estimator.estimate([spec()], KNOWN_C, np.inf)
    (quote,) = estimate.plans
    assert (quote.difficulty, quote.p_saturation, quote.finish_in_s) == (None, None, None)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"places": ("moon",)}, "no place 'moon' in this cell; places: bench"),
        ({"payload_kg": 9.0}, "at 'bench': torque: too much"),
        ({"force_n": 3.0}, "only a press"),
    ],
)
def test_an_infeasible_job_has_a_reason(arm, changes, reason):
    estimator, _ = estimator_of(arm)
    estimator.prepare(spec(**changes))
    (estimate,) = estimator.estimate([spec(**changes)], KNOWN_C, 0.0)
    assert not estimate.feasible
    assert reason in estimate.reason
    assert not estimator.plans(spec(**changes))


def test_an_unplanned_job_is_reported_and_every_work_is_planned_once(arm):
    estimator, asked = estimator_of(arm)
    one, other = spec(), spec(name="k", payload_kg=1.0)
    assert not estimator.is_prepared(one)
    assert [o.reason for o in estimator.estimate([one, other], KNOWN_C, 0.0)] == [NOT_PLANNED, NOT_PLANNED]
    assert not asked
    for _ in range(3):
        estimator.prepare(one)
        estimator.prepare(spec(name="l", repetitions=9))
    assert len(asked) == 1
    assert [o.feasible for o in estimator.estimate([one, other], KNOWN_C, 0.0)] == [True, False]
    assert not asked[1:]


def test_cycles_that_are_done_cost_nothing(arm):
    """The estimate is that of a job with as many cycles as are left."""
    estimator, _ = estimator_of(arm, model=ByRepetitions())
    begun, short = spec(repetitions=9), spec(name="k", repetitions=4)
    assert not estimator.is_prepared(begun, 5)
    estimator.prepare(begun, 5)
    estimator.prepare(short)
    rest, whole = estimator.estimate([begun, short], KNOWN_C, 10.0, {"j": 5})
    assert rest.plans == whole.plans
    assert rest.plans[0].p_saturation == pytest.approx(0.04)


class ByRepetitions:
    """A model whose P grows with the number of cycles."""

    version = "by repetitions"

    def score(self, plan, repetitions):
        return Difficulty(np.full(7, 0.1), p_saturation=repetitions / 100.0)


def test_an_estimate_says_whether_a_load_is_too_heavy(arm):
    def plan(work):
        raise InfeasibleJob(arm.robot.name, "bench", "4.6 kg is too much", too_heavy=work.payload_kg > 4.5)

    estimator = Estimator(arm.model, plan, PLACES, NominalPeaks())
    jobs = [spec(name=f"{kg} kg", payload_kg=kg) for kg in (1.0, 5.0)]
    for job in jobs:
        estimator.prepare(job)
    assert [each.too_heavy for each in estimator.estimate(jobs, KNOWN_C, 0.0)] == [False, True]


def test_a_job_with_alternatives_is_planned_at_each_and_its_stations_are_those_that_all_need(small):
    places = {name: Place(name=name, position_m=(0.5, 0.0, 0.2)) for name in ("feeder", "left", "right")}
    works = [small.work("feeder", 4.0, to=name) for name in ("left", "right")]
    arm, asked = small.arm(0, works), []

    def plan(work):
        asked.append(tuple(place.name for place in work.places))
        if work.places[1].name == "left":
            raise InfeasibleJob("arm_0", "left", "out of reach")
        return next(plans for each, plans in arm.plans.items() if each.places == work.places)

    estimator = Estimator(arm.model, plan, places, NominalPeaks())
    job = spec(kind="pick_place", places=("feeder", "left"), alternatives=(("feeder", "right"),), payload_kg=4.0)
    assert job.stations == ("feeder",)
    estimator.prepare(job)
    assert asked == [("feeder", "left"), ("feeder", "right")]
    (estimate,) = estimator.estimate([job], KNOWN_C, 0.0)
    assert estimate.feasible
    (scored,) = estimator.plans(job)
    assert scored.plan.work.places[1].name == "right"
    assert [work.places[1].name for work in estimator.job(job).works] == ["left", "right"]
    unknown = spec(places=("left",), alternatives=(("shelf",),))
    (refused,) = estimator.estimate([unknown], KNOWN_C, 0.0)
    assert "there is no place 'shelf' in this cell" in refused.reason


@pytest.mark.parametrize(
    ("alternatives", "message"),
    [
        ((("bench",),), "JobSpec.places must name each alternative once"),
        ((("a", "b"),), "JobSpec.places must be one place for a hold"),
        ((("a/b",),), "JobSpec.alternatives must have"),
        (tuple((f"p{i}",) for i in range(64)), "JobSpec.places must have 1 to 64 alternatives (got 65)"),
    ],
)
def test_impossible_alternatives_are_named(alternatives, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        spec(alternatives=alternatives)


class Expects:
    """A peak of 30 °C, and 20 K more with twice the assumed heat."""

    version = "expects"

    def score(self, plan, repetitions):
        peak = Forecast(np.array([30.0]), np.zeros((1, KNOWN)), gain=np.array([20.0]))
        return Difficulty(np.full(7, 0.1), peak=peak)


def test_a_measured_excess_of_heat_counts_for_all_jobs_with_the_same_works(arm):
    made, _ = estimator_of(arm, model=Expects())
    jobs = [spec(name="a"), spec(name="b", repetitions=9), spec(name="heavier", payload_kg=2.0)]
    for job in jobs:
        made.prepare(job)
    assert [each.plans[0].peak_c for each in made.estimate(jobs, KNOWN_C, 0.0)] == pytest.approx([30.0] * 3)
    made.learn(jobs[0], 0.25)
    assert [each.plans[0].peak_c for each in made.estimate(jobs, KNOWN_C, 0.0)] == pytest.approx([35.0, 35.0, 30.0])
    made.learn(spec(name="impossible", places=("nowhere",)), 9.0)
    assert made.excess_of(spec(name="impossible", places=("nowhere",))) == 0.0


def test_more_heat_than_expected_counts_for_all_jobs(arm):
    made, _ = estimator_of(arm, model=Expects())
    made.learn(spec(), 0.25)
    for ratio, excess in ((1.0, 0.25), (1.2, 0.5), (2.0, 1.5)):
        made.heat_ratio = ratio
        assert made.excess_of(spec()) == pytest.approx(excess)
        assert made.excess_of(spec(payload_kg=2.0)) == pytest.approx((1.0 + excess) / 1.25 - 1.0)


def test_of_very_many_works_the_oldest_excess_is_forgotten(arm):
    made, _ = estimator_of(arm, model=Expects())
    for number in range(MAX_WORKS + 1):
        made.learn(spec(payload_kg=number * 4.0 / MAX_WORKS), 0.5)
    assert made.excess_of(spec(payload_kg=0.0)) == 0.0
    assert made.excess_of(spec(payload_kg=4.0)) == 0.5
