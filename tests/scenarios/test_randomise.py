"""`--randomise` of `thermofleet compare` and `thermofleet train`."""

import json
import re
from dataclasses import replace

import pytest

from fleet.errors import FleetError, ScenarioError
from scenarios.cli.options import parse_randomisation
from scenarios.evaluate import runner
from scenarios.evaluate.rollout import outcomes
from scenarios.evaluate.store import read_rows
from scenarios.evaluate.study import Case, Study
from scenarios.prepare.fleet import prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.spec.load import load
from scenarios.spec.parse import override

VARIED = Randomisation(ambient_k=(-5.0, 15.0), arrivals=(0.5, 2.0), variants=[{"spread": {"scale": 2.0, "seed": 9}}])
BLIND = ("--policies", "random,round_robin", "--difficulty", "blind", "--seeds", 2, "--workers", 1)


def study_of(*scenarios, randomise: Randomisation | None = VARIED) -> Study:
    cases = [Case(name=each.name, scenario=each, seeds=(0, 1, 2, 3)) for each in scenarios]
    return Study(policies=["random", "round_robin"], cases=cases, difficulties=["blind"], randomise=randomise)


def test_a_constant_offset_equals_a_scenario_with_a_warmer_cell(thermofleet, small_toml, tmp_path):
    warm = tmp_path / "warm.toml"
    warm.write_text(small_toml.read_text() + "[ambient]\npoints = [[0, 40]]\n", encoding="utf-8")
    assert load(small_toml).ambient.points == ((0.0, 25.0),)
    for name, file, more in (
        ("offset", small_toml, ("--randomise", "ambient_k=[15, 15]")),
        ("warm", warm, ()),
        ("cool", small_toml, ()),
    ):
        thermofleet("compare", file, *BLIND, "--out", tmp_path / name, *more).succeeded()
    offset, warm, cool = ([row.outcome for row in read_rows(tmp_path / name)] for name in ("offset", "warm", "cool"))
    for one, other, without in zip(offset, warm, cool, strict=True):
        assert one is not None
        assert other is not None
        assert without is not None
        assert one.peak_c == pytest.approx(other.peak_c, abs=0.01)  # losses at rest depend on the temperature
        assert (one.reward, one.finished) == pytest.approx((other.reward, other.finished), abs=0.01)
        assert one.peak_c > without.peak_c + 10
        assert one.reward != without.reward


def test_instances_of_one_cell_keep_their_own_jobs_in_variants(small_toml, plans):
    scenario = load(small_toml)
    hold, sort = scenario.jobs
    worth = replace(scenario, name="worth", jobs=(hold, replace(sort, value=3.0, repetitions=(2, 4))))
    rows = runner.run_study(study_of(scenario, worth), cache_dir=plans, workers=1)
    fleet = prepare(worth, difficulty="blind", randomise=VARIED, cache=plans)
    alone = [each for policy in ("random", "round_robin") for each in outcomes(fleet, policy, range(4))]
    assert [row.outcome for row in rows if row.key.instance == "worth"] == alone


def test_results_say_how_they_were_randomised(thermofleet, small_toml, tmp_path):
    how = ("compare", small_toml, *BLIND, "--out", tmp_path / "out")
    ambient, arrivals = ("--randomise", "ambient_k=[-2, 8]"), ("--randomise", "arrivals=[1,1.5]")
    said = thermofleet(*how, *ambient, *arrivals).succeeded()
    text = "Randomisation: ambient temperature -2 to +8 K, arrival rate times 1 to 1.5."
    assert text in said.out.replace("\n", "")
    assert "references are of shifts without randomisation" in said.out
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert text in page
    assert "--randomise &#39;ambient_k=[-2, 8]&#39; --randomise &#39;arrivals=[1,1.5]&#39;" in page
    expected = {"ambient_k": [-2.0, 8.0], "arrivals": [1.0, 1.5], "variants": []}
    assert json.loads((tmp_path / "out" / "study.json").read_text())["randomise"] == expected
    same = thermofleet(*how, "--randomise", "arrivals=[1.0, 1.5]\nambient_k=[-2.0, 8.0]", "--json")  # of a file, say
    assert json.loads(same.out)["randomise"] == expected
    for other in ((), ambient):
        assert thermofleet(*how, *other).refused("holds a study with randomise")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["ambient_k"], r"--randomise must be FIELD=VALUE in TOML, as in .+ \(got 'ambient_k'\)"),
        (["arrivals=[1,2]", "# ambient_k=[1,2]"], r"--randomise must be FIELD=VALUE in TOML"),
        (["ambient=[1,2]"], "--randomise has no field 'ambient'; did you mean 'ambient_k'"),
        (["arrivals=[1,2]", "arrivals=[1,3]"], "--randomise arrivals is given twice"),
        (["ambient_k=[2,1]"], r"--randomise ambient_k must be two finite numbers, low <= high \(got \[2, 1\]\)"),
        (["ambient_k=[0,1" + "0" * 400 + "]"], "--randomise ambient_k must be two finite numbers"),
        (["arrivals=[0,1]"], "--randomise arrivals must be > 0 and at most 100"),
        (["variants=[]"], r"--randomise changes nothing \(got 'variants=\[\]'\); leave it out"),
        (["variants={slots=3}"], "--randomise variants must be a list of dictionaries"),
    ],
)
def test_invalid_text_is_refused(given, message):
    with pytest.raises(FleetError, match=message):
        parse_randomisation(given)


def test_text_gives_the_same_value_as_python():
    texts = ["ambient_k=[-5, 15]", "arrivals=[0.5,2]\nvariants=[{spread={scale=2.0,seed=9}}]"]
    assert parse_randomisation(texts) == VARIED
    assert parse_randomisation(None) is None
    assert not Randomisation(ambient_k=(0, 0))
    lists = Randomisation(ambient_k=[-5, 15], arrivals=[0.5, 2], variants=VARIED.variants)  # pyright: ignore[reportArgumentType]
    assert hash(lists) == hash(VARIED)
    dated = parse_randomisation(["variants=[{name=2020-01-01}]"])
    assert dated == Randomisation(variants=[{"name": "2020-01-01"}])


def test_commands_refuse_what_cannot_be_randomised(thermofleet, small_toml, tmp_path):
    file = tmp_path / "references.jsonl"
    file.touch()
    for words, message in (
        (("compare", small_toml, "--randomise", "ambient_k=[0,1]", "--references", file), "Give either --references"),
        (("compare", small_toml, "--randomise", "ambient_k=[0,99]"), "ambient_k (0.0, 99.0) goes too far"),
        (("compare", small_toml, "--randomise", "variants=[{slots=3}]"), "a variant must keep the slots"),
        (("compare", small_toml, "--randomise", "x=1"), "--randomise has no field 'x'"),
        (("train", small_toml, "--randomise", "x=1"), "--randomise has no field 'x'"),
        (("train", "--suite", "train", "--randomise", "ambient_k=[0,1]"), "--randomise needs a scenario"),
    ):
        assert thermofleet(*words).refused(message)
    scenario = override(load(small_toml), ambient={"points": [[0, 55]]})
    with pytest.raises(ScenarioError, match="goes too far"):
        study_of(scenario)


def test_a_training_is_randomised_and_says_so(thermofleet, small_toml, tmp_path):
    pytest.importorskip("torchrl")
    how = ("train", small_toml, "--difficulty", "blind", "--envs", 2, "--iterations", 1)
    best = {}
    for name, more in (("hot", ("--randomise", "ambient_k=[20, 35]")), ("plain", ())):
        said = thermofleet(*how, "--out", tmp_path / name, *more).succeeded()
        assert re.search(r"Saved: iteration (0 \(an untrained network\)|1),", said.out)
        first = json.loads((tmp_path / name / "progress.jsonl").read_text().splitlines()[0])
        best[name] = first["validation"]  # of the same network
        cards = [json.loads((tmp_path / name / file).read_text()) for file in ("training.json", "policy.json")]
        expected = {"ambient_k": [20.0, 35.0], "arrivals": [1.0, 1.0], "variants": []} if more else None
        assert [card["randomise"] for card in cards] == [expected, expected]
    assert best["hot"] < best["plain"]
    for name, more in (("hot", ()), ("plain", ("--randomise", "arrivals=[1,2]"))):
        assert thermofleet(*how, "--out", tmp_path / name, "--resume", *more).refused("has randomise = ")
