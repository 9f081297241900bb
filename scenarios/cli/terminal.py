"""Output of every command: sentences, tables, JSON and a progress bar."""

import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from fleet.errors import FleetError, visible
from fleet.files import cache_folder
from scenarios.progress import COUNTED, Progress


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


out_console = SafeConsole()
err_console = SafeConsole(stderr=True)

LONG_STAGES = {
    "training": "Training the twins that are not in the cache: up to a minute per arm and core, full size minutes …",
    "learning the log": "Training the twin of the log: up to a minute, several minutes at full size …",
    "teaching": "Training the networks that the report compares and the cache lacks: the longest part …",
    "comparing": "Comparing the policies …",
}
"""Lines printed for long stages when there is no terminal to draw a bar on."""
INTERRUPTED = 130
"""Exit code after Ctrl-C."""


class Interrupted(FleetError):
    """Ctrl-C before there was a result to keep; names the stage."""


@contextmanager
def progress_bar(*, kept: str = "Plans and twins already made are") -> Iterator[Progress]:
    """Show a bar on standard error that names the stage; without a terminal, one line for each long stage.

    Args:
        kept: What an interruption leaves in the cache, as the beginning of a sentence; empty for nothing.

    Raises:
        Interrupted: Ctrl-C.
    """
    from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    is_terminal = err_console.is_terminal
    name = TextColumn("{task.description:<9}")
    columns = (SpinnerColumn(), name, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Bar(*columns, console=err_console, transient=True, disable=not is_terminal) as bar:
        task = bar.add_task("starting", total=1.0)

        def report(stage: str, fraction: float) -> None:
            if not is_terminal and stage != bar.tasks[0].description:
                if stage.startswith(COUNTED):
                    say(f"{stage[0].upper()}{stage[1:]}")
                elif fraction < 1.0 and stage in LONG_STAGES:
                    say(LONG_STAGES[stage])
            bar.update(task, description=stage, completed=fraction)

        try:
            yield report
        except KeyboardInterrupt:
            rest = f" {kept} kept in {cache_folder()}, and the same command continues from there." if kept else ""
            raise Interrupted(f"Interrupted while {bar.tasks[0].description}: nothing was written.{rest}") from None


def print_json(value: object) -> None:
    """Print a value on standard output as JSON."""
    import msgspec

    echo(msgspec.json.format(msgspec.json.encode(value), indent=1).decode())


def plain_table(*heads: str, numbers: bool = True, title: str | None = None, caption: str | None = None) -> Table:
    """An empty table without lines; with `numbers` all columns but the first are aligned to the right."""
    table = Table(box=None, pad_edge=False, title=title, caption=caption, title_justify="left", caption_justify="left")
    for column, head in enumerate(heads):
        table.add_column(head, justify="right" if numbers and column else "left", no_wrap=numbers and not column)
    return table


def say(sentence: str, console: Console = err_console) -> None:
    """Print a sentence, by default on standard error; a terminal wraps it between words, so that paths stay whole."""
    if console.is_terminal:
        sentence = textwrap.fill(sentence, console.width, break_long_words=False, break_on_hyphens=False)
    console.print(sentence, markup=False, highlight=False, soft_wrap=True)
