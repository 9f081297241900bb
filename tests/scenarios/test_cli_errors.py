"""Errors of the command line: one sentence that names the mistake and what is allowed."""

from collections.abc import Callable

import pytest

QUICK = ("--difficulty", "blind", "--bus", "memory", "--policy", "round_robin")


def unreachable(text: str) -> str:
    return text.replace("position_m = [0.0, 0.2, 0.25]", "position_m = [9.0, 0.2, 0.25]")


def too_heavy(text: str) -> str:
    return text.replace("payload_kg = [2.0]", "payload_kg = [9.0]")


BAD_INPUT: list[tuple[str, Callable[[str], str] | None, list[str], str]] = [
    ("unknown key", lambda t: t + "\n[reward]\nfaullts = 1\n", [], "heat.toml: reward: unknown key 'faullts'; did you"),
    ("wrong type", lambda t: t.replace("= 180", '= "long"'), [], "heat.toml: horizon_s: expected a number, got a text"),
    (
        "negative mass",
        lambda t: t.replace("[2.0]", "[-2.0]"),
        [],
        "jobs[0].payload_kg must be between 0 and 10 kg (got -2.0).",
    ),
    ("one place", lambda t: t.replace("[0.45, 0", "[-0.45, 0"), [], "'right' is 0.00 m from 'left' (arms[0]);"),
    ("not a number", lambda t: t.replace("= 180", "= nan"), [], "heat.toml: horizon_s: expected a finite number,"),
    ("bad TOML", lambda t: t + "\n[[", [], "heat.toml: not valid TOML: "),
    (
        "no arm",
        lambda t: t.replace("[[arms]]", "[[places]]").replace("tilt_deg", "tool_deg").replace('home = "retract"', ""),
        [],
        "there are no arms",
    ),
    ("no trace", lambda t: t.replace('"batch", count = 2', '"trace", file = "t.txt"'), [], "there is no file '"),
    (
        "unreachable",
        unreachable,
        [],
        "jobs[0].places: no arm can do 'hold' with 2 kg (left at 'bench': reach:",
    ),
    (
        "too heavy",
        too_heavy,
        [],
        "jobs[0].places: no arm can do 'hold' with 9 kg (left at 'bench': 9 kg at 0.",
    ),
    ("policy", None, ["--policy", "raundom"], "No policy 'raundom'; did you mean 'random'? Allowed: "),
    ("plant", None, ["--plant", "mojoco"], "No plant 'mojoco'; did you mean 'mujoco'? Allowed: mujoco, profile."),
    ("bus", None, ["--bus", "zeno"], "No bus 'zeno'; did you mean 'zenoh'? Allowed: memory, zenoh."),
    (
        "difficulty",
        None,
        ["--difficulty", "blnd"],
        "No difficulty 'blnd'; did you mean 'blind'? Allowed: blind, oracle",
    ),
    ("seed text", None, ["--seed", "one"], "parse string as an integer (got 'one'). See"),
    ("option", None, ["--sed", "1"], "No such option: --sed"),
    ("out is a file", None, ["--out", "HERE/heat.toml"], "it is a file; --out needs a folder."),
    ("out below a file", None, ["--out", "HERE/heat.toml/run"], "heat.toml' is a file, not a folder."),
    ("out is taken", None, ["--out", "HERE"], "holds other files ('heat.toml'); --out needs a new folder"),
]


@pytest.mark.parametrize(("edit", "options", "sentence"), [row[1:] for row in BAD_INPUT], ids=[r[0] for r in BAD_INPUT])
def test_bad_input_is_told_in_one_sentence_and_nothing_is_written(
    thermofleet, small_toml, tmp_path, edit, options, sentence
):
    if edit is not None:
        small_toml.write_text(edit(small_toml.read_text(encoding="utf-8")), encoding="utf-8")
    options = [option.replace("HERE", str(tmp_path)) for option in options]
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run", *options)
    assert said.code == 2
    assert said.err.startswith("Error: ")
    assert sentence in said.err
    assert said.err.count("\n") == (2 if edit is unreachable else 1)  # two jobs need the place
    assert said.err.endswith(".\n")
    assert "Traceback" not in said.err
    assert said.out == ""
    assert [p.name for p in tmp_path.iterdir()] == ["heat.toml"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "quikstart"], "No scenario 'quikstart'; did you mean 'quickstart'? Allowed: "),
        (["run", "nowhere.toml"], "There is no scenario file 'nowhere.toml'."),
        (["show", "quikstart"], "No scenario 'quikstart'; did you mean 'quickstart'? Allowed: "),
        (["run"], "Missing argument 'scenario'."),
        (["rnu"], "No such command 'rnu'. Did you mean 'run'?"),
        (["submit", "jobs.json"], "`thermofleet submit` is now `thermofleet job submit`."),
        (["suite", "--split", "test"], "`thermofleet suite` is now `thermofleet show --suite`."),
        (["arm", "resume", "arm_0"], "`thermofleet arm resume` is now `thermofleet arm pause --end`."),
        (["arm", "quickstart", "arm_0"], "`thermofleet arm SCENARIO NAME` is now `thermofleet arm run SCENARIO NAME`."),
        (["show", "quickstart", "--hold", "1"], "--hold needs no scenario; leave 'quickstart' out."),
        (["show", "quickstart", "--suite", "test"], "--suite needs no scenario; leave 'quickstart' out."),
        (
            ["show", "--suite", "tst"],
            "No suite 'tst'; did you mean 'test'? Allowed: cells, sizes, test, train, validation.",
        ),
        (["compare", "quickstart", "--policies", "random,rnd"], "No policy 'rnd'; did you mean 'random'?"),
        (["compare", "quickstart", "--baseline", "best"], "The baseline 'best' is not among the policies compared: "),
        (["show", "--hold", "1", "--posture", "hom"], "No posture 'hom'; did you mean 'home'?"),
    ],
)
def test_every_command_tells_what_is_wrong(thermofleet, arguments, sentence):
    said = thermofleet(*arguments)
    assert said.code == 2
    assert sentence in said.err
    assert said.err.count("\n") == 1


def test_a_cache_that_cannot_be_written_is_told(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.setenv("THERMOFLEET_CACHE", str(small_toml / "cache"))
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert said.code == 2
    assert said.err.startswith("Error: Cannot keep plans and twins in '")
