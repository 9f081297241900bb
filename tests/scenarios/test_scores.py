"""Normalised scores of rows, against values by hand; what has no reference, and what failed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenarios.evaluate.rollout import FIGURES, Outcome
from scenarios.evaluate.scores import normalised, references_of, scores_of
from scenarios.evaluate.statistics import interval
from scenarios.evaluate.study import Case, Key, Row
from scenarios.spec.load import load

SHIFTS = [("test/0000", 7), ("test/0001", 8), ("test/0002", 9)]


class Known:
    """A reference as `scenarios.evaluate.references` stores it, with what scores read."""

    def __init__(self, instance: str, random: float, hindsight: float, upper: float) -> None:
        self.instance, self.random, self.hindsight, self.upper = instance, random, hindsight, upper


REFERENCES = {
    SHIFTS[0]: Known("test/0000", 10.0, 20.0, 30.0),
    SHIFTS[1]: Known("test/0001", 0.0, 50.0, 50.0),
    SHIFTS[2]: Known("test/0002", 5.0, 5.0, 6.0),
}


def scored(by_policy: dict[str, list[Row]], known: dict[tuple[str, int], Known], **more: bool):
    return normalised(by_policy, known, **more)  # pyright: ignore[reportArgumentType]  # a stand-in


def rows_of(policy: str, rewards: dict[int, float | None], trainings: int = 1) -> list[Row]:
    """A row for each shift and training; training k has k more reward, None is a failure."""
    blank = Outcome(**dict.fromkeys(FIGURES, 0.0))
    return [
        Row(Key(policy, name, 0, k, "oracle", seed), replace(blank, reward=own + k) if own is not None else None)
        for (name, seed), own in zip(SHIFTS, rewards.values(), strict=True)
        for k in range(trainings)
    ]


def test_scores_are_shares_of_the_way_from_random_to_hindsight():
    by_policy = {"a": rows_of("a", {0: 15.0, 1: 50.0, 2: 5.0}), "b": rows_of("b", {0: 7.0, 1: 24.0, 2: 0.0}, 3)}
    values = scored(by_policy, REFERENCES)
    assert values is not None
    assert values.instances == ("test/0000", "test/0001")
    assert values.flat == ("test/0002",)
    assert values.score["a"].tolist() == [[0.5, 1.0]]
    assert values.score["b"].tolist() == [pytest.approx([-0.2, 0.5])]  # means of trainings of twins: 8 and 25
    assert values.to_bound["a"].tolist() == [[0.75, 0.0]]
    scores = scores_of(values, "b")
    assert scores.policies["a"].mean.mean == 0.75
    assert scores.policies["a"].difference.mean == pytest.approx(0.6)
    assert scores.policies["a"].optimality_gap.mean == 0.25
    assert scores.policies["a"].improvement.mean == 1.0
    assert scores.policies["b"].bound_gap.mean == pytest.approx((22 / 20 + 0.5) / 2)


def test_trainings_of_a_policy_are_a_sample_and_those_of_twins_are_not():
    rewards = {0: 15.0, 1: 40.0, 2: 5.0}
    by_policy = {"pairs-*": rows_of("pairs-*", rewards, 3), "a": rows_of("a", {0: 12.0, 1: 30.0, 2: 5.0})}
    values = scored(by_policy, REFERENCES)
    assert values is not None
    each = np.array([[0.5, 0.8], [0.6, 0.82], [0.7, 0.84]])  # instances in columns
    assert values.score["pairs-*"].tolist() == [pytest.approx(row.tolist()) for row in each]
    learned = scores_of(values, "a").policies["pairs-*"]
    assert learned.mean == interval(values.score["pairs-*"][:, None])
    assert learned.mean.mean == pytest.approx(each.mean())
    # Two instances: with trainings as a sample the interval is wider than that of the means over trainings.
    given = interval(each.mean(axis=0))
    assert learned.mean.high - learned.mean.low > given.high - given.low
    assert scores_of(values, "a").remarks[0].startswith("Unit: 2 instances × 3 trainings of a policy.")


def test_shifts_without_a_reference_are_counted_and_failures_can_count_as_random():
    rows = rows_of("a", {0: None, 1: 50.0, 2: 0.0})
    known = {shift: REFERENCES[shift] for shift in SHIFTS[:2]}
    values = scored({"a": rows}, known, failed_as_random=True)
    assert values is not None
    assert (values.missing, values.score["a"].tolist()) == (1, [[0.0, 1.0]])
    assert scored({"a": rows}, {}) is None
    with pytest.raises(ValueError, match="2 instances"):
        scores_of(replace(values, instances=("x",)), "a")


def test_a_file_of_references_counts_for_the_same_scenario_only():
    file = Path(__file__).parents[2] / "docs" / "results" / "bounds_library.jsonl"
    wave = load("heat_wave")
    case = Case(name="heat_wave", scenario=wave, seeds=(100, 104, 105))
    assert sorted(seed for _, seed in references_of([case], file)) == [100, 104]
    assert not references_of([replace(case, scenario=replace(wave, slots=wave.slots + 1))], file)
