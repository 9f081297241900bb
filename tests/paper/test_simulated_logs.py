"""Logs of the simulator: what its network simulates, and what is identified from them."""

import numpy as np
import pytest

from benchmarks.paper.subjects import Study, make_study
from fleet.heat.thermal import WINDING
from fleet.robot import JOINTS
from scenarios.prepare.identify import AIR_SD_K, own_logs
from twin.logs.recording import heat_logs
from twin.thermal.identify import HeatModel, Noise, ParameterVector, Problem, identify, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin


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
