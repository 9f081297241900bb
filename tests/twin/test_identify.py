from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper.real_logs import held_out_errors, rms
from fleet.errors import CheckpointError, IdentificationError
from fleet.heat.motor import friction_heat, gen3_motors, reference_current
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalSpread,
    drive_heat,
    gen3_network,
    spread_motors,
    thermal_model,
)
from fleet.robot import JOINTS
from twin.logs.recording import Recording, heat_logs
from twin.thermal.checkpoint import CARD, load, load_twin, save
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
from twin.thermal.thermal_twin import RcTwin

AIR_C = 22.0
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
    recording, temp = logged(body, rng, 15.0)
    errors, simulated = held_out_errors(body, recording)
    np.testing.assert_allclose(rms(errors), body.motors.sensor_noise_k, rtol=0.2)
    np.testing.assert_allclose(simulated[-1][-1, HOUSING], temp[-1, HOUSING], atol=0.5)


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


def test_where_friction_is_known_the_rest_is_told_better(rng):
    body = nominal_heat_model()
    recordings = [logged(body, rng, 20.0)[0]]
    known, unknown = identify(recordings, free=THERMAL), identify(recordings)
    pairs = [(known.parameter(p.name, p.joint).sd, p.sd) for p in unknown.parameters if p.name in THERMAL]
    assert len(pairs) == 43
    assert np.mean([k < u for k, u in pairs]) > 0.9


def test_intervals_shrink_with_data_and_what_the_log_is_silent_about_is_said(rng):
    body = nominal_heat_model()
    recordings = [logged(body, rng, 20.0, name=f"log {i}")[0] for i in range(4)]
    few, many = (identify(part, ambient_sd_k=0.0) for part in (recordings[:1], recordings))
    narrower = [m.sd < f.sd for f, m in zip(few.parameters, many.parameters, strict=True)]
    assert np.mean(narrower) > 0.95
    # Joint 5 carries nothing here: its copper loss stays unknown, its idle heat does not.
    quiet = [replace(r, current_a=r.current_a * (np.arange(JOINTS) != 4)) for r in recordings[:1]]
    assert few.parameter("copper_w_per_a2", 5).informed
    silent = identify(quiet, ambient_sd_k=0.0)
    assert not silent.parameter("copper_w_per_a2", 5).informed
    assert silent.parameter("copper_w_per_a2", 5).value == pytest.approx(0.34, rel=0.05)
    with pytest.raises(KeyError, match="was not free"):
        identify(recordings[:1], free=("idle_w",)).parameter("coulomb_nm", 1)


def test_torque_and_speed_stand_in_for_a_current_that_was_not_recorded(rng):
    body = nominal_heat_model()
    recording, _ = logged(body, rng, 30.0)
    by_torque = identify([replace(recording, current_a=None)], ambient_sd_k=0.0)
    assert by_torque.source == "torque"
    # The recording's current knows no magnets and the law does: a few per cent of heat.
    assert by_torque.parameter("copper_w_per_a2", 2).value == pytest.approx(0.41, rel=0.1)


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


def test_logs_split_at_gaps_and_keep_the_mean_heat(rng):
    recording, _ = logged(nominal_heat_model(), rng, 5.0)
    whole = heat_logs(recording, gen3_motors(), "current")[0]
    kept = np.concatenate([np.arange(100), np.arange(140, 301)])
    cut = Recording(
        name="cut", **{n: getattr(recording, n)[kept] for n in ("time_s", "q", "qd", "tau", "current_a", "temp_c")}
    )
    parts = heat_logs(cut, gen3_motors(), "current")
    assert [part.time_s[0] for part in parts] == [0.0, 140.0]
    square = (recording.current_a[1:] ** 2 + recording.current_a[:-1] ** 2) / 2.0
    assert np.allclose(whole.current_terms[..., 0].mean(axis=0), square[: len(whole.dt_s) * 10].mean(axis=0))


def still(recording: Recording, **changed) -> Recording:
    return replace(recording, **changed)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda r: [], "at least one recording"),
        (lambda r: [r, r], "Names of recordings must differ"),
        (lambda r: [still(r, temp_c=None)], "no motor temperatures. Record"),
        (lambda r: [still(r, temp_c=np.full_like(r.temp_c, 30.0))], "No motor warms or cools"),
        (lambda r: [still(r, current_a=0.0 * r.current_a)], "copper loss is unknown"),
        (lambda r: [Recording(name="s", **{n: getattr(r, n)[:60] for n in CHANNELS})], "at least 300 s are needed"),
        (
            lambda r: [Recording(name="s", time_s=r.time_s, **{n: getattr(r, n)[:, :6] for n in CHANNELS[1:]})],
            "6 joints",
        ),
    ],
)
def test_recordings_that_cannot_tell_are_refused_with_what_to_do(rng, spoil, says):
    recording, _ = logged(nominal_heat_model(), rng, 6.0)
    with pytest.raises(IdentificationError, match=says):
        identify(spoil(recording))


CHANNELS = ("time_s", "q", "qd", "tau", "current_a", "temp_c")


def test_arguments_that_make_no_sense_are_refused(rng):
    recording, _ = logged(nominal_heat_model(), rng, 6.0)
    with pytest.raises(ValueError, match="ambient_sd_k"):
        identify([recording], ambient_sd_k=-1.0)
    with pytest.raises(ValueError, match="Free parameters must be some of"):
        identify([recording], free=("copper",))
    without = replace(gen3_motors(), idle_w=np.zeros(JOINTS))
    with pytest.raises(ValueError, match=r"nominal values > 0 \(got 0 for idle_w"):
        identify([recording], nominal=HeatModel(without, gen3_network()))


def test_a_round_trip_keeps_every_number_and_a_change_is_noticed(rng, tmp_path):
    recording, _ = logged(prior_draw(rng), rng, 10.0)
    got = identify([recording], arm="left", ambient_sd_k=0.0)
    save(got, tmp_path)
    back = load(tmp_path)
    assert (back.version, back.arm, back.parameters, back.rms_k) == (got.version, "left", got.parameters, got.rms_k)
    np.testing.assert_array_equal(thermal_model(back.heat_model.network).laplacian, got.heat_model.thermal().laplacian)
    assert load_twin(tmp_path).version == RcTwin.of(got).version
    text = (tmp_path / CARD).read_text()
    for old, new, says in (
        ('"format": 2', '"format": 9', "format 9 is not supported, only 2"),
        ('"winding_3":', '"winding_x":', "unknown nodes: winding_x"),
        ('"seconds":', '"secs":', "secs"),
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
