"""`thermofleet bounds`: random, best rule, hindsight and upper bound of shifts."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scenarios.cli import options
from scenarios.cli.terminal import echo, out_console, plain_table, print_json, progress_bar, say
from scenarios.load import load
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
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
    format_: Annotated[str, typer.Option("--format", help="table, markdown or json.")] = "table",
) -> None:
    """Bound the reward of shifts from both sides.

    Below: the mean of the policy random, the best built-in policy, and the best
    schedule that a search finds with all jobs known (hindsight). Above: an upper
    bound that no policy can exceed. Every row is kept as soon as it is known; the
    same command continues after an interruption. A larger budget searches again.
    """
    choose("format", format_, Literal["table", "markdown", "json"])
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
        with progress_bar(kept="Plans are") as progress:
            found = references(tasks, out, Budget(seconds=budget), difficulty=source, progress=progress)
    if format_ == "json":
        print_json([asdict(each) | {"gap": each.gap, "rule_score": each.normalised(each.best_rule)} for each in found])
        return
    if format_ == "markdown":
        echo(markdown(found))
        return
    shown = plain_table(*HEADS)
    for each in found:
        shown.add_row(*cells(each))
    out_console.print(shown)
    if not show_only:
        say(f"Written to {out}.")


HEADS = ("instance", "random", "best rule", "reward", "hindsight", "upper bound", "score of the rule", "gap", "CPU s")


def cells(each: "Reference") -> tuple[str, ...]:
    """One line of the table."""
    rewards = [f"{value:.1f}" for value in (each.best_rule, each.hindsight, each.upper)]
    score = f"{each.normalised(each.best_rule):.3f}"
    return each.instance, f"{each.random:.1f}", each.rule, *rewards, score, f"{each.gap:.3f}", f"{each.seconds:.0f}"


def markdown(references: "Sequence[Reference]") -> str:
    """The table for a page: every instance, and the mean of each scenario."""
    from scenarios.doc_tables import table

    lines: list[tuple[str, ...]] = []
    for scenario in dict.fromkeys(each.instance.rpartition("/")[0] for each in references):
        own = [each for each in references if each.instance.rpartition("/")[0] == scenario]
        lines += [cells(each) for each in own]
        figures = ("random", "best_rule", "hindsight", "upper")
        random, *rewards = (f"**{sum(getattr(each, name) for each in own) / len(own):.1f}**" for name in figures)
        score = sum(each.normalised(each.best_rule) for each in own) / len(own)
        gap, seconds = (
            sum(values) / len(own) for values in zip(*((each.gap, each.seconds) for each in own), strict=True)
        )
        lines.append(
            (f"**{scenario}**, mean", random, "", *rewards, f"**{score:.3f}**", f"**{gap:.3f}**", f"{seconds:.0f}")
        )
    return table(HEADS, lines)
