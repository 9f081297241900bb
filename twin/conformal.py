"""p-values of split conformal prediction, and the rate of false alarms that they imply.

Source: Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World, 2005, prop. 2.8; Vovk, Conditional validity of
inductive conformal predictors, ACML 2012, prop. 2a.
"""

import numpy as np
from scipy.special import betaincinv

Array = np.ndarray


def p_value(ordered: Array, score: Array) -> Array:
    """(1 + #{reference ≥ score}) / (n + 1) of each score, in (0, 1], same shape as the scores.

    For a job exchangeable with the reference it is ≤ α with probability ≤ α, for every α.

    Args:
        ordered: Scores of the n reference jobs, ascending, [job].
    """
    at_least = len(ordered) - np.searchsorted(ordered, score, side="left")
    return (1.0 + at_least) / (len(ordered) + 1.0)


def largest_p_value(reference: Array, group: Array, score: Array) -> Array:
    """The largest of the p-values against each group of reference jobs, same shape as the scores.

    It is valid for a job that is exchangeable with the jobs of any one group, whichever that is.

    Args:
        reference: Scores of the reference jobs, [job].
        group: Group of each, int [job].
    """
    return np.max([p_value(np.sort(reference[group == g]), score) for g in np.unique(group)], axis=0)


def allowed(count: int, alpha: float) -> int:
    """floor(α (n + 1)): a new score is an alarm if fewer than so many of the n reference scores reach it."""
    return int(np.floor(alpha * (count + 1) + 1e-9))


def fewest(alpha: float) -> int:
    """Fewest reference jobs with which any p-value can be ≤ α."""
    return int(np.ceil(1 / alpha - 1 - 1e-9))


def rate_interval(count: int, alpha: float, confidence: float = 0.9) -> tuple[float, float]:
    """Interval of the rate of false alarms of one calibration with n jobs, for scores without ties.

    Given the calibration, the rate is Beta(m, n + 1 − m), m = floor(α (n + 1)). Its mean over calibrations is
    m / (n + 1).
    """
    m = allowed(count, alpha)
    tail = 0.5 * (1 - confidence)
    low, high = betaincinv(m, count + 1 - m, [tail, 1 - tail])
    return float(low), float(high)
