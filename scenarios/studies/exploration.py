"""Effect of light exploration: equally many training jobs with and without light motions among them.

A twin trained on work alone raises false alarms on light new motions. This measures how many, and whether critical jobs
are still detected when part of the training is exploration.
"""

import numpy as np

from scenarios.studies.benchmark import jobs_of
from scenarios.studies.detection_metrics import Detection, detection
from scenarios.studies.ranking import by_measure
from scenarios.studies.setup import Bench
from twin.vae.measures import score_of

Array = np.ndarray

SCORES = ("sum", "joint_2", "load", "excess")
"""Scores that are compared, by the names of `twin.vae.measures.score_of`."""


def coverage(bench: Bench, *, exploration: int, train: int) -> dict[int, dict[str, dict[str, Array]]]:
    """Quality of a twin trained on `train` cool jobs of work, and of one trained on a mix with light motions.

    Thresholds come from held-out cool jobs of work, of which 5 % may raise an alarm.

    Args:
        exploration: Light motions among the training jobs of the second twin.

    Returns:
        [light motions among the training jobs: 0 or `exploration`][score][measure] → [seed].

    Raises:
        ValueError: no seeds, or no exploration.
    """
    if not 0 < exploration <= train:
        raise ValueError(f"Coverage needs 0 < exploration <= train (got {exploration}, {train}).")
    quality = {}
    for count in (0, exploration):
        by_score = {name: list[Detection]() for name in SCORES}
        for _, study, twin in bench.studies(train=train, exploration=count):
            jobs = [jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel)]
            features = [twin.features(each.plans, each.repetitions) for each in jobs]
            for name, results in by_score.items():
                test, reference, novel = (score_of(each, name) for each in features)
                peak_c = study.test.peak_c.max(axis=1)
                results.append(detection(test, peak_c, reference=reference, novel=novel, limit_c=study.warning_c))
        quality[count] = {name: by_measure(results) for name, results in by_score.items()}
    return quality
