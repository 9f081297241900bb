"""Sentences of the chapters on the value of a twin, from made-up results."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from scenarios.show.page import sections_page
from scenarios.studies.detection_metrics import Detection
from scenarios.studies.ranking import QUESTIONS, Quality, by_measure, side_by_side
from scenarios.studies.report import baseline_chapters as worth
from scenarios.studies.report import saturation_chapters as heat
from scenarios.studies.report.context import QUICK
from scenarios.studies.report.section_cache import plain
from scenarios.studies.saturation import Alarm, Prediction
from scenarios.studies.self_training import GENERATED, OWN, PRIOR
from twin.saturation.reliability import reliability


@pytest.fixture
def lab():
    return SimpleNamespace(seeds=(0, 1), size=QUICK, bench=None, progress=lambda stage, share: None)


def detected(value: float) -> Detection:
    return Detection(auroc=value, auprc=value - 0.1, spearman=value - 0.2, caught=0.9, false_novel=0.5)


def table_of(values: dict[str, float]) -> Quality:
    seeds = [{name: detected(v + extra) for name, v in values.items()} for extra in (0.0, 0.01)]
    return side_by_side([dict.fromkeys(QUESTIONS, seed) for seed in seeds])


def whole(section):
    """The section as page and as JSON, both of which must be possible."""
    assert section.failed is None
    assert section.pictures
    json.dumps(plain(dict(section.numbers)), allow_nan=False)
    return sections_page("t", [], [section])


def test_a_rival_that_wins_is_named_and_a_missed_target_too(lab, monkeypatch):
    monkeypatch.setattr(worth, "quality", lambda bench, networks: table_of({"VAE": 0.9, "kNN-5": 0.95, "PCA-2": 0.7}))
    section = worth.quality_chapter(lab)
    text = " ".join(section.sentences)
    assert "VAE is beaten by kNN-5 (AUROC +.050, AUPRC +.050, Spearman +.050). It beats PCA-2." in text
    assert "AUROC 0.905 ± 0.007 (target 0.93: not reached)" in text
    assert "Spearman 0.705 ± 0.007 (target 0.75: not reached)" in text
    assert [t.rows[1][2] for t in section.tables] == ["0.955 ± 0.007"] * 3
    assert "kNN-5" in whole(section)


def test_where_none_wins_it_says_so(lab, monkeypatch):
    monkeypatch.setattr(worth, "quality", lambda bench, networks: table_of({"VAE": 0.95, "PCA-2": 0.7}))
    section = worth.quality_chapter(lab)
    assert "with motion alone, VAE beats PCA-2." in " ".join(section.sentences)
    assert "beaten" not in " ".join(section.sentences[:-1])
    assert "AUROC 0.955 ± 0.007 (target 0.93: reached)" in section.sentences[0]


def test_saturation_names_the_head_with_the_least_brier(lab, monkeypatch):
    rng = np.random.default_rng(3)
    p = rng.uniform(size=300)
    passed = rng.uniform(size=300) < p

    def prediction(name, auroc, brier, peak_error_k=np.nan):
        table = reliability(p, passed)
        return Prediction(name=name, auroc=auroc, brier=brier, table=table, peak_error_k=peak_error_k)

    learned = [prediction(f"{evidence}, logistic", 0.9, b) for evidence, b in (("load", 0.07), ("errors", 0.04))]
    networks = prediction("rc nominal", 0.99, 0.03, 4.0), prediction("rc identified", 0.99, 0.02, 1.0)
    predictions = {p.name: [p, p] for p in (*learned, *networks)}
    alarms = {"sum": [Alarm(score="sum", false_alarms=0.05, false_novel=0.7, caught=0.2)] * 2}
    monkeypatch.setattr(heat, "saturation_study", lambda bench, **sizes: (predictions, alarms))
    section = heat.saturation_chapter(lab)
    assert "The best head of the learned twin (errors, logistic)" in section.sentences[0]
    assert (
        "AUROC 0.900 ± 0.000 (target 0.97: not reached), Brier 0.040 ± 0.000 (target 0.05: reached)"
        in (section.sentences[0])
    )
    assert (
        "1.0 ± 0.0 K instead of 4.0 ± 0.0 K: it improves temperatures rather than the ranking." in section.sentences[2]
    )
    assert section.tables[1].rows == (("sum", "0.050 ± 0.000", "0.700 ± 0.000", "0.200 ± 0.000"),)
    assert [row[0] for row in section.tables[0].rows] == [
        "load, logistic",
        "errors, logistic",
        "rc nominal",
        "rc identified",
    ]
    whole(section)


def test_coverage_says_from_what_to_what(lab, monkeypatch):
    before = Detection(auroc=0.9, auprc=0.8, spearman=0.7, caught=0.9, false_novel=0.8)
    after = Detection(auroc=0.9, auprc=0.8, spearman=0.7, caught=0.9, false_novel=0.1)
    found = {0: {"sum": by_measure([before] * 2)}, QUICK.explored: {"sum": by_measure([after] * 2)}}
    monkeypatch.setattr(worth, "coverage", lambda bench, **sizes: found)
    section = worth.coverage_chapter(lab)
    assert "from 80% to 10%" in section.sentences[0]
    whole(section)


def test_autonomy_counts_what_remains_above_chance(lab, monkeypatch):
    found = table_of({OWN: 0.9, GENERATED: 0.7, PRIOR: 0.6})
    monkeypatch.setattr(worth.self_training, "autonomy", lambda bench, **sizes: found)
    section = worth.autonomy_chapter(lab)
    remaining = section.numbers["remaining"]["auroc"]
    np.testing.assert_allclose(remaining, [0.2 / 0.4, 0.21 / 0.41])
    assert "51% of the AUROC above chance" in section.sentences[0]
    whole(section)


@pytest.mark.parametrize(
    ("latent", "said"), [((5.0, 4.0), "Raw features beat latent ones"), ((2.0, 4.0), "with 10 labels (ridge)")]
)
def test_transfer_says_with_how_many_labels_the_latent_helps(lab, monkeypatch, latent, said):
    rows = {
        (name, "ridge", n): {"rmse_k": [e, e + 0.2], "r2": [0.5, 0.6]}
        for name, errors in (("latent", latent), ("raw", (3.0, 2.0)))
        for n, e in zip((10, 50), errors, strict=True)
    }
    monkeypatch.setattr(worth, "transfer", lambda bench, **sizes: rows)
    section = worth.transfer_chapter(lab)
    assert said in section.sentences[0]
    whole(section)
