"""The page of a twin report: its numbers on small inputs, what it says of missing data, and the documented commands."""

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from fleet.errors import FleetError
from fleet.motion import RATE_HZ
from scenarios.result_folder import json_text
from scenarios.show import twin_report as report
from scenarios.show.page import Page
from scenarios.table import Table
from twin.logs.recording import Recording
from twin.vae.config import TwinConfig
from twin.vae.measures import TAU
from twin.vae.twin import Twin
from twin.vae.window import cut

SMALL = report.Size(jobs=40, windows=80, epochs=(0, 2), epoch_seeds=1, strengths=(0.0, 1.0), generated=1)
TINY = TwinConfig(
    rate_hz=2.0, record_hz=2.0, window=20, stride=10, score_stride=20, hidden=6, epochs=3, restarts=1, max_windows=64,
    allow_collapse=True,
)  # fmt: skip


def logged(name: str, temp_2_c: float, *, seed: int = 0, minutes: float = 2.0, load: float = 1.0) -> Recording:
    """Sines at 2 Hz, all motors at 30 °C but for joint 2."""
    time_s = np.arange(0.0, 60 * minutes, 0.5)
    rng = np.random.default_rng(seed)
    q = 0.4 * np.sin(rng.uniform(0.2, 0.6, 7) * time_s[:, None] + rng.uniform(0, 6, 7))
    temp_c = np.full_like(q, 30.0)
    temp_c[:, 1] = temp_2_c
    qd, tau = np.gradient(q, time_s, axis=0), load * (20 * np.sin(q) + 8.0)
    return Recording(name=name, time_s=time_s, q=q, qd=qd, tau=tau, temp_c=temp_c)


COOL = [logged(f"cool_{i}", 35.0, seed=i) for i in range(8)]
HOT = [logged(f"hot_{i}", 45.0, seed=20 + i, load=3.0) for i in range(3)]


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    return report.log_subject([*COOL, *HOT], 3, size=SMALL, folder=folder, config=TINY)


@pytest.fixture(scope="module")
def chapters(subject):
    return {each.key: each for each in report.chapters_of([subject], SMALL)}


def words_of(page: str) -> str:
    """The text of a page, without its tags."""
    return unescape(re.sub(r"<[^>]*>", "", page))


def test_an_example_is_usual_in_every_channel():
    """By hand: the first row has the median sum, but a torque error of five times the median; the last is usual."""
    errors = np.array([[0.1, 0.1, 2.0], [1.0, 1.0, 0.1], [2.0, 2.0, 0.4], [0.9, 0.8, 0.5]])
    assert report.typical(errors) == 3
    assert report.typical(errors[:1]) == 0
    rng = np.random.default_rng(0)
    many = rng.lognormal(size=(200, 3))
    usual = many[report.typical(many)] / np.median(many, axis=0)
    assert np.all((usual > 0.7) & (usual < 1.4))
    # Units do not matter.
    assert report.typical(many * [1.0, 50.0, 0.01]) == report.typical(many)


def test_no_file_is_trained_on_and_tested(subject):
    names = report.training_files([*COOL, *HOT], 3)
    assert len(names) == 5
    assert set(subject.names) == {r.name for r in [*COOL, *HOT]} - names
    assert [name.startswith("hot") for name in subject.names] == subject.recorded_hot.tolist()
    assert report.training_files([*COOL, *HOT], 4) != names
    assert (subject.kind == report.HOT).sum() == 3 * len(cut(np.zeros((240, 3, 7)), TINY.window, TINY.stride))


def test_the_examples_are_the_most_typical_recordings_of_their_kind(subject):
    errors = subject.recorded.errors[:, 1]
    for hot, chosen in zip((False, True), subject.examples, strict=True):
        group = np.flatnonzero(subject.recorded_hot == hot)
        assert chosen == group[report.typical(errors[group])]


def test_training_data_are_beside_their_rms_torque(subject, chapters):
    (table,) = chapters["data"].tables
    every = np.concatenate([record[:, TAU] for record in subject.trained_on])
    assert table.rows[0][1:] == tuple(f"{v:.2f}" for v in np.sqrt((every**2).mean(axis=0)))
    tau = np.concatenate([r.tau[:, 1] for r in HOT])
    assert float(table.rows[2][2]) == pytest.approx(np.sqrt(np.mean(tau**2)), rel=0.05)


def test_a_whole_recording_is_reconstructed_in_si_units(subject, chapters):
    motion = subject.motion(0)
    recorded, made = report.reconstruct(subject.twin, motion)
    assert recorded.shape == made.shape == motion.shape == (240, 3, 7)
    np.testing.assert_allclose(recorded[:, 1:], motion[:, 1:], atol=1e-4)
    first = motion[None, : TINY.window].transpose(0, 1, 3, 2)
    np.testing.assert_allclose(made[: TINY.window], subject.twin.reconstruct(first)[0].transpose(0, 2, 1), atol=1e-6)
    short = report.reconstruct(subject.twin, motion[:7])
    assert short[0].shape == short[1].shape == (7, 3, 7)
    (table,) = chapters["reconstruction"].tables
    for row, i in zip((table.rows[0], table.rows[3]), subject.examples, strict=True):
        seen, again = report.reconstruct(subject.twin, subject.motion(i))
        assert row[1:4] == tuple(f"{e:.3g}" for e in np.abs(seen - again)[:, :, 1].mean(axis=0))
        assert float(row[4]) == pytest.approx(np.sqrt(np.mean(subject.motion(i)[:, TAU, 1] ** 2)), abs=0.06)


def test_the_latent_map_has_the_posterior_means_of_every_window(subject, chapters):
    data = chapters["latent"].charts[0].figure["data"]
    mu = subject.twin.posterior(subject.windows)[0][:, 1]
    cool, hot = (np.array([trace["x"], trace["y"]], dtype=float).T for trace in data[:2])
    np.testing.assert_allclose(cool, mu[~subject.window_hot], rtol=1e-3)
    np.testing.assert_allclose(hot, mu[subject.window_hot], rtol=1e-3)
    values = chapters["latent"].numbers["auroc"]
    tau = subject.windows[:, :, 1, TAU].astype(float)
    assert values["RMS torque"] == report.auroc(subject.window_hot, (tau**2).mean(axis=1))
    assert len(values) == 3


def test_the_difficulty_in_the_table_is_the_twins_score(subject, chapters):
    medians, ranks = chapters["difficulty"].tables
    scores = subject.twin.measures_of(subject.features)
    for row, kind in zip(medians.rows, (report.COOL, report.HOT), strict=False):
        chosen = subject.kind == kind
        expected = [*np.median(scores.difficulty[chosen], axis=0), np.median(scores.total[chosen])]
        assert row[1:] == tuple(f"{v:.3f}" for v in expected)
    hot = subject.kind == report.HOT
    by_name = dict(ranks.rows)
    assert by_name["d of joint 2"] == f"{report.auroc(hot, scores.difficulty[:, 1]):.3f}"
    assert by_name["RMS torque of joint 2"] == f"{report.auroc(hot, subject.features.torque_sq[:, 1]):.3f}"
    assert "d of joint 2, untrained network" in by_name


def test_an_event_that_never_or_always_happens_has_no_auroc():
    score = np.array([0.1, 0.4, 0.3, 0.9])
    assert report.auroc(np.array([False, True, False, True]), score) == 1.0
    assert np.isnan(report.auroc(np.ones(4, bool), score))


def test_generated_windows_lie_near_their_source(subject, chapters):
    (table,) = chapters["generation"].tables
    assert [row[0] for row in table.rows] == ["twin, s = 0", "twin, s = 1", "untrained network, s = 1"]
    made = subject.make(subject.twin, 0.0, 1)
    ((source, motion),) = made.pairs
    assert made.distance_rad == pytest.approx(np.sqrt(np.mean((motion - source)[:, 0] ** 2)))
    assert table.rows[0][2] == f"{made.distance_rad:.3f}"
    assert table.rows[0][3] == f"{np.sqrt(np.mean(source[:, TAU, 1] ** 2)):.1f}"
    assert table.rows[0][5] == "–"


def test_the_page_holds_every_chapter_in_the_order_of_the_paper(chapters, subject, tmp_path):
    origin = report.origin_of([subject]) | {"command": "thermofleet twin report <x>"}
    failed = report.write(list(chapters.values()), origin, tmp_path, "The twin & more")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    order = ["data", "latent", "reconstruction", "difficulty", "epochs", "generation"]
    assert re.findall(r'<section id="(\w+)"', text) == list(chapters) == order
    assert not re.search(r'(?:src|href)="(?!data:|#)', text)
    for words in ("The twin & more", "twin report <x>", subject.twin.version, "untrained", "RMS torque"):
        assert words in words_of(text)
    stored = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert stored["failed"] == failed == {}
    assert list(stored["chapters"]) == order
    assert all(len(chapter.charts) == 1 for chapter in chapters.values())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "report.json"]


def test_a_chapter_that_fails_leaves_its_reason_and_the_others(subject):
    cold = replace(subject, recorded_hot=np.zeros_like(subject.recorded_hot))
    chapters = report.chapters_of([cold], SMALL)
    failed = {each.key: each.failed for each in chapters if each.failed}
    assert set(failed) == {"data", "reconstruction", "difficulty"}
    assert "0 of 6 recordings or jobs get hot" in str(failed["data"])
    words = words_of(Page(title="Title", sections=chapters).html())
    assert "3 of 6 sections could not be computed: Training data" in words
    assert words.count("Not computed: ") == 3


def test_logs_that_cannot_be_studied_say_why(tmp_path):
    def subject_of(*recordings: Recording):
        return report.log_subject(recordings, 0, size=SMALL, folder=tmp_path, config=TINY)

    with pytest.raises(FleetError, match="0 of 1 logs stay below 40 °C on joint 2"):
        subject_of(logged("hot", 45.0))
    with pytest.raises(FleetError, match=r"None of the 1 test logs lasts 10 s"):
        subject_of(logged("a", 35.0), logged("hot", 45.0, minutes=0.1))
    with pytest.raises(FleetError, match="'blind' has no motor temperatures"):
        subject_of(replace(logged("blind", 35.0), temp_c=None))


def test_spread_is_the_sample_deviation():
    values = [0.1, 0.2, 0.6]
    assert report.spread(values) == f"{np.mean(values):.3f} ± {np.std(values, ddof=1):.3f}"
    assert report.spread([0.5]) == "0.500"
    assert report.spread([float("nan")]) == "–"


def test_not_a_number_becomes_null():
    values = {"dots": np.array([0.0, np.nan]), "none": float("nan"), "one": np.float64(1.5), "rows": ((1,),)}
    assert json.loads(json_text(values)) == {"dots": [0.0, None], "none": None, "one": 1.5, "rows": [[1]]}


def test_a_table_with_odd_rows_is_refused():
    with pytest.raises(ValueError, match="Every row needs 2 cells"):
        Table(head=("a", "b"), rows=(("1",),))


@pytest.fixture(scope="module")
def waves():
    rng = np.random.default_rng(2)
    time_s = np.arange(0, 8, 1 / RATE_HZ)
    jobs = []
    for _ in range(6):
        q = np.sin(np.outer(time_s, rng.uniform(0.5, 2.0, 2)) + rng.uniform(0, 6, 2))
        jobs.append([np.stack([q, np.gradient(q, 1 / RATE_HZ, axis=0), 10 * q], axis=1).astype(np.float32)])
    return jobs


SHORT = {"epochs": (0, 60), "seeds": (0, 1), "config": TwinConfig(hidden=8, restarts=1, batch=32), "records": 2}


def test_more_epochs_know_the_record_better(waves):
    tested = np.zeros((5, 12, 2, 3))
    errors, of_tested = report.epoch_study(waves, tested, **SHORT, workers=1)
    assert errors.shape == (2, 2, 2, 2, 3)  # trained on or held out, seed, epochs, joint, channel
    assert of_tested.shape == (2, 2, 5, 2)  # seed, epochs, window, joint
    known = errors[0].mean(axis=(2, 3))
    assert (known[:, 1] < known[:, 0]).all()


def test_too_few_jobs_are_refused(waves):
    with pytest.raises(ValueError, match="needs 10 cool jobs or more"):
        report.epoch_study(waves, np.zeros((5, 12, 2, 3)), **SHORT | {"records": 5})


@pytest.mark.slow
def test_the_documented_report_of_a_scenario_has_every_chapter(thermofleet, tmp_path):
    out = tmp_path / "report"
    thermofleet("twin", "report", "quickstart", "--out", out).succeeded()
    card = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert card["failed"] == {}
    assert card["origin"]["command"] == "thermofleet twin report quickstart --arm arm_0 --seeds 3"
    auroc = card["chapters"]["difficulty"]["numbers"]["auroc"]
    assert np.mean(auroc["d of joint 2"]) > 0.95
    assert np.mean(auroc["RMS torque of joint 2"]) > 0.95
    errors = card["chapters"]["reconstruction"]["numbers"]["mean_error_si"]
    assert errors["hot, twin"][TAU] > errors["cool, twin"][TAU]
    assert len(card["chapters"]["epochs"]["numbers"]["held out"][0]) == 6


LOGS = Path(__file__).parents[2] / "../shared/data/gen3_logs"


@pytest.mark.slow
@pytest.mark.skipif(not LOGS.is_dir(), reason="the Gen3 logs are not beside this checkout")
def test_the_hot_example_of_a_real_arm_is_reconstructed_worse_as_hot_motion_is(tmp_path):
    from twin.logs.reader import read_folder

    subject = report.log_subject(read_folder(LOGS), 0, size=report.SIZE, folder=tmp_path)
    assert isinstance(subject.twin, Twin)
    assert (subject.kind == report.HOT).sum() == 526
    chapter = report.reconstruction_chapter([subject], report.SIZE)
    errors = chapter.numbers["mean_error_si"]
    assert np.all(errors["hot, twin"] > errors["cool, twin"])
