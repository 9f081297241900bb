"""`thermofleet bounds`: random, best rule, hindsight and upper bound of shifts."""

from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import echo, out_console, plain_table, print_json, progress_bar, say
from scenarios.schema_errors import choose


def bounds_command(
    scenarios: Annotated[
        str | None,
        typer.Argument(
            help="Separated by commas: library names (see `thermofleet show`), .toml files, or instances of the suite, "
            "as test/0017.",
            show_default=False,
        ),
    ] = None,
    suite: Annotated[
        str | None, typer.Option(help="All instances of a split: train, validation, test or sizes.", show_default=False)
    ] = None,
    seeds: Annotated[int, options.number("Number of seeds of each scenario.", 1, 10_000)] = 5,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 0,
    budget: Annotated[float, options.number("CPU seconds of the search for each shift.", 0, 86_400, above=True)] = 30.0,
    evaluations: Annotated[
        int | None,
        options.number(
            "End the search after this number of simulated shifts; the file then does not depend on other load.",
            1,
            10**9,
            show_default=False,
        ),
    ] = None,
    nodes: Annotated[
        int,
        options.number("Maximum nodes of the upper bound's branch and bound; 0: only the linear program.", 0, 10**6),
    ] = 2000,
    starts: Annotated[
        str | None,
        typer.Option(
            help="Policies that the search starts from, separated by commas; default: all but random. Without "
            "rolling_horizon it takes a tenth of the time.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[int, options.number("Number of processes.", 1, 1024)] = 1,
    difficulty: options.DifficultyOption = "oracle",
    out: Annotated[Path, typer.Option(help="File of the rows; finished ones are not computed again.")] = Path(
        "runs/bounds.jsonl"
    ),
    show_only: Annotated[bool, typer.Option("--show", help="Compute nothing: print all rows of the file.")] = False,
    format_: Annotated[str, typer.Option("--format", help="table, markdown or json.")] = "table",
) -> None:
    """Bound the best possible reward of shifts from both sides.

    Below: the mean of the policy random, the best built-in policy, and the best
    schedule that a search finds with all jobs known (hindsight). Above: an upper
    bound that no policy can exceed. Every row is kept as soon as it is known; the
    same command continues after an interruption. A larger budget searches again.
    With --evaluations in place of --budget, a repetition gives the same file.
    """
    choose("format", format_, Literal["table", "markdown", "json"])
    from scenarios.evaluate.hindsight import Budget
    from scenarios.evaluate.references import (
        STARTS,
        cells,
        heads_of,
        load_references,
        reference_table,
        references,
        tasks_of,
    )
    from scenarios.policy_loader import scope_of
    from scenarios.specs import DifficultyName

    if show_only:
        if not out.is_file():
            raise FleetError(f"--show prints a file of this command, and there is no file '{out}'.")
        found = load_references(out)
    else:
        if bool(scenarios) == bool(suite):
            raise FleetError("Give either scenarios or --suite.")
        tasks = tasks_of(suite or scenarios or "", seeds, first_seed)
        limit = Budget(seconds=budget, nodes=nodes)
        if evaluations is not None:
            limit = Budget(seconds=inf, evaluations=evaluations, nodes=nodes)
        source = choose("difficulty", difficulty, DifficultyName)
        policies = options.split_names(starts) if starts else STARTS
        for name in policies:
            scope_of(name)
        chosen: Any = {"difficulty": source, "workers": workers, "policies": policies}
        with progress_bar(kept="Finished rows are", file=out) as progress:
            found = references(tasks, out, limit, **chosen, progress=progress)
    if format_ == "json":
        print_json([asdict(each) | {"gap": each.gap, "rule_score": each.normalised(each.best_rule)} for each in found])
        return
    if format_ == "markdown":
        echo(reference_table(found))
        return
    shown = plain_table(*heads_of(found))
    for each in found:
        shown.add_row(*cells(each)[: len(shown.columns)])
    out_console.print(shown)
    if not show_only:
        say(f"Written to {out}.")
