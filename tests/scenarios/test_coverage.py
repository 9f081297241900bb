"""Effect of exploration: rates counted by hand on a few jobs, whose scores are their payloads."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet.motor import gen3_motors
from fleet.robot import JOINTS, Robot
from fleet.thermal import gen3_network
from scenarios.studies.exploration import SCORES, coverage
from scenarios.studies.setup import Bench, Sample, Study
from twin.vae.config import TwinConfig
from twin.vae.measures import PARTS, Features

SEEDS = [np.random.SeedSequence(seed) for seed in (5, 6)]
HORIZON_S = 95.0
NEW_KG = (5.0, 5.0, 0.2, 0.2)
TEST = {3.0: 70.0, 1.0: 65.0, 0.5: 50.0, 2.0: 30.0}
"""Payload and true peak: of the two critical jobs one stands out of the reference, and a cool one does."""


class ByExcess:
    """Stands for a twin: the excess of joint 2 is the payload, its errors fall with it.

    What it explored makes it find motion with more than 4 kg usual.
    """

    def __init__(self, explored: bool) -> None:
        self.explored = explored

    def features(self, plans, repetitions) -> Features:
        for plan, times in zip(plans, repetitions, strict=True):
            assert (times - 1) * plan.cycle.duration_s < HORIZON_S <= times * plan.cycle.duration_s
        payloads = np.array([plan.work.payload_kg for plan in plans])
        packed = np.zeros((len(plans), JOINTS, PARTS))
        packed[:, 1, 4] = np.where(self.explored & (payloads > 4.0), 0.1, payloads)
        packed[:, 1, :4] = 1.0 - payloads[:, None] / 10.0
        return Features(packed)


@pytest.fixture
def make(small):
    """Makes a study in which an explored training job is one with 9 kg."""

    def sample(payloads_kg, peaks_c) -> Sample:
        works = [small.work(f"place_{i}", payload_kg=float(kg)) for i, kg in enumerate(payloads_kg)]
        plans = tuple(variants[0] for variants in small.arm(0, works).plans.values())
        return Sample(plans, np.repeat(np.array(peaks_c, dtype=float)[:, None], JOINTS, axis=1))

    def made(_seed, *, train: int, exploration: int) -> Study:
        learned = [1.0] * (train - exploration) + [9.0] * exploration
        return Study(
            robot=Robot(name="arm"),
            motors=gen3_motors(),
            network=gen3_network(),
            ambient_c=23.0,
            horizon_s=HORIZON_S,
            cool_c=40.0,
            warning_c=60.0,
            train=sample(learned, [30.0] * train),
            reference=sample(np.arange(19) / 10, [30.0] * 19),
            test=sample(TEST, list(TEST.values())),
            novel=sample(NEW_KG, [30.0] * len(NEW_KG)),
        )

    return made


@pytest.fixture
def trainings(monkeypatch) -> list[dict[str, Any]]:
    """What each twin was trained on."""
    seen = []

    def train(records, config, seed, *, arm, folder):
        # Joint 2 of the small arms bears 15 N·m and the payload at one metre.
        payloads = [(float(np.abs(record[:, 2, 1]).max()) - 15.0) / 9.81 for record in records[1::3]]
        explored = sum(kg > 5.0 for kg in payloads)
        seen.append({"explored": explored, "work": len(payloads) - explored, "seed": seed, "config": config})
        return ByExcess(explored > 0)

    monkeypatch.setattr("scenarios.studies.setup.train_or_load", train)
    return seen


def test_rates_are_those_counted_by_hand(make, trainings):
    found = coverage(Bench(SEEDS, TwinConfig(), Path("none"), make), exploration=3, train=8)
    assert list(found) == [0, 3]
    assert set(found[0]) == set(found[3]) == set(SCORES)
    for seed in range(len(SEEDS)):
        without, explored = ({m: row[seed] for m, row in found[count]["excess"].items()} for count in (0, 3))
        # Ranked 3 kg (critical), 2, 1 (critical), 0.5: three of four pairs are in order.
        assert without["auroc"] == 0.75
        assert without["auprc"] == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
        assert without["spearman"] == pytest.approx(1 - 6 * (0 + 1 + 1 + 4) / 60)  # ranks 4 2 1 3 and 4 3 2 1
        # At 5 % of 19 references only what is above all of them, 1.8 kg, raises an alarm.
        assert without["caught"] == 0.5
        assert without["false_novel"] == 0.5
        assert explored == {**without, "false_novel": 0.0}
        # Its errors fall with the payload: no test job stands out, and only one pair is in order.
        falling = {m: row[seed] for m, row in found[0]["joint_2"].items()}
        assert (falling["auroc"], falling["caught"], falling["false_novel"]) == (0.25, 0.0, 0.0)


def test_both_twins_get_as_many_jobs_and_the_same_seed(make, trainings):
    config = TwinConfig.quick()
    coverage(Bench(SEEDS, config, Path("none"), make), exploration=3, train=8)
    assert [(t["work"], t["explored"]) for t in trainings] == [(8, 0)] * 2 + [(5, 3)] * 2
    assert [t["seed"] for t in trainings] == [*SEEDS, *SEEDS]
    assert all(t["config"] == config for t in trainings)


@pytest.mark.parametrize("exploration", [0, 9])
def test_no_or_too_much_exploration_is_refused(make, exploration):
    with pytest.raises(ValueError, match="0 < exploration <= train"):
        coverage(Bench(SEEDS, TwinConfig(), Path("none"), make), exploration=exploration, train=8)


def test_no_seed_is_refused(make):
    with pytest.raises(ValueError, match="at least one seed"):
        coverage(Bench([], TwinConfig(), Path("none"), make), exploration=3, train=8)
