"""The names of `import thermofleet`: each is there, loaded when it is used, and works from the name of a scenario."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import thermofleet as tf
from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError
from scenarios.spec.options import LiveSpec, RunSpec, StudySpec
from scenarios.table import Table
from tests.logs import COOL, TINY
from twin.vae.config import TwinConfig

ROOT = Path(__file__).parents[2]


def python(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = f"import sys; sys.path[:0] = [{str(folder)!r}, {str(ROOT)!r}]; "
    return subprocess.run([sys.executable, "-c", path + code], capture_output=True, text=True, check=False, timeout=300)


def test_every_public_name_is_there_and_nothing_heavy_is_loaded_before_it_is_used(tmp_path):
    assert set(tf.__all__) | {"__version__"} <= set(dir(tf))
    assert all(getattr(tf, name) is not None for name in dir(tf))
    heavy = "('torch', 'mujoco', 'zenoh', 'numba', 'numpy')"
    done = python(f"import thermofleet; print([m for m in {heavy} if m in sys.modules])", tmp_path)
    assert done.stdout == "[]\n"


def test_a_wrong_name_is_answered_with_the_right_ones():
    with pytest.raises(AttributeError, match=r"module 'thermofleet' has no attribute 'runn'; it has .*\brun\b"):
        _ = tf.runn  # pyright: ignore


def test_a_file_of_the_user_with_the_name_of_a_package_is_named(tmp_path):
    (tmp_path / "fleet.py").write_text("")
    done = python("import thermofleet; thermofleet.load", tmp_path)
    said = done.stderr.splitlines()[-1]
    assert said.startswith(
        f"ImportError: Python finds '{tmp_path / 'fleet.py'}' instead of thermofleet's package 'fleet'"
    )
    assert "rename your file or folder" in said


def test_a_shift_and_a_comparison_from_the_file_of_a_scenario(small_toml, plans, tmp_path):
    shift = tf.run(small_toml, policy="round_robin", seed=3, difficulty="blind", out=tmp_path / "run")
    rows = shift.telemetry.to_pandas()
    assert len(rows) == len(shift.readings.time_s) * len(shift.arms)
    again = tf.open_run(tmp_path / "run")
    assert (again.metrics, again.reward, len(again.events)) == (shift.metrics, shift.reward, len(shift.events))
    assert "<" in shift._repr_html_()
    assert repr(shift) == f"<RunLog of {shift.scenario.name}, round_robin, seed 3: reward {shift.reward:.1f}>"
    seeds: Any = np.arange(2)
    result = tf.compare(small_toml, ["round_robin", "wspt"], seeds=seeds, difficulty="blind", workers=1)
    assert [type(seed) for seed in result.seeds] == [int, int]
    assert result.baseline == "round_robin"
    assert "wspt" in result.table.markdown()


class Mine:
    """A policy in a notebook."""


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: tf.compare("quickstart", "wsept"), r"policies must be a list of names, .* \(got 'wsept'\)"),  # pyright: ignore
        (lambda: tf.compare("quickstart", ["wsept", Mine]), r"A policy is given by name: .*'mine.py:Mine' for a class"),  # pyright: ignore
        (
            lambda: tf.compare("quickstart", ["wspt"], difficulty="rc-nominl"),
            "No difficulty 'rc-nominl'; did you mean 'rc-nominal'",
        ),
        (lambda: tf.compare("quickstart", ["wsept"], seeds=[0, 1, 0]), "Seed 0 is given twice"),
        (lambda: tf.compare("quickstart", ["wsept"], seeds=[1.5]), r"seed must be an integer from 0 to \d+ \(got 1.5"),  # pyright: ignore
        (lambda: tf.compare("quickstart", ["wsept"], seeds=np.array([0.0])), r"seed must be an integer .* \(got 0\.0"),
        (lambda: tf.compare("quickstart", ["wsept"], seeds=np.array(3)), r"list of integers"),
        (lambda: tf.compare("quickstart", ["wsept"], seeds=[0, np.int64(0)]), "Seed 0 is given twice"),
        (lambda: tf.compare("quickstart", ["wsept"], seeds=3), r"list of integers, for example range\(3\) \(got 3\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", policy=Mine), "A policy is given by name"),
        (lambda: tf.run("quickstart", seed=1.5), r"^seed must be an integer \(got 1.5\)"),
        (lambda: tf.run("quickstart", polcy="wspt"), r"no option 'polcy'; did you mean 'policy'\? Allowed: bus, "),
        (lambda: tf.prepare("quickstart", training=1.5), r"training must be an integer >= 0 \(got 1.5\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", "wspt"), r"^Options are given by name, as policy='wspt' \(got 'wspt'\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", channel="star"), r"^channel must be of type Channel, .* \(got 'star'\)"),
        (lambda: tf.run("quickstart", record="no"), r"record must be True or False \(got 'no'\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", progress=None), r"progress must be a function of .* \(got None\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", stopped=None), r"stopped must be a function without .* \(got None\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", endpoint="tcp/x:1"), r"endpoint needs bus='zenoh' \(.* and bus='memory'\)"),
        (lambda: tf.run("quickstart", out=3), r"out must be the path of a folder \(got 3\)"),  # pyright: ignore
        (lambda: tf.run("quickstart", out=""), r"out must be the path of a folder \(got ''\)"),
        (lambda: tf.run("quickstart", out=ROOT), r"holds other files .*; out needs a new folder"),
        (lambda: tf.run("quickstart", out=ROOT / "x.csv"), r"^out must be a folder, without the ending"),
        (lambda: tf.open_run(None), r"folder must be the path of a folder \(got None\)"),  # pyright: ignore
        (lambda: tf.compare("quickstart", ["wspt"], channel=3), r"channel must be of type Channel, .* \(got 3\)"),  # pyright: ignore
        (lambda: tf.compare("quickstart", ["wspt"], workers=1.5), r"workers must be an integer >= 1, .* \(got 1.5\)"),  # pyright: ignore
        (lambda: tf.compare("quickstart", ["wspt"], progress=None), r"progress must be a function .* \(got None\)"),  # pyright: ignore
        (lambda: tf.prepare("quickstart", like=3), r"like must be of type Fleet, for example .* \(got 3\)"),  # pyright: ignore
        (lambda: tf.make_env("quickstart", slot=3), "Allowed: ahead_s, ambient, arms, bids, breaks, bus, cache, "),
    ],
)  # fmt: skip
def test_arguments_are_checked(call, says):
    with pytest.raises(FleetError, match=says):
        call()


@pytest.mark.parametrize(
    ("kind", "field", "value", "says"),
    [
        (Channel, "loss", "a", r"Channel\.loss must be a number \(got 'a'\)"),
        (Channel, "loss", True, r"loss must be a number \(got True\)"),
        (Channel, "loss", np.float32("nan"), r"loss must be 0 to 1 \(got nan\)"),
        (RunSpec, "seed", None, r"RunSpec\.seed must be an integer \(got None\)"),
        (RunSpec, "seed", 2**32, r"seed must be 0 to 4294967295 \(got 4294967296\)"),
        (RunSpec, "plant", 3, r"No plant '3'\. Allowed: mujoco, profile\."),
        (LiveSpec, "fleet", 3, r"fleet must have .* \(got '3'\)"),
        (TwinConfig, "allow_collapse", "no", r"allow_collapse must be True or False \(got 'no'\)"),
        (StudySpec, "decision_limit_s", "60", r"decision_limit_s must be a number \(got '60'\)"),
    ],
)
def test_fields_are_checked(kind, field, value, says):
    with pytest.raises(ValueError, match=says):
        kind(**{field: value})


def test_numbers_of_numpy_become_plain_ones():
    numbers: Any = {"topology": "random_geometric", "radius": np.float32(0.5), "topology_seed": np.uint8(3)}
    channel = Channel(**numbers)
    assert [type(number) for number in (channel.radius, channel.topology_seed)] == [float, int]
    assert StudySpec(decision_limit_s=None).decision_limit_s is None


@pytest.mark.parametrize("learn", [tf.identify, lambda given: tf.train_twin(given, TINY, seed=0, cool_c=40.0)])
@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ([], FleetError, r"At least one recording is needed \(got none\)"),
        (
            [COOL[0], COOL[1], replace(COOL[2], name=COOL[1].name)],
            FleetError,
            "given more than once: cool_1. Give each",
        ),
        (COOL[0], TypeError, r"A list of recordings is needed \(got one, 'cool_0'\); put it in brackets"),
    ],
)
def test_a_log_is_a_list_of_recordings_with_names_of_their_own(learn, given, error, says):
    with pytest.raises(error, match=says):
        learn(given)


train: Any = partial(tf.train_twin, COOL)
identify: Any = partial(tf.identify, COOL)
forecast: Any = partial(tf.forecast, COOL[0], COOL[0])
quick = {"config": TINY, "seed": 0, "cool_c": 40.0}


@pytest.mark.parametrize(
    ("call", "given", "says"),
    [
        (train, quick | {"hold_out": -1}, r"hold_out must be 0 to 0.9 \(got -1\)"),
        (train, quick | {"hold_out": "x"}, r"hold_out must be a number \(got 'x'\)"),
        (train, quick | {"cool_c": math.nan}, r"cool_c must be 0 to 200 \(got nan\)"),
        (train, quick | {"cool_c": None}, r"cool_c must be a number \(got None\)"),
        (train, quick | {"seed": None}, r"seed must be an integer \(got None\)"),
        (train, quick | {"config": TwinConfig}, r"of type TwinConfig, for example .* \(got <class 'twin"),
        (identify, {"nominal": "gen3"}, r"nominal must be of type HeatModel, for example .* \(got 'gen3'\)"),
        (identify, {"ambient_c": None}, r"ambient_c must be a number \(got None\)"),
        (identify, {"ambient_c": math.nan}, r"ambient_c must be -40 to 60 \(got nan\)"),
        (identify, {"ambient_sd_k": math.inf}, r"ambient_sd_k must be 0 to 100 \(got inf\)"),
        (identify, {"step_s": 0}, r"step_s must be > 0 and at most 600 \(got 0\)"),
        (identify, {"arm": None}, r"arm must have 1 to 128 printable .* \(got 'None'\)"),
        (forecast, {"network": "x"}, r"network must be of type Identified, .* \(got 'x'\)"),
        (forecast, {"ambient_c": math.nan}, r"ambient_c must be -40 to 60 \(got nan\)"),
        (forecast, {"repetitions": 1.5}, r"repetitions must be an integer \(got 1.5\)"),
        (forecast, {"repetitions": 0}, r"repetitions must be 1 to 1000000 \(got 0\)"),
        (forecast, {"seed": None}, r"seed must be an integer \(got None\)"),
    ],
)
def test_arguments_of_twins_are_checked(call, given, says):
    with pytest.raises(ValueError, match=says) as error:
        call(**given)
    assert isinstance(error.value, FleetError)


def test_free_parameters_are_a_list_of_names():
    for free in (None, 3, "idle_w", ["idle"]):
        with pytest.raises(ValueError, match=r"Free parameters must be some of copper_w_per_a2, .*, each once \(got"):
            identify(free=free)


def test_a_policy_that_needs_arguments_is_refused_before_a_preparation(tmp_path, monkeypatch):
    monkeypatch.delattr("scenarios.run.shift.prepare")
    own = tmp_path / "mine.py"
    own.write_text("from agents.rules import RoundRobin\nclass Mine(RoundRobin):\n def __init__(self, gain): ...\n")
    says = "missing a required argument: 'gain'.*: give its parameters defaults"
    with pytest.raises(FleetError, match=says):
        tf.run("quickstart", policy=f"{own}:Mine")
    with pytest.raises(FleetError, match=says):
        tf.compare("quickstart", [f"{own}:Mine"], workers=1)


def test_a_table_is_printed_as_the_command_prints_it():
    table = Table(head=("policy", "jobs"), rows=(("wspt", "71"), ("wsept", "79")), notes=("Two shifts.",))
    assert str(table).split() == ["policy", "jobs", "wspt", "71", "wsept", "79", "Two", "shifts."]


def test_the_card_of_a_prepared_fleet_has_its_predictions_and_plain_numbers(small_toml, plans, tmp_path):
    oracle = tf.prepare(small_toml, difficulty="oracle", cache=plans)
    card = tf.run(oracle, policy="wspt", seed=np.int64(3), out=tmp_path / "run").card
    assert (card["difficulty"], card["seed"], type(card["seed"])) == ("oracle", 3, int)
    assert tf.open_run(tmp_path / "run").card["difficulty"] == "oracle"
    with pytest.raises(FleetError, match=r"holds a finished run; give another out\.$"):
        tf.run(oracle, policy="wspt", out=tmp_path / "run")
    with pytest.raises(FleetError, match=r"or a Scenario \(got a Fleet; give its .scenario\)"):
        tf.make_env(oracle)  # pyright: ignore
    other: Any
    for other in ({"difficulty": "blind"}, {"difficulty": "twin"}, {"risk": "rc-nominal"}):
        says = r"is prepared with (difficulty='oracle'|risk='rc') \(got .* leave the option out"
        with pytest.raises(FleetError, match=says):
            tf.run(oracle, policy="wspt", **other)
    with pytest.raises(FleetError, match=r"is prepared with difficulty='oracle' \(got difficulty='blind'\)"):
        tf.run(oracle, RunSpec(policy="wspt", difficulty="blind"))
