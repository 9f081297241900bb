"""Words, tables and a progress bar on the terminal, for every command alike."""

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Progressbar

from fleet.errors import FleetError

out_console = Console()
err_console = Console(stderr=True)

Progress = Callable[[str, float], None]
"""Told what is going on and the share of it that is done, 0 to 1."""

LONG_STAGES = {
    "training": "Training the twins that are not in the cache: a minute at most per arm and core, full ones minutes …",
    "learning the log": "Training the twin of the log: up to a minute, at full size some minutes …",
    "teaching": "Training the networks that the report compares and the cache lacks: the longest part …",
    "comparing": "Comparing the policies …",
}
"""What is said of a stage that takes long where there is no terminal to draw a bar on."""
COUNTED = "computing "
"""Begins the name of a stage that counts what there is to do; where there is no bar, each is said as it is."""


class Interrupted(FleetError):
    """Ctrl-C before there was anything to keep; names the stage."""


@contextmanager
def progress_bar(*, kept: str = "Plans and twins already made are") -> Iterator[Progress]:
    """A bar on standard error that names the stage; where there is no terminal, a line for each that takes long.

    Args:
        kept: What is found in the cache after an interruption, as the beginning of a sentence; empty for nothing.

    Raises:
        Interrupted: Ctrl-C in a stage that keeps nothing but what is in the cache.
    """
    from scenarios.build import cache_folder

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description:<9}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    with Progressbar(*columns, console=err_console, transient=True, disable=not err_console.is_terminal) as bar:
        task = bar.add_task("starting", total=1.0)

        def tell(stage: str, share: float) -> None:
            if not err_console.is_terminal and stage != bar.tasks[0].description:
                if stage.startswith(COUNTED):
                    say(f"{stage[0].upper()}{stage[1:]}")
                elif share < 1.0 and stage in LONG_STAGES:
                    say(LONG_STAGES[stage])
            bar.update(task, description=stage, completed=share)

        try:
            yield tell
        except KeyboardInterrupt:
            again = f" {kept} kept in {cache_folder()}, and the same command goes on from there." if kept else ""
            raise Interrupted(f"Interrupted while {bar.tasks[0].description}: nothing was written.{again}") from None


def say(sentence: str, console: Console = err_console) -> None:
    """A sentence on standard error; on a terminal wrapped between words, but never within one, which may be a path."""
    if console.is_terminal:
        sentence = textwrap.fill(sentence, console.width, break_long_words=False, break_on_hyphens=False)
    console.print(sentence, markup=False, highlight=False, soft_wrap=True)
