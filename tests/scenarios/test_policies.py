"""Policies by name, from own files and modules; one that fails is named in one sentence."""

import sys
import time
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import numpy as np
import pytest

from agents.policy import EveryArm
from agents.registry import RULES
from agents.rules import LeastDifficulty
from fleet.errors import FleetError
from scenarios.evaluate.study import check_policy
from scenarios.policy_loader import PolicyFailed, arm_policy_of, failure, label, policy_of, scope_of
from tests.scenarios.conftest import QUICK
from tests.waiting import PATIENCE_S


@pytest.fixture
def own(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "class Idle:\n scope = 'central'\n def reset(self, rng): ...\n def act(self, o): return dict.fromkeys(o, 0)\n"
        "class Lone:\n scope = 'arm'\n def reset(self, rng): ...\n def choose(self, o, arm_index): return arm_index\n"
        "class Old:\n def reset(self, rng): ...\n def act(self, o): return dict.fromkeys(o, 0)\n"
        "class No:\n scope = 'central'\n"
        "def make(): return Idle()\n"
        "from agents.policy import Local\nclass Unset(Local): ...\n"
        "class Needy(Idle):\n def __init__(self, size): ...\n"
    )
    return file


@pytest.mark.parametrize("name", RULES)
def test_a_rule_by_its_name(name):
    policy = policy_of(name)
    assert (policy.kind if isinstance(policy, EveryArm) else type(policy)) is RULES[name].kind
    assert policy.scope == scope_of(name) == RULES[name].scope
    assert label(name) == name
    if scope_of(name) == "arm":
        assert type(arm_policy_of(name)) is RULES[name].kind
    else:
        with pytest.raises(FleetError, match=f"'{name}' is a central policy"):
            arm_policy_of(name)


def test_every_arm_has_an_instance_of_its_own(own):
    assert policy_of(f"{own}:Lone").act({"a": None, "b": None}) == {"a": 0, "b": 1}  # pyright: ignore[reportArgumentType]

    class Counting:
        scope: ClassVar = "arm"
        asked = 0

        def reset(self, rng):
            """Nothing to reset."""

        def choose(self, observation, arm_index):
            self.asked += 1
            return self.asked

    every = EveryArm(Counting)
    assert [every.act({"a": None, "b": None}) for _ in range(2)] == [{"a": 1, "b": 1}, {"a": 2, "b": 2}]  # pyright: ignore[reportArgumentType]
    every.reset(np.random.default_rng(0))
    assert every.act({"b": None}) == {"b": 1}  # pyright: ignore[reportArgumentType]


def test_an_own_class_from_a_file_or_a_module(own):
    found = policy_of(f"{own}:Idle")
    assert found.act({"arm_0": None}) == {"arm_0": 0}  # pyright: ignore[reportArgumentType]  # it never looks
    assert label(f"{own}:Idle") == "Idle"
    made = [policy_of(f"{own}:make") for _ in range(2)]
    assert made[0] is not made[1]
    assert type(made[0]).__name__ == "Idle"
    assert scope_of(f"{own}:make") == "central"
    assert isinstance(arm_policy_of("agents.rules:LeastDifficulty"), LeastDifficulty)


def in_folder(folder: Path, action: int) -> str:
    """A policy whose action is in a module beside it."""
    folder.mkdir(exist_ok=True)
    (folder / "helper.py").write_text(f"import deeper.inner\nACTION = {action} + deeper.inner.ZERO\n")
    (folder / "deeper").mkdir(exist_ok=True)
    (folder / "deeper" / "__init__.py").touch()
    (folder / "deeper" / "inner.py").write_text("ZERO = 0\n")
    (folder / "calendar.py").write_text("raise ValueError('not that of the standard library')\n")
    (folder / "fleet.py").write_text("raise ValueError('not that of the project')\n")
    (folder / "own.py").write_text(
        "from __future__ import annotations\nimport calendar\nfrom dataclasses import dataclass\n"
        "from typing import ClassVar\nfrom fleet.job import Job\nfrom helper import ACTION\n@dataclass\nclass Own:\n"
        " scope: ClassVar[str] = 'central'\n def reset(self, rng): ...\n def act(self, o): return {'a': ACTION}\n"
    )
    return f"{folder / 'own.py'}:Own"


def test_a_file_imports_modules_beside_it_and_never_those_of_another_folder(tmp_path, monkeypatch):
    names = [in_folder(tmp_path / folder, action) for folder, action in (("one", 1), ("two", 2))]
    elsewhere = ModuleType("helper")
    monkeypatch.setitem(sys.modules, "helper", elsewhere)
    in_folder(tmp_path / "three", 3)
    (tmp_path / "three" / "fleet.py").unlink()
    (tmp_path / "three" / "calendar.py").unlink()
    monkeypatch.syspath_prepend(tmp_path / "three")
    path = list(sys.path)
    actions = [policy_of(name).act({}) for name in (*names, *names)]
    assert actions == [{"a": 1}, {"a": 2}] * 2
    in_folder(tmp_path / "one", 1000)
    assert [policy_of(name).act({}) for name in names] == [{"a": 1000}, {"a": 2}]
    assert (sys.modules["helper"], sys.path) == (elsewhere, path)
    assert "deeper" not in sys.modules
    (tmp_path / "one" / "helper.py").unlink()
    monkeypatch.delitem(sys.modules, "helper")
    sys.path.remove(str(tmp_path / "three"))
    with pytest.raises(FleetError, match=r"ModuleNotFoundError in line 6: No module named 'helper'\.$"):
        policy_of(names[0])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("least_dificulty", "did you mean 'least_difficulty'"),
        ("{own}:Idel", r"did you mean 'Idle'\? Allowed: Idle, Lone, Needy, No, Old, Unset, make\.$"),
        (
            "{own}",
            r"mine.py' names no class: give .*mine.py:CLASS\. Allowed: Idle, Lone, Needy, No, Old, Unset, make\.$",
        ),
        ("{own}:No", r"is no policy: of scope central it needs the methods reset\(rng\) and act\(observations\)"),
        (
            "{own}:Old",
            r"Old' has no valid scope \(got None\). Set in the class: .* its choose\(observation, arm_index\)",
        ),
        ("{own}:Needy", r"must be a class or function that is called without arguments \(missing a required argument:"),
        ("{own}:Unset", r"Unset has no central policy that an arm can have alone \(got None\)\. Add to the class"),
        ("nowhere.py:Idle", "there is no file 'nowhere.py'"),
        ("no_such_module:Idle", "cannot import 'no_such_module'"),
    ],
)
def test_what_is_no_policy_is_said_in_words(own, name, said):
    with pytest.raises(FleetError, match=said):
        policy_of(name.format(own=own))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\nclass Idle(:\n", r"SyntaxError in line 2: invalid syntax\.$"),
        ("\nimport json\njson.loads('')\n", "JSONDecodeError in line 3: Expecting value"),
        ("import no_such_module\n", r"ModuleNotFoundError in line 1: No module named 'no_such_module'\.$"),
        ("\0", r"SyntaxError: source code .* null bytes\.$"),
        ("import sys\nsys.exit()\n", r"SystemExit in line 2\.$"),
        ("raise SystemExit('no licence')\n", r"SystemExit in line 1: no licence\.$"),
    ],
)
def test_an_own_file_that_cannot_be_loaded_is_said_with_its_line(tmp_path, text, said):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(FleetError, match=f"mine.py' cannot be loaded: {said}"):
        policy_of(f"{file}:Idle")


@pytest.mark.parametrize("error", ["SystemExit", "ValueError"])
def test_a_file_or_a_function_that_ends_the_process_is_a_policy_that_fails(
    thermofleet, small_toml, tmp_path, monkeypatch, error
):
    (tmp_path / "loaded.py").write_text(f"raise {error}('bye')\n")
    (tmp_path / "made.py").write_text(f"def make(): raise {error}('bye')\n")
    monkeypatch.syspath_prepend(tmp_path)
    file, module, made = f"{tmp_path / 'loaded.py'}:A", "loaded:A", f"{tmp_path / 'made.py'}:make"
    not_loaded = f"cannot be loaded: {error}"
    for name, said in ((file, not_loaded), (module, not_loaded), (made, f"failed in loading: {error}: bye")):
        assert thermofleet("run", small_toml, "--policy", name, *QUICK[:4]).refused(said)
    for name in (file, module):
        assert thermofleet("compare", small_toml, "--policies", name, "--difficulty", "blind").refused(not_loaded)
    check_policy(made)  # it fails shift by shift


@pytest.mark.parametrize(
    ("command", "policy", "expected"),
    [
        ("run", "Raises", "KeyError: 'nobody' (FILE, line 18)"),
        ("run", "Exits", "SystemExit: 0 (FILE, line 30)"),
        ("run", "Misplans", "ValueError: no plan (FILE, line 32)"),
        pytest.param("bounds", "Misplans", "ValueError: no plan (FILE, line 32)", marks=pytest.mark.ci_slow),
    ],
)
def test_it_is_one_sentence(thermofleet, small_toml, tmp_path, bad, command, policy, expected) -> None:
    name = f"{bad}:{policy}"
    words = {
        "run": (small_toml, "--policy", name, "--difficulty", "blind", "--bus", "memory"),
        "bounds": (small_toml, "--starts", name, "--evaluations", 2, "--nodes", 0, "--difficulty", "blind"),
    }
    result = thermofleet(command, *words[command], "--out", tmp_path / "out")
    assert result.code == 2
    assert "Traceback" not in result.err
    message = " ".join(result.err.split())
    assert f"The policy '{name}' failed in heat/" in message
    assert expected.replace("FILE", str(bad)) in message


def test_a_policy_that_is_never_made_is_refused_in_time(bad) -> None:
    began_s = time.monotonic()
    with pytest.raises(FleetError, match=r"takes longer than 0\.2 s to load"):
        check_policy(f"{bad}:Endless", 0.2)
    assert time.monotonic() - began_s < PATIENCE_S


def test_errors_of_rules_and_errors_of_ours_stay_as_they_are() -> None:
    ours, other = FleetError("bus lost"), ValueError("a defect")
    assert failure("mine.py:X", ours, "here") is ours
    assert failure("wspt", other, "here") is other
    assert isinstance(failure("mine.py:X", other, "here"), PolicyFailed)
