"""Readings of a twin's errors, the sides of its latent space, and questions on logs: by hand and by made-up windows."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper.readings import JOINTS, MEASURES, TOTALS, Errors, reading_cells, share_of
from benchmarks.paper.real_logs import QUESTIONS, Windows, answers, judged_windows
from fleet.errors import FleetError
from scenarios.evaluate.statistics import interval
from tests.logs import COOL, TINY, WARM
from twin.vae.measures import PARTS, Calibration, Features, moments


def windows_of(file: list[str], d: list[float], rms: list[float], temp_c: list[float]) -> Windows:
    scores = {"d": np.array(d), "load": np.array(d), "latent": np.array(d), "rms_torque": np.array(rms)}
    temps = np.array(temp_c)
    return Windows(
        file=np.array(file), fold=np.zeros(len(file), int), scores=scores, temp_c=temps, end_c=temps, peak_next_c=temps
    )


def test_a_lead_over_rms_torque_has_an_interval_over_files() -> None:
    """d ranks every window rightly, RMS torque is constant: AUROC 1 and ½, whichever files are drawn."""
    file = [name for name in "abcdef" for _ in range(4)]
    temp_c = [45.0 if name in "abc" else 30.0 for name in file]
    found = answers(windows_of(file, temp_c, [1.0] * len(file), temp_c))
    assert list(found) == list(QUESTIONS)[:1]  # nothing passes 40 °C from below, nothing gains 1 K
    (answer,) = found.values()
    assert [answer[each] for each in ("windows", "events", "files", "files_with")] == [24, 12, 6, 3]
    auroc, lead = answer["auroc"], answer["lead"]
    means = auroc["d"].mean, auroc["rms_torque"].mean, lead["d"].mean
    assert means == (1.0, 0.5, 0.5)
    assert lead["d"].note.startswith("no variation in ")
    # One file with the event: no interval over files.
    alone = [45.0 if name == "a" else 30.0 for name in file]
    assert answers(windows_of(file, alone, alone, alone)) == {}


def test_every_file_is_judged_once_by_a_twin_that_does_not_know_it(tmp_path) -> None:
    recordings = [*COOL, WARM, replace(WARM, name="warm_2")]
    windows = judged_windows(recordings, 0, config=replace(TINY, epochs=1), folder=tmp_path)
    assert set(windows.file) == {r.name for r in recordings}
    for name in np.unique(windows.file):
        assert len(np.unique(windows.fold[windows.file == name])) == 1
    assert len(np.unique(windows.fold)) == 5
    assert all(np.isfinite(score).all() for score in windows.scores.values())
    with pytest.raises(FleetError, match="needs 10 logs that stay below 40 °C on joint 2"):
        judged_windows(COOL[:9], 0, config=TINY, folder=tmp_path)


def test_readings_rank_more_error_higher_and_tell_jobs_apart() -> None:
    rng = np.random.default_rng(4)
    known = Features(rng.gamma(2.0, 0.2, (40, 7, PARTS + moments(2))))
    calibration = Calibration(known, np.zeros(40, int))
    less = known.packed[:10]
    more = less.copy()
    more[..., :PARTS] *= 1.7
    weight = rng.dirichlet(np.ones(7)) * 7
    for name, reading in {**TOTALS, **JOINTS}.items():
        low, high = (reading(Errors(Features(packed), calibration, weight)) for packed in (less, more))
        assert np.all(high >= low), name
        if not name.startswith("latent"):
            assert np.any(high > low), name


def test_shares_have_their_intervals() -> None:
    share, low, high = share_of(np.repeat([True, False], [9, 1]))
    # Wilson's interval of 9 of 10, Agresti & Coull, The American Statistician 52 (1998): centre (9 + 1.92) / 13.84.
    assert share == 0.9
    assert (low + high) / 2 == pytest.approx((9 + 1.96**2 / 2) / (10 + 1.96**2), abs=1e-3)


def test_readings_are_means_over_arms_not_over_their_seeds() -> None:
    values = {"s/a/0": 1.0, "s/a/1": 3.0, "s/b/0": 5.0, "s/b/1": None, "s/c/0": 6.0, "s/c/1": 6.0}
    measures = {name: dict.fromkeys(MEASURES) | {"auroc": value} for name, value in values.items()}
    rows = [{"arm": name, "any": {"d": each}} for name, each in measures.items()]
    ((reading, found),) = reading_cells(rows, "any").items()
    assert reading == "d"
    assert found["auroc"] == interval([2.0, 5.0, 6.0])
    assert np.isnan(found["hits"].mean)
