"""Child seeds, and counter-based random numbers.

A counter-based generator gives the same value for the same key and count, in any order of calls. So a row
of a batch needs no generator of its own. SplitMix64 (Steele, Lea & Flood, OOPSLA 2014) scrambles the counter.
"""

from statistics import NormalDist
from typing import Any

import numpy as np

from fleet.jit import jit_inline

Array = np.ndarray
Bits = Any
"""np.uint64 or an array of them, which numba compiles alike."""

LEVELS = 256
"""Normal quantiles in the table, 1 kB: the sum of two of them has 2¹⁵ values, up to 4 standard deviations."""


def _quantiles() -> Array:
    values = np.array([NormalDist().inv_cdf((level + 0.5) / LEVELS) for level in range(LEVELS)])
    return (values / np.sqrt(2.0 * np.mean(values**2))).astype(np.float32)


QUANTILES: Array = _quantiles()
"""float32 [level], of standard deviation 1/√2."""
_GOLDEN, _FIRST, _SECOND = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_11, _27, _30, _31, _32 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(32)
_MASK = np.uint64(LEVELS - 1)


def key_of(seed: np.random.SeedSequence) -> int:
    """The 64-bit key of a seed."""
    return int(seed.generate_state(1, np.uint64)[0])


@jit_inline
def random_word(key: Bits, count: Bits) -> Bits:
    """64 random bits for a key and a count, uint64; elementwise over arrays."""
    word = key + count * _GOLDEN
    word = (word ^ (word >> _30)) * _FIRST
    word = (word ^ (word >> _27)) * _SECOND
    return word ^ (word >> _31)


@jit_inline
def random_uniform(key: Bits, count: Bits) -> Any:  # a float or an array
    """A uniform value in [0, 1) for a key and a count, uint64; elementwise over arrays."""
    return (random_word(key, count) >> _11) * (1.0 / 9007199254740992.0)


@jit_inline
def random_normal(key: Bits, count: Bits) -> Any:  # a float or an array
    """A standard normal value, float32, for a key and a count, uint64; elementwise over arrays."""
    word = random_word(key, count)
    return QUANTILES[word & _MASK] + QUANTILES[(word >> _32) & _MASK]


def child(seed: np.random.SeedSequence, *path: int) -> np.random.SeedSequence:
    """Child seed at a spawn path; stateless, unlike `SeedSequence.spawn`."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *path))


def shift_seeds(seed: np.random.SeedSequence) -> tuple[np.random.SeedSequence, np.random.SeedSequence]:
    """Seeds of a shift's jobs and of its sensors."""
    return child(seed, 0), child(seed, 1)


def exchange_seed(sensors: np.random.SeedSequence) -> np.random.SeedSequence:
    """Seed of the delays and losses of messages in a shift, from the seed of its sensors."""
    return child(sensors, 0)
