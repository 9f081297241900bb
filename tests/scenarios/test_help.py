"""Help, version, shell completion and warnings of the command line."""

import os
import subprocess
import sys
import textwrap
from importlib.metadata import version

import pytest

from agents.registry import RULES
from fleet.bus.exchange.channel import TOPOLOGIES
from scenarios.cli.main import COMMANDS


def test_help_names_every_command_by_group_and_run_names_every_policy_and_topology(thermofleet):
    said = thermofleet("--help")
    assert said.code == 0
    assert all(f"│ {name.split()[0]} " in said.out for name in COMMANDS)
    assert all(f"─ {entry.panel} ─" in said.out for entry in COMMANDS.values())
    wide = " ".join(thermofleet("run", "--help").out.replace("│", " ").split())
    assert all(name in wide for name in (*RULES, *TOPOLOGIES))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_listed_command_can_be_imported_and_explains_itself(thermofleet, name):
    said = thermofleet(*name.split(), "--help")
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
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    assert said.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("module", ["run", "look", "evaluate", "live", "jobs", "keys", "twin"])
def test_a_command_is_declared_without_what_it_runs(module):
    """Its help takes 0.3 s; the schema of scenarios, Zenoh or MuJoCo would double that."""
    large = ("networkx", "torch", "zenoh", "plotly", "mujoco", "numba", "scenarios.spec.schema")
    program = f"import sys, scenarios.cli.{module}; print([name for name in {large} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        ("thermofleet re", ["report"]),
        ("thermofleet run --pl", ["--plant"]),
        ("thermofleet run quickstart --plant m", ["mujoco"]),
        ("thermofleet bus re", ["record", "replay"]),
        ("thermofleet arm re", ["reset"]),
    ],
)
def test_the_shell_completes_commands_and_their_options(words, completions):
    program = "from scenarios.cli.main import main; main()"
    last = str(len(words.split()) - 1)
    asked = {"_THERMOFLEET_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": last}
    command = [sys.executable, "-c", program]
    said = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, timeout=300, check=True)
    assert sorted(said.stdout.split()) == completions


def test_a_warning_is_one_line_where_there_is_no_terminal():
    warn = "logging.getLogger('fleet.live').warning('%s', 'word ' * 60)"
    code = f"import logging, scenarios.cli.main as cli; cli.app = lambda **_: {warn}; cli.main([])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert done.stderr == f"WARNING  fleet.live: {'word ' * 60}\n"
