"""What light exploration is worth: the same number of training jobs with and without light motions among them.

A twin that has only seen work takes a light new motion for a danger. How many false alarms that costs, and whether
the dangerous jobs are still found when part of the rehearsal goes to exploration, is measured here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenarios.contest import jobs_of
from scenarios.detection import Detection, detection
from scenarios.rehearse import trained
from scenarios.study import Sample, Study, make_study
from twin.measures import Features, score_of
from twin.model import TwinConfig
from twin.score import Twin

READ = ("sum", "joint_2", "load", "excess")
"""Scores that are compared, by the names of `twin.measures.score_of`."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Quality of each score under each seed, without and with exploration; the two share all but the training jobs."""

    exploration: int
    """Training jobs that were light motions, of `train`."""
    train: int
    without: dict[str, tuple[Detection, ...]]
    """By score, [seed]."""
    explored: dict[str, tuple[Detection, ...]]
    """By score, [seed]."""


def coverage(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    exploration: int = 80,
    train: int = 200,
    make: Callable[..., Study] = make_study,
) -> Coverage:
    """Train a twin on `train` cool jobs of work, and one on a mix with light motions, and let both judge the same jobs.

    Thresholds come from held-out cool jobs of work, of which 5 % may raise an alarm.

    Args:
        folder: Where trained twins are kept.
        exploration: How many of the training jobs are light motions in the second twin.
        make: Makes the study of a seed, as `make_study`.

    Raises:
        ValueError: no seed, or no exploration.
    """
    if not seeds or not 0 < exploration <= train:
        raise ValueError(f"Coverage needs a seed and 0 < exploration <= train (got {len(seeds)}, {exploration}).")
    without: dict[str, list[Detection]] = {name: [] for name in READ}
    explored: dict[str, list[Detection]] = {name: [] for name in READ}
    for seed in seeds:
        for count, found in ((0, without), (exploration, explored)):
            study = make(seed, train=train, exploration=count)
            twin = trained(study.train.records(), config, seed, arm=study.robot.name, folder=folder)
            for name, quality in _judged(twin, study).items():
                found[name].append(quality)
    return Coverage(
        exploration=exploration,
        train=train,
        without={name: tuple(found) for name, found in without.items()},
        explored={name: tuple(found) for name, found in explored.items()},
    )


def _judged(twin: Twin, study: Study) -> dict[str, Detection]:
    test, reference, novel = (_features(twin, part, study) for part in (study.test, study.reference, study.novel))
    return {
        name: detection(
            score_of(test, name),
            study.test.peak_c.max(axis=1),
            reference=score_of(reference, name),
            novel=score_of(novel, name),
            limit_c=study.warning_c,
        )
        for name in READ
    }


def _features(twin: Twin, sample: Sample, study: Study) -> Features:
    jobs = jobs_of(sample, study.horizon_s)
    return twin.features(jobs.plans, jobs.repetitions)
