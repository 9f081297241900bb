"""Cache key of everything that determines the weights of a training."""

import hashlib
from collections.abc import Sequence

import msgspec
import numpy as np

from twin.vae.config import TwinConfig

Array = np.ndarray

RECIPE = 3
"""Increase it when the same records, configuration and seed give other weights."""


def hash_records(records: Sequence[Array]) -> str:
    """Hash of the training data."""
    digest = hashlib.sha256()
    for record in records:
        digest.update(f"{record.dtype}{record.shape}".encode())
        digest.update(np.ascontiguousarray(record).tobytes())
    return digest.hexdigest()[:32]


def training_key(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> str:
    """Cache key of a training: equal keys mean equal weights."""
    parts = [str(RECIPE), hash_records(records), msgspec.json.encode(config).decode(), seed_text(seed)]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:32]


def seed_text(seed: np.random.SeedSequence) -> str:
    """A seed as text, `entropy/spawn.key`."""
    return f"{seed.entropy}/{'.'.join(map(str, seed.spawn_key))}"
