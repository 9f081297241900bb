"""The systemd units in docs/systemd, as systemd itself and the command line read them."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scenarios.cli.main import GROUPS, load_command

PROGRAM = "/opt/thermofleet/bin/thermofleet"
UNITS = {path.name: path.read_text() for path in (Path(__file__).parents[1] / "docs" / "systemd").glob("*.service")}


def test_systemd_accepts_the_documented_units(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    assert len(UNITS) == 3
    for name, text in UNITS.items():
        (tmp_path / name).write_text(text.replace(PROGRAM, sys.executable))  # verify needs an executable file
    paths = [str(tmp_path / name) for name in UNITS]
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *paths], capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.returncode, [line for line in done.stderr.splitlines() if str(tmp_path) in line]) == (0, [])
    wrong = tmp_path / "wrong.service"
    wrong.write_text(UNITS["thermofleet-router.service"].replace("Restart=always", "Restart=allways"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(wrong)], capture_output=True, text=True, timeout=300, check=False
    )
    assert "allways" in done.stderr  # it does read them


@pytest.mark.parametrize("name", UNITS)
def test_the_command_line_accepts_the_commands_of_the_units(name):
    (line,) = re.findall(r"^ExecStart=(.*)$", UNITS[name], re.MULTILINE)
    program, command, *words = shlex.split(line)
    assert program == PROGRAM
    if command in GROUPS:
        command, *words = f"{command} {words[0]}", *words[1:]
    load_command(command).make_context(command, words)  # raises on an unknown option or a value out of range
