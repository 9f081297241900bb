"""Detection of jobs that overheat: threshold-free measures, and alarms at a threshold from cool jobs."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr
from sklearn.metrics import average_precision_score, roc_auc_score

from fleet.errors import FleetError
from twin.saturation.alarm import ConformalAlarm

Array = np.ndarray

LIMIT_C = 60.0
"""A job whose hottest winding reaches this within the horizon is critical (the arm's warning limit)."""
ALARM_RATE = 0.05
"""Share of cool jobs that may raise an alarm."""


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Quality of one score on held-out jobs."""

    auroc: float
    """Probability that a critical job scores above another one."""
    auprc: float
    """Average precision; by chance, the share of critical jobs."""
    spearman: float
    """Rank correlation with the true peak temperature."""
    caught: float
    """Share of critical jobs that raise an alarm at the threshold."""
    false_novel: float
    """Share of light new motions that raise an alarm although they stay cool."""


def detection(score: Array, peak_c: Array, *, reference: Array, novel: Array, limit_c: float = LIMIT_C) -> Detection:
    """Quality of scores [job] of held-out jobs with true peaks [job], °C.

    Args:
        reference: Scores of other held-out cool jobs, [job]; the threshold comes from these alone.
        novel: Scores of light new motions, [job].

    Raises:
        ValueError: scores that are not finite, or not one per peak.
        FleetError: no job is critical or all are, or too few reference jobs for the alarm.
    """
    if score.shape != peak_c.shape or score.ndim != 1:
        raise ValueError(f"Scores and peaks must be [job] alike (got {score.shape} and {peak_c.shape}).")
    if not all(np.isfinite(values).all() for values in (score, peak_c, reference, novel)):
        raise ValueError("Scores and peaks must be finite.")
    critical = peak_c >= limit_c
    if critical.all() or not critical.any():
        raise FleetError(
            f"{critical.sum()} of {len(critical)} test jobs reach {limit_c:g} °C: without some of both kinds no "
            "quality can be measured. Change the payloads, the ambient temperature or the limit."
        )
    alarm = ConformalAlarm.fit(reference, ALARM_RATE)
    return Detection(
        auroc=float(roc_auc_score(critical, score)),
        auprc=float(average_precision_score(critical, score)),
        spearman=float(np.asarray(spearmanr(score, peak_c))[0]),
        caught=float(alarm(score[critical]).mean()),
        false_novel=float(alarm(novel).mean()) if len(novel) else float("nan"),
    )
