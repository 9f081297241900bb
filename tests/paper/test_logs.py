"""Studies of real and simulated logs: identification, and folds by file."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper.real_logs import AHEAD_S, MOTION, QUESTIONS, Windows, answers, judged_windows, peak_within
from benchmarks.paper.subjects import Study, make_study
from fleet.errors import FleetError
from fleet.heat.thermal import WINDING
from fleet.robot import JOINTS
from scenarios.prepare.calibrate import own_logs
from tests.logs import COOL, TINY, WARM
from twin.logs.recording import Recording, cool_stretches, heat_logs
from twin.thermal.identify import Noise, ParameterVector, Problem, nominal_heat_model
from twin.thermal.thermal_twin import RcTwin

ONE_EPOCH = replace(TINY, epochs=1)


def made_up(file: list[str], d: list[float], rms: list[float], temp_c: list[float]) -> Windows:
    scores = {name: np.array(rms if name == "rms_torque" else d) for name in MOTION}
    temps = np.array(temp_c)
    return Windows(
        file=np.array(file), fold=np.zeros(len(file), int), scores=scores, temp_c=temps, end_c=temps, peak_next_c=temps
    )


@pytest.mark.slow
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


def test_every_file_is_judged_once_by_a_twin_that_does_not_know_it(tmp_path, monkeypatch) -> None:
    recordings, known = [*COOL, WARM, replace(WARM, name="warm_2")], list[set[str]]()

    def names_of(training, *arguments, **options):
        known.append({r.name for r in training})
        return cool_stretches(training, *arguments, **options)

    monkeypatch.setattr("benchmarks.paper.real_logs.cool_stretches", names_of)
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


@pytest.fixture(scope="module")
def study() -> Study:
    return make_study(np.random.SeedSequence(5), train=0, reference=0, test=160, novel=0)


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
