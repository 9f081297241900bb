"""The command line: `thermofleet run`, `list`, `show`, `compare`, `hold` and `demo`."""

import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from fleet.errors import FleetError
from fleet.metrics import Metrics
from scenarios.hold import hold_command
from scenarios.load import library, load
from scenarios.scenario import Scenario

app = typer.Typer(
    help="Robot fleets that know how hard a job is on their motors, tell each other, and share the work.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
out_console = Console()
err_console = Console(stderr=True)

ScenarioArg = Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")]
PolicyOption = Annotated[str, typer.Option(help="random, round_robin, coolest_first or least_difficulty.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Draws the jobs, the noise and the policy's chance.")]
PlantOption = Annotated[str, typer.Option(help="profile (planned heat) or mujoco (closed loop in one scene).")]
BusOption = Annotated[str, typer.Option(help="zenoh (in-process router) or memory.")]
DifficultyOption = Annotated[str, typer.Option(help="What scores the plans: twin, blind or oracle.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print figures as JSON.")]


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point: errors that the user can mend are one sentence and exit code 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        app(args=list(argv) if argv is not None else None)
    except FleetError as error:
        err_console.print(f"Error: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)


@app.command("run")
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
    overwrite: Annotated[bool, typer.Option(help="Replace a finished run in --out.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Work one shift of a scenario and record it."""
    from scenarios.folder import check_free

    chosen = load(scenario)
    where = out or Path("runs") / f"{chosen.name}-{policy}-{seed}"
    check_free(where, overwrite=overwrite)
    spec = _spec(policy, seed, plant, bus, difficulty)
    with progress_bar() as progress:
        result = _run_into(chosen, spec, where, overwrite, progress)
    if as_json:
        typer.echo(json.dumps({"out": str(where), **_figures(result)}, indent=1))
    else:
        out_console.print(table_of({policy: result.metrics}, f"{chosen.name}, seed {seed}"))
        out_console.print(f"Recorded in {where}; open {where / 'report.html'} in a browser.", soft_wrap=True)
    if not result.finished:
        err_console.print(
            f"Interrupted at {result.time_s:.0f} s of {chosen.horizon_s:.0f} s: what happened until then is kept in "
            f"{where} (status 'interrupted'). The same command runs the shift anew from the cached plans and twins.",
            soft_wrap=True,
        )
        raise typer.Exit(130)


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
def compare_command(
    scenario: ScenarioArg,
    policies: Annotated[
        str, typer.Option(help="Comma-separated.")
    ] = "random,round_robin,coolest_first,least_difficulty",
    seeds: Annotated[int, typer.Option(min=2, help="How many, from 0.")] = 10,
    baseline: Annotated[str, typer.Option(help="Paired differences are against this policy.")] = "round_robin",
    difficulty: DifficultyOption = "twin",
    as_json: JsonOption = False,
) -> None:
    """Several policies on the same seeds, with intervals."""
    from scenarios.compare import compare, comparison_table

    chosen = load(scenario)
    names = [name.strip() for name in policies.split(",")]
    with progress_bar() as progress:
        how: Any = difficulty  # checked when the fleet is prepared
        result = compare(chosen, names, seeds=range(seeds), baseline=baseline, difficulty=how, progress=progress)
    if as_json:
        typer.echo(msgspec.json.format(msgspec.json.encode(result), indent=1).decode())
    else:
        out_console.print(comparison_table(result))


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option(help="Folder for the two recordings.")] = Path("out/demo"),
    seed: SeedOption = 0,
) -> None:
    """The quickstart shift under two policies, side by side."""
    chosen = load("quickstart")
    results: dict[str, Metrics] = {}
    with progress_bar() as progress:
        for policy in ("round_robin", "least_difficulty"):
            spec = _spec(policy, seed, "profile", "zenoh", "twin")
            result = _run_into(chosen, spec, out / policy, True, progress)
            if not result.finished:
                err_console.print(f"Interrupted; finished recordings are in {out}.")
                raise typer.Exit(130)
            results[policy] = result.metrics
    out_console.print(table_of(results, f"{chosen.name}, seed {seed}: {chosen.description}"))
    out_console.print(
        f"Open {out / 'least_difficulty' / 'report.html'} in a browser to see what happened.", soft_wrap=True
    )


app.command("hold")(hold_command)


def _spec(policy: str, seed: int, plant: str, bus: str, difficulty: str) -> Any:
    from agents.rules import make_policy
    from scenarios.build import BusName, DifficultyName, PlantName, choose
    from scenarios.run import RunSpec

    try:
        make_policy(policy)
    except ValueError as error:
        raise FleetError(str(error)) from error
    choose("plant", plant, PlantName)
    choose("bus", bus, BusName)
    choose("difficulty", difficulty, DifficultyName)
    fields: dict[str, Any] = {"plant": plant, "bus": bus, "difficulty": difficulty}
    return RunSpec(policy=policy, seed=seed, **fields)


def _run_into(scenario: Scenario, spec: Any, out: Path, overwrite: bool, progress: Callable[[str, float], None]) -> Any:
    from scenarios.build import prepare
    from scenarios.folder import new_folder, write
    from scenarios.run import run

    with new_folder(out, overwrite=overwrite) as folder:
        fleet = prepare(scenario, difficulty=spec.difficulty, progress=progress)
        result = run(fleet, spec, progress=progress)
        progress("writing", 0.0)
        write(result, folder)
    return result


def _figures(result: Any) -> dict[str, Any]:
    from scenarios.run import summary

    whole = summary(result)
    return {key: whole[key] for key in ("status", "policy", "seed", "plant", "bus", "difficulty", "metrics")}


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A bar on standard error that names the stage."""
    columns = (SpinnerColumn(), TextColumn("{task.description:<10}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err_console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)

        def tell(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        yield tell


def table_of(results: dict[str, Metrics], title: str) -> Table:
    """Key figures, one column per policy."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
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
    for label, text in rows:
        table.add_row(label, *(text(m) for m in results.values()))
    for arm in next(iter(results.values())).peak_c:
        table.add_row(f"peak {arm}, °C", *(f"{m.peak_c[arm]:.1f}" for m in results.values()))
    return table
