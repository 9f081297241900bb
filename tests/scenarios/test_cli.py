"""The command line: options, ranges, help and errors."""

import ast
import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from agents.registry import RULES
from fleet.bus.exchange.channel import TOPOLOGIES, Channel, Partition
from fleet.bus.protocol.keys import CHANNEL, STATE_HZ
from fleet.errors import MAX_NAME, FleetError
from fleet.fields import check, option, options_of
from fleet.robot import ThermalLimits
from scenarios.cli.main import COMMANDS, GROUPS, MOVED, load_command
from scenarios.cli.options import From, Given, flags_of, with_fields
from scenarios.live.gateway import ROLES
from scenarios.run.log import FILES
from scenarios.spec.load import library, load
from scenarios.spec.options import ENDPOINT, PORT, Budget, LiveSpec, RunSpec, Shot, StudySpec
from scenarios.suite.instances import CELLS
from tests.commands import REAL
from tests.own_policies import IDLE
from tests.scenarios.conftest import QUICK, run_json
from twin.thermal.identify import AMBIENT_C


def test_a_run_prints_its_figures_and_leaves_four_files(thermofleet, small_toml, tmp_path):
    out = tmp_path / "run"
    said = thermofleet("run", small_toml, *QUICK, "--out", out).succeeded()
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    printed = run_json(out)
    assert printed["status"] == "finished"
    for label in ("jobs finished", "value", "on time", "faults", "above warning, min", "energy to heat, Wh"):
        assert label in said.out
    assert f"{printed['metrics']['finished']} of {printed['metrics']['jobs']}" in said.out
    for arm, peak_c in printed["metrics"]["peak_c"].items():
        assert f"peak {arm}, °C" in said.out
        assert f"{peak_c:.1f}" in said.out
    assert str(out / "report.html") in said.out
    assert said.err == ""


def test_a_run_of_a_fleet_that_stands_still_says_so(thermofleet, small_toml, tmp_path):
    small_toml.write_text(
        small_toml.read_text(encoding="utf-8").replace("horizon_s = 180", "horizon_s = 1800"), "utf-8"
    )
    policy = tmp_path / "idle.py"
    policy.write_text(IDLE, encoding="utf-8")
    options = ("--difficulty", "blind", "--out", tmp_path / "run")
    said = thermofleet("run", small_toml, "--policy", f"{policy}:Idle", *options).succeeded()
    jobs = run_json(tmp_path / "run")["metrics"]["jobs"]
    waited = re.search(  # without an award no offer is recorded
        r"(\d+) jobs still waited at the end\. \d+ jobs waited for at least 15 min; which arms can do them is not rec",
        " ".join(said.err.split()),
    )
    assert waited
    assert int(waited[1]) == jobs


@pytest.mark.ci_slow
@pytest.mark.parametrize("plant", ["profile", "mujoco"])
def test_the_same_seed_gives_the_same_files_also_in_another_process(thermofleet, small_toml, tmp_path, plant):
    one, two = tmp_path / "one", tmp_path / "two"
    command = ("run", small_toml, *QUICK, "--plant", plant, "--seed", 3)
    thermofleet(*command, "--out", one).succeeded()
    if plant == "mujoco":
        thermofleet(*command, "--out", two).succeeded()
    else:
        words = [*REAL, *map(str, command), "--out", str(two)]
        subprocess.run(words, check=True, env=os.environ | {"PYTHONHASHSEED": "7"}, capture_output=True, timeout=300)
    for name in FILES:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


def test_json_is_one_object_of_a_run_which_goes_into_runs_and_is_kept_without_overwrite(
    thermofleet, small_toml, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    command = ("run", small_toml, *QUICK, "--seed", 5)
    printed = json.loads(thermofleet(*command, "--json").out)
    assert printed["out"] == "runs/heat-round_robin-5"
    assert printed["metrics"] == run_json(Path(printed["out"]))["metrics"]
    changed = Path(printed["out"], "events.parquet")
    changed.write_bytes(b"")
    assert thermofleet(*command).code == 2
    assert changed.read_bytes() == b""
    thermofleet(*command, "--overwrite").succeeded()
    assert changed.read_bytes() != b""


def test_show_lists_the_library_the_cells_and_the_instances_of_a_split(thermofleet):
    said = thermofleet("show").succeeded()
    assert all(name in said.out for name in library())
    assert set(json.loads(thermofleet("show", "--json").out)) == set(library())
    names = [row["name"] for row in json.loads(thermofleet("show", "--suite", "test", "--json").out)]
    assert names[:2] == ["test/0000", "test/0001"]
    assert all(name in thermofleet("show", "--suite", "test").out for name in names[:2])
    cells = json.loads(thermofleet("show", "--suite", "cells", "--json").out)
    assert set(cells) == {cell.name for cell in CELLS}


def test_show_fits_eighty_columns_and_cuts_no_word(thermofleet, small_toml):
    small_toml.write_text(small_toml.read_text().replace('kind = "hold"', 'kind = "hold"\ndue = "hard"\ndue_s = 150'))
    said = thermofleet("show", small_toml).succeeded()
    assert max(len(line.rstrip()) for line in said.out.splitlines()) <= 80
    assert "…" not in said.out
    assert "hold 2 kg at bench, 1–2 × 10 s" in said.out
    assert "sort shelf → bench, 0.2 or 0.5 kg, 1–3 times" in said.out
    assert "expires after 2 min 30 s; 2 at 0 s" in said.out
    assert "due after 30 min; Poisson" in said.out
    assert "thermal load factor" in said.out
    assert json.loads(thermofleet("show", small_toml, "--json").out)["name"] == "heat"
    assert "Without work" not in said.out
    for limits, sentence in (
        (
            "restart_c = 20\nwarning_c = 30",
            "Without work, motors of left and right are above the warning limit of 30 °C at",
        ),
        ("restart_c = 20\nwarning_c = 25\nerror_c = 30", "above the error limit of 30 °C at"),
    ):
        low = small_toml.with_name("low.toml")
        low.write_text(f"{small_toml.read_text()}\n[limits]\n{limits}\n")
        assert sentence in " ".join(thermofleet("show", low).out.split())


def test_compare_prints_a_table_or_json_against_round_robin_or_the_first_policy(thermofleet, small_toml, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    some = ("compare", small_toml, "--seeds", 2, "--difficulty", "blind", "--policies")
    for policies, baseline in (("random,coolest_first", "random"), ("random, round_robin", "round_robin")):
        printed = json.loads(thermofleet(*some, policies, "--json").out)
        assert (set(printed["figures"]), printed["baseline"]) == (set(policies.replace(" ", "").split(",")), baseline)
    assert "min above warning" in thermofleet(*some, "random, round_robin").out


def unreachable(text: str) -> str:
    return text.replace("position_m = [0.0, 0.2, 0.25]", "position_m = [9.0, 0.2, 0.25]")


BAD_INPUT: list[tuple[str, Callable[[str], str] | None, list[str], str]] = [
    ("unknown key", lambda t: t + "\n[reward]\nfaullts = 1\n", [], "heat.toml: reward: unknown key 'faullts'; did you"),
    ("unreachable", unreachable, [], "jobs[0].places: no arm can do 'hold' with 2 kg (left at 'bench': reach:"),
    ("policy", None, ["--policy", "raundom"], "No policy 'raundom'; did you mean 'random'? Allowed: "),
    ("difficulty", None, ["--difficulty", "blnd"], "No difficulty 'blnd'; did you mean 'blind'? Allowed: blind,"),
    ("seed text", None, ["--seed", "one"], "parse string as an integer (got 'one'). See"),
    ("option", None, ["--sed", "1"], "No such option: --sed"),
    ("out is no table", None, ["--out", "HERE/run.pdf"], "--out must be a folder, without the ending of a file (got '"),
    ("out is taken", None, ["--out", "HERE"], "holds other files ('heat.toml'); --out needs a new folder"),
]


@pytest.mark.parametrize(("edit", "options", "sentence"), [row[1:] for row in BAD_INPUT], ids=[r[0] for r in BAD_INPUT])
def test_bad_input_is_one_sentence_and_nothing_is_written(thermofleet, small_toml, tmp_path, edit, options, sentence):
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


WRONG_WORDS = {
    "run quikstart": "No scenario 'quikstart'; did you mean 'quickstart'? Allowed: ",
    "rnu": "No such command 'rnu'. Did you mean 'run'?",
    "submit jobs.json": "`thermofleet submit` is now `thermofleet job submit`.",
    "show quickstart --suite test": "--suite takes no scenario; leave 'quickstart' out.",
    "show --suite tst": "No suite 'tst'; did you mean 'test'? Allowed: cells, test, train, validation.",
    "arm quickstart arm_0": "`thermofleet arm SCENARIO NAME` is now `thermofleet arm run SCENARIO NAME`.",
    "show quickstart --hold 1": "--hold takes no scenario; leave 'quickstart' out.",
    "compare quickstart --out x.pdf": "without the ending of a file, or a file that ends in .csv, .xlsx (got '",
    "up quickstart --out x.pdf": "--out must be a folder, without the ending of a file (got 'x.pdf').",
    "bus record quickstart --out x.pdf": "--out must be a folder, without the ending of a file (got 'x.pdf').",
    "train quickstart --out x.pdf": "--out must be a folder, without the ending of a file (got 'x.pdf').",
    "twin identify --log x.csv --out x.pdf": "--out must be a folder, without the ending of a file (got 'x.pdf').",
    "show --hold 1 --posture hom": "No posture 'hom'; did you mean 'home'?",
    "run heat.toml --topology rign": "Error: No topology 'rign'; did you mean 'ring'?",
    "compare heat.toml --partition soon": "Error: --partition needs FROM_S:TO_S:ARM,ARM|ARM,ARM",
    "compare heat.toml --partition 0:9:lefft": "Error: A partition names an unknown arm 'lefft'; did you mean 'left'?",
}


@pytest.mark.parametrize("words", WRONG_WORDS)
def test_an_error_of_any_command_is_one_sentence(thermofleet, small_toml, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    said = thermofleet(*words.split())
    assert said.code == 2
    assert WRONG_WORDS[words] in said.err
    assert said.err.count("\n") == 1


def test_a_cache_that_cannot_be_written_is_an_error(thermofleet, small_toml, tmp_path, monkeypatch):
    monkeypatch.setenv("THERMOFLEET_CACHE", str(small_toml / "cache"))
    run_small = thermofleet("run", small_toml, *QUICK, "--out", tmp_path / "run")
    assert run_small.refused("Error: Cannot keep plans and twins in '")


HUGE = "9" * 30
WRONG = {int: (HUGE, f"-{HUGE}"), float: (HUGE, f"-{HUGE}", "nan", "inf", "-inf")}


def numbers() -> Iterator[tuple[tuple[str, ...], str, type]]:
    """Words of a command, one of its numeric options, and its type."""
    for name in COMMANDS:
        for parameter in load_command(name).params:
            kind = parameter.type_descriptor.annotation if parameter.param_type_name == "option" else None
            if kind in WRONG:
                yield tuple(name.split()), parameter.opts[0], kind


NUMBERS = list(numbers())


@pytest.mark.parametrize(("words", "option", "kind"), NUMBERS, ids=[" ".join((*w, o)) for w, o, _ in NUMBERS])
def test_a_number_out_of_range_is_refused_in_one_sentence(thermofleet, words, option, kind):
    for value in WRONG[kind]:
        said = thermofleet(*words, f"{option}={value}")
        assert said.code == 2, value
        assert said.err.startswith(f"Error: {option} must be ")
        assert said.err.count("\n") == 1
        assert said.out == ""


@pytest.mark.parametrize(
    "words",
    [
        ("bus", "auctioneer", "--name"),
        ("bus", "record"),
        ("arm", "run", "quickstart"),
        ("bus", "ros2", "listen", "--arm"),
    ],
)
@pytest.mark.parametrize("name", ["", "a/b", "a\nb", "x" * (MAX_NAME + 1), "\udcff"])
def test_a_name_of_another_form_is_refused(thermofleet, words, name):
    said = thermofleet(*words, name)
    assert said.code == 2
    assert f"1 to {MAX_NAME} printable characters" in said.err
    assert said.err.count("\n") == 1


def test_help_names_every_command_by_group_and_run_names_every_policy_and_topology(thermofleet):
    assert thermofleet("--version").out == f"thermofleet {version('thermofleet')}\n"
    said = thermofleet("--help").succeeded()
    assert all(f"│ {name.split()[0]} " in said.out for name in COMMANDS)
    assert all(f"─ {entry.panel} ─" in said.out for entry in COMMANDS.values())
    wide = " ".join(thermofleet("run", "--help").out.replace("│", " ").split())
    assert all(name in wide for name in (*RULES, *TOPOLOGIES))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_listed_command_can_be_imported_and_explains_itself(thermofleet, name):
    said = thermofleet(*name.split(), "--help").succeeded()
    assert f"Usage: thermofleet {name}" in said.out


def test_help_and_the_declarations_of_commands_import_no_large_library():
    """The page takes 0.2 s of CPU time; NumPy alone would take as much again. Help of a command takes 0.3 s."""
    program = textwrap.dedent("""
        import contextlib, sys
        from importlib import import_module
        from scenarios.cli.main import main

        large = {"networkx", "torch", "zenoh", "plotly", "mujoco", "numba", "scenarios.spec.schema"}
        with contextlib.suppress(SystemExit):
            main(["--help"])
        print("help", {"numpy", *large} & {*sys.modules})
        for name in ("run", "look", "evaluate", "live", "jobs", "keys", "twin"):
            import_module(f"scenarios.cli.{name}")
            print(name, large & {*sys.modules})
    """)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    lines = done.stdout.splitlines()[-8:]
    assert [line for line in lines if not line.endswith(" set()")] == []
    assert lines[0].startswith("help ")


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        ("thermofleet re", ["report"]),
        ("thermofleet run quickstart --plant m", ["mujoco"]),
        ("thermofleet bus re", ["record", "replay"]),
    ],
)
def test_the_shell_completes_commands_and_their_options(words, completions):
    program = "from scenarios.cli.main import main; main()"
    last = str(len(words.split()) - 1)
    asked = {"_THERMOFLEET_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": last}
    said = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    assert sorted(said.stdout.split()) == completions


def test_a_warning_is_one_line_where_there_is_no_terminal():
    warn = "logging.getLogger('fleet.live').warning('%s', 'word ' * 60)"
    code = f"import logging, scenarios.cli.main as cli; cli._command = lambda: lambda *_, **__: {warn}; cli.main([])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert done.stderr == f"WARNING  fleet.live: {'word ' * 60}\n"


@dataclass(frozen=True, kw_only=True)
class Oven:
    heat_c: float = option("Temperature, °C.", 180.0, low=0, high=300)
    mode: str = option("fan or grill.", "fan", choices=("fan", "grill"))
    minutes: int | None = option("Time, min.", None, low=0, high=600, above=True)
    shelves: tuple[int, ...] = option("Shelves.", (), flag="--shelf", parse=int)
    clean: bool = option("Clean it afterwards.", False)
    maker: str = "nobody"

    def __post_init__(self) -> None:
        check(self)


def run(*words, **defaults) -> Given | BaseException:
    """What a command is given by its words; or its error."""
    received: list[Given] = []

    def bake(given: Annotated[Given, From(Oven, **defaults)], twice: bool = option("Again.", False)) -> None:
        received.append(given)

    app = typer.Typer()
    app.command()(with_fields(bake))
    done = CliRunner().invoke(app, [*words])
    return received[0] if received else done.exception or AssertionError(done.output)


def test_a_command_receives_given_values_and_no_defaults():
    assert run() == {}
    assert run("--heat-c", "90", "--twice") == {"heat_c": 90.0}
    assert run("--shelf", "1", "--shelf", "3", "--clean") == {"shelves": (1, 3), "clean": True}
    assert run("--mode", "fan") == {"mode": "fan"}  # given, although it is the default
    assert run(heat_c=100.0) == {"heat_c": 100.0}  # the command's own default
    assert run("--heat-c", "90", heat_c=100.0) == {"heat_c": 90.0}


@pytest.mark.parametrize(
    ("word", "value", "said"),
    [
        ("heat-c", 301.0, "must be 0 to 300 (got 301)."),
        ("heat-c", float("nan"), "must be 0 to 300 (got nan)."),
        ("minutes", 0, "must be > 0 and at most 600 (got 0)."),
        ("mode", "gril", "No mode 'gril'; did you mean 'grill'? Allowed: fan, grill."),
    ],
)
def test_the_same_bounds_hold_on_the_command_line_and_in_python(word, value, said):
    error = run(f"--{word}", str(value))
    assert isinstance(error, FleetError)
    field = word.replace("-", "_")
    assert str(error) == (said if said.startswith("No ") else f"--{word} {said}")
    with pytest.raises(ValueError) as raised:  # noqa: PT011  # the sentence is compared below
        Oven(**{field: value})
    assert str(raised.value) == (said if said.startswith("No ") else f"Oven.{field} {said}")


def test_words_of_a_command_line_give_the_same_value():
    oven = Oven(heat_c=12345.678e-3 + 80, mode="grill", minutes=5, clean=True)
    names = ("heat_c", "mode", "minutes", "clean")
    assert Oven(**run(*flags_of(oven, *names))) == oven


@pytest.mark.parametrize("kind", [RunSpec, LiveSpec, StudySpec, Budget, Shot, Channel])
def test_defaults_are_allowed_and_each_option_has_a_sentence(kind):
    kind()
    defaults = {each.name: each.default for each in fields(kind)}
    for name, known in options_of(kind).items():
        assert known.help.endswith("."), name
        assert not known.problem(name, defaults[name]), name


def test_an_earlier_name_of_a_command_names_a_present_one():
    for old, new in MOVED.items():
        command, *options = new.partition(" --")[0], *new.split()[2:]
        assert command in COMMANDS, old
        flags = {flag for option in load_command(command).params for flag in getattr(option, "opts", ())}
        assert {word for word in options if word.startswith("--")} <= flags, old
        assert old not in {name.split()[0] for name in COMMANDS}, old
    assert {name.split()[0] for name in COMMANDS if " " in name} == set(GROUPS)


def test_every_command_that_the_product_speaks_of_exists():
    root = Path(__file__).parents[2]
    paths = [path for folder in ("agents", "fleet", "scenarios", "twin") for path in (root / folder).rglob("*.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in paths)
    said = set(re.findall(r"`thermofleet ([a-z]+)( [a-z0-9]+\b)?", text))
    assert len(said) > 20
    assert not {one + more for one, more in said if one not in COMMANDS and (one + more) not in {*COMMANDS, *GROUPS}}


def test_defaults_that_the_help_states_are_those_of_the_modules_that_it_does_not_load():
    def default(command, name):
        return next(each.default for each in load_command(command).params if each.name == name)

    assert default("arm run", "rate_hz") == STATE_HZ
    assert default("bus router", "state_hz") == CHANNEL["arm", "state"].limit_hz
    ambient = next(each for each in load_command("twin identify").params if each.name == "ambient")
    assert f"default: {AMBIENT_C:g} is assumed" in ambient.help
    limits = ThermalLimits()
    assert (default("bus ros2", "warning_c"), default("bus ros2", "error_c")) == (limits.warning_c, limits.error_c)
    assert ENDPOINT == f"tcp/127.0.0.1:{PORT}" == default("bus watch", "endpoint")
    tokens = next(each for each in load_command("bus gateway").params if each.name == "tokens")
    assert ", ".join(ROLES) in tokens.help


BLIND = ("--difficulty", "blind", "--policy", "least_difficulty")
HARD = ("--topology", "line", "--delay-s", 20, "--jitter-s", 5, "--loss", 0.2, "--partition", "30:60:left|right")


def test_a_partition_is_read_from_a_text():
    assert Partition.parse("600:1200:a, b|c") == Partition(600.0, 1200.0, (("a", "b"), ("c",)))
    assert Partition.parse("0:1e3:arm:1") == Partition(0.0, 1000.0, (("arm:1",),))
    for text in ("", "600", "600:1200", "a:b:left", "1200:600:left|right", "0:10:left|", "0:10:a,a"):
        with pytest.raises(ValueError, match=r"partition .*\(got|names 'a' twice"):
            Partition.parse(text)


def test_a_run_records_its_channel_and_is_the_same_over_either_bus(thermofleet, small_toml, tmp_path):
    printed = {}
    for bus in ("memory", "zenoh"):
        out = tmp_path / bus
        thermofleet("run", small_toml, *BLIND, *HARD, "--bus", bus, "--out", out).succeeded()
        printed[bus] = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert printed["memory"]["channel"] == {
        "topology": "line",
        "delay_s": 20.0,
        "jitter_s": 5.0,
        "loss": 0.2,
        "partitions": [{"from_s": 30.0, "to_s": 60.0, "groups": [["left"], ["right"]]}],
    }
    assert printed["memory"] | {"bus": "zenoh"} == printed["zenoh"]
    assert (tmp_path / "memory/events.parquet").read_bytes() == (tmp_path / "zenoh/events.parquet").read_bytes()
    words = 2 * 19  # 18 ticks and the one of the reset, two links
    assert 0 < printed["memory"]["metrics"]["messages"] < words


def test_a_comparison_states_its_channel(thermofleet, small_toml):
    call = ("compare", small_toml, "--difficulty", "blind", "--seeds", 2, "--policies", "round_robin")
    plain, hard = thermofleet(*call), thermofleet(*call, *HARD)
    assert "Channel" not in plain.out
    said = "Channel: line, 20 to 25 s late, 20 % lost, cut from 30 to 60 s."
    assert said in " ".join(hard.out.split())
    assert json.loads(thermofleet(*call, *HARD, "--json").out)["channel"]["delay_s"] == 20.0


def test_every_option_of_a_command_is_read():
    unread: list[str] = []
    for path in sorted((Path(__file__).parents[2] / "scenarios" / "cli").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                read = {each.id for part in node.body for each in ast.walk(part) if isinstance(each, ast.Name)}
                names = [each.arg for each in (*node.args.args, *node.args.kwonlyargs)]
                ignored = [name for name in names if not name.startswith("_") and name not in read | {"self"}]
                unread += [f"{path.name}: {node.name}({name})" for name in ignored]
    assert unread == []


def test_a_new_scenario_runs_and_its_comments_are_allowed_choices(thermofleet, tmp_path):
    file, out = tmp_path / "my_cell.toml", tmp_path / "run"
    said = thermofleet("new", file)
    assert (said.code, f"thermofleet layout {file}" in said.out) == (0, True)
    thermofleet("layout", file).succeeded()
    thermofleet("run", file, *QUICK, "--out", out).succeeded()
    metrics = run_json(out)["metrics"]
    assert 5 < metrics["finished"] == metrics["jobs"]
    text = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r"^# (?=\[+\w+\]|\w+ = )", "", text, flags=re.MULTILINE), encoding="utf-8")
    (tmp_path / "monday.csv").write_text("name,kind,places,release\nfirst,hold,clamp,6:30\n", encoding="utf-8")
    commented = load(file)
    assert commented.limits == load(library()["quickstart"]).limits == ThermalLimits()
    assert len(commented.fixtures) == 1
    assert commented.jobs[-1].arrivals.times_s == (1800.0,)


def test_a_new_scenario_may_be_a_copy_and_replaces_no_file(thermofleet, tmp_path):
    file = tmp_path / "mine.toml"
    thermofleet("new", file, "--from", "quickstart").succeeded()
    assert file.read_bytes() == library()["quickstart"].read_bytes()
    for words, reason in (
        ((file,), f"'{file}' exists. Give another name, or remove it."),
        ((tmp_path / "x.toml", "--from", "quikstart"), "no scenario 'quikstart'; did you mean 'quickstart'? Allowed: "),
        ((tmp_path / "x.csv",), "The name of a scenario file ends in .toml (got 'x.csv')."),
        ((tmp_path / "no" / "x.toml",), "No such file or directory."),
    ):
        assert thermofleet("new", *words).refused(reason)


def test_a_bound_has_one_end_of_its_search(thermofleet, small_toml: Path) -> None:
    call = ("bounds", small_toml, "--budget", 30, "--evaluations", 64)
    assert thermofleet(*call).refused("Error: --budget and --evaluations exclude each other (got 30 and 64).")
