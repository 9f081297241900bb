"""The physical twin on the study's jobs, and on real logs; its own logs are what its simulator would have shown."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from fleet.errors import FleetError
from fleet.robot import JOINTS
from fleet.thermal import WINDING
from scenarios.prepare.simulated_logs import AIR_SD_K, own_logs
from scenarios.studies.real_logs import CONFIG, LogStudy, log_study
from scenarios.studies.real_logs_forecast import log_rc
from scenarios.studies.saturation import judge_networks, past_work
from scenarios.studies.setup import Study, make_study
from twin.logs.heat_log import heat_logs
from twin.logs.reader import read_folder
from twin.logs.recording import Recording
from twin.thermal.identify import identify
from twin.thermal.least_squares import Noise, Problem
from twin.thermal.parameters import ParameterVector
from twin.thermal.result import HeatModel, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin
from twin.vae.measures import PARTS, Features, latent_moments

LOGS = Path(__file__).parents[2] / "../shared/data/gen3_logs"


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


def test_an_identified_arm_knows_its_peaks_and_both_are_trusted(study: Study):
    pair = judge_networks(past_work(study, seed=5, labelled=80, watched=0))
    nominal, identified = pair
    assert (nominal.name, identified.name) == ("rc nominal", "rc identified")
    assert nominal.table.count.sum() == 80
    assert min(each.auroc for each in pair) > 0.95
    assert max(each.brier for each in pair) < 0.08
    assert identified.peak_error_k < 0.7 * nominal.peak_error_k
    with pytest.raises(ValueError, match="more than 150 \\+ 10 test jobs"):
        past_work(study, seed=5, labelled=150, watched=10)


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
    auroc = found.below.auroc
    assert found.below.windows < found.every.windows
    assert auroc["rc, load planned"] > 0.99
    assert auroc["rc, load planned"] > auroc["rc, load continued"] > auroc["d"]
    cool = [recordings[0]]
    with pytest.raises(FleetError, match="nothing to tell apart"):
        log_rc(windows_of(cool), cool, identified=found.identified)


@pytest.mark.slow
@pytest.mark.skipif(not LOGS.is_dir(), reason="the Gen3 logs are not beside this checkout")
def test_real_joint_2_passes_forty_degrees_as_foretold():
    recordings = read_folder(LOGS, damaged="skip")
    found = [log_rc(log_study(recordings, s, config=replace(CONFIG, epochs=10)), recordings) for s in range(3)]
    for each in found:
        print(each.below)
        print(each.every)
        assert each.below.auroc["rc, load planned"] >= 0.95
        assert each.every.auroc["rc, load planned"] >= 0.95
        assert each.below.auroc["rc, load continued"] > each.below.auroc["d"]
