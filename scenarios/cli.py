"""The command line: `thermofleet run`, `list`, `show`, `compare`, `animate`, `demo`, and what has a file of its own."""

import errno
import json
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.logging import RichHandler
from rich.table import Table

from agents.rules import RULES
from fleet.bus.channel import PERFECT, Channel
from fleet.errors import FleetError
from fleet.metrics import Metrics
from scenarios.animate import animate_command
from scenarios.channel_options import ChannelMaker, with_channel
from scenarios.contract_cli import contract_command
from scenarios.hold import hold_command
from scenarios.keys_cli import keys_command
from scenarios.live_cli import register as register_live
from scenarios.load import library, load
from scenarios.policies import label, policy_of
from scenarios.router_cli import router_command
from scenarios.scenario import Scenario
from scenarios.terminal import Interrupted, Progress, err_console, out_console, progress_bar, say
from scenarios.train_cli import train_command
from scenarios.twin_cli import twin_app

app = typer.Typer(
    help="Robot fleets that know how hard a job is on their motors, tell each other, and share the work.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
ScenarioArg = Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")]
PolicyOption = Annotated[str, typer.Option(help=f"{', '.join(RULES)}, an own FILE.py:CLASS, or a folder of train.")]
SeedOption = Annotated[int, typer.Option(help="Draws the jobs, the noise and the policy's chance; 0 or more.")]
PlantOption = Annotated[str, typer.Option(help="profile (planned heat) or mujoco (closed loop in one scene).")]
BusOption = Annotated[str, typer.Option(help="zenoh (in-process router) or memory.")]
DifficultyOption = Annotated[str, typer.Option(help="What scores the plans: twin, blind or oracle.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print figures as JSON.")]

USAGE, INTERRUPTED = 2, 130
"""Exit codes: something the user can mend; Ctrl-C."""
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point: errors that the user can mend are one sentence and exit code 2; Ctrl-C is 130."""
    if err_console.is_terminal:
        told = RichHandler(console=err_console, show_time=False, show_path=False, rich_tracebacks=False)
        logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", handlers=[told])
    else:  # a file, where a line is a message
        logging.basicConfig(level=logging.WARNING, format="%(levelname)-8s %(name)s: %(message)s")
    try:
        code = app(args=list(argv) if argv is not None else None, prog_name="thermofleet", standalone_mode=False)
    except Interrupted as interrupted:
        say(str(interrupted))
        sys.exit(INTERRUPTED)
    except FleetError as error:
        say(f"Error: {error}")
        sys.exit(USAGE)
    except typer.TyperException as error:
        message = error.format_message()
        if message:  # none where the help was shown instead
            say(f"Error: {message.rstrip('.')}{'' if message.endswith('?') else '.'} See thermofleet --help.")
        sys.exit(USAGE)
    except OSError as error:
        if error.errno not in _DISK:
            raise
        say(f"Error: '{error.filename or 'disk'}': {error.strerror}.")
        sys.exit(USAGE)
    sys.exit(code or 0)


@app.command("run")
@with_channel
def run_command(
    scenario: ScenarioArg,
    policy: PolicyOption = "least_difficulty",
    seed: SeedOption = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the recording; default runs/SCENARIO-POLICY-SEED.")
    ] = None,
    plant: PlantOption = "profile",
    bus: BusOption = "zenoh",
    difficulty: DifficultyOption = "twin",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a finished run in --out.")] = False,
    listen: Annotated[
        int, typer.Option(help="Loopback port of the fleet's Zenoh router, for others to watch; 0 is any free one.")
    ] = 0,
    as_json: JsonOption = False,
    *,
    channel: ChannelMaker,
) -> None:
    """Work one shift of a scenario and record it."""
    from scenarios.folder import check_free

    chosen = load(scenario)
    spec = _spec(policy, seed, plant, bus, difficulty, channel(chosen))
    if not 0 <= listen <= 65535 or (listen and bus == "memory"):
        raise FleetError(f"--listen needs a port from 1 to 65535 and --bus zenoh (got {listen}, {bus}).")
    where = out or Path("runs") / f"{chosen.name}-{label(policy)}-{seed}"
    check_free(where, overwrite=overwrite)
    with router_at(listen) as endpoint, progress_bar() as progress:
        _, result = _run_into(chosen, spec, where, overwrite, progress, endpoint=endpoint)
    if as_json:
        typer.echo(json.dumps({"out": str(where), **_figures(result)}, indent=1))
    else:
        say(f"{chosen.name}, seed {seed}", out_console)
        out_console.print(table_of({label(policy): result.metrics}))
        if result.finished:
            say(f"Recorded in {where}; open {where / 'report.html'} in a browser.", out_console)
    if not result.finished:
        say(
            f"Interrupted after {result.time_s:g} s of {chosen.horizon_s:g} s: the shift until then is kept in {where} "
            "(status 'interrupted'). The same command works the whole shift from the plans and twins already made."
        )
        raise typer.Exit(INTERRUPTED)


@app.command("list")
def list_command(as_json: JsonOption = False) -> None:
    """Scenarios that come with thermofleet."""
    scenarios = {name: load(path) for name, path in library().items()}
    if as_json:
        typer.echo(json.dumps({name: s.description for name, s in scenarios.items()}, indent=1))
        return
    table = Table(box=None, pad_edge=False)
    for column in ("scenario", "arms", "hours", "what it is"):
        table.add_column(column)
    for name, s in scenarios.items():
        table.add_row(name, str(len(s.arms)), f"{s.horizon_s / 3600:g}", s.description)
    out_console.print(table)


@app.command("show")
def show_command(scenario: ScenarioArg, as_json: JsonOption = False) -> None:
    """A scenario in full: its fleet, its work, its thermal load factor."""
    from scenarios.show import describe

    chosen = load(scenario)
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(chosen), indent=1).decode())
        return
    with progress_bar() as progress:
        parts = describe(chosen, progress)
    for part in parts:
        out_console.print(part)


@app.command("compare")
@with_channel
def compare_command(
    scenario: ScenarioArg,
    policies: Annotated[
        str, typer.Option(help="Comma-separated; an own one as FILE.py:CLASS, a trained one as its folder.")
    ] = ",".join(RULES),
    seeds: Annotated[int, typer.Option(help="How many; 2 or more.")] = 10,
    first_seed: Annotated[int, typer.Option(help="The first of them; hold some out when you tune.")] = 0,
    baseline: Annotated[
        str | None,
        typer.Option(
            help="Paired differences are against this policy; default round_robin, or else the first.",
            show_default=False,
        ),
    ] = None,
    difficulty: DifficultyOption = "twin",
    as_json: JsonOption = False,
    *,
    channel: ChannelMaker,
) -> None:
    """Several policies on the same seeds, with intervals."""
    from scenarios.compare import compare, comparison_table

    chosen = load(scenario)
    if seeds < 2:
        raise FleetError(f"--seeds must be 2 or more, so that there is something to compare (got {seeds}).")
    if first_seed < 0:
        raise FleetError(f"--first-seed must be 0 or more (got {first_seed}).")
    between = channel(chosen)
    chosen_seeds = range(first_seed, first_seed + seeds)
    names = [name.strip() for name in policies.split(",")]
    with progress_bar() as progress:
        how: Any = difficulty  # checked when the fleet is prepared
        result = compare(
            chosen,
            names,
            seeds=chosen_seeds,
            baseline=baseline or ("round_robin" if "round_robin" in names else names[0]),
            difficulty=how,
            channel=between,
            progress=progress,
        )
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(result), indent=1).decode())
    else:
        out_console.print(comparison_table(result))


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option(help="Folder for the two recordings.")] = Path("out/demo"),
    seed: SeedOption = 1,
) -> None:
    """The quickstart shift under two policies, side by side."""
    chosen = load("quickstart")
    results: dict[str, Metrics] = {}
    fleet = None
    with progress_bar() as progress:
        for policy in ("round_robin", "least_difficulty"):
            spec = _spec(policy, seed, "profile", "zenoh", "twin")
            fleet, result = _run_into(chosen, spec, out / policy, True, progress, fleet=fleet)
            if not result.finished:
                raise Interrupted(f"Interrupted while working; recordings are in {out}.")
            results[policy] = result.metrics
    say(f"{chosen.name}, seed {seed}: {chosen.description}", out_console)
    out_console.print(table_of(results))
    say(f"Open {out / 'least_difficulty' / 'report.html'} in a browser to see what happened.", out_console)


app.command("animate")(animate_command)
app.command("train")(train_command)
app.command("hold")(hold_command)
app.command("keys")(keys_command)
app.command("router")(router_command)
app.command("contract")(contract_command)
register_live(app)
app.add_typer(twin_app, name="twin")


def _spec(policy: str, seed: int, plant: str, bus: str, difficulty: str, channel: Channel = PERFECT) -> Any:
    from scenarios.build import BusName, DifficultyName, PlantName, choose
    from scenarios.run import RunSpec

    policy_of(policy)
    if seed < 0:
        raise FleetError(f"--seed must be 0 or more (got {seed}).")
    choose("plant", plant, PlantName)
    choose("bus", bus, BusName)
    choose("difficulty", difficulty, DifficultyName)
    fields: dict[str, Any] = {"plant": plant, "bus": bus, "difficulty": difficulty, "channel": channel}
    return RunSpec(policy=policy, seed=seed, **fields)


def _run_into(
    scenario: Scenario,
    spec: Any,
    out: Path,
    overwrite: bool,
    progress: Progress,
    *,
    endpoint: str | None = None,
    fleet: Any = None,
) -> tuple[Any, Any]:
    """The fleet, made ready unless it is given, and the result of its shift, written to `out`."""
    from scenarios.build import prepare
    from scenarios.folder import new_folder, write
    from scenarios.run import run

    with new_folder(out, overwrite=overwrite) as folder:
        fleet = fleet or prepare(scenario, difficulty=spec.difficulty, progress=progress)
        with stop_on_interrupt() as stopped:
            result = run(fleet, spec, progress=progress, stopped=stopped, endpoint=endpoint)
            progress("writing", 0.0)
            write(result, folder)
    return fleet, result


@contextmanager
def router_at(port: int) -> Iterator[str | None]:
    """The endpoint of a router on a loopback port, open before the fleet comes, so that its first words are heard."""
    if not port:
        yield None
        return
    from fleet.bus.router import Router

    with Router(port) as router:
        yield router.endpoint


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Ctrl-C turns the given function true, so that a shift ends between two steps; a second Ctrl-C breaks it off."""
    pressed = threading.Event()

    def note(_signal: int, _frame: object) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    if threading.current_thread() is not threading.main_thread():  # only that one may handle signals
        yield pressed.is_set
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def _figures(result: Any) -> dict[str, Any]:
    from scenarios.run import summary

    whole = summary(result)
    return {key: whole[key] for key in ("status", "policy", "seed", "plant", "bus", "difficulty", "metrics")}


def table_of(results: dict[str, Metrics]) -> Table:
    """Key figures, one column per policy."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in results:
        table.add_column(name, justify="right")
    rows: list[tuple[str, Callable[[Metrics], str]]] = [
        ("jobs finished", lambda m: f"{m.finished} of {m.jobs}"),
        ("value", lambda m: f"{m.value:g} of {m.value_offered:g}"),
        ("on time", lambda m: str(m.on_time)),
        ("tardiness, min", lambda m: f"{m.tardiness_min:.1f}"),
        ("faults", lambda m: str(m.faults)),
        ("min above warning", lambda m: f"{m.above_warning_min:.1f}"),
        ("availability", lambda m: f"{m.availability:.1%}"),
        ("energy, Wh", lambda m: f"{m.energy_wh:.0f}"),
    ]
    for what, text in rows:
        table.add_row(what, *(text(m) for m in results.values()))
    for arm in next(iter(results.values())).peak_c:
        table.add_row(f"peak {arm}, °C", *(f"{m.peak_c[arm]:.1f}" for m in results.values()))
    return table
