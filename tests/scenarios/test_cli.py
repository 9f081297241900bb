"""The command line, called as a person calls it."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from agents.registry import RULES, make_policy
from fleet.bus.exchange.channel import TOPOLOGIES
from scenarios.cli.main import COMMANDS
from scenarios.load import library
from scenarios.run.run_folder import FILES

QUICK = ("--difficulty", "blind", "--bus", "memory", "--policy", "round_robin")


def run_json(folder: Path) -> dict:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def test_a_run_prints_its_figures_and_leaves_four_files(thermofleet, small_toml, tmp_path):
    out = tmp_path / "run"
    said = thermofleet("run", small_toml, *QUICK, "--out", out)
    assert said.code == 0
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    told = run_json(out)
    assert told["status"] == "finished"
    for label in ("jobs finished", "value", "on time", "faults", "min above warning", "energy, Wh"):
        assert label in said.out
    assert f"{told['metrics']['finished']} of {told['metrics']['jobs']}" in said.out
    for arm, peak_c in told["metrics"]["peak_c"].items():
        assert f"peak {arm}, °C" in said.out
        assert f"{peak_c:.1f}" in said.out
    assert str(out / "report.html") in said.out
    assert said.err == ""


@pytest.mark.parametrize("plant", ["profile", "mujoco"])
def test_the_same_seed_gives_the_same_files(thermofleet, small_toml, tmp_path, plant):
    one, two = tmp_path / "one", tmp_path / "two"
    for out in (one, two):
        assert thermofleet("run", small_toml, *QUICK, "--plant", plant, "--seed", 3, "--out", out).code == 0
    for name in FILES:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_the_same_seed_gives_the_same_files_in_another_process(thermofleet, small_toml, tmp_path, plans):
    one, two = tmp_path / "one", tmp_path / "two"
    assert thermofleet("run", small_toml, *QUICK, "--out", one).code == 0
    env = {**os.environ, "THERMOFLEET_CACHE": str(plans), "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-c", "from scenarios.cli.main import main; main()", "run", str(small_toml), *QUICK]
    subprocess.run([*command, "--out", str(two)], check=True, env=env, capture_output=True, timeout=60)
    for name in FILES:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_zenoh_and_memory_record_the_same_shift(thermofleet, small_toml, tmp_path):
    for bus in ("zenoh", "memory"):
        assert thermofleet("run", small_toml, *QUICK, "--bus", bus, "--out", tmp_path / bus).code == 0
    for name in ("telemetry.parquet", "events.parquet"):
        assert (tmp_path / "zenoh" / name).read_bytes() == (tmp_path / "memory" / name).read_bytes(), name


def test_json_is_one_object_and_nothing_else(thermofleet, small_toml, tmp_path):
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run", "--json")
    told = json.loads(said.out)
    assert told["out"] == str(tmp_path / "run")
    assert told["metrics"] == run_json(tmp_path / "run")["metrics"]


def test_without_out_the_run_goes_into_runs(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert thermofleet("run", small_toml, *QUICK, "--seed", 5).code == 0
    assert (tmp_path / "runs" / "heat-round_robin-5" / "run.json").is_file()


def test_a_finished_run_is_kept_until_told_otherwise(thermofleet, small_toml, tmp_path):
    out = tmp_path / "run"
    assert thermofleet("run", small_toml, *QUICK, "--out", out).code == 0
    said = thermofleet("run", small_toml, *QUICK, "--seed", 1, "--out", out)
    assert said.code == 2
    assert run_json(out)["seed"] == 0
    assert thermofleet("run", small_toml, *QUICK, "--seed", 1, "--out", out, "--overwrite").code == 0
    assert run_json(out)["seed"] == 1


class PressingCtrlC:
    """Round robin, until somebody presses Ctrl-C at a certain step."""

    def __init__(self, step: int, times: int) -> None:
        self._policy, self._left, self._times = make_policy("round_robin"), step, times

    def reset(self, rng):
        self._policy.reset(rng)

    def act(self, observations):
        self._left -= 1
        if self._left == 0:
            for _ in range(self._times):
                os.kill(os.getpid(), signal.SIGINT)
        return self._policy.act(observations)


def test_ctrl_c_while_working_keeps_what_was_done_and_the_same_command_replaces_it(
    thermofleet, small_toml, tmp_path, monkeypatch
):
    out = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr("scenarios.policy_loader.policy_of", lambda name: PressingCtrlC(step=4, times=1))
        said = thermofleet("run", small_toml, *QUICK, "--out", out)
    assert said.code == 130
    assert "Interrupted after 40 s of 180 s: the shift until then is kept in " in said.err
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert run_json(out)["status"] == "interrupted"
    assert run_json(out)["time_s"] == 40.0
    assert thermofleet("run", small_toml, *QUICK, "--out", out).code == 0
    assert run_json(out)["status"] == "finished"
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_second_ctrl_c_leaves_nothing(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.policy_loader.policy_of", lambda name: PressingCtrlC(step=4, times=2))
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert said.code == 130
    assert "Interrupted while working: nothing was written." in said.err
    assert [p.name for p in tmp_path.iterdir()] == ["heat.toml"]


def test_afterwards_ctrl_c_is_as_it_was(thermofleet, small_toml, tmp_path):
    before = signal.getsignal(signal.SIGINT)
    thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_while_planning_writes_nothing_and_keeps_the_plans(
    thermofleet, small_toml, tmp_path, monkeypatch, plans
):
    from fleet.planning.planner import Planner

    made = 0
    plan = Planner.plan

    def interrupted(self, work):
        nonlocal made
        if made == 2:
            raise KeyboardInterrupt
        made += 1
        return plan(self, work)

    own = tmp_path / "cache"
    monkeypatch.setenv("THERMOFLEET_CACHE", str(own))
    monkeypatch.setattr(Planner, "plan", interrupted)
    said = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "a" / "run")
    assert said.code == 130
    assert said.err.startswith("Interrupted while planning: nothing was written.")
    assert str(own) in said.err
    assert not (tmp_path / "a").exists()
    assert len(list((own / "plans").glob("*.npz"))) == 2


def test_a_killed_run_leaves_only_a_folder_with_a_dot(small_toml, tmp_path, plans):
    program = textwrap.dedent("""
        import os, signal, sys
        import scenarios.policy_loader
        from scenarios.cli.main import main

        class Killed:
            def reset(self, rng): pass
            def act(self, observations): os.kill(os.getpid(), signal.SIGKILL)

        scenarios.policy_loader.policy_of = lambda name: Killed()
        main(sys.argv[1:])
    """)
    where = tmp_path / "runs"
    command = [sys.executable, "-c", program, "run", str(small_toml), *QUICK, "--out", str(where / "run")]
    env = {**os.environ, "THERMOFLEET_CACHE": str(plans)}
    killed = subprocess.run(command, env=env, capture_output=True, timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert all(p.name.startswith(".run.") for p in where.iterdir())


def unreachable(text: str) -> str:
    return text.replace("position_m = [0.0, 0.2, 0.25]", "position_m = [9.0, 0.2, 0.25]")


def too_heavy(text: str) -> str:
    return text.replace("payload_kg = [2.0]", "payload_kg = [40.0]")


BAD_INPUT: list[tuple[str, Callable[[str], str] | None, list[str], str]] = [
    ("unknown key", lambda t: t + "\n[reward]\nfaullts = 1\n", [], "heat.toml: reward: unknown key 'faullts'; did you"),
    ("wrong type", lambda t: t.replace("= 180", '= "long"'), [], "heat.toml: horizon_s: expected a number, got a text"),
    (
        "negative mass",
        lambda t: t.replace("[2.0]", "[-2.0]"),
        [],
        "jobs[0].payload_kg must be a non-empty list of masses",
    ),
    ("one place", lambda t: t.replace("[0.45, 0", "[-0.45, 0"), [], "'right' stands 0.00 m from 'left' (arms[0]);"),
    ("not a number", lambda t: t.replace("= 180", "= nan"), [], "heat.toml: horizon_s: expected a finite number,"),
    ("bad TOML", lambda t: t + "\n[[", [], "heat.toml: not valid TOML: "),
    (
        "no arm",
        lambda t: t.replace("[[arms]]", "[[places]]").replace("tilt_deg", "tool_deg"),
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
        "jobs[0].places: no arm can do 'hold' with 40 kg (left at 'bench': torque:",
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
    ("seed", None, ["--seed", "-1"], "--seed must be 0 or more (got -1)."),
    ("seed text", None, ["--seed", "one"], "Invalid value for '--seed'"),
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
    assert said.err.count("\n") == 1
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
        (["compare", "quickstart", "--seeds", "1"], "--seeds must be 2 or more, because intervals need several"),
        (["compare", "quickstart", "--policies", "random,rnd"], "No policy 'rnd'; did you mean 'random'?"),
        (["compare", "quickstart", "--baseline", "best"], "The baseline 'best' is not among the policies compared: "),
        (["hold", "--payload", "-1"], "The payload must be a mass of 0 kg or more (got -1.0)."),
        (["hold", "--posture", "hom"], "No posture 'hom'; did you mean 'home'?"),
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


def test_list_names_every_scenario_of_the_library(thermofleet):
    said = thermofleet("list")
    assert said.code == 0
    assert all(name in said.out for name in library())
    assert set(json.loads(thermofleet("list", "--json").out)) == set(library())


def test_show_fits_eighty_columns_and_cuts_no_word(thermofleet, small_toml):
    said = thermofleet("show", small_toml)
    assert said.code == 0
    assert max(len(line.rstrip()) for line in said.out.splitlines()) <= 80
    assert "…" not in said.out
    assert "hold 2 kg at bench, 1–2 × 10 s" in said.out
    assert "sort shelf → bench, 0.2 or 0.5 kg, 1–3 times" in said.out
    assert "2 at 0 s" in said.out
    assert "thermal load factor" in said.out
    assert json.loads(thermofleet("show", small_toml, "--json").out)["name"] == "heat"


def test_compare_prints_a_table_or_json(thermofleet, small_toml, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    some = ("compare", small_toml, "--seeds", 2, "--policies", "random, round_robin", "--difficulty", "blind")
    told = json.loads(thermofleet(*some, "--json").out)
    assert set(told["figures"]) == {"random", "round_robin"}
    assert "above_warning_min" in thermofleet(*some).out


def test_without_round_robin_the_first_policy_is_the_baseline(thermofleet, small_toml, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    some = ("compare", small_toml, "--seeds", 2, "--difficulty", "blind", "--json", "--policies")
    for policies, baseline in (("random,coolest_first", "random"), ("random,round_robin", "round_robin")):
        assert json.loads(thermofleet(*some, policies).out)["baseline"] == baseline


def test_the_demo_sets_two_policies_side_by_side(thermofleet, tmp_path, monkeypatch, plans):
    from scenarios.prepare.fleet import prepare

    def without_twins(scenario, *, difficulty, progress):
        return prepare(scenario, difficulty="blind", cache=plans, progress=progress)

    monkeypatch.setattr("scenarios.prepare.fleet.prepare", without_twins)
    said = thermofleet("demo", "--out", tmp_path / "demo")
    assert said.code == 0
    head = said.out.splitlines()[1].split()
    assert head == ["round_robin", "least_difficulty"]
    for policy in head:
        told = run_json(tmp_path / "demo" / policy)
        assert (told["policy"], told["status"], told["scenario"]["name"]) == (policy, "finished", "quickstart")
        assert f"{told['metrics']['energy_wh']:.0f}" in said.out
    assert str(tmp_path / "demo" / "least_difficulty" / "report.html") in said.out


def test_help_names_every_command_by_group_and_run_names_every_policy_and_topology(thermofleet):
    said = thermofleet("--help")
    assert said.code == 0
    assert all(f"│ {name} " in said.out for name in COMMANDS)
    assert all(f"─ {entry.panel} ─" in said.out for entry in COMMANDS.values())
    wide = " ".join(thermofleet("run", "--help").out.replace("│", " ").split())
    assert all(name in wide for name in (*RULES, *TOPOLOGIES))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_listed_command_can_be_imported_and_explains_itself(thermofleet, name):
    said = thermofleet(name, "--help")
    assert said.code == 0
    assert f"Usage: thermofleet {name}" in said.out


def test_the_version_is_printed(thermofleet):
    said = thermofleet("--version")
    assert (said.code, said.out) == (0, f"thermofleet {version('thermofleet')}\n")


def test_help_imports_no_large_library():
    """The page takes 0.2 s of CPU time; NumPy alone would take as much again."""
    program = textwrap.dedent("""
        import contextlib, sys
        from scenarios.cli.main import main

        with contextlib.suppress(SystemExit):
            main(["--help"])
        print([m for m in ("numpy", "networkx", "torch", "zenoh", "plotly", "mujoco", "numba") if m in sys.modules])
    """)
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        ("thermofleet re", ["record", "replay"]),
        ("thermofleet run --pl", ["--plant"]),
        ("thermofleet twin re", ["recover", "report"]),
    ],
)
def test_the_shell_completes_commands_and_their_options(words, completions):
    program = "from scenarios.cli.main import main; main()"
    last = str(len(words.split()) - 1)
    asked = {"_THERMOFLEET_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": last}
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, timeout=60, check=True)
    assert sorted(said.stdout.split()) == completions


def test_a_warning_is_one_line_where_there_is_no_terminal():
    warn = "logging.getLogger('fleet.live').warning('%s', 'word ' * 60)"
    code = f"import logging, scenarios.cli.main as cli; cli.app = lambda **_: {warn}; cli.main([])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr == f"WARNING  fleet.live: {'word ' * 60}\n"
