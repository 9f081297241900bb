"""`thermofleet list`, `thermofleet suite`, `thermofleet show` and `thermofleet layout`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from fleet.files import atomic_path
from scenarios.cli.options import JsonOption, OverwriteOption, ScenarioArg
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.load import library, load
from scenarios.result_folder import check_file, disk_errors


def list_command(as_json: JsonOption = False) -> None:
    """List the scenarios that come with thermofleet."""
    scenarios = {name: load(path) for name, path in library().items()}
    if as_json:
        print_json({name: s.description for name, s in scenarios.items()})
        return
    table = plain_table("scenario", "arms", "hours", "description", numbers=False)
    for name, s in scenarios.items():
        table.add_row(name, str(len(s.arms)), f"{s.horizon_s / 3600:g}", s.description)
    out_console.print(table)


def suite_command(
    split: Annotated[
        str | None,
        typer.Option(help="List the instances of this split: train, validation, test or sizes.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the cells of the benchmark suite, or the instances of one of its splits.

    A cell is a group of arms with stations and tasks. An instance is a scenario
    in a cell with a seed: `thermofleet show test/0000` describes it.
    """
    from scenarios.suite.cells import CELLS
    from scenarios.suite.splits import manifest

    if split is not None:
        rows = manifest(split)
        if as_json:
            print_json([asdict(row) for row in rows])
            return
        table = plain_table("instance", "cell", "axes", "jobs", numbers=False)
        for row in rows:
            axes = ", ".join(f"{name} {value}" for name, value in asdict(row.axes).items())
            table.add_row(row.name, row.cell, axes, str(row.count))
        out_console.print(table)
        return
    if as_json:
        print_json({cell.name: {**asdict(cell), "stations_per_arm": cell.stations_per_arm} for cell in CELLS})
        return
    table = plain_table("split", "cell", "arms are", "stations per arm", "hours", "instances", numbers=False)
    for cell in CELLS:
        numbers = (f"{cell.stations_per_arm:.2g}", f"{cell.hours:g}", str(cell.instances))
        table.add_row(cell.split, cell.name, cell.unlike, *numbers)
    out_console.print(table)


def show_command(scenario: ScenarioArg, as_json: JsonOption = False) -> None:
    """Show a scenario: its arms, its jobs and its thermal load factor.

    The thermal load factor is the heat of all jobs relative to the capacity of
    the fleet. Above 1.2 no policy keeps all motors below the warning limit.
    """
    from scenarios.show.describe import describe

    chosen = load(scenario)
    if as_json:
        print_json(asdict(chosen))
        return
    with progress_bar() as progress:
        parts = describe(chosen, progress)
    for part in parts:
        out_console.print(part, "")


def layout_command(
    scenario: ScenarioArg,
    out: Annotated[Path | None, typer.Option(help="Draw the cell from above as this PNG file.")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the reach of each arm, which jobs exclude each other in space, and how many arms can work at once.

    Lists all problems of the cell, for example two arms that are too close at
    home. Exit code 2: there are problems.
    """
    from scenarios.show.layout import layout_report, layout_scene, layout_tables

    chosen = load(scenario)
    if out is not None:
        check_file(out, (".png",), overwrite)
    with progress_bar() as progress:
        report = layout_report(chosen, progress)
    if as_json:
        print_json(report)
    else:
        tables, at_once = layout_tables(chosen, report)
        for table in tables:
            out_console.print(table, "")
        say(at_once, out_console)
    if out is not None:
        from matplotlib.image import imsave

        from fleet.env.render.picture import Picture

        with disk_errors(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(out) as file:
                imsave(file, Picture().frame(layout_scene(chosen, report)), format="png")
        say(f"Drew the cell: {out}.")
    for problem in report.problems:
        say(f"Error: {problem}")
    if report.problems:
        raise typer.Exit(2)
