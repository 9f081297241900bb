"""`thermofleet leaderboard` and `thermofleet submit-result`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import echo, out_console, print_json, progress_bar, say
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from scenarios.leaderboard.submission import Submission

FOLDER = Path("docs/results/leaderboard")
"""Of the results in a checkout."""


def leaderboard_command(
    folder: Annotated[Path, typer.Argument(help="Folder of results, one file for each policy.")] = FOLDER,
    split: Annotated[str, typer.Option(help="Split of the suite: test, sizes or validation.")] = "test",
    verify: Annotated[
        int, options.number("Number of shifts to repeat of each result of a built-in policy.", 0, 200)
    ] = 0,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the table as docs/leaderboard.md has it.")
    ] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Print the leaderboard: normalised scores of all results on a split.

    Every file is checked as by `thermofleet submit-result`. A failed shift counts
    as the mean of random. With --verify, repeated shifts must give equal figures.
    """
    from scenarios.leaderboard.board import best_text, board_of, board_text, read_all, remark_text
    from scenarios.schema import SplitName
    from scenarios.statistics.scores import score_tables
    from scenarios.statistics.tables import LEGEND

    split = choose("split", split, SplitName)
    if not folder.is_dir():
        raise FleetError(f"'{folder}' is no folder; give the folder of the results.")
    found = read_all(folder, split)
    if verify:
        from scenarios.leaderboard.repeat import check_repeated

        with progress_bar() as progress:
            for each in found:
                say(check_repeated(each, verify, progress))
    board = board_of(split, found)
    if as_json:
        print_json(board.scores if board else None)
    elif board is None or markdown:
        echo(board_text(board, split))
    else:
        sources = sorted({each.card.difficulty for each in board.entries.values()})
        labels = {
            name: each.card.policy
            + (f"@{each.card.difficulty}" if len(sources) > 1 else "")
            + (" (arm)" if each.card.scope == "arm" else "")
            for name, each in board.entries.items()
        }
        about = f"Predictions: {', '.join(sources)}. (arm): scope arm, others central. {LEGEND}."
        out_console.print(best_text(board), about, *score_tables(board.scores, labels), remark_text(board), sep="\n")


def submit_command(
    results: Annotated[Path, typer.Argument(help="Folder of `thermofleet compare --suite test --out`.")],
    author: Annotated[str, typer.Option(help="Name of the person who sends the result.")],
    about: Annotated[str, typer.Option(help="What the policy is, and where to get it; one sentence.")] = "",
    policies: Annotated[
        str | None, typer.Option(help="Policies of the folder, separated by commas; default: all.", show_default=False)
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the files.")] = Path(),
) -> None:
    """Check results on a whole split, and write one file per policy for the leaderboard.

    Instances must have the hashes of the manifest, every shift must be there, and
    versions must be stated. A failed shift counts as the mean of random.
    """
    from scenarios.extras import require_extra

    require_extra("report")
    from scenarios.leaderboard.submission import check, read_card, split_references, submissions_of, write
    from scenarios.policy_loader import label
    from scenarios.trials.store import read_rows

    try:
        made: list[Submission] = submissions_of(read_card(results), read_rows(results), author, about)
    except (KeyError, TypeError, AttributeError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else f"has a value of another type ({error})"
        raise FleetError(f"'{results}' is damaged: its study.json {what}. Run the comparison again.") from error
    if policies is not None:
        wanted = [label(name) for name in options.split_names(policies)]
        unknown = [name for name in wanted if name not in {each.card.policy for each in made}]
        if unknown:
            raise FleetError(f"'{results}' has no results of {', '.join(unknown)}.")
        made = [each for each in made if each.card.policy in wanted]
    known = {split: split_references(split) for split in {each.card.split for each in made}}
    for each in made:
        check(each, known[each.card.split])
    for each in made:
        path = write(each, out)
        failed = f", {each.failures} failed shifts, which count as random" if each.failures else ""
        say(f"Checked: {len(each.rows)} shifts of {each.card.policy}{failed}. Written to {path}.")
