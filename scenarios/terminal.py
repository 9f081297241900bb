"""Output of every command: sentences, tables, JSON and a progress bar."""

import os
import textwrap
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from fleet.errors import FleetError, visible
from fleet.files import cache_folder
from scenarios.progress import COUNTED, Progress, StageClock, brief
from scenarios.table import Table


class SafeConsole(Console):
    """Console that escapes control characters and direction marks in all texts, so none can change the terminal."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Return segments whose text is visible; control segments are rich's own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text, "\n"), segment.style)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return visible text, so that its width is known (Any: options of rich, passed on)."""
        return super().render_str(visible(text, "\n"), **options)


def echo(text: str, *, nl: bool = True) -> None:
    """Print text on standard output, with control characters and direction marks escaped."""
    typer.echo(visible(text, "\n"), nl=nl)


out_console = SafeConsole(emoji=False)  # a name such as `:bomb:` stays as it is
err_console = SafeConsole(stderr=True, emoji=False)

EVERY_S, AFTER_S = 30.0, 2.0
"""Without a terminal: time between two lines of one stage, and time that a stage must last to have a line."""
KEPT = "Plans and twins already made are"
"""What an interruption leaves in the cache."""
INTERRUPTED = 130
"""Exit code after Ctrl-C."""


class Interrupted(FleetError):
    """Ctrl-C before there was a result to keep; names the stage."""


@contextmanager
def progress_bar(*, kept: str = KEPT, file: Path | None = None) -> Iterator[Progress]:
    """Show a bar on standard error: what is going on, count and time left. Without a terminal, print lines.

    Lines are printed when a stage begins that lasts longer than `AFTER_S`, and every `EVERY_S` in it.

    Args:
        kept: What an interruption leaves in the cache, as the beginning of a sentence; empty for nothing.
        file: File or folder that has it, in place of the cache.

    Raises:
        Interrupted: Ctrl-C.
    """
    shown = _Bar() if err_console.is_terminal else _Lines()
    with shown:
        try:
            yield shown.report
        except KeyboardInterrupt:
            where = file or cache_folder()
            rest = f" {kept} kept in {where}, and the same command continues from there." if kept else ""
            stage = shown.clock.stage or "starting"
            raise Interrupted(f"Interrupted while {stage}{'.' if file else ': nothing was written.'}{rest}") from None


class _Bar:
    """A bar on the terminal."""

    def __init__(self) -> None:
        from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        self.clock = StageClock()
        text, left = TextColumn("{task.description}"), TextColumn("{task.fields[left]}")
        columns = (SpinnerColumn(), text, BarColumn(bar_width=18), TaskProgressColumn(), TimeElapsedColumn(), left)
        self._bar = Bar(*columns, console=err_console, transient=True)
        self._task = self._bar.add_task("Starting", total=1.0, left="")

    def __enter__(self) -> None:
        self._bar.start()

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def report(self, stage: str, fraction: float) -> None:
        """Show a report."""
        now_s = time.monotonic()
        if self.clock.update(stage, fraction, now_s):
            self._bar.reset(self._task, total=1.0)
        left_s = self.clock.left_s(now_s)
        left = "" if left_s is None else f"{brief(left_s)} left"
        self._bar.update(self._task, description=self.clock.label, completed=float(fraction), left=left)


class _Lines:
    """Lines on standard error, printed by a thread: a long step reports nothing meanwhile."""

    def __init__(self) -> None:
        self.clock = StageClock()
        self._due_s, self._begun = float("inf"), False
        self._changed, self._ended = threading.Condition(), False
        self._thread = threading.Thread(target=self._print, name="progress", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def report(self, stage: str, fraction: float) -> None:
        """Take a report."""
        with self._changed:
            now_s = time.monotonic()
            if self.clock.update(stage, fraction, now_s):
                self._begun = stage.startswith(COUNTED)
                if self._begun:
                    say(self.clock.first_line().removesuffix(" …"))
                self._due_s = now_s + (EVERY_S if self._begun else AFTER_S)
                self._changed.notify()

    def _print(self) -> None:
        with self._changed:
            while not self._ended:
                now_s = time.monotonic()
                if now_s < self._due_s:
                    self._changed.wait(None if self._due_s == float("inf") else self._due_s - now_s)
                    continue
                if self.clock.fraction < 1.0:
                    say(self.clock.line(now_s) if self._begun else self.clock.first_line())
                    self._begun = True
                self._due_s = now_s + EVERY_S


def print_json(value: object) -> None:
    """Print a value on standard output as JSON."""
    from scenarios.result_folder import json_text

    echo(json_text(value), nl=False)


def print_either(as_json: bool, value: object, *parts: RenderableType) -> None:
    """Print a value as JSON, or else what shows it to people."""
    if as_json:
        print_json(value)
    else:
        out_console.print(*parts, sep="\n")


WIDE = 200
"""Columns of a table with many columns in a file or a pipe, which have no width of their own."""


def print_wide(table: RenderableType) -> None:
    """Print a table with many columns: in the width of the terminal, without one in `WIDE`."""
    (out_console if _has_width() else SafeConsole(width=WIDE)).print(table)


def print_lines(table: Table, leave_out: Sequence[str]) -> None:
    """Print a table with a line for each row: whole without a terminal, else as `Table.in_lines`.

    On a terminal that is too narrow for that, each row is a sentence.
    """
    if not _has_width():
        SafeConsole(width=table.width).print(table)
    elif (lines := table.in_lines(out_console.width, leave_out)).width <= out_console.width:
        out_console.print(lines)
    else:
        for name, *cells in table.rows:
            fields = zip(table.headings[1:], cells, strict=True)
            say(f"{name}: {', '.join(f'{heading} {cell}' for heading, cell in fields if cell)}", out_console)


def _has_width() -> bool:
    return out_console.is_terminal or "COLUMNS" in os.environ


def say(sentence: str, console: Console = err_console) -> None:
    """Print a sentence, by default on standard error; a terminal wraps it between words, so that paths stay whole."""
    if console.is_terminal:
        sentence = textwrap.fill(sentence, console.width, break_long_words=False, break_on_hyphens=False)
    console.print(sentence, markup=False, highlight=False, soft_wrap=True)
