"""Effect of light exploration: equally many training jobs with and without light motions among them.

A twin trained on work alone raises false alarms on light new motions. Measured here: how many, and whether critical
jobs are still found when part of the rehearsal is exploration.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import Make, jobs_of
from scenarios.studies.detection_metrics import Detection, detection
from scenarios.studies.setup import make_study
from twin.vae.measures import score_of
from twin.vae.model import TwinConfig

READ = ("sum", "joint_2", "load", "excess")
"""Scores that are compared, by the names of `twin.vae.measures.score_of`."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Quality of each score under each seed, without and with exploration in the training jobs."""

    exploration: int
    """Light motions among the `train` training jobs."""
    train: int
    without: dict[str, list[Detection]]
    """By score, [seed]."""
    explored: dict[str, list[Detection]]
    """By score, [seed]."""


def coverage(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    exploration: int = 80,
    train: int = 200,
    make: Make = make_study,
) -> Coverage:
    """Quality of a twin trained on `train` cool jobs of work, and of one trained on a mix with light motions.

    Thresholds come from held-out cool jobs of work, of which 5 % may raise an alarm.

    Args:
        folder: Cache of trained twins.
        exploration: Light motions among the training jobs of the second twin.

    Raises:
        ValueError: no seed, or no exploration.
    """
    if not seeds or not 0 < exploration <= train:
        raise ValueError(f"Coverage needs a seed and 0 < exploration <= train (got {len(seeds)}, {exploration}).")
    quality = {count: {name: list[Detection]() for name in READ} for count in (0, exploration)}
    for seed in seeds:
        for count, by_score in quality.items():
            study = make(seed, train=train, exploration=count)
            twin = train_or_load(study.train.records(), config, seed, arm=study.robot.name, folder=folder)
            jobs = [jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel)]
            test, reference, novel = (twin.features(each.plans, each.repetitions) for each in jobs)
            for name in READ:
                by_score[name].append(
                    detection(
                        score_of(test, name),
                        study.test.peak_c.max(axis=1),
                        reference=score_of(reference, name),
                        novel=score_of(novel, name),
                        limit_c=study.warning_c,
                    )
                )
    return Coverage(exploration=exploration, train=train, without=quality[0], explored=quality[exploration])
