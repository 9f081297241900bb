"""Studies of real and simulated logs: no window that is judged was seen in training."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.paper.real_logs import AHEAD_S, CONFIG, LogStudy, log_rc, log_study, peak_within
from benchmarks.paper.subjects import Study, make_study
from fleet.errors import FleetError
from fleet.heat.thermal import WINDING
from fleet.robot import JOINTS
from scenarios.prepare.calibrate import AIR_SD_K, own_logs
from twin.logs.recording import Recording, heat_logs
from twin.thermal.identify import HeatModel, Noise, ParameterVector, Problem, identify, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin
from twin.vae.measures import PARTS, Features, latent_moments

QUICK = replace(CONFIG, epochs=1, hidden=4, allow_collapse=True)


def logged(name: str, temp_2_c: float, *, seed: int = 0, minutes: float = 1.0) -> Recording:
    """Sines at 2 Hz, all motors at 30 °C but for joint 2."""
    time_s = np.arange(0.0, 60 * minutes, 0.5)
    rng = np.random.default_rng(seed)
    q = 0.4 * np.sin(rng.uniform(0.2, 0.6, 7) * time_s[:, None] + rng.uniform(0, 6, 7))
    temp_c = np.full_like(q, 30.0)
    temp_c[:, 1] = temp_2_c
    return Recording(
        name=name, time_s=time_s, q=q, qd=np.gradient(q, time_s, axis=0), tau=20 * np.sin(q), temp_c=temp_c
    )


def test_no_file_is_trained_on_and_tested():
    recordings = [logged(f"cool_{i}", 35.0, seed=i) for i in range(5)] + [logged("hot", 45.0, seed=9)]
    study = log_study(recordings, 3, config=QUICK)
    assert len(study.train_files) == 3
    assert set(study.file) == {r.name for r in recordings} - set(study.train_files)
    assert "hot" in study.file
    np.testing.assert_array_equal(study.temp_c[:, 1] >= 40.0, study.file == "hot")
    np.testing.assert_array_equal(study.end_s - study.start_s, (CONFIG.window - 1) / CONFIG.rate_hz)
    assert study.errors.shape == (len(study.file), 7, 3)
    again = log_study(recordings, 3, config=QUICK)
    np.testing.assert_array_equal(again.errors, study.errors)
    assert log_study(recordings, 4, config=QUICK).train_files != study.train_files


def test_the_next_peak_is_unknown_past_the_end():
    recording = logged("a", 35.0, minutes=10.0)
    assert recording.temp_c is not None
    recording.temp_c[600, 1] = 50.0  # at 300 s
    assert peak_within(recording, 0.0, AHEAD_S)[1] == 50.0
    assert peak_within(recording, 299.0, AHEAD_S)[1] == 50.0
    assert np.isnan(peak_within(recording, 300.0, AHEAD_S)).all()


def test_what_cannot_be_studied_says_why():
    with pytest.raises(FleetError, match="0 of 1 logs stay below 40 °C on joint 2"):
        log_study([logged("hot", 45.0)], 0, config=QUICK)
    with pytest.raises(FleetError, match=r"None of the 1 test logs lasts 25 s"):
        log_study([logged("a", 35.0), logged("hot", 45.0, minutes=0.2)], 0, config=QUICK)
    blind = replace(logged("blind", 35.0), temp_c=None)
    with pytest.raises(ValueError, match="'blind' has no motor temperatures"):
        log_study([blind], 0, config=QUICK)


class _Clock:
    """All that the forecast asks of a learned twin."""

    config = CONFIG


def heated(name: str, load: float, rng: np.random.Generator) -> Recording:
    """2 Hz for fifteen minutes by the nominal arm: joint 2 carries `load` A after five of them."""
    twin, count = RcTwin.nominal(), 1800
    amps = np.zeros((count + 1, 7))
    amps[600:, 1] = load
    temps = np.empty((count + 1, 14))
    temps[0] = twin.idle_c
    phi, gamma = twin.thermal.step_matrices(0.5)
    for k in range(count):
        heat = np.append(twin.motors.copper_w_per_a2 * amps[k] ** 2, twin.motors.idle_w)
        temps[k + 1] = phi @ temps[k] + gamma @ (heat + twin.thermal.to_ambient * twin.ambient_c)
    still = np.zeros_like(amps)
    tau = amps * twin.motors.torque_per_amp * twin.motors.eta
    return Recording(
        name=name,
        time_s=np.arange(count + 1) / 2.0,
        q=still,
        qd=still,
        tau=tau,
        current_a=amps,
        temp_c=temps[:, :7] + 0.01 * rng.standard_normal(amps.shape),
    )


def noise(count: int, rng: np.random.Generator) -> Features:
    moments = latent_moments(rng.standard_normal((count, 7, 2)))
    return Features(np.concatenate([rng.random((count, 7, PARTS)), moments], axis=-1))


def windows_of(recordings: list[Recording]) -> LogStudy:
    """A study's windows every 30 s with a difficulty that knows nothing."""
    end_s = np.arange(30.0, 590.0, 30.0)
    files, temps, peaks = [], [], []
    for r in recordings:
        assert r.temp_c is not None
        for end in end_s:
            files.append(r.name)
            temps.append(r.temp_c[int(2 * end)])
            peaks.append(r.temp_c[int(2 * end) + 1 : int(2 * end) + 601].max(axis=0))
    rng = np.random.default_rng(0)
    return LogStudy(
        twin=cast(Any, _Clock()),
        train_files=(recordings[0].name,),
        file=np.array(files),
        start_s=np.tile(end_s - 24.5, len(recordings)),
        end_s=np.tile(end_s, len(recordings)),
        windows=np.zeros((len(files), 50, 7, 3), np.float32),
        temp_c=np.array(temps),
        end_c=np.array(temps),
        peak_next_c=np.array(peaks),
        features=noise(len(files), rng),
        known=noise(9, rng),
    )


def test_a_known_load_tells_what_temperature_and_difficulty_cannot():
    rng = np.random.default_rng(1)
    recordings = [heated(f"log {i}", load, rng) for i, load in enumerate(np.linspace(2.0, 6.0, 6))]
    found = log_rc(windows_of(recordings), recordings, identified=identify(recordings, ambient_sd_k=0.0))
    auroc = found["below"]["auroc"]
    assert found["below"]["windows"] < found["every"]["windows"]
    assert auroc["rc, load planned"] > 0.99
    assert auroc["rc, load planned"] > auroc["rc, load continued"] > auroc["d"]
    cool = [recordings[0]]
    with pytest.raises(FleetError, match="nothing to tell apart"):
        log_rc(windows_of(cool), cool, identified=identify(recordings, ambient_sd_k=0.0))


@pytest.fixture(scope="module")
def study() -> Study:
    return make_study(np.random.SeedSequence(5), train=0, reference=0, test=160, novel=0)


@pytest.mark.slow
def test_intervals_hold_the_truth_on_brisk_work_logged_at_2_hz():
    inside = []
    for seed in (1, 2, 3):
        brisk = make_study(np.random.SeedSequence(seed), train=6, reference=0, test=0, novel=0)
        logs = own_logs(brisk.hardware, brisk.train.plans, np.random.default_rng(seed), ambient_c=brisk.ambient_c)
        found = identify(logs, ambient_c=brisk.ambient_c, ambient_sd_k=AIR_SD_K)
        truth = HeatModel(brisk.motors, brisk.network)
        for p in found.parameters:
            true = float(truth.value(p.name)[0 if p.joint is None else p.joint - 1])
            inside.append(p.low <= true <= p.high)
    assert np.mean(inside) >= 0.8  # 171 values, three arms whose errors are not independent


def test_own_logs_are_what_the_network_simulates(study: Study):
    (log,) = own_logs(
        study.hardware,
        study.test.plans[:1],
        np.random.default_rng(0),
        ambient_c=study.ambient_c,
        work_s=300.0,
        rest_s=100.0,
    )
    assert log.time_s[-1] == 400.0
    assert log.temp_c is not None
    # Idle-warm, in the study's air, at the start.
    idle = RcTwin.nominal(ambient_c=study.ambient_c).idle_c[WINDING]
    np.testing.assert_allclose(log.temp_c[0], idle, atol=12.0)
    layout = ParameterVector(nominal_heat_model())
    heat = heat_logs(log, layout.nominal.motors, "current", step_s=0.0)
    problem = Problem(heat, study.ambient_c, 0.0, layout, Noise(np.full(JOINTS, 0.01), np.ones(JOINTS)))
    (error_k,) = problem.unexplained(layout.mean)
    assert np.sqrt(np.mean(error_k**2, axis=0)).max() < 1.0
