"""Seeds that follow from a seed."""

import numpy as np


def child(seed: np.random.SeedSequence, *places: int) -> np.random.SeedSequence:
    """The child at a place (of the child at a place, …), the same at every call: `SeedSequence.spawn` would count."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *places))
