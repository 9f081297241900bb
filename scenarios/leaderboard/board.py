"""The table of the leaderboard, from the files of results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

from fleet.errors import FleetError
from scenarios.bounds.command import markdown
from scenarios.bounds.references import Reference, load_references
from scenarios.doc_tables import table
from scenarios.leaderboard.submission import Submission, check, read, split_references
from scenarios.schema import SPLITS
from scenarios.statistics.scores import Scores, ranked, score_cells, scores_of
from scenarios.suite.cells import JUDGED
from scenarios.suite.splits import manifest
from scenarios.trials.plan import CARD
from scenarios.trials.scores import Shift, normalised

BASELINE = "wsept"
"""Policy that differences refer to, with the scores of `SOURCE`; without it the last of the board."""
SOURCE = "oracle"
HEADS = ("", "policy", "predictions", "scope", "mean score", "difference", "IQM", "short of 1", "better in", "to bound")
MORE = ("faults", "failed", "by", "code")


@dataclass(frozen=True, kw_only=True)
class Board:
    """The results on one split, the best first."""

    split: str
    scores: Scores
    """By name of the submission."""
    entries: Mapping[str, Submission]
    instances: int
    """Of the split."""

    @property
    def order(self) -> list[str]:
        """Names of the submissions, the best first."""
        return ranked(self.scores)

    def best(self, scope: str) -> Submission | None:
        """The best of a scope."""
        return next((self.entries[name] for name in self.order if self.entries[name].card.scope == scope), None)


def read_all(folder: Path, split: str) -> list[Submission]:
    """The checked results of a split in a folder, by the names of their files.

    Raises:
        FleetError: a file is no result, or one that is refused, or has the name of another, or of no split.
    """
    if (folder / CARD).exists():
        raise FleetError(
            f"'{folder}' is a folder of `thermofleet compare`; run `thermofleet submit-result` with it first."
        )
    references, found = split_references(split), list[Submission]()
    for path in sorted(folder.glob("*.jsonl")):
        if (named := path.stem.partition("-")[0]) not in JUDGED:
            raise FleetError(
                f"'{path}' must have the name that `thermofleet submit-result` gives, SPLIT-POLICY-PREDICTIONS.jsonl "
                f"with SPLIT {', '.join(JUDGED)}."
            )
        if named != split:
            continue
        submission = read(path)
        if path.stem != submission.name:
            raise FleetError(f"'{path}' must have the name of its policy and split, {submission.name}.jsonl.")
        check(submission, references)
        found.append(submission)
    return found


def board_of(
    split: str, submissions: Sequence[Submission], references: Mapping[Shift, Reference] | None = None
) -> Board | None:
    """The board of a split; None without results or without references.

    A failed shift counts as the mean of random.
    """
    entries = {each.name: each for each in submissions}
    rows = {name: each.study_rows() for name, each in entries.items()}
    values = normalised(rows, split_references(split) if references is None else references, failed_as_random=True)
    if values is None:
        return None
    base = next((name for name, each in entries.items() if _is_baseline(each)), None)
    last = min(entries, key=lambda name: values.score[name].mean())
    return Board(split=split, scores=scores_of(values, base or last), entries=entries, instances=len(manifest(split)))


def _is_baseline(each: Submission) -> bool:
    card = each.card
    return (card.policy, card.difficulty, card.policy_hash) == (BASELINE, SOURCE, "")


def board_text(board: Board | None, split: str) -> str:
    """The board as Markdown: what is best of each scope, the table, and what must be known."""
    if board is None:
        return f"No results on the split {split}."
    scores = board.scores
    parts = [best_text(board)]
    rows = [(str(place), *_cells(scores, name, board.entries[name])) for place, name in enumerate(board.order, start=1)]
    parts.append(table((*HEADS, *MORE), rows))
    return "\n\n".join([*parts, remark_text(board)])


def best_text(board: Board) -> str:
    """The policy with the highest mean score of each scope, in a sentence."""
    best = [
        f"{scope} `{each.card.policy}` ({board.scores.policies[each.name].mean.text()})"
        for scope in ("central", "arm")
        for each in [board.best(scope)]
        if each
    ]
    return f"Highest mean score of scope {', of scope '.join(best)}."


def remark_text(board: Board) -> str:
    """What a reader must know of the results."""
    scores = board.scores
    base = board.entries[scores.baseline].card
    missing = board.instances - scores.instances - len(scores.flat)
    remark = f"{scores.instances} of {board.instances} instances; differences to `{base.policy}` ({base.difficulty})."
    if missing:
        remark += f" {missing} have no reference yet and are not scored."
    if scores.flat:
        remark += f" {scores.flat_remark}"
    if len({each.card.code_hash for each in board.entries.values()}) > 1:
        remark += " Results are of several versions of the code; `--verify` repeats some shifts of each with this one."
    return remark


def _cells(scores: Scores, name: str, entry: Submission) -> tuple[str, ...]:
    mean, difference, stars, *rest = score_cells(scores, name)
    card = entry.card
    own = (
        entry.title,
        card.difficulty,
        card.scope,
        mean,
        f"{difference} {stars}".strip().replace("*", "\\*"),
    )
    return (
        *own,
        *rest,
        f"{entry.mean('faults'):.2f}",
        str(entry.failures or ""),
        card.author,
        f"`{card.code_hash[:8]}`",
    )


def references_text() -> str:
    """A line for each split: how its references were found, and how far their two bounds are apart, as Markdown."""
    rows: list[tuple[str, ...]] = []
    for split in SPLITS:
        found = list(split_references(split).values())
        rows.append(
            (
                split,
                f"{len(found)} of {len(manifest(split))}",
                _span([each.evaluations for each in found]),
                _span([each.nodes for each in found]),
                f"{median(each.gap for each in found):.2f}",
                f"{median(each.normalised(each.best_rule) for each in found):.2f}",
            )
        )
    heads = (
        "split",
        "instances",
        "shifts of the last search",
        "nodes",
        "gap, median",
        "score of the best starting policy, median",
    )
    return table(heads, rows)


def _span(numbers: Sequence[int]) -> str:
    least, most = min(numbers), max(numbers)
    return f"{least}" if least == most else f"{least} to {most}"


def benchmark_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table of docs/leaderboard.md and docs/bounds.md by the name in its mark.

    Args:
        results: docs/results.
    """

    def board(split: str) -> str:
        return board_text(board_of(split, read_all(results / "leaderboard", split)), split)

    return {
        "bounds": lambda: markdown(load_references(results / "bounds_library.jsonl")),
        "references": references_text,
        **{f"leaderboard_{split}": partial(board, split) for split in JUDGED},
    }
