"""Studies of real and simulated logs: forecasts, identification, and folds by file."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from benchmarks.paper.real_logs import (
    AHEAD_S,
    FORECAST,
    MOTION,
    NETWORK,
    QUESTIONS,
    Windows,
    answers,
    forecasts,
    judged_windows,
    peak_within,
)
from benchmarks.paper.subjects import Study, make_study
from fleet.errors import FleetError
from fleet.heat.thermal import WINDING
from fleet.robot import JOINTS
from scenarios.prepare.calibrate import AIR_SD_K, own_logs
from tests.logs import COOL, TINY, WARM
from twin.logs.recording import Recording, heat_logs
from twin.thermal.identify import HeatModel, Noise, ParameterVector, Problem, identify, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin

ONE_EPOCH = replace(TINY, epochs=1)


def made_up(file: list[str], d: list[float], rms: list[float], temp_c: list[float]) -> Windows:
    names = (*MOTION, *NETWORK)
    scores = {name: np.array(rms if name == "rms_torque" else d) for name in names}
    temps = np.array(temp_c)
    return Windows(
        file=np.array(file), fold=np.zeros(len(file), int), scores=scores, temp_c=temps, end_c=temps, peak_next_c=temps
    )


@pytest.mark.ci_slow
def test_a_lead_over_rms_torque_has_an_interval_over_files() -> None:
    """d ranks every window rightly, RMS torque is constant: AUROC 1 and ½ in every resample of the files."""
    file = [name for name in "abcdef" for _ in range(4)]
    temp_c = [45.0 if name in "abc" else 30.0 for name in file]
    found = answers(made_up(file, temp_c, [1.0] * len(file), temp_c))
    assert list(found) == list(QUESTIONS)[:1]  # nothing passes 40 °C from below, nothing gains 1 K
    (answer,) = found.values()
    assert [answer[each] for each in ("windows", "events", "files", "files_with")] == [24, 12, 6, 3]
    auroc, lead = answer["auroc"], answer["lead"]
    means = auroc["d"].mean, auroc["rms_torque"].mean, lead["d"].mean
    assert means == (1.0, 0.5, 0.5)
    assert lead["d"].note.startswith("no variation in ")
    # One file with the event: no interval over files.
    alone = [45.0 if name == "a" else 30.0 for name in file]
    assert answers(made_up(file, alone, alone, alone)) == {}


@pytest.mark.ci_slow
def test_the_forecast_is_judged_where_the_network_predicts() -> None:
    file = [name for name in "abcd" for _ in range(4)]
    before, after = np.full(16, 35.0), np.array([45.0, 35.0] * 8)
    windows = replace(made_up(file, list(after), [1.0] * 16, list(before)), peak_next_c=after)
    partly = {**windows.scores, "load planned": np.where(np.arange(16) < 12, after, np.nan)}
    found = answers(replace(windows, scores=partly))
    assert (found[FORECAST]["windows"], found["forecast"]["windows"]) == (16, 12)
    assert list(found[FORECAST]["auroc"]) == list(MOTION)
    assert list(found["forecast"]["auroc"]) == [*MOTION, *NETWORK]
    assert found["forecast"]["auroc"]["load planned"].mean == 1.0


def test_every_file_is_judged_once_by_models_that_do_not_know_it(tmp_path, monkeypatch) -> None:
    recordings, known = [*COOL, WARM, replace(WARM, name="warm_2")], list[set[str]]()

    def names_of(training, *, arm):
        known.append({r.name for r in training})

    monkeypatch.setattr("benchmarks.paper.real_logs.identify", names_of)
    monkeypatch.setattr("benchmarks.paper.real_logs.RcTwin.of", lambda _: RcTwin.nominal())
    windows = judged_windows(recordings, 0, config=ONE_EPOCH, folder=tmp_path)
    assert set(windows.file) == {r.name for r in recordings}
    for fold, training in enumerate(known):
        assert not training & set(windows.file[windows.fold == fold])
        assert not training & {"warm", "warm_2"}
    for name in np.unique(windows.file):
        assert len(np.unique(windows.fold[windows.file == name])) == 1
    assert len(np.unique(windows.fold)) == 5
    assert all(np.isfinite(windows.scores[name]).all() for name in MOTION)
    with pytest.raises(FleetError, match="needs 10 logs that stay below 40 °C on joint 2"):
        judged_windows(COOL[:9], 0, config=TINY, folder=tmp_path)
    with pytest.raises(ValueError, match="'cool_0' has no motor temperatures"):
        judged_windows([replace(COOL[0], temp_c=None)], 0, config=TINY, folder=tmp_path)


def test_the_next_peak_is_unknown_past_the_end():
    temp_c = np.full((1200, 7), 35.0)
    temp_c[600, 1] = 50.0  # at 300 s
    still = np.zeros((1200, 7))
    recording = Recording(name="a", time_s=np.arange(1200) / 2.0, q=still, qd=still, tau=still, temp_c=temp_c)
    assert peak_within(recording, 0.0, AHEAD_S)[1] == 50.0
    assert peak_within(recording, 299.0, AHEAD_S)[1] == 50.0
    assert np.isnan(peak_within(recording, 300.0, AHEAD_S)).all()


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


@pytest.mark.ci_slow
def test_a_known_load_tells_more_than_the_present_temperature():
    rng = np.random.default_rng(1)
    recordings = [heated(f"log {i}", load, rng) for i, load in enumerate(np.linspace(2.0, 6.0, 6))]
    twin = RcTwin.of(identify(recordings, ambient_sd_k=0.0))
    end_s = np.tile(np.arange(30.0, 590.0, 30.0), len(recordings))
    file = np.repeat([r.name for r in recordings], len(end_s) // len(recordings))
    continued, planned = forecasts(recordings, file, end_s, twin, past_s=25.0)
    by_name = {r.name: r for r in recordings}
    now = np.array([peak_within(by_name[name], end - 0.5, 0.5)[1] for name, end in zip(file, end_s, strict=True)])
    ahead = np.array([peak_within(by_name[name], end, AHEAD_S)[1] for name, end in zip(file, end_s, strict=True)])
    below = now < 40.0
    passes = ahead[below] >= 40.0
    auroc = [float(roc_auc_score(passes, score[below])) for score in (planned, continued)]
    assert auroc[0] > 0.99
    assert auroc[0] > auroc[1] > 0.5
    np.testing.assert_allclose(planned, ahead, atol=2.5)  # the simulated arm has no temperature coefficients


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
