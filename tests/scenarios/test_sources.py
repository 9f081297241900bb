"""Sources of predictions, and comparisons of them."""

import json
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from fleet.difficulty import KNOWN, Difficulty, Forecast
from scenarios.evaluate import runner
from scenarios.evaluate.rollout import FIGURES
from scenarios.evaluate.sources import _Random, inverted
from scenarios.evaluate.store import read_rows


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
    opposite, known_c = inverted(hard).score(plan(np.zeros((2, 3, 7))), 1), np.full(KNOWN, 30.0)
    assert opposite is not None
    assert opposite.per_joint == pytest.approx(np.linspace(1.0, 0.1, 7))
    assert (opposite.per_joint < 1.0).all()
    assert opposite.p_at(known_c) == pytest.approx(1.0 - risk.at(known_c))


QUICK: dict[str, list[float]] = {
    "wspt@rc-nominal": [5.99749417852418, 8.997540478131903, 5.997348023627421, 8.997400913679169],
    "wspt@random": [
        5.997495397180928,
        8.997542830431069,
        5.99749417852418,
        8.997541705519062,
        5.99734675079658,
        8.997398132164946,
        5.99734675079658,
        8.997398382846647,
    ],
    "wspt@constant": [5.99749417852418, 8.997540225994873, 5.997348023627421, 8.997401117223173],
    "wspt@blind": [5.99749417852418, 8.997540225994873, 5.997348023627421, 8.997401117223173],
    "wspt@oracle": [5.99749417852418, 8.997540225994873, 5.997348023627421, 8.997401117223173],
    "round_robin@blind": [5.997494576202657, 8.997540477589707, 5.9973476880432175, 8.997400912449335],
}
"""Rewards of the small scenario with seeds 10000 and 10001, of each of two fleets and two trainings, as an earlier
implementation, `thermofleet ablate`, computed them."""
TRAINED: dict[str, list[float]] = {
    "wspt@trained": [
        5.997495397180928,
        8.997542830431069,
        5.997495397180928,
        8.997541460698054,
        5.99734675079658,
        8.997398383369463,
        5.99734675079658,
        8.997398629429464,
    ],
    "wspt@unweighted": [
        5.997495397180928,
        8.997543052291434,
        5.997495397180928,
        8.997543052291434,
        5.99734675079658,
        8.997398132164946,
        5.99734675079658,
        8.997398132164946,
    ],
    "wspt@untrained": [
        5.99749417852418,
        8.997540478131903,
        5.997495397180928,
        8.99754169904697,
        5.99734675079658,
        8.99739964131719,
        5.99734675079658,
        8.997398383369463,
    ],
    "wspt@torque": [5.997495397180928, 8.9975423294294, 5.99734675079658, 8.997398132164946],
    "wspt@weighted-torque": [5.99749417852418, 8.997540225994873, 5.997348023627421, 8.997401117223173],
    "wspt@rc": [5.99749417852418, 8.997540225994873, 5.997348023627421, 8.997401117223173],
    "wspt@inverted": [
        5.99749417852418,
        8.997541466873425,
        5.99749417852418,
        8.997541961857248,
        5.997348023627421,
        8.997399875725273,
        5.997348023627421,
        8.997399651469813,
    ],
    "least_difficulty@rc": [5.9974948357982685, 8.997541818562766, 5.997347333903775, 8.997399587617933],
}


def rewards(thermofleet, file: Path, out: Path, names: Iterable[str]) -> dict[str, list[float]]:
    """Of each POLICY@SOURCE, in the order of `QUICK`."""
    how = ("--fleets", 2, "--trainings", 2, "--seeds", 2, "--first-seed", 10_000, "--out", out)
    done = thermofleet("compare", file, "--policies", ",".join(names), *how)
    assert done.code == 0, done.err
    found: dict[str, list[float]] = {}
    for row in read_rows(out):
        assert row.outcome is not None
        found.setdefault(f"{row.key.policy}@{row.key.difficulty}", []).append(row.outcome.reward)
    return found


def test_sources_have_the_rewards_that_they_always_had(thermofleet, small_toml, tmp_path) -> None:
    assert rewards(thermofleet, small_toml, tmp_path / "out", QUICK) == QUICK


@pytest.mark.slow
def test_trained_sources_have_the_rewards_that_they_always_had(thermofleet, small_toml, tmp_path) -> None:
    small_toml.write_text(f'{small_toml.read_text()}\n[twin]\nsize = "quick"\n')
    assert rewards(thermofleet, small_toml, tmp_path / "out", TRAINED) == TRAINED


def test_a_comparison_of_sources_resumes(thermofleet, small_toml, tmp_path, monkeypatch) -> None:
    out = tmp_path / "sources"
    how = ("--fleets", 2, "--trainings", 2, "--first-seed", 10_000, "--workers", 1)
    names = ("--policies", "wspt,round_robin@blind", "--difficulty", "blind,random,constant,oracle")
    call = ("compare", small_toml, *names, *how, "--out", out)
    done = thermofleet(*call, "--seeds", 2)
    assert done.code == 0, done.err
    for name in ("wspt@blind", "wspt@random", "wspt@constant", "wspt@oracle", "round_robin@blind"):
        assert done.out.count(f"  {name} ") == 1 + len(FIGURES)  # its scope, and each figure
    assert len(read_rows(out)) == 2 * 2 * (1 + 2 + 1 + 1 + 1)  # random numbers have two trainings
    again = thermofleet(*call, "--seeds", 2, "--json")
    alone = thermofleet("compare", small_toml, "--policies", "round_robin", "--difficulty", "blind", *how, "--seeds", 2,
                        "--json")  # fmt: skip
    in_all, single = (json.loads(each.out)["figures"] for each in (again, alone))
    assert in_all["round_robin@blind"]["value"]["mean"] == single["round_robin"]["value"]["mean"]

    units, real = [], runner.run_unit
    monkeypatch.setattr(runner, "run_unit", lambda unit, settings: units.append(unit) or real(unit, settings))
    assert thermofleet(*call, "--seeds", 3).code == 0
    assert [unit.case.seeds for unit in units] == [(10_002,)] * 12


def test_bad_sources_are_named(thermofleet, small_toml) -> None:
    for words in (("--difficulty", "trained,oracel"), ("--policies", "wspt@oracel")):
        said = thermofleet("compare", small_toml, *words)
        assert said.code == 2
        assert "No difficulty 'oracel'; did you mean 'oracle'?" in said.err
    said = thermofleet("compare", small_toml, "--policies", "wspt,wspt@blind", "--difficulty", "blind")
    assert said.code == 2
    assert "The policy 'wspt@blind' is given twice" in said.err
