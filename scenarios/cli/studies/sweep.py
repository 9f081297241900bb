"""`thermofleet twin sweep` and `parsimony`: what the choices of a twin and the amount of its data change."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fleet.errors import FleetError, nearest
from scenarios.cli import options
from scenarios.cli.terminal import echo, plain_table, print_json, print_wide, progress_bar, say
from scenarios.load import load
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from scenarios.json_rows import Row
    from scenarios.studies.sweep.subjects import Subject

SCENARIOS = "quickstart,active_waiting,heat_wave"
ScenariosOption = Annotated[str, typer.Option(help="Scenarios whose arms are studied, separated by commas.")]
ArmsOption = Annotated[str, typer.Option(help="Places of the studied arms in each scenario, from 0.")]
SeedsOption = Annotated[int, options.number("Number of seeds: bodies, jobs and trainings of each arm.", 1, 100)]
TestOption = Annotated[int, options.number("Test jobs of each arm.", 50, 100_000)]
CarrierOption = Annotated[
    bool,
    typer.Option("--carrier-only", help="Train networks up to the carrying joint only: faster, d of it alone."),
]
ShowOption = Annotated[bool, typer.Option("--show", help="Compute nothing: print the rows of the file.")]
FormatOption = Annotated[str, typer.Option("--format", help="table, markdown or json.")]


def sweep_command(
    out: Annotated[Path, typer.Option(help="File of the rows; finished ones are not computed again.")] = Path(
        "runs/twin_sweep.jsonl"
    ),
    scenarios: ScenariosOption = SCENARIOS,
    arms: ArmsOption = "0,2",
    seeds: SeedsOption = 1,
    test: TestOption = 600,
    carrier_only: CarrierOption = False,
    only: Annotated[str | None, typer.Option(help="Configurations, separated by commas; default: all.")] = None,
    show_only: ShowOption = False,
    format_: FormatOption = "table",
) -> None:
    """Train twins under many configurations, the paper's own among them, and compare how d ranks jobs.

    A configuration is trained on all arms side by side: half a minute of one core
    for each arm. Every row is kept as soon as it is known; the same command
    continues after an interruption, and prints the table once all rows are there.
    """
    choose("format", format_, Literal["table", "markdown", "json"])
    from scenarios.json_rows import Rows
    from scenarios.studies.sweep.configurations import CONFIGURATIONS
    from scenarios.studies.sweep.measure import sweep
    from scenarios.studies.sweep.table import lines_of, table_of

    whole = {name for name, each in CONFIGURATIONS.items() if carrier_only and each.config.scope == "arm"}
    every = [name for name in CONFIGURATIONS if name not in whole]
    names = every if only is None else list(dict.fromkeys(options.split_names(only)))
    for name in names:
        if name not in CONFIGURATIONS:
            raise FleetError(f"No configuration '{name}'{nearest(name, CONFIGURATIONS)}")
        if name in whole:
            raise FleetError(f"'{name}' is one network of all joints; leave out --carrier-only.")
    chosen = {name: CONFIGURATIONS[name] for name in names}
    subjects = subjects_from(scenarios, arms, seeds, test, carrier_only=carrier_only)
    rows = Rows(out)
    if show_only:
        wanted = sweep(subjects, chosen, rows, compute=False)
        check_some(wanted, out, " and --carrier-only, if they had it")
    else:
        with progress_bar(kept="Finished rows are", file=out) as progress:
            wanted = sweep(subjects, chosen, rows, progress=progress)
    if format_ == "json":
        print_json(wanted)
        return
    with rows.readable():
        heads, cells = table_of(lines_of(wanted, chosen))
        title = f"d of the carrying joint on {count_of(wanted)}"
    caption = "in brackets: paired difference to ours, ± the 95 % margin over the arms; * if that excludes zero"
    show(heads, cells, format_, title=title, caption=caption)
    say(f"The rows are in {out}.")


def places(text: str) -> list[int]:
    """Places of arms from `0,2`.

    Raises:
        FleetError: not whole numbers from zero.
    """
    try:
        found = list(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        found = [-1]
    if min(found) < 0:
        raise FleetError(f"--arms must be whole numbers from 0, separated by commas (got '{text}').")
    return found


def parsimony_command(
    out: Annotated[Path, typer.Option(help="File of the rows; finished ones are not computed again.")] = Path(
        "runs/twin_parsimony.jsonl"
    ),
    scenarios: ScenariosOption = SCENARIOS,
    arms: ArmsOption = "0,2",
    seeds: SeedsOption = 1,
    test: TestOption = 600,
    show_only: ShowOption = False,
    format_: FormatOption = "table",
) -> None:
    """Compare twins and temperature regressors trained on more and more jobs: how much data each needs.

    The regressor is an LSTM on torques, trained on the temperatures of the same
    jobs, or of as many jobs of any heat. A minute of one core for each arm; the
    same command continues after an interruption.
    """
    choose("format", format_, Literal["table", "markdown", "json"])
    from scenarios.json_rows import Rows
    from scenarios.studies.sweep.parsimony import HEADS, parsimony, summary

    subjects = subjects_from(scenarios, arms, seeds, test, carrier_only=True)
    rows = Rows(out)
    if show_only:
        wanted = parsimony(subjects, rows, compute=False)
        check_some(wanted, out)
    else:
        with progress_bar(kept="Finished rows are", file=out) as progress:
            wanted = parsimony(subjects, rows, progress=progress)
    if format_ == "json":
        print_json(wanted)
        return
    with rows.readable():
        lines, title = summary(wanted), f"Quality by amount of training data, {count_of(wanted)}"
    show(HEADS, lines, format_, title=title)
    say(f"The rows are in {out}.")


def check_some(rows: "Sequence[Row]", out: Path, more: str = "") -> None:
    """Raise a FleetError if the file has none of the rows that --show asks for."""
    if not rows:
        raise FleetError(
            f"'{out}' has no such row. Give the options with which its rows were computed (--scenarios, --arms, "
            f"--seeds, --test{more}), or leave out --show to compute them."
        )


def count_of(rows: "Sequence[Row]") -> str:
    """`6 arms`: the subjects of the rows."""
    count = len({row["subject"] for row in rows})
    return f"{count} arm{'s' * (count != 1)}"


def subjects_from(scenarios: str, arms: str, seeds: int, test: int, *, carrier_only: bool = False) -> "list[Subject]":
    """The subjects that the options name."""
    from scenarios.studies.sweep.subjects import Sizes, subjects_of

    chosen = {name: load(name) for name in options.split_names(scenarios)}
    wanted, most = places(arms), max(len(scenario.arms) for scenario in chosen.values()) - 1
    if max(wanted) > most:
        raise FleetError(f"--arms must be 0 to {most}, as the scenarios have arms (got '{arms}').")
    numbers, of = range(1, seeds + 1), tuple(chosen.values())
    return list(subjects_of(of, arms=wanted, seeds=numbers, sizes=Sizes(test=test), carrier_only=carrier_only))


def show(heads: Sequence[str], rows: Sequence[Sequence[str]], format_: str, *, title: str, caption: str = "") -> None:
    """Print rows as a table, or in Markdown."""
    from scenarios.studies.sweep.table import markdown

    if format_ == "markdown":
        echo(markdown(heads, rows), nl=False)
        return
    table = plain_table(*heads, title=title, caption=caption or None)
    for row in rows:
        table.add_row(*row)
    print_wide(table)
