"""Forecasts of motor temperatures from the log of an arm, against the simulator's law with the arm's true numbers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleet.errors import FleetError
from fleet.heat.thermal import NODES
from fleet.robot import JOINTS
from scenarios.show.forecast_page import summary
from tests.twin.test_identify import AIR_C, FULL_REACH_NM, own_arm, working
from twin.logs.recording import Recording
from twin.thermal.forecast import (
    DRIFT_K,
    FROM_LOG_TO_LOG,
    MOST_RESIDUAL_K,
    MOST_S,
    MOST_SD,
    RISK,
    SAMPLES,
    ThermalForecast,
    forecast,
)
from twin.thermal.identify import Identified, Parameter, ParameterVector, identify, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin

CYCLE_S = 40.0


def held(tau: np.ndarray, seconds: float = CYCLE_S) -> Recording:
    time_s = np.arange(0.0, seconds + 0.25, 0.5)
    still = np.zeros((len(time_s), JOINTS))
    return Recording(name="hold", time_s=time_s, q=still, qd=still, tau=still + tau)


def true_arm(seed: int) -> RcTwin:
    return RcTwin(arm="own", heat_model=own_arm(seed)[1], ambient_c=AIR_C, base="true")


def course(arm: RcTwin, start_c: np.ndarray, tau: np.ndarray, seconds: float) -> np.ndarray:
    """Temperatures after each ten seconds of a hold, °C, [time, node]."""
    from fleet.motion import static_drive

    drive = static_drive(tau, arm.motors)
    each = replace(drive, current_sq=drive.current_sq[None], friction_w=drive.friction_w[None])
    nodes = arm.simulate(each, np.array([seconds]), start_c)[:, 0]
    at = np.linspace(0.0, seconds, len(nodes))
    wanted = np.arange(0.0, seconds + 1.0, 10.0)
    return np.stack([np.interp(wanted, at, nodes[:, n]) for n in range(NODES)], axis=1)


@pytest.fixture(scope="module")
def hour() -> tuple[RcTwin, Recording, np.ndarray, ThermalForecast]:
    """A nominal arm after an hour of work, its true temperatures, and the forecast of twenty minutes of holding."""
    arm = RcTwin.nominal()
    log, nodes = working(arm, 60.0, np.random.default_rng(1))
    return arm, log, nodes[-1], forecast(log, held(FULL_REACH_NM), 30, ambient_c=AIR_C)


def test_arms_unlike_the_nominal_one_end_in_the_intervals_near_the_median() -> None:
    inside, error_k, change_k = [], [], []
    for seed in range(4):
        arm = true_arm(seed)
        log, nodes = working(arm, 40.0, np.random.default_rng(seed))
        low, median, high = (each[-1] for each in forecast(log, held(FULL_REACH_NM), 30).interval())
        end_c = course(arm, nodes[-1], FULL_REACH_NM, 30 * CYCLE_S)[-1, :JOINTS]
        inside += [*((low <= end_c) & (end_c <= high))]
        error_k.append(abs(median - end_c)[1])
        change_k.append(abs(end_c - nodes[-1, :JOINTS])[1])
    assert np.mean(inside) >= 0.9
    assert max(error_k) < 0.15 * np.median(change_k)


def test_intervals_hold_95_percent_of_the_ends_of_arms_that_vary_as_assumed() -> None:
    """Parameters by the network's covariance and from log to log, and another ambient temperature in the run."""
    rng, vector, sd = np.random.default_rng(7), ParameterVector(nominal_heat_model()), 0.08
    spread = [
        Parameter(name=name, joint=None if j is None else j + 1, value=1, low=1, high=1, prior=1, prior_sd=1, sd=sd)
        for name, j in vector.names
    ]
    about = {"arm": "own", "rms_k": {}, "memory_s": (), "seconds": 0.0, "data_hash": "", "source": "current"}
    network = Identified(
        heat_model=vector.nominal,
        parameters=tuple(spread),
        information=np.eye(len(vector)) / sd,
        ambient_c=AIR_C,
        ambient_sd_k=0.0,
        **about,
    )
    inside = []
    for _ in range(9):
        x = vector.mean + np.hypot(sd, FROM_LOG_TO_LOG) * rng.standard_normal(len(vector))
        arm = RcTwin(arm="own", heat_model=vector.heat_model(x), ambient_c=AIR_C, base="true")
        log, nodes = working(arm, 10.0, rng)
        warmer = replace(arm, ambient_c=AIR_C + DRIFT_K * rng.standard_normal())
        end_c = course(warmer, nodes[-1], FULL_REACH_NM, 20 * CYCLE_S)[-1, :JOINTS]
        low, _, high = (each[-1] for each in forecast(log, held(FULL_REACH_NM), 20, network=network).interval())
        inside.append((low <= end_c) & (end_c <= high))
    # 63 ends, of which those of an arm are correlated.
    assert 0.9 <= np.mean(inside) <= 0.99


def test_an_identified_network_narrows_the_interval() -> None:
    arm, rng = true_arm(3), np.random.default_rng(3)
    logs = [replace(working(arm, 40.0, rng)[0], name=f"{i}") for i in range(3)]
    short = logs[2].part(slice(0, 600))
    widths = [
        np.ptp([each[-1, 1] for each in forecast(short, held(FULL_REACH_NM), 30, network=network).interval()])
        for network in (None, identify(logs[:2], ambient_sd_k=0.0, step_s=20.0))
    ]
    assert widths[1] < 0.7 * widths[0]


def test_limits_are_reached_when_the_simulator_reaches_them(hour) -> None:
    arm, _, start_c, found = hour
    joint_2 = course(arm, start_c, FULL_REACH_NM, found.run_s)[:, 1]
    limit_c = float(joint_2[0] + 0.7 * (joint_2[-1] - joint_2[0]))
    true_s = np.interp(limit_c, joint_2, 10.0 * np.arange(len(joint_2)))
    early_s, median_s, late_s = found.reached_s(limit_c)
    assert early_s <= true_s <= late_s
    assert median_s == pytest.approx(true_s, rel=0.1)
    assert found.probability(limit_c) == 1.0
    assert found.probability(float(joint_2[-1]) + 10.0) == 0.0
    assert found.reached_s(float(joint_2[-1]) + 10.0) == (np.inf,) * 3


def test_the_longest_run_is_that_whose_own_forecast_is_just_safe(hour) -> None:
    _, log, _, found = hour
    limit_c = float(found.interval()[1].max()) + 1.0
    longest_s = found.longest_s(limit_c)
    count = int(longest_s / CYCLE_S)
    just, beyond = (forecast(log, held(FULL_REACH_NM), n, ambient_c=AIR_C) for n in (count - 1, count + 2))
    assert just.probability(limit_c) <= RISK + 1.0 / SAMPLES < beyond.probability(limit_c) + 2.0 / SAMPLES
    assert found.longest_s(200.0) == np.inf


def test_an_arm_that_starts_warmer_by_the_safe_change_just_stays_below_the_limit(hour) -> None:
    """No start is safe if a cold arm gets there too."""
    arm, log, start_c, found = hour
    limit_c = float(found.interval()[1].max()) + 3.0
    more_k = found.safe_start_k(limit_c)
    peak_c = [course(arm, start_c + k, FULL_REACH_NM, found.run_s)[:, :JOINTS].max() for k in (more_k, more_k + 3.0)]
    assert peak_c[0] < limit_c < peak_c[1]
    endless = forecast(log, held(2.0 * FULL_REACH_NM), 300, ambient_c=AIR_C)
    assert endless.safe_start_k(60.0) == -np.inf


def test_a_longer_run_is_never_safer_and_keeps_the_peaks_of_short_bursts(hour) -> None:
    """A quarter of an hour with a burst of 20 s: P(limit) of 100 repetitions is not below that of 16."""
    _, log, _, _ = hour
    plan = held(np.zeros(JOINTS), 900.0)
    plan.tau[:40] = 1.6 * FULL_REACH_NM
    few, many = (forecast(log, plan, n, ambient_c=AIR_C) for n in (16, 100))
    limit_c = float(np.median(few.interval()[1].max()))
    assert many.probability(limit_c) >= few.probability(limit_c) > 0.0
    for found in (few, many):
        longest_s = found.longest_s(limit_c)
        assert (found.sampled_c[:, found.time_s <= longest_s].max(axis=(1, 2)) >= limit_c).mean() <= RISK


def test_the_same_seed_gives_the_same_forecast_and_short_cycles_that_of_long_ones(hour) -> None:
    _, log, _, found = hour
    again = forecast(log, held(FULL_REACH_NM), 30, ambient_c=AIR_C)
    np.testing.assert_array_equal(again.sampled_c, found.sampled_c)
    short = forecast(log, held(FULL_REACH_NM, 2.0), 600, ambient_c=AIR_C)
    assert short.run_s == found.run_s
    np.testing.assert_allclose(short.interval()[1][-1], found.interval()[1][-1], atol=0.02)


@pytest.fixture
def few_samples(monkeypatch) -> None:
    """For a test that reads neither a probability nor an interval."""
    monkeypatch.setattr("twin.thermal.forecast.SAMPLES", 20)


def test_a_plan_at_rest_stays_and_late_rows_of_a_moving_one_are_left_out(hour, few_samples) -> None:
    _, log, _, _ = hour
    hold = held(FULL_REACH_NM)
    warm = replace(hold, temp_c=np.full((len(hold.time_s), JOINTS), 30.0))
    assert (forecast(log, warm, 5).sampled_c == forecast(log, hold, 5).sampled_c).all()
    # Ten seconds of load between two of none, of which a late logger repeats the last loaded row for eight more.
    tau = np.where((hold.time_s[:, None] > 10.0) & (hold.time_s[:, None] <= 20.0), FULL_REACH_NM, 0.0)
    temp_c = 30.0 + 0.01 * hold.time_s[:, None] + np.zeros(JOINTS)
    moving = replace(warm, qd=hold.qd + 0.001, tau=tau, temp_c=temp_c)
    late = np.arange(len(hold.time_s))
    late[40:56] = 40
    stale = replace(moving, qd=moving.qd[late], tau=tau[late], temp_c=temp_c[late])
    true_c, late_c, held_on_c = (
        np.median(forecast(log, each, 20).sampled_c[:, -1, 1]) for each in (moving, stale, replace(stale, temp_c=None))
    )
    assert abs(late_c - true_c) < 0.6 * (held_on_c - true_c)


def test_temperatures_of_other_joints_and_other_currents_are_told(hour, few_samples) -> None:
    """Without a word, joint 2 would end 30 K too cool; with half the currents, hundreds of kelvin too hot."""
    _, log, _, found = hour
    assert log.temp_c is not None
    swapped = replace(log, temp_c=log.temp_c[:, [0, 4, 2, 3, 1, 5, 6]])
    wrong = forecast(swapped, held(FULL_REACH_NM), 30, ambient_c=AIR_C)
    assert found.residual_k.max() < MOST_RESIDUAL_K < wrong.residual_k.max()
    assert log.current_a is not None
    half = forecast(replace(log, current_a=0.5 * log.current_a), held(FULL_REACH_NM), 30, ambient_c=AIR_C)
    assert found.distance_sd < MOST_SD < half.distance_sd
    drift_k = np.outer(np.linspace(0.0, 12.0, len(log.time_s)), np.eye(7)[3])
    drifting = forecast(replace(log, temp_c=log.temp_c + drift_k), held(FULL_REACH_NM), 30, ambient_c=AIR_C)
    assert max(drifting.residual_k) < MOST_RESIDUAL_K
    assert drifting.distance_sd < MOST_SD
    assert "joint 4 without load is 3." in summary(drifting, log, 30)[0]
    said = [summary(each, log, 30)[0].startswith("Do not trust this forecast") for each in (found, wrong, half)]
    assert said == [False, True, True]


def test_a_forecast_needs_temperatures_time_and_a_whole_plan(hour) -> None:
    _, log, _, _ = hour
    plan = held(FULL_REACH_NM)
    with pytest.raises(FleetError, match="'work' has no motor temperatures"):
        forecast(replace(log, temp_c=None), plan)
    with pytest.raises(FleetError, match="less than 60 s since its start or its last gap"):
        forecast(log.part(slice(0, 30)), plan)
    with pytest.raises(FleetError, match="'hold' has a gap of 34 s after 1 s; at most 10 s"):
        forecast(log, plan.part(np.array([0, 1, 2, 70])))
    with pytest.raises(FleetError, match="'hold' has 2 samples; at least 3"):
        forecast(log, plan.part(np.array([0, 1])))
    with pytest.raises(FleetError, match=r"a motor at .* below the ambient temperature of 50 °C"):
        forecast(log, plan, ambient_c=50.0)
    six = {name: getattr(plan, name)[:, :6] for name in ("q", "qd", "tau")}
    with pytest.raises(FleetError, match="6 joints, the thermal network 7"):
        forecast(log, replace(plan, **six))
    with pytest.raises(FleetError, match="at most 168 h can be forecast"):
        forecast(log, plan, int(MOST_S / CYCLE_S) + 1)
    path: Any = "x.csv"
    for call in (lambda: forecast(path, plan), lambda: identify(path), lambda: identify([path])):
        with pytest.raises(TypeError, match=r"A recording is needed \(got .* twin\.logs\.reader\.read\(path\) returns"):
            call()
