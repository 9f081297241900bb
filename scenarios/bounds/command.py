"""`thermofleet bounds`: random, best rule, hindsight and upper bound of shifts."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenarios.cli import options
from scenarios.cli.terminal import out_console, plain_table, print_json, progress_bar, say
from scenarios.load import load
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from rich.table import Table

    from scenarios.bounds.references import Reference


def bounds_command(
    scenarios: Annotated[
        str,
        typer.Argument(help="Scenarios, separated by commas: library names (see `thermofleet list`) or .toml files."),
    ],
    seeds: Annotated[int, options.number("Number of seeds of each scenario.", 1, 10_000)] = 5,
    first_seed: Annotated[int, options.number("First seed.", 0, options.MAX_SEED)] = 0,
    budget: Annotated[float, options.number("CPU seconds of the search for each shift.", 0, 86_400, above=True)] = 30.0,
    difficulty: options.DifficultyOption = "oracle",
    out: Annotated[Path, typer.Option(help="File of the rows; finished ones are not computed again.")] = Path(
        "runs/bounds.jsonl"
    ),
    show_only: Annotated[bool, typer.Option("--show", help="Compute nothing: print all rows of the file.")] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Bound the reward of shifts from both sides.

    Below: the mean of the policy random, the best built-in policy, and the best
    schedule that a search finds with all jobs known (hindsight). Above: an upper
    bound that no policy can exceed. Every row is kept as soon as it is known; the
    same command continues after an interruption. A larger budget searches again.
    """
    from scenarios.bounds.hindsight import Budget
    from scenarios.bounds.references import Task, load_references, references
    from scenarios.prepare.fleet import DifficultyName

    if show_only:
        found = load_references(out)
    else:
        chosen = [load(name.strip()) for name in scenarios.split(",")]
        tasks = [
            Task(f"{scenario.name}/{seed}", scenario, seed)
            for scenario in chosen
            for seed in range(first_seed, first_seed + seeds)
        ]
        source = choose("difficulty", difficulty, DifficultyName)
        with progress_bar(kept="Finished rows are") as progress:
            found = references(tasks, out, Budget(seconds=budget), difficulty=source, progress=progress)
    if as_json:
        print_json([asdict(each) | {"gap": each.gap, "rule_score": each.normalised(each.best_rule)} for each in found])
        return
    out_console.print(bounds_table(found))
    if not show_only:
        say(f"Written to {out}.")


def bounds_table(references: "list[Reference]") -> "Table":
    """One line for each instance."""
    heads = ("instance", "random", "best rule", "reward", "hindsight", "upper bound", "score of rule", "gap", "CPU s")
    table = plain_table(*heads)
    for each in references:
        table.add_row(
            each.instance,
            f"{each.random:.1f}",
            each.rule,
            f"{each.best_rule:.1f}",
            f"{each.hindsight:.1f}",
            f"{each.upper:.1f}",
            f"{each.normalised(each.best_rule):.3f}",
            f"{each.gap:.3f}",
            f"{each.seconds:.0f}",
        )
    return table
