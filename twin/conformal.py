"""The p-value of split conformal prediction."""

import numpy as np

Array = np.ndarray


def p_value(ordered: Array, score: Array) -> Array:
    """(1 + #{reference ≥ score}) / (n + 1) of each score, in (0, 1], same shape as the scores.

    For a job exchangeable with the reference it is ≤ α with probability ≤ α, for every α.

    Args:
        ordered: Scores of the n reference jobs, ascending, [job].

    Source: Vovk, Gammerman & Shafer, Algorithmic Learning in a Random World, 2005, prop. 2.8.
    """
    at_least = len(ordered) - np.searchsorted(ordered, score, side="left")
    return (1.0 + at_least) / (len(ordered) + 1.0)
