"""Every tutorial runs, and pages on files of a scenario: commands, files and programs in order, with their outputs.

A block of `sh` is run in a shell, one of `python` by Python; with a title it is a file instead. A block of `text` is
the output of the block before it, where … matches anything. After `<!-- background -->` a command keeps running.
"""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [
    *sorted((DOCS / "tutorials").glob("*.md")),
    *(DOCS / "how_to" / f"{name}.md" for name in ("job_table", "mesh")),
]
_BLOCK = re.compile(
    r'^(?P<behind><!-- background -->\n)?```(?P<kind>\w+)(?: title="(?P<title>[\w.]+)")?\n(?P<text>.*?)^```$',
    re.DOTALL | re.MULTILINE,
)
LIMIT_S = 240


class Block(NamedTuple):
    kind: str
    title: str | None
    text: str
    background: bool


def blocks(page: str) -> list[Block]:
    return [Block(m["kind"], m["title"], m["text"], bool(m["behind"])) for m in _BLOCK.finditer(page)]


def pattern(shown: str) -> re.Pattern[str]:
    """What an output must match: … alone in a line is any lines, inside a line any text."""
    lines = [".*?" if line == "…" else re.escape(line.rstrip()).replace("…", r"[^\n]*") for line in shown.splitlines()]
    return re.compile(r"\s*\n\s*".join(lines).replace(r".*?\s*\n\s*", r".*?"), re.DOTALL)


class Terminal:
    """Runs blocks in a folder; commands in the background end with it."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = str(probe.getsockname()[1])
        (folder / "bin").mkdir()
        main = "from scenarios.cli.main import main; main()"
        for name, rest in (("thermofleet", f" -c {shlex.quote(main)}"), ("python", "")):
            script = folder / "bin" / name
            script.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)}{rest} "$@"\n', encoding="utf-8")
            script.chmod(0o755)
        self._folder, self._behind = folder, list[subprocess.Popen[str]]()
        self._env = os.environ | {
            "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join((str(DOCS.parent), str(folder))),
            "THERMOFLEET_CACHE": str(folder / "cache"),
            "THERMOFLEET_ENDPOINT": f"tcp/127.0.0.1:{self._port}",
            "PYTHONUNBUFFERED": "1",
            "COLUMNS": "80",
        }

    def run(self, block: Block, shown: str | None) -> None:
        text = block.text.replace("7447", self._port)
        expected = None if shown is None else pattern(shown.replace("7447", self._port))
        if block.title is not None:
            (self._folder / block.title).write_text(text, encoding="utf-8")
            return
        command = [sys.executable, "-c", text] if block.kind == "python" else ["sh", "-ec", text]
        if block.background:
            self._start(["sh", "-ec", f"exec {text}"], expected)
            return
        done = subprocess.run(
            command, cwd=self._folder, env=self._env, timeout=LIMIT_S, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        output = done.stdout.decode()
        assert done.returncode == 0, f"{text}\n{output}"
        assert expected is None or expected.search(output), f"{text}\n{output}"

    def _start(self, command: list[str], expected: re.Pattern[str] | None) -> None:
        process = subprocess.Popen(
            command, cwd=self._folder, env=self._env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._behind.append(process)
        assert process.stdout is not None
        limit, output = threading.Timer(LIMIT_S, process.kill), ""
        limit.start()
        for line in process.stdout:
            output += line
            if expected is None or expected.search(output):
                break
        else:
            pytest.fail(output)
        limit.cancel()

    def close(self) -> None:
        for process in self._behind:
            process.send_signal(signal.SIGINT)
        for process in self._behind:
            process.communicate(timeout=LIMIT_S)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    opened = Terminal(tmp_path)
    yield opened
    opened.close()


@pytest.mark.ci_slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_runs_and_prints_the_outputs_of_its_page(page: Path, terminal: Terminal) -> None:
    steps = blocks(page.read_text(encoding="utf-8"))
    assert sum(step.kind == "text" for step in steps) >= 3
    for step, following in zip(steps, [*steps[1:], None], strict=True):
        if step.kind != "text":
            shown = following.text if following is not None and following.kind == "text" else None
            terminal.run(step, shown)


def test_another_output_does_not_match() -> None:
    shown = "a 1\n…\nc … 3\n"
    for right in ("a 1\nb\nb\nc 2 3\n", "a 1  \nc  3"):
        assert pattern(shown).search(right), right
    for wrong in ("a 2\nb\nc 2 3", "a 1\nc 2\n3", "a 1\n"):
        assert not pattern(shown).search(wrong), wrong
