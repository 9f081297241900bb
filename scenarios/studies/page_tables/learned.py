"""Tables of docs/learning.md: trainings, and learned policies on fleets of sizes of the training and on others."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from agents.learned.training_log import read_log
from scenarios.doc_tables import table
from scenarios.evaluate.leaderboard import BASELINE, SOURCE, Submission, read_all, split_references
from scenarios.evaluate.scores import Normalised, Scores, normalised, ranked, scores_of
from scenarios.evaluate.statistics import Interval
from scenarios.policy_loader import trainings_of
from scenarios.studies.page_tables.cells import bold_if
from scenarios.suite.cells import CELLS
from scenarios.suite.splits import instance

Array = np.ndarray

TRAINED = {cell.arms for cell in CELLS if cell.split == "train"}
"""Numbers of arms of the fleets of the training split."""


UNTRAINED = "wsept_untrained"
LEARNED = ("train-pairs-*", "wsept_learned", "wsept_learned_local")


def learned_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of the table by the name in its mark.

    Args:
        results: docs/results, with the files of the leaderboard.
    """
    return {
        "trainings": lambda: _trainings(results / "learned"),
        "learned_gain": lambda: _gain(results / "leaderboard"),
        "learned_test": lambda: _by_size(
            results / "leaderboard", "test", {
                "trained sizes": lambda arms: np.isin(arms, list(TRAINED)),
                "other sizes": lambda arms: ~np.isin(arms, list(TRAINED)) & (arms < max(TRAINED)),
                "larger": lambda arms: arms > max(TRAINED),
            },
        ),
        "learned_sizes": lambda: _by_size(
            results / "leaderboard", "sizes", {
                "7 to 10 arms": lambda arms: arms <= 10,
                "11 to 14 arms": lambda arms: (arms > 10) & (arms < max(TRAINED)),
                "20 and 24 arms": lambda arms: arms > max(TRAINED),
            },
        ),
    }  # fmt: skip


def _trainings(folder: Path) -> str:
    """Scores in validation of the trainings in a folder: at the beginning, and the best."""
    rows: list[tuple[str, ...]] = []
    for training in map(Path, trainings_of(str(folder / "train-pairs-*"))):
        log = read_log(training)
        validated = [row for row in log if "validation" in row]
        best = max(validated, key=lambda row: row["validation"])
        iterations = max(row.get("number", 0) for row in log)
        scores = (validated[0]["validation"], best["validation"], validated[-1]["teacher"])
        rows.append((training.name.rpartition("-")[2], str(iterations), *(f"{score:.3f}" for score in scores)))
    return table(("training", "iterations", "first parameters", "best", "`wsept`"), rows)


def _scored(folder: Path, split: str) -> tuple[dict[str, Submission], Normalised]:
    """The results on a split by policy, and their scores."""
    found = {each.card.policy: each for each in read_all(folder, split) if each.card.difficulty == SOURCE}
    values = normalised(
        {name: each.study_rows() for name, each in found.items()}, split_references(split), failed_as_random=True
    )
    assert values is not None
    return found, values


def _gain(folder: Path) -> str:
    """Scores of learned policies less those of the best rule, and of the parameters that training began with."""
    bases = (BASELINE, UNTRAINED)
    rows: list[tuple[str, ...]] = []
    for split in ("test", "sizes"):
        found, values = _scored(folder, split)
        for name in LEARNED:
            if name in found:
                cells = [_shown(values.difference(name, base)) for base in bases]
                rows.append((f"{split}: {found[name].title}", f"{found[name].mean('faults'):.3f}", *cells))
    return table(("split and policy", "faults per shift", *(f"score less that of `{base}`" for base in bases)), rows)


def _shown(difference: Interval) -> str:
    """A difference with its interval, bold if that excludes 0."""
    return bold_if(difference.excludes_zero, difference.text())


def _by_size(folder: Path, split: str, groups: Mapping[str, Callable[[Array], Array]]) -> str:
    """Differences of normalised scores to the best rule on a split: on all instances, and by numbers of arms."""
    found, values = _scored(folder, split)
    arms = np.array([len(instance(name).scenario.arms) for name in values.instances])
    parts: dict[str, Scores] = {}
    for name, chosen in {"all instances": np.ones_like, **groups}.items():
        own = values.only(chosen(arms).astype(bool))
        parts[f"{name} ({len(own.instances)} in {len(set(own.cells))} cells)"] = scores_of(own, BASELINE)
    rows: list[tuple[str, ...]] = []
    for name in ranked(next(iter(parts.values()))):
        cells = [found[name].title]
        for scores in parts.values():
            cells.append("" if name == BASELINE else _shown(scores.policies[name].difference))
        rows.append((*cells, f"{found[name].mean('faults'):.2f}"))
    return table(("policy", *parts, "faults"), rows)
