"""Sources of scores, and the command that compares them."""

import csv
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from fleet.difficulty import KNOWN, Difficulty, Forecast
from scenarios.studies import ablation
from scenarios.studies.ablation import FIGURES
from scenarios.studies.score_sources import SOURCES, _Inverted, _Random


def plan(profile: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(arm="a", cycle=SimpleNamespace(profile=profile))


def test_random_scores_are_uniform_and_repeat() -> None:
    rng, scores = np.random.default_rng(0), _Random(3)
    plans = [plan(rng.standard_normal((20, 3, 7))) for _ in range(400)]
    drawn = np.array([[*score.per_joint, score.p_saturation] for score in (scores.score(each, 4) for each in plans)])
    assert stats.kstest(drawn.ravel(), "uniform").pvalue > 0.01
    assert scores.score(plans[0], 4).per_joint.tolist() == drawn[0, :7].tolist()
    assert _Random(4).score(plans[0], 4).per_joint.tolist() != drawn[0, :7].tolist()


def test_the_inverse_has_the_opposite_order_and_probability() -> None:
    risk = Forecast(np.array([-3.0]), np.full((1, KNOWN), 0.05))
    hard = SimpleNamespace(version="v", score=lambda *_: Difficulty(np.linspace(0.0, 0.9, 7), risk=risk))
    opposite, known_c = _Inverted(hard).score(plan(np.zeros((2, 3, 7))), 1), np.full(KNOWN, 30.0)
    assert opposite is not None
    assert opposite.per_joint == pytest.approx(np.linspace(1.0, 0.1, 7))
    assert (opposite.per_joint < 1.0).all()
    assert opposite.p_at(known_c) == pytest.approx(1.0 - risk.at(known_c))


def test_the_command_resumes_and_shows_every_source(thermofleet, small_toml, tmp_path, monkeypatch) -> None:
    out = tmp_path / "ablation"
    scores = "blind,random,constant,oracle,round_robin@blind"
    call = ("ablate", small_toml, "--fleets", 2, "--sources", scores, "--out", out, "--policy", "wspt")
    done = thermofleet(*call, "--seeds", 2)
    assert done.code == 0, done.err
    for name in scores.split(","):
        policy, _, source = name.rpartition("@")
        assert done.out.count(f"  {policy and f'{policy}, '}{SOURCES[source].label} ") == len(FIGURES)
    with (out / "ablation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * (1 + 2 + 1 + 1 + 1)  # random numbers have two trainings
    card = json.loads((out / "ablation.json").read_text())
    mean = np.mean([float(row["reward"]) for row in rows if row["scores"] == "random"])
    assert card["effects"]["random"]["reward"]["mean"] == pytest.approx(mean)
    alone = tmp_path / "alone"
    call_alone = (*call[:4], "--sources", "blind", "--policy", "round_robin", "--out", alone)
    assert thermofleet(*call_alone, "--seeds", 2).code == 0
    same = json.loads((alone / "ablation.json").read_text())["effects"]["blind"]["value"]["mean"]
    assert card["effects"]["round_robin@blind"]["value"]["mean"] == same

    asked = []
    real = ablation.outcomes
    monkeypatch.setattr(
        ablation, "outcomes", lambda fleet, policy, seeds: asked.append(seeds) or real(fleet, policy, seeds)
    )
    assert thermofleet(*call, "--seeds", 3).code == 0
    assert asked == [[10_002]] * 12
    before = (out / "ablation.csv").read_bytes()
    (out / "ablation.csv").write_bytes(before[:-9])  # killed within a row
    assert thermofleet(*call, "--seeds", 3).code == 0
    assert (out / "ablation.csv").read_bytes() == before
    refused = thermofleet(*call[:-1], "random", "--seeds", 3)
    assert refused.code == 2
    assert "holds an ablation with policy 'wspt', not 'random'; give another --out" in refused.err


def test_bad_sources_are_named(thermofleet, small_toml, tmp_path) -> None:
    said = thermofleet("ablate", small_toml, "--sources", "trained,oracel", "--out", tmp_path / "x")
    assert said.code == 2
    assert "No source of predictions 'oracel'; did you mean 'oracle'?" in said.err
    assert not (tmp_path / "x").exists()
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("x")
    said = thermofleet("ablate", small_toml, "--sources", "blind,constant", "--out", full)
    assert said.code == 2
    assert "holds other files" in said.err
