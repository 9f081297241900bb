"""Sensor noise by counting: the same key and moment give the same noise, in whatever order and company it is asked for.

SplitMix64 (Steele, Lea & Flood, OOPSLA 2014) scrambles a counter; two of the words' stretches of bits look up a
standard normal quantile each, and the sum is scaled to unit variance.
"""

import numpy as np
from scipy.special import ndtri

Array = np.ndarray

GOLDEN, FIRST, SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
"""The constants of SplitMix64."""
LEVELS = 4096
"""Quantiles in the table: with 12 bits each, two of them give 2²³ different values up to 5 standard deviations."""


def _quantiles() -> Array:
    values = ndtri((np.arange(LEVELS) + 0.5) / LEVELS)
    return values / np.sqrt(2.0 * np.mean(values**2))


QUANTILES: Array = _quantiles()
"""[level], of standard deviation 1/√2."""


def key_of(seed: np.random.SeedSequence) -> int:
    """The key of a seed, 64 bits."""
    return int(seed.generate_state(1, np.uint64)[0])


def standard_normal(key: int, moment: int, shape: tuple[int, ...]) -> Array:
    """Independent standard normal values of a moment, [shape]."""
    size = int(np.prod(shape))
    count = np.arange(moment * size + 1, (moment + 1) * size + 1, dtype=np.uint64)
    word = np.uint64(key) + count * np.uint64(GOLDEN)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(FIRST)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(SECOND)
    word ^= word >> np.uint64(31)
    levels = np.uint64(LEVELS - 1)
    return (QUANTILES[word & levels] + QUANTILES[(word >> np.uint64(32)) & levels]).reshape(shape)
