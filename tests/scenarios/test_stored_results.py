"""The results that the project keeps are those of its code."""

from dataclasses import asdict
from pathlib import Path

import pytest

from scenarios.evaluate.leaderboard import read_all
from scenarios.evaluate.runner import run_study
from scenarios.evaluate.study import Study, suite_of

RESULTS = Path(__file__).parents[2] / "docs" / "results" / "leaderboard"


def test_stored_results_of_built_in_policies_repeat():
    """One shift of each, with the present code: a change of a policy needs new results."""
    found = [each for each in read_all(RESULTS, "test") if not each.card.policy_hash]
    for difficulty in {each.card.difficulty for each in found}:
        stored = {each.card.policy: each for each in found if each.card.difficulty == difficulty}
        study = Study(policies=list(stored), cases=suite_of("test/0000", 1), difficulties=[difficulty])
        for row in run_study(study, workers=1):
            (before,) = [own.figures for own in stored[row.key.policy].rows if own.instance == "test/0000"]
            assert row.outcome is not None
            assert list(asdict(row.outcome).values()) == pytest.approx(before, rel=1e-6, abs=1e-6), row.key
