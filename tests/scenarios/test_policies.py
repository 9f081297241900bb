"""Policies by name: rules, own files, own modules, and what is said when there is none."""

import pytest

from agents.rules import RULES, LeastDifficulty
from fleet.errors import FleetError
from scenarios.policies import label, policy_of


@pytest.fixture
def own(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "class Idle:\n def reset(self, rng): ...\n def act(self, o): return dict.fromkeys(o, 0)\nclass No: ...\n"
    )
    return file


@pytest.mark.parametrize("name", RULES)
def test_a_rule_by_its_name(name):
    assert type(policy_of(name)) is RULES[name]
    assert label(name) == name


def test_an_own_class_from_a_file_or_a_module(own):
    found = policy_of(f"{own}:Idle")
    assert found.act({"arm_0": None}) == {"arm_0": 0}  # pyright: ignore[reportArgumentType]  # it never looks
    assert label(f"{own}:Idle") == "Idle"
    assert isinstance(policy_of("agents.rules:LeastDifficulty"), LeastDifficulty)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("least_dificulty", "did you mean 'least_difficulty'"),
        ("{own}:Idel", "did you mean 'Idle'"),
        ("{own}:No", r"is no policy: it needs the methods reset\(rng\) and act"),
        ("nowhere.py:Idle", "there is no file 'nowhere.py'"),
        ("no_such_module:Idle", "cannot import 'no_such_module'"),
    ],
)
def test_what_is_no_policy_is_said_in_words(own, name, said):
    with pytest.raises(FleetError, match=said):
        policy_of(name.format(own=own))
