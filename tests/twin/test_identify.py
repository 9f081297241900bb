"""The thermal twin, and its parameters identified from recordings, with intervals."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.metrics import brier_score_loss

from benchmarks.paper.reliability import calibration_error
from fleet.difficulty import KNOWN, SETTLING_S, known_temperatures
from fleet.errors import CheckpointError, FleetError, IdentificationError
from fleet.heat.motor import friction_heat, gen3_motors, reference_current
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalSpread,
    drive_heat,
    gen3_network,
    simulate_temperatures,
    spread_motors,
    thermal_model,
)
from fleet.motion import RATE_HZ, Drive, drives
from fleet.robot import JOINTS
from scenarios.cli.twin import doubts_of
from scenarios.prepare.oracle import peaks
from twin.logs.recording import READINGS, Recording, heat_logs, without_repeats
from twin.thermal.checkpoint import CARD, load, load_curve, save, save_curve
from twin.thermal.identify import (
    PRIOR_SD,
    THERMAL,
    HeatModel,
    Noise,
    ParameterVector,
    Problem,
    identify,
    linear_temperatures,
    noise_of,
    nominal_heat_model,
)
from twin.thermal.thermal_twin import (
    CalibratedTwin,
    LinearHeat,
    NotEnoughExperience,
    PeakCurve,
    RcTwin,
    fit_curve,
    peak_forecast,
)

AIR_C = 22.0
FULL_REACH_NM = np.array([0.0, 50.1, 0.0, 21.3, 0.0, 1.0, 0.0])
"""3 kg held outstretched (gravity torques of the Gen3 model)."""


def hold(tau, seconds: float = 4.0):
    samples = round(seconds * RATE_HZ)
    return np.stack([np.zeros((samples, JOINTS)), np.zeros((samples, JOINTS)), np.tile(tau, (samples, 1))], axis=1)


@pytest.fixture
def rng_5():
    return np.random.default_rng(5)


@pytest.fixture
def holds(make_plan):
    """Plan that holds joint torques."""

    def make(tau, seconds: float = 4.0):
        short = hold(tau, 0.5)
        return make_plan(*(p.astype(np.float32) for p in (short, hold(tau, seconds), short)))

    return make


def test_three_kilograms_outstretched_pass_the_limit_when_the_project_says(holds):
    # 12.6 min from a cold arm in 25 °C, DESIGN §3.
    twin = RcTwin.nominal(ambient_c=25.0)
    load = drives([holds(FULL_REACH_NM).cycle.profile], twin.motors)
    temp_c = twin.simulate(load, np.array([1800.0]), np.full(NODES, 25.0))[:, 0]
    passed_s = np.interp(60.0, temp_c[:, 1], np.linspace(0.0, 1800.0, len(temp_c)))
    assert passed_s / 60.0 == pytest.approx(12.6, abs=0.2)


def test_peaks_are_those_of_the_simulator_with_the_same_parameters(holds, rng_5):
    twin = RcTwin.nominal()
    plans = [holds(scale * FULL_REACH_NM) for scale in (0.3, 0.7, 1.1)]
    repetitions = [20, 100, 300]
    start = np.full(NODES, 30.0)
    mine = twin.peaks(plans, repetitions, start_c=start)
    lasts = [plan.duration_s(n) for plan, n in zip(plans, repetitions, strict=True)]
    theirs = peaks(plans, lasts, motors=twin.motors, thermal=twin.thermal, start_c=start, ambient_c=AIR_C)
    np.testing.assert_allclose(mine, theirs, atol=0.05)  # steps of unequal length


def test_difficulty_grows_with_load_and_repetitions_and_is_none_at_rest(holds):
    twin = RcTwin.nominal()
    rest = twin.score(holds(np.zeros(JOINTS)), 100)
    np.testing.assert_allclose(rest.per_joint, 0.0, atol=1e-9)
    d = [twin.score(holds(s * FULL_REACH_NM), n).per_joint[1] for s, n in ((0.5, 100), (1.0, 100), (1.0, 1000))]
    assert 0 < d[0] < d[1] < d[2] < 1
    # The limit is reached where the rise fills the room: d = 1 − 1/e.
    idle = twin.idle_c[1]
    at_limit = replace(twin, warning_c=float(twin.peaks([holds(FULL_REACH_NM)], [100], start_c=twin.idle_c)[0, 1]))
    assert at_limit.warning_c > idle
    assert at_limit.score(holds(FULL_REACH_NM), 100).per_joint[1] == pytest.approx(1 - np.exp(-1))


def test_the_peak_is_that_of_the_step_by_step_simulation(holds):
    """Hot and cold starts, short and long plans, copper and magnets that change with temperature."""
    twin, rng = RcTwin.nominal(), np.random.default_rng(1)
    errors = []
    for _ in range(60):
        plan, times = holds(rng.uniform(0.0, 1.3) * FULL_REACH_NM), int(rng.integers(10, 900))
        ambient_c, warm_k = rng.uniform(15.0, 38.0), rng.uniform(0.0, 25.0)
        housing_c = ambient_c + warm_k * rng.uniform(0.0, 1.0, JOINTS)
        start_c = np.append(housing_c + warm_k * rng.uniform(0.0, 1.0, JOINTS), housing_c)
        settled_s = min(SETTLING_S, plan.duration_s(times))
        load = drives([plan.cycle.profile], twin.motors)
        law = {"motors": twin.motors, "thermal": twin.thermal, "ambient_c": ambient_c}
        settled = simulate_temperatures(load, [settled_s], start_c=start_c, **law)
        after_s = plan.duration_s(times) - settled_s
        wanted_c = simulate_temperatures(load, [after_s], start_c=settled.end_c[0], **law).highest_c.max()
        known_c = known_temperatures(start_c[:JOINTS], housing_c, ambient_c)
        if wanted_c < 90.0:  # beyond the error limit nothing needs to be right
            errors.append(twin.score(plan, times).peak_at(known_c) - wanted_c)
    assert len(errors) > 30
    assert np.sqrt(np.mean(np.square(errors))) < 0.3
    assert np.abs(errors).max() < 1.0


def test_a_plan_that_cools_a_warm_motor_is_not_held_against_it(holds):
    twin = replace(RcTwin.nominal(), curve=PeakCurve(knots=((59.0, 0.01), (61.0, 0.99)), jobs=30))
    warm_c = known_temperatures(np.append(65.0, np.full(6, 30.0)), np.full(JOINTS, 30.0), 22.0)
    light = twin.score(holds(0.0 * FULL_REACH_NM), 2000)
    assert light.p_at(warm_c) == 0.01
    hot_c = known_temperatures(np.full(JOINTS, 70.0), np.full(JOINTS, 68.0), 36.0)
    assert light.p_at(hot_c) == 0.99


def test_pieces_of_later_moments_say_so(holds):
    peak = RcTwin.nominal().peak(holds(FULL_REACH_NM), 8000)
    assert peak.time_s is not None
    assert set(np.round(peak.time_s)) <= {0.0, 480.0, np.round(peak.time_s.max())}
    assert (peak.time_s == 0.0).any()
    assert len(peak.offset) <= 24


def test_a_curve_is_the_chance_of_the_prediction_error(holds):
    """Normal errors of 2 K with a bias of 1 K; P is then a normal distribution function."""
    rng = np.random.default_rng(3)
    predicted_c = rng.uniform(40.0, 80.0, 4000)
    curve = fit_curve(predicted_c, predicted_c + rng.normal(1.0, 2.0, 4000), 60.0)
    at, p = np.array(curve.knots).T
    expected = norm.cdf((at + 1.0 - 60.0) / 2.0)
    assert p == pytest.approx(expected, abs=0.04)
    with pytest.raises(NotEnoughExperience, match="needs 30 past jobs"):
        fit_curve(predicted_c[:29], predicted_c[:29], 60.0)


def test_bad_plans_are_refused(holds, make_plan):
    twin, empty = RcTwin.nominal(), np.zeros((0, 3, JOINTS), np.float32)
    with pytest.raises(ValueError, match="at least one repetition"):
        twin.score(holds(FULL_REACH_NM), 0)
    with pytest.raises(ValueError, match="no motion"):
        twin.score(make_plan(empty, empty, empty), 1)
    six = np.zeros((50, 3, 6), np.float32)
    with pytest.raises(ValueError, match="7 joints"):
        twin.score(make_plan(six, six, six), 1)


def working(twin: RcTwin, minutes: float, rng: np.random.Generator) -> tuple[Recording, np.ndarray]:
    """A log at 1 Hz of a hold and a rest from warm housings, and the true node temperatures."""
    count = round(60 * minutes)
    on = (np.arange(count + 1) < count // 2).astype(float)[:, None]
    tau, still = on * FULL_REACH_NM, np.zeros((count + 1, JOINTS))
    start = np.append(np.full(JOINTS, 35.0), np.full(JOINTS, 31.0))
    phi, gamma = twin.thermal.step_matrices(1.0)
    temp, amps = [start], []
    for k in range(count):
        square = reference_current(tau[k], still[k], twin.motors) ** 2
        heat = drive_heat(temp[-1], square, friction_heat(still[k], twin.motors), twin.motors)
        temp.append(phi @ temp[-1] + gamma @ (heat + twin.thermal.to_ambient * AIR_C))
    for k in range(count + 1):
        factor = 1.0 + twin.motors.alpha_kt_per_k * (temp[k][HOUSING] - twin.motors.reference_c)
        amps.append(reference_current(tau[k], still[k], twin.motors) / factor)
    temps = np.array(temp)
    seen = temps[:, WINDING] + twin.motors.sensor_noise_k * rng.standard_normal((count + 1, JOINTS))
    arrays = {"q": still, "qd": still, "tau": tau, "current_a": np.array(amps), "temp_c": seen}
    return Recording(name="work", time_s=np.arange(count + 1.0), **arrays), temps


def own_arm(seed: int) -> tuple[RcTwin, HeatModel]:
    rng, spread = np.random.default_rng(seed), ThermalSpread.gen3()
    body = nominal_heat_model()
    return RcTwin.nominal(), HeatModel(spread_motors(body.motors, spread, rng), gen3_network(spread=spread, rng=rng))


def test_an_identified_arm_predicts_its_own_heat_better_than_the_nominal_one(holds, rng_5, tmp_path):
    nominal, body = own_arm(11)
    true = RcTwin(arm="own", heat_model=body, ambient_c=AIR_C, base="true")
    recordings = [replace(working(true, 40.0, rng_5)[0], name=f"{i}") for i in range(2)]
    got = identify(recordings, ambient_sd_k=0.0, step_s=20.0)
    plans = [holds(s * FULL_REACH_NM) for s in (0.5, 0.8, 1.1)]
    start = np.full(NODES, 30.0)
    wanted = true.peaks(plans, [200] * 3, start_c=start)[:, 1]
    error = [
        np.abs(twin.peaks(plans, [200] * 3, start_c=start)[:, 1] - wanted).max() for twin in (nominal, RcTwin.of(got))
    ]
    assert error[1] < min(0.5 * error[0], 0.5)
    save(got, tmp_path)
    kept, back = RcTwin.of(got), RcTwin.of(load(tmp_path))
    assert back.version == kept.version
    np.testing.assert_array_equal(
        back.peaks(plans, [200] * 3, start_c=start), kept.peaks(plans, [200] * 3, start_c=start)
    )
    curve = PeakCurve(knots=((59.0, 0.1), (61.0, 0.9)), jobs=30)
    save_curve(curve, tmp_path)
    assert load_curve(tmp_path) == curve


def test_probability_from_past_jobs_of_an_arm_unlike_the_nominal_one(holds):
    # Jobs of random loads and lengths from random starts; labels by the simulator's law with the arm's own numbers.
    nominal, body = own_arm(2)
    rng = np.random.default_rng(0)
    count, taught = 700, 200
    scale = rng.uniform(0.2, 1.3, count)
    tau = scale[:, None] * FULL_REACH_NM * rng.uniform(0.5, 1.5, (count, JOINTS))
    plans = [holds(row, 0.2) for row in tau]
    repetitions = rng.integers(300, 12000, count)
    winding = rng.uniform(22, 50, (count, 1)) + rng.normal(0, 2, (count, JOINTS))
    housing = winding - rng.uniform(0, 5, (count, JOINTS))
    loads = drives([plan.cycle.profile for plan in plans], body.motors)
    lasts = np.array([plan.duration_s(int(n)) for plan, n in zip(plans, repetitions, strict=True)])
    law = {"motors": body.motors, "thermal": body.thermal(), "ambient_c": np.full(count, 24.0)}
    settled_s = np.minimum(SETTLING_S, lasts)
    start = np.concatenate([winding, housing], axis=1)
    settled = simulate_temperatures(loads, settled_s, start_c=start, **law)
    peak = simulate_temperatures(loads, lasts - settled_s, start_c=settled.end_c, **law).highest_c.max(axis=1)
    known = known_temperatures(winding, housing, np.full(count, 24.0))
    part = slice(0, taught)
    twin = nominal.with_past_jobs(plans[part], repetitions[part], known_c=known[part], peak_c=peak[part])
    passed = peak >= 60.0
    p = np.array(
        [
            float(twin.peak(plan, int(times)).at(at))
            for plan, times, at in zip(plans[taught:], repetitions[taught:], known[taught:], strict=True)
        ]
    )
    assert 0.1 < passed.mean() < 0.9
    assert brier_score_loss(passed[taught:], p) <= 0.045
    assert calibration_error(p, passed[taught:]) <= 0.04


def test_a_calibrated_twin_states_what_each_model_states(twin, plan) -> None:
    known_c = np.linspace(20.0, 50.0, KNOWN)
    heat = replace(RcTwin.nominal(), curve=PeakCurve(knots=((0.0, 0.25), (200.0, 0.25)), jobs=30))
    calibrated = CalibratedTwin(twin, heat)
    score = calibrated.score(plan, 40)
    np.testing.assert_array_equal(score.per_joint, twin.score(plan, 40).per_joint)
    assert score.peak_at(known_c) == heat.peak(plan, 40).value(known_c)
    assert score.p_at(known_c) == 0.25
    assert calibrated.version == f"d:{twin.version}+peak:{heat.version}"


GRAVITY_NM = np.array([3.0, 25.0, 6.0, 12.0, 2.0, 5.0, 2.0])


def prior_draw(rng: np.random.Generator) -> HeatModel:
    """An arm as the prior has them."""
    layout = ParameterVector(nominal_heat_model())
    return layout.heat_model(layout.mean + layout.sd * rng.standard_normal(len(layout)))


def logged(body: HeatModel, rng: np.random.Generator, minutes: float = 40.0, *, noise: float = 1.0, name: str = "log"):
    """A recording at 1 Hz by the project's step law: two loads and a rest, each held with a little motion."""
    motors, model = body.motors, body.thermal()
    count = round(60 * minutes)
    time_s = np.arange(count + 1.0)
    load = rng.uniform(0.3, 2.0, (3, JOINTS)) * np.array([1.0, 1.0, 0.1])[:, None]
    which = np.minimum(3 * np.arange(count + 1) // (count + 1), 2)
    speed = rng.uniform(0.0, 0.5, (3, JOINTS)) * np.array([1.0, 1.0, 0.0])[:, None]
    qd = speed[which] * np.where(np.arange(count + 1) % 20 < 10, 1.0, -1.0)[:, None]
    tau = load[which] * GRAVITY_NM
    amps = reference_current(tau, qd, motors)
    temp = np.full((count + 1, NODES), AIR_C) + np.append(rng.uniform(0, 10, JOINTS), rng.uniform(0, 8, JOINTS))
    phi, gamma = model.step_matrices(1.0)
    for k in range(count):
        square = (amps[k] ** 2 + amps[k + 1] ** 2) / 2.0
        rubbing = (friction_heat(qd[k], motors) + friction_heat(qd[k + 1], motors)) / 2.0
        # The recorded current is the one that flows, so the magnets do not enter twice.
        heat_w = drive_heat(np.append(temp[k, WINDING], np.full(JOINTS, motors.reference_c)), square, rubbing, motors)
        temp[k + 1] = phi @ temp[k] + gamma @ (heat_w + model.to_ambient * AIR_C)
    sensed = temp[:, WINDING] + noise * motors.sensor_noise_k * rng.standard_normal((count + 1, JOINTS))
    q = np.concatenate([np.zeros((1, JOINTS)), np.cumsum((qd[1:] + qd[:-1]) / 2.0, axis=0)])
    return Recording(name=name, time_s=time_s, q=q, qd=qd, tau=tau, current_a=amps, temp_c=sensed), temp


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def problem_of(recordings, **layout) -> Problem:
    logs = [log for r in recordings for log in heat_logs(r, gen3_motors(), "current")]
    noise = Noise(np.full(JOINTS, 0.05), np.full(JOINTS, 3.0))
    return Problem(logs, AIR_C, 1.5, ParameterVector(nominal_heat_model(), **layout), noise)


def test_the_gradient_is_that_of_finite_differences(rng):
    free = tuple(PRIOR_SD)
    problem = problem_of([logged(prior_draw(rng), rng, 10.0)[0]], free=free)
    x = problem.vector.mean + 0.1 * rng.standard_normal(len(problem.vector))
    by_jacobian = problem.jacobian(x).T @ problem.residual(x)

    def cost(at):
        return 0.5 * np.sum(problem.residual(at) ** 2)

    for k in range(0, len(x), 5):
        e = 1e-5 * np.eye(len(x))[k]
        by_difference = (cost(x + e) - cost(x - e)) / 2e-5
        assert by_jacobian[k] == pytest.approx(by_difference, rel=1e-4, abs=1e-3), problem.vector.names[k]


def test_the_information_is_that_left_when_the_hidden_starts_are_fitted_too(rng):
    # Second method: parameters and start together, the start's share then taken out (Schur complement).
    problem = problem_of([logged(prior_draw(rng), rng, 6.0)[0]], free=("copper_w_per_a2", "housing_j_per_k"))
    x = problem.vector.mean
    (hidden,) = problem._unknowns(x)
    size = len(x)

    def rows(both):
        (at,) = problem._unknowns(both[:size])
        return np.append(at.wanted - at.matrix @ both[size:], (both[:size] - problem.vector.mean) / problem.vector.sd)

    middle, nudge = np.append(x, hidden.solution), 1e-4 * np.eye(size + len(hidden.solution))
    slope = np.array([(rows(middle + e) - rows(middle - e)) / 2e-4 for e in nudge]).T
    whole = slope.T @ slope
    left = whole[:size, :size] - whole[:size, size:] @ np.linalg.solve(whole[size:, size:], whole[size:, :size])
    jacobian = problem.jacobian(x)
    np.testing.assert_allclose(jacobian.T @ jacobian, left, rtol=1e-3, atol=1e-3 * np.abs(left).max())


def test_the_course_in_modes_is_that_of_a_fine_euler_step(rng):
    body = prior_draw(rng)
    model, dt_s = body.thermal(), np.array([10.0, 3.0, 25.0])
    heat_w, start = rng.uniform(0, 20, (3, NODES)), rng.uniform(20, 50, NODES)
    batch = ParameterVector(body).models(ParameterVector(body).mean[None])
    got = linear_temperatures(dt_s, batch, heat_w[None], AIR_C, start)[0]
    temp, fine = start.copy(), 1e-3
    for k, dt in enumerate(dt_s):
        for _ in range(round(dt / fine)):
            flow = heat_w[k] + model.to_ambient * AIR_C - model.laplacian @ temp
            temp = temp + fine * flow / model.capacity
        np.testing.assert_allclose(got[k + 1], temp, atol=2e-3)


def test_the_true_arm_simulates_a_recording_down_to_the_sensor_noise(rng):
    body = prior_draw(rng)
    layout = ParameterVector(body)
    logs = heat_logs(logged(body, rng, 15.0)[0], body.motors, "current", step_s=0.0)
    errors = np.concatenate(
        Problem(logs, AIR_C, 0.0, layout, Noise(np.full(JOINTS, 0.01), np.ones(JOINTS))).unexplained(layout.mean)
    )
    np.testing.assert_allclose(np.sqrt(np.mean(errors**2, axis=0)), body.motors.sensor_noise_k, rtol=0.2)


@pytest.mark.ci_slow
def test_true_values_lie_in_the_intervals_about_as_often_as_they_say():
    inside, shrunk = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = prior_draw(rng)
        recordings = [logged(body, rng, 30.0, name=f"log {i}")[0] for i in range(2)]
        got = identify(recordings, ambient_c=AIR_C, ambient_sd_k=0.0)
        for p in got.parameters:
            truth = body.value(p.name)[0 if p.joint is None else p.joint - 1]
            inside.append(p.low <= truth <= p.high)
            shrunk.append(p.sd / p.prior_sd)
    # 228 draws at 95 %: 0.95 ± 0.03 by the binomial if they were independent; those of one arm are not quite.
    assert np.mean(inside) >= 0.88
    assert np.median(shrunk) < 0.6  # friction, too, has to be told, and with it the scale of all heat


def test_intervals_shrink_with_data_and_a_joint_without_current_stays_uninformed(rng):
    body = nominal_heat_model()
    recordings = [logged(body, rng, 20.0, name=f"log {i}")[0] for i in range(3)]
    few, many = (identify(part, ambient_sd_k=0.0) for part in (recordings[:1], recordings))
    narrower = [m.sd < f.sd for f, m in zip(few.parameters, many.parameters, strict=True)]
    assert np.mean(narrower) > 0.95
    # Joint 5 carries nothing here: its copper loss stays unknown, its idle heat does not.
    quiet = [replace(r, current_a=r.current_a * (np.arange(JOINTS) != 4)) for r in recordings[:1]]
    assert few.parameter("copper_w_per_a2", 5).informed
    silent = identify(quiet, ambient_sd_k=0.0)
    assert not silent.parameter("copper_w_per_a2", 5).informed
    assert silent.parameter("copper_w_per_a2", 5).value == pytest.approx(0.34, rel=0.05)


def test_torque_and_speed_stand_in_for_a_current_that_was_not_recorded(rng):
    body = nominal_heat_model()
    recording, _ = logged(body, rng, 30.0)
    by_torque = identify([replace(recording, current_a=None)], ambient_sd_k=0.0)
    assert by_torque.source == "torque"
    # The recording's current knows no magnets and the law does: a few per cent of heat.
    assert by_torque.parameter("copper_w_per_a2", 2).value == pytest.approx(0.41, rel=0.1)


UNLIKE = {
    "as it is": (lambda r: r, ""),
    "current √2": (
        lambda r: replace(r, current_a=np.sqrt(2.0) * np.asarray(r.current_a)),
        "Currents 0.[67].* RMS, or peak values",
    ),
    "torque 2": (lambda r: replace(r, current_a=None, tau=2.0 * r.tau), "Torques 0.[45].* as large .* in N·m"),
    "drift": (
        lambda r: replace(
            r, temp_c=np.asarray(r.temp_c) + np.outer(np.linspace(0.0, 30.0, len(r.time_s)), np.eye(JOINTS)[1])
        ),
        "joint 2 without load is .* times as far above the ambient temperature as in a nominal Gen3. Check the",
    ),
}


@pytest.mark.parametrize("name", UNLIKE)
def test_currents_and_temperatures_of_no_gen3_are_doubted(rng, name: str) -> None:
    """Joint by joint the changes are within the spread of arms; together they are not."""
    change, sentence = UNLIKE[name]
    spread = ThermalSpread.gen3()
    network = gen3_network(spread=spread, rng=rng)
    recording, _ = logged(HeatModel(spread_motors(gen3_motors(), spread, rng), network), rng, 15.0)
    doubts = doubts_of(identify([change(recording)], ambient_c=AIR_C))
    assert bool(doubts) == bool(sentence)
    assert re.search(sentence, "".join(doubts))


def test_air_that_differs_from_log_to_log_is_put_down_to_the_air(rng):
    body = nominal_heat_model()
    recordings = [logged(body, rng, 20.0, name=f"log {i}")[0] for i in range(3)]
    off = [replace(r, temp_c=r.temp_c + k) for r, k in zip(recordings, (-1.0, 0.0, 1.0), strict=True)]
    stiff, loose = (identify(off, ambient_sd_k=sd, free=THERMAL) for sd in (0.0, 1.5))
    wrong = [np.abs(np.log(got.heat_model.value("idle_w") / body.value("idle_w"))).max() for got in (stiff, loose)]
    assert wrong[1] < 0.5 * wrong[0]


def test_white_noise_has_no_memory_and_a_random_walk_has(rng):
    white, walk = rng.normal(0, 0.1, (2000, 2)), np.cumsum(rng.normal(0, 0.1, (2000, 2)), axis=0)
    found = noise_of([np.concatenate([white, walk - walk.mean(axis=0)], axis=1)], np.zeros(4))
    np.testing.assert_allclose(found.steps[:2], 1.0, atol=0.3)
    assert (found.steps[2:] > 50).all()
    np.testing.assert_allclose(found.sd_k[:2], 0.1, rtol=0.05)


def test_rows_that_a_late_logger_repeats_are_no_readings(rng):
    """The heat of each third row, repeated twice, is that of these rows alone; no gap arises, and no rest is cut."""
    recording, _ = logged(nominal_heat_model(), rng, 5.0)

    def repeated(rows):
        readings = {name: getattr(recording, name)[rows] for name in READINGS}
        return replace(recording, **readings)

    late, stale = repeated(np.arange(301) // 3 * 3), repeated(np.minimum(np.arange(301), 200))
    fresh = heat_logs(recording.part(slice(None, None, 3)), gen3_motors(), "current")[0]
    got = heat_logs(late, gen3_motors(), "current")[0]
    np.testing.assert_allclose(got.current_terms, fresh.current_terms)
    np.testing.assert_allclose(got.temp_c, fresh.temp_c)
    assert len(without_repeats(stale).time_s) == 301
    assert len(without_repeats(replace(late, temp_c=None)).time_s) == 301


def test_logs_split_at_gaps_and_keep_the_mean_heat(rng):
    recording, _ = logged(nominal_heat_model(), rng, 5.0)
    whole = heat_logs(recording, gen3_motors(), "current")[0]
    kept = np.concatenate([np.arange(100), np.arange(140, 301)])
    cut = recording.part(kept)
    parts = heat_logs(cut, gen3_motors(), "current")
    assert [part.time_s[0] for part in parts] == [0.0, 140.0]
    square = (recording.current_a[1:] ** 2 + recording.current_a[:-1] ** 2) / 2.0
    assert np.allclose(whole.current_terms[..., 0].mean(axis=0), square[: len(whole.dt_s) * 10].mean(axis=0))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: [replace(r, temp_c=None)], "no motor temperatures. Record"),
        (lambda r: [replace(r, temp_c=np.full_like(r.temp_c, 30.0))], "No motor warms or cools by .* of 'log'"),
        (lambda r: [replace(r, current_a=0.0 * r.current_a)], "in 'log', so copper loss is unknown"),
        (lambda r: [r.part(slice(3))], "Too little was recorded in 'log': 2 s, at least 300 s are needed"),
        (
            lambda r: [replace(r.part(slice(60)), name=name) for name in ("one", "two")],
            r"in 2 logs \('one', …\): 118 s, at least",
        ),
        (lambda r: [r.part(np.arange(0, 361, 12))], "'log': 0 s in stretches without a gap, of 360 s, at least"),
        (lambda r: [replace(r, **{name: getattr(r, name)[:, :6] for name in READINGS})], "6 joints"),
    ],
)
def test_recordings_that_cannot_tell_are_refused_with_what_to_do(rng, spoil, says):
    recording, _ = logged(nominal_heat_model(), rng, 6.0)
    with pytest.raises(IdentificationError, match=says):
        identify(spoil(recording))


def test_arguments_that_make_no_sense_are_refused(rng):
    recording, _ = logged(nominal_heat_model(), rng, 6.0)
    with pytest.raises(FleetError, match="below the ambient temperature of 58 °C, which no powered motor can be"):
        identify([recording], ambient_c=58.0)
    with pytest.raises(ValueError, match="Free parameters must be some of"):
        identify([recording], free=("copper",))
    without = replace(gen3_motors(), idle_w=np.zeros(JOINTS))
    with pytest.raises(ValueError, match=r"nominal values > 0 \(got 0 for idle_w"):
        identify([recording], nominal=HeatModel(without, gen3_network()))


def test_a_round_trip_keeps_every_number_and_a_change_is_noticed(rng, tmp_path):
    recording, _ = logged(prior_draw(rng), rng, 10.0)
    got = identify([recording], arm="left", ambient_sd_k=0.0, free=THERMAL)
    with pytest.raises(KeyError, match="was not free"):
        got.parameter("coulomb_nm", 1)
    save(got, tmp_path)
    back = load(tmp_path / CARD)
    np.testing.assert_array_equal(back.information, got.information)
    assert (back.version, back.arm, back.parameters, back.rms_k) == (got.version, "left", got.parameters, got.rms_k)
    np.testing.assert_array_equal(thermal_model(back.heat_model.network).laplacian, got.heat_model.thermal().laplacian)
    text = (tmp_path / CARD).read_text()
    for old, new, says in (
        ('"format": 2', '"format": 9', "format 9 is not supported, only 2"),
        ('"winding_3":', '"winding_x":', "unknown nodes: winding_x"),
        ('"seconds":', '"secs":', "secs"),
        ('"information": "', '"information": "AAAA', "buffer size must be a multiple"),
        (f'"arm": "{got.arm}"', '"arm": "right"', "has changed since it was saved"),
    ):
        assert old in text
        (tmp_path / CARD).write_text(text.replace(old, new, 1))
        with pytest.raises(CheckpointError, match=says):
            load(tmp_path)
    (tmp_path / CARD).unlink()
    with pytest.raises(CheckpointError, match="missing"):
        load(tmp_path)


@pytest.mark.parametrize("cooling", ["still_air", "immersion"])
def test_an_arm_with_values_of_its_own_gives_them_back(rng, cooling):
    spread = ThermalSpread.gen3()
    network = gen3_network(cooling=cooling, spread=spread, rng=rng)
    body = HeatModel(spread_motors(gen3_motors(), spread, rng), network)
    layout = ParameterVector(body, tuple(PRIOR_SD))
    again, batch = layout.heat_model(layout.mean), layout.models(layout.mean[None])
    np.testing.assert_allclose(batch.laplacian[0], body.thermal().laplacian, atol=1e-12)
    np.testing.assert_allclose(batch.to_ambient[0], body.thermal().to_ambient)
    np.testing.assert_allclose(batch.rates[0], body.thermal().rates)
    np.testing.assert_allclose(again.thermal().laplacian, body.thermal().laplacian)
    np.testing.assert_allclose(again.thermal().capacity, body.thermal().capacity)
    np.testing.assert_allclose(again.motors.copper_w_per_a2, body.motors.copper_w_per_a2)


@pytest.mark.parametrize("excess", [-0.2, 0.15, 0.3])
def test_a_forecast_with_more_heat_is_that_of_the_heavier_load(holds, excess) -> None:
    """Second method: the forecast of the drives with that much more heat; to first order in the excess."""
    twin, plan = RcTwin.nominal(), holds(FULL_REACH_NM, 60.0)
    load = drives([phase.profile for phase in plan.phases], twin.motors)
    known_c = known_temperatures(np.full(JOINTS, 38.0), np.full(JOINTS, 36.0), 24.0)
    lasts_s = plan.duration_s(10) * plan.weights(10)
    more = Drive(load.current_sq * (1 + excess), load.friction_w * (1 + excess))
    found = peak_forecast(LinearHeat.of(load, twin.motors, twin.thermal), lasts_s).value(known_c, excess=excess)
    exact = peak_forecast(LinearHeat.of(more, twin.motors, twin.thermal), lasts_s).value(known_c)
    plain = peak_forecast(LinearHeat.of(load, twin.motors, twin.thermal), lasts_s).value(known_c)
    assert abs(found - exact) < 0.15 * abs(exact - plain) + 0.05
