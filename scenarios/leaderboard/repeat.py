"""Repeat some shifts of a result."""

from dataclasses import asdict
from math import isclose

import numpy as np

from fleet.errors import FleetError
from scenarios.leaderboard.submission import Submission
from scenarios.progress import Progress, quiet
from scenarios.suite.splits import instance
from scenarios.trials.contest import run_study
from scenarios.trials.plan import Case, Study

CLOSE = 1e-6
"""Relative difference of figures on other machines: libraries round differently."""


def check_repeated(submission: Submission, count: int, progress: Progress = quiet) -> str:
    """Run some shifts of a result again, always the same ones; returns what was done.

    Raises:
        FleetError: a figure came out otherwise.
    """
    card = submission.card
    if card.policy_hash:
        return f"{submission.name}: not repeated, as its policy is a file of its author."
    rng = np.random.default_rng(np.random.SeedSequence([len(submission.rows), count]))
    rows = [row for row in submission.rows if row.training == 0]
    chosen = [rows[i] for i in sorted(rng.permutation(len(rows))[:count].tolist())]
    cases = [Case(name=row.instance, scenario=instance(row.instance).scenario, seeds=(row.seed,)) for row in chosen]
    study = Study(policies=[card.policy], cases=cases, difficulties=[card.difficulty], risk=card.risk)  # pyright: ignore[reportArgumentType]  # as it was written
    for row, again in zip(chosen, run_study(study, workers=1, progress=progress), strict=True):
        figures = None if again.outcome is None else list(asdict(again.outcome).values())
        same = figures is not None and row.figures is not None
        close = same and all(
            isclose(a, b, rel_tol=CLOSE, abs_tol=CLOSE) for a, b in zip(figures or (), row.figures or (), strict=True)
        )
        if not close and (figures is not None or row.figures is not None):
            raise FleetError(
                f"The result '{submission.name}' does not repeat: {row.instance} has the figures {figures} with this "
                f"code, not {row.figures}."
            )
    return f"{submission.name}: {len(chosen)} shifts repeated, with equal figures."
