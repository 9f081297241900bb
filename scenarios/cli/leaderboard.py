"""`thermofleet leaderboard`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from scenarios.cli import options
from scenarios.cli.terminal import echo, out_console, print_json, progress_bar, say
from scenarios.schema_errors import choose

if TYPE_CHECKING:  # slow to import
    from scenarios.evaluate.leaderboard import Submission

_SUBMIT = "Check a result and write the file to send"
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
    submit: Annotated[
        Path | None,
        typer.Option(help="Folder of `thermofleet compare --suite test --out`.", rich_help_panel=_SUBMIT),
    ] = None,
    author: Annotated[
        str, typer.Option(help="--submit: name of the person who sends the result.", rich_help_panel=_SUBMIT)
    ] = "",
    about: Annotated[
        str,
        typer.Option(help="--submit: what the policy is, and where to get it; one sentence.", rich_help_panel=_SUBMIT),
    ] = "",
    policies: Annotated[
        str | None,
        typer.Option(
            help="--submit: policies of the folder, separated by commas; default: all.",
            show_default=False,
            rich_help_panel=_SUBMIT,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="--submit: folder for the files.", rich_help_panel=_SUBMIT)] = Path(),
) -> None:
    """Print the leaderboard: normalised scores of all results on a split.

    Every file is checked as by --submit. A failed shift counts as the mean of random.
    With --verify, repeated shifts must give equal figures. With --submit the results
    of a comparison on a whole split are checked, and one file per policy is written.
    """
    if submit is not None:
        if not author:
            raise FleetError("--submit needs --author, the name of the person who sends the result.")
        submit_results(submit, author, about, policies, out)
        return
    if author or about or policies is not None:
        raise FleetError("--author, --about and --policies are for --submit: leave them out.")
    from scenarios.evaluate.leaderboard import best_text, board_of, board_text, read_all, remark_text
    from scenarios.evaluate.tables import LEGEND
    from scenarios.schema import SplitName
    from scenarios.show.comparison_page import narrow_score_tables

    split = choose("split", split, SplitName)
    if not folder.is_dir():
        raise FleetError(f"'{folder}' is no folder; give the folder of the results.")
    found = read_all(folder, split)
    if verify:
        from scenarios.evaluate.leaderboard import check_repeated

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
        out_console.print(
            best_text(board), about, *narrow_score_tables(board.scores, labels), remark_text(board), sep="\n"
        )


def submit_results(results: Path, author: str, about: str, policies: str | None, out: Path) -> None:
    """Check results on a whole split, and write one file per policy for the leaderboard.

    Instances must have the hashes of the manifest, every shift must be there, and
    versions must be stated. A failed shift counts as the mean of random.
    """
    from scenarios.extras import require_extra

    require_extra("report")
    from scenarios.evaluate.leaderboard import check, split_references, submissions_of, write
    from scenarios.evaluate.store import read_card, read_rows
    from scenarios.evaluate.study import SHIFTS
    from scenarios.policy_loader import label

    try:
        made: list[Submission] = submissions_of(read_card(results, SHIFTS), read_rows(results, SHIFTS), author, about)
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
