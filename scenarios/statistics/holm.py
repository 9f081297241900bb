"""Several tests at once."""

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray


def holm(p: ArrayLike) -> Array:
    """p-values adjusted for all tests of a table (Holm, Scandinavian Journal of Statistics 6, 1979).

    The probability of any adjusted value below α where there is no difference is at most α, whether or not the tests
    depend on each other.

    Args:
        p: Any shape; NaN is no test and remains NaN.
    """
    raw = np.asarray(p, dtype=float)
    tested = raw[np.isfinite(raw)]
    order = np.argsort(tested)
    grown = np.maximum.accumulate(tested[order] * np.arange(len(tested), 0, -1))
    adjusted = np.empty(len(tested))
    adjusted[order] = np.minimum(grown, 1.0)
    result = np.full(raw.shape, np.nan)
    result[np.isfinite(raw)] = adjusted
    return result
