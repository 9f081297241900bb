"""The command line `thermofleet`: its commands by group, and the exit codes of errors.

The module of a command is imported when the command runs, so `--help` is fast.
"""

import errno
import logging
import os
import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from itertools import zip_longest
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from fleet.errors import FleetError, JournalFull, NoRouter, printable, visible
from fleet.live.supervisor import SUPERVISED, WAITS, name_process
from scenarios.cli.options import with_fields
from scenarios.extras import missing_extra
from scenarios.terminal import INTERRUPTED, Interrupted, echo, err_console, say

USAGE = 2
"""Exit code of an error that the user can correct."""
_DISK = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOENT),
)
"""Errors of a path that the user gave, or of its disk."""


class LazyCommand(NamedTuple):
    """A command whose module is imported when it runs."""

    panel: str
    """Heading in `thermofleet --help`."""
    target: str
    """MODULE:NAME of its function, the module relative to this package."""
    help: str


_LOOK, _POLICIES, _LIVE, _TWIN = "Run and look", "Evaluate policies", "Run a live fleet", "Digital twin"
GROUPS = {
    "job": LazyCommand(_LIVE, "", "Submit, follow and steer jobs."),
    "arm": LazyCommand(_LIVE, "", "Run and steer arms."),
    "bus": LazyCommand(_LIVE, "", "Run, watch, record and connect the other processes of a fleet."),
    "twin": LazyCommand(_TWIN, "", "Train, score and use the digital twin of an arm."),
}
"""Groups of commands."""
COMMANDS = {
    "demo": LazyCommand(_LOOK, "run:demo_command", "Run the quickstart shift under two policies."),
    "run": LazyCommand(_LOOK, "run:run_command", "Run one shift of a scenario and record it."),
    "show": LazyCommand(_LOOK, "look:show_command", "List the scenarios or the suite, or show one scenario."),
    "new": LazyCommand(_LOOK, "look:new_command", "Write a commented scenario file to change."),
    "layout": LazyCommand(_LOOK, "look:layout_command", "Show reach, space and problems of a cell."),
    "view": LazyCommand(_LOOK, "look:view_command", "Play a shift in MuJoCo's viewer, or write it as a film or scene."),
    "report": LazyCommand(_LOOK, "look:report_command", "Write the page of a run or recording, or trace an event."),
    "compare": LazyCommand(_POLICIES, "evaluate:compare_command", "Compare policies on the same seeds."),
    "bounds": LazyCommand(_POLICIES, "evaluate:bounds_command", "Bound the reward of shifts."),
    "leaderboard": LazyCommand(_POLICIES, "evaluate:leaderboard_command", "Print the leaderboard, or check a result."),
    "train": LazyCommand(_POLICIES, "evaluate:train_command", "Train a policy by reinforcement learning."),
    "up": LazyCommand(_LIVE, "live:up_command", "Start a whole fleet, one process per participant."),
    "job submit": LazyCommand(_LIVE, "jobs:submit_command", "Submit jobs, or request quotes."),
    "job list": LazyCommand(_LIVE, "jobs:list_command", "List the jobs of a fleet."),
    "job cancel": LazyCommand(_LIVE, "jobs:cancel_command", "Cancel jobs."),
    "job change": LazyCommand(_LIVE, "jobs:change_command", "Change due date and value of a job."),
    "job settle": LazyCommand(_LIVE, "jobs:settle_command", "Resolve a job with unknown outcome."),
    "arm run": LazyCommand(_LIVE, "live:arm_command", "Run one arm of a fleet."),
    "arm pause": LazyCommand(_LIVE, "jobs:pause_command", "Pause or resume one arm or all arms."),
    "arm reset": LazyCommand(_LIVE, "jobs:reset_command", "Clear the fault of an arm."),
    "arm clear": LazyCommand(_LIVE, "jobs:clear_command", "Free the space of an offline arm."),
    "bus router": LazyCommand(_LIVE, "live:router_command", "Run the Zenoh router of a fleet."),
    "bus auctioneer": LazyCommand(_LIVE, "live:auctioneer_command", "Run the auctioneer of a fleet."),
    "bus watch": LazyCommand(_LIVE, "live:watch_command", "Watch a fleet in the terminal."),
    "bus doctor": LazyCommand(_LIVE, "live:doctor_command", "Check the health of a fleet."),
    "bus record": LazyCommand(_LIVE, "live:record_command", "Record a fleet to Parquet."),
    "bus replay": LazyCommand(_LIVE, "live:replay_command", "Replay a run or a recording on the bus."),
    "bus gateway": LazyCommand(_LIVE, "live:gateway_command", "Serve a fleet over HTTP, with a live page."),
    "bus keys": LazyCommand(_LIVE, "keys:keys_command", "Make and show TLS keys and certificates."),
    "bus ros2": LazyCommand(_LIVE, "live:ros2_command", "Connect a fleet to ROS 2."),
    "twin train": LazyCommand(_TWIN, "twin:train_command", "Train the twins of a scenario, or one from logs."),
    "twin score": LazyCommand(_TWIN, "twin:score_command", "Score and judge every job of a scenario, or a log."),
    "twin identify": LazyCommand(_TWIN, "twin:identify_command", "Identify an arm's thermal network."),
    "twin forecast": LazyCommand(_TWIN, "twin:forecast_command", "Predict motor temperatures of a planned motion."),
    "twin generate": LazyCommand(_TWIN, "twin:generate_command", "Generate new cool motion."),
    "twin recover": LazyCommand(_TWIN, "twin:recover_command", "Find a posture with less load for a warm arm."),
    "twin export": LazyCommand(_TWIN, "twin:export_command", "Export a twin as ONNX."),
    "twin report": LazyCommand(_TWIN, "twin:report_command", "Write the paper's figures as one page."),
}
MOVED = {
    **{word: f"job {word}" for word in ("submit", "cancel", "change", "settle")},
    **{word: f"arm {word}" for word in ("pause", "reset", "clear")},
    **{word: f"bus {word}" for word in ("router", "watch", "doctor", "gateway", "record", "replay", "ros2", "keys")},
    "list": "show",
    "film": "view --out",
    "trace": "report --trace",
    "hold": "show --hold",
    "suite": "show --suite",
    "ablate": "compare --difficulty",
    "submit-result": "leaderboard --submit",
    "ask": "job submit --quote",
    "resume": "arm pause --end",
    "arm resume": "arm pause --end",
    "auction": "bus auctioneer",
    "dashboard": "bus gateway --page",
    "twin verdict": "twin score --verdict",
}
"""Earlier names of commands."""


class LazyGroup(TyperGroup):
    """The commands of `COMMANDS` below `words`: listed from their entries, imported when they run."""

    words: tuple[str, ...] = ()
    """Before the name of each command."""

    def __init__(self, **attributes: Any) -> None:  # whatever typer passes on to its base class
        super().__init__(**attributes)
        depth = len(self.words)
        for name, entry in COMMANDS.items():
            *before, word = name.split()[: depth + 1]
            if tuple(before) == self.words and word not in self.commands:
                listed = entry if depth else GROUPS.get(word, entry)
                panel = None if depth else listed.panel
                self.add_command(TyperCommand(word, help=listed.help, rich_help_panel=panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Import the command in place of its entry, for running it and for shell completion.

        Any: typer keeps the classes of contexts and commands private.
        """
        if args and args[0] not in self.commands:
            old = " ".join((*self.words, args[0]))
            if old in MOVED and not ctx.resilient_parsing:
                raise FleetError(f"`thermofleet {old}` is now `thermofleet {MOVED[old]}`.")
            if self.words == ("arm",) and not args[0].startswith("-") and len(args) > 1 and not ctx.resilient_parsing:
                raise FleetError("`thermofleet arm SCENARIO NAME` is now `thermofleet arm run SCENARIO NAME`.")
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and load_command(" ".join((*self.words, str(name)))), rest


def load_command(name: str) -> Any:
    """Import a command, or make a group of them (Any: typer keeps the class of commands private).

    Args:
        name: Its words, as `bus router`.
    """
    words = name.split()
    if name in GROUPS:
        kind = type("LazyGroup", (LazyGroup,), {"words": tuple(words)})
        alone = typer.Typer(cls=kind, help=GROUPS[name].help, no_args_is_help=True, add_completion=False)
        alone.callback()(lambda: None)
    else:
        module, _, attribute = COMMANDS[name].target.partition(":")
        prefix = "" if module.startswith("scenarios.") else "scenarios.cli."
        alone = typer.Typer(add_completion=False)
        alone.command(words[-1])(with_fields(getattr(import_module(prefix + module), attribute)))
    command = typer.main.get_command(alone)
    command.name = words[-1]
    return command


app = typer.Typer(
    cls=LazyGroup,
    help="Simulate and run fleets of robot arms that allocate jobs by predicted motor temperatures.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        echo(f"thermofleet {version('thermofleet')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@cache
def _command() -> Any:
    """The commands; forks of `up` share them."""
    return typer.main.get_command(app)


def _given(error: typer.TyperException, words: Sequence[str]) -> str | None:
    """The last value of the option that an error is about, which typer's own messages leave out; None without one."""
    options, given = getattr(getattr(error, "param", None), "opts", ()), None
    for word, following in zip_longest(words, words[1:]):
        name, is_whole, value = word.partition("=")
        if name in options:
            given = value if is_whole else following
    return given


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line. Exit codes: 2 for an error that the user can correct, with one sentence; 130 for Ctrl-C."""
    _log_warnings()
    name_process()
    # The matrices of an arm are small: threads of NumPy's library would only wait for each other. Torch has its own.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        code = _command()(list(argv) if argv is not None else None, prog_name="thermofleet", standalone_mode=False)
    except Interrupted as interrupted:
        say(str(interrupted))
        sys.exit(INTERRUPTED)
    except FleetError as error:
        say(f"Error: {error}")
        sys.exit(WAITS if isinstance(error, NoRouter | JournalFull) and SUPERVISED in os.environ else USAGE)
    except ModuleNotFoundError as error:
        if missing_extra(error) is None:
            raise
        say(f"Error: {missing_extra(error)}")
        sys.exit(USAGE)
    except typer.TyperException as error:
        message = error.format_message().replace("Value error, ", "")  # typer's own word before "'x' is not one of"
        if message:  # empty if the help was shown instead
            given = _given(error, sys.argv[1:] if argv is None else argv)
            more = "" if given is None or given in message else f" (got '{printable(given)}')"
            say(f"Error: {message.rstrip('.')}{more}{'' if message.endswith('?') else '.'} See thermofleet --help.")
        sys.exit(USAGE)
    except OSError as error:
        if error.errno not in _DISK:
            raise
        say(f"Error: '{error.filename or 'disk'}': {error.strerror}.")
        sys.exit(USAGE)
    sys.exit(code or 0)


class VisibleFormatter(logging.Formatter):
    """Formatter that escapes control characters and direction marks."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as text."""
        return visible(super().format(record), "\n")


def _log_warnings() -> None:
    if not err_console.is_terminal:  # a file, in which every line is one message
        plain = logging.StreamHandler()
        plain.setFormatter(VisibleFormatter("%(levelname)-8s %(name)s: %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[plain])
        return
    from rich.logging import RichHandler

    handler = RichHandler(console=err_console, show_time=False, show_path=False, rich_tracebacks=False)
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", handlers=[handler])
