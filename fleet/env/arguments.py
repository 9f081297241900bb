"""Seeds and counts as callers give them, checked alike by the single environment and the batch."""

from typing import Any

import numpy as np


def seed_of(seed: Any) -> np.random.SeedSequence:
    """The seed of a shift.

    Raises:
        ValueError: no integer, or one below 0.
    """
    if not _whole(seed) or seed < 0:
        raise ValueError(f"seed must be an integer >= 0 (got {seed!r}).")
    return np.random.SeedSequence(int(seed))


def seeds_of(seed: Any, envs: int) -> list[np.random.SeedSequence]:
    """The seeds of a batch: counted up from one, or one each, or by chance where there is none.

    Raises:
        ValueError: neither one seed nor one for each env.
    """
    if seed is None:
        return np.random.SeedSequence().spawn(envs)
    if _whole(seed):
        return [seed_of(seed + e) for e in range(envs)]
    if isinstance(seed, list | tuple | range | np.ndarray) and np.shape(seed) == (envs,):
        return [seed_of(each) for each in seed]
    raise ValueError(f"seed must be one integer or one for each of {envs} envs (got {seed!r}).")


def at_least_one(name: str, value: Any) -> int:
    """A count.

    Raises:
        ValueError: no integer, or one below 1.
    """
    if not _whole(value) or value < 1:
        raise ValueError(f"{name} must be an integer >= 1 (got {value!r}).")
    return int(value)


def _whole(value: Any) -> bool:
    """Whether it is one integer, of Python or NumPy."""
    return (
        isinstance(value, int | np.integer | np.ndarray)
        and np.ndim(value) == 0
        and np.asarray(value).dtype.kind in "iu"
    )
