"""The command line `thermofleet`: its commands by group, and the exit codes of errors.

The module of a command is imported when the command runs, so `--help` is fast.
"""

import errno
import logging
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import zip_longest
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from fleet.errors import FleetError, JournalFull, NoRouter, printable, visible
from fleet.live.supervisor import SUPERVISED, WAITS
from scenarios.cli.from_fields import with_fields
from scenarios.cli.terminal import INTERRUPTED, Interrupted, echo, err_console, say
from scenarios.extras import missing_extra

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
    """Its group in `thermofleet --help`."""
    target: str
    """MODULE:NAME of its function or `typer.Typer`, the module relative to this package."""
    help: str


_LOOK, _POLICIES, _LIVE = "Run and look", "Evaluate policies", "Run a live fleet"
_TWIN, _TOOLS = "Digital twin", "Tools"
COMMANDS = {
    "demo": LazyCommand(_LOOK, "run:demo_command", "Run the quickstart shift under two policies."),
    "run": LazyCommand(_LOOK, "run:run_command", "Run one shift of a scenario and record it."),
    "list": LazyCommand(_LOOK, "library:list_command", "List the scenarios that come with thermofleet."),
    "suite": LazyCommand(_LOOK, "library:suite_command", "List the benchmark's suite of instances."),
    "show": LazyCommand(_LOOK, "library:show_command", "Show a scenario: arms, jobs, thermal load factor."),
    "layout": LazyCommand(_LOOK, "library:layout_command", "Show reach, space and problems of a cell."),
    "film": LazyCommand(_LOOK, "film:film_command", "Film a recorded shift."),
    "view": LazyCommand(_LOOK, "view:view_command", "Play a shift in MuJoCo's viewer."),
    "trace": LazyCommand(_LOOK, "scenarios.trace.command:trace_command", "Follow an event to its causes."),
    "compare": LazyCommand(_POLICIES, "compare:compare_command", "Compare policies on the same seeds."),
    "ablate": LazyCommand(_POLICIES, "compare:ablate_command", "Compare sources of predictions under one policy."),
    "bounds": LazyCommand(_POLICIES, "scenarios.bounds.command:bounds_command", "Bound the reward of shifts."),
    "leaderboard": LazyCommand(
        _POLICIES, "scenarios.leaderboard.command:leaderboard_command", "Print the leaderboard of a split."
    ),
    "submit-result": LazyCommand(
        _POLICIES, "scenarios.leaderboard.command:submit_command", "Check a result and write the file to send."
    ),
    "cooling": LazyCommand(
        _POLICIES, "heat.cooling:cooling_command", "Compare ways of cooling motor, joint and fleet."
    ),
    "train": LazyCommand(_POLICIES, "train:train_command", "Train a policy by reinforcement learning."),
    "up": LazyCommand(_LIVE, "live.up:up_command", "Start a whole fleet, one process per participant."),
    "router": LazyCommand(_LIVE, "router:router_command", "Run the Zenoh router of a fleet."),
    "arm": LazyCommand(_LIVE, "live.arm:arm_command", "Run one arm of a fleet."),
    "auction": LazyCommand(_LIVE, "live.auction:auction_command", "Run the auctioneer of a fleet."),
    "submit": LazyCommand(_LIVE, "live.submit:submit_command", "Submit jobs to a fleet."),
    "ask": LazyCommand(_LIVE, "live.ask:ask_command", "Ask every arm for a quote."),
    "clear": LazyCommand(_LIVE, "live.clear:clear_command", "Free the space of an absent arm."),
    "cancel": LazyCommand(_LIVE, "live.control:cancel_command", "Cancel jobs."),
    "settle": LazyCommand(_LIVE, "live.control:settle_command", "Say what became of an unfinished job."),
    "change": LazyCommand(_LIVE, "live.control:change_command", "Change due date and value of a job."),
    "pause": LazyCommand(_LIVE, "live.control:pause_command", "Give an arm, or all arms, no more jobs."),
    "resume": LazyCommand(_LIVE, "live.control:resume_command", "End a pause."),
    "reset": LazyCommand(_LIVE, "live.control:reset_command", "Clear the fault of an arm."),
    "watch": LazyCommand(_LIVE, "live.watch:watch_command", "Watch a fleet in the terminal."),
    "doctor": LazyCommand(_LIVE, "live.doctor:doctor_command", "Check the health of a fleet."),
    "dashboard": LazyCommand(_LIVE, "live.gateway:dashboard_command", "Show a fleet live on a page."),
    "gateway": LazyCommand(_LIVE, "live.gateway:gateway_command", "Serve a fleet over HTTP."),
    "record": LazyCommand(_LIVE, "live.record:record_command", "Record a fleet to Parquet."),
    "replay": LazyCommand(_LIVE, "live.record:replay_command", "Replay a run or a recording on the bus."),
    "report": LazyCommand(_LIVE, "live.record:report_command", "Write the report of a recording."),
    "ros2": LazyCommand(_LIVE, "ros2:ros2_app", "Connect a fleet and ROS 2."),
    "vda5050": LazyCommand(_LIVE, "live.vda5050:vda5050_command", "Take orders by VDA 5050 over MQTT."),
    "keys": LazyCommand(_LIVE, "keys:keys_command", "Make and show TLS keys and certificates."),
    "twin": LazyCommand(_TWIN, "twin.group:twin_app", "Train, score and use the digital twin of an arm."),
    "study": LazyCommand(
        _TWIN, "scenarios.studies.lifetime.command:study_command", "Study transfer, augmentation, drift of a twin."
    ),
    "hold": LazyCommand(_TWIN, "scenarios.motion.hold:hold_command", "Compute how long an arm can hold a payload."),
    "contract": LazyCommand(_TOOLS, "contract:contract_command", "Generate the bus schemas and the tables in docs."),
}


class LazyGroup(TyperGroup):
    """The commands of `COMMANDS`: listed by their entries, imported when they run."""

    def __init__(self, **attributes: Any) -> None:  # whatever typer passes on to its base class
        super().__init__(**attributes)
        for name, entry in COMMANDS.items():
            self.add_command(TyperCommand(name, help=entry.help, rich_help_panel=entry.panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Import the command in place of its entry, for running it and for shell completion.

        Any: typer keeps the classes of contexts and commands private.
        """
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and load_command(str(name)), rest


def target_of(name: str) -> Callable[..., None] | typer.Typer:
    """Import the function of a command, or its group of commands."""
    module, _, attribute = COMMANDS[name].target.partition(":")
    prefix = "" if module.startswith("scenarios.") else "scenarios.cli."
    return getattr(import_module(prefix + module), attribute)


def load_command(name: str) -> Any:
    """Import a command (Any: typer keeps the class of commands private)."""
    target = target_of(name)
    if not isinstance(target, typer.Typer):
        alone = typer.Typer(add_completion=False)
        alone.command(name)(with_fields(target))
        target = alone
    command = typer.main.get_command(target)
    command.name = name
    return command


app = typer.Typer(
    cls=LazyGroup,
    help="Simulate and run fleets of robot arms that allocate jobs by thermal difficulty.",
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


def _given(error: typer.TyperException, words: Sequence[str]) -> str | None:
    """The last value of the option that an error is about, which typer's own messages leave out; None without one."""
    options, given = getattr(getattr(error, "param", None), "opts", ()), None
    for word, following in zip_longest(words, words[1:]):
        name, is_whole, value = word.partition("=")
        if name in options:
            given = value if is_whole else following
    return given


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line: an error that the user can correct is one sentence and exit code 2; Ctrl-C is 130."""
    _log_warnings()
    try:
        code = app(args=list(argv) if argv is not None else None, prog_name="thermofleet", standalone_mode=False)
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
