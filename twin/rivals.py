"""Simpler ways to find hard jobs, fitted on the same cool motion as a twin: what the twin must be compared with.

Every scorer answers alike, per joint and for the whole job, as a mean over the job's time with its phases weighted as
in the twin's own score. Detectors on window features stand in `twin.novelty`, torque rules in `twin.nominal`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from sklearn.decomposition import PCA

from fleet.difficulty import DifficultyModel, difficulty_of_error
from fleet.motion import CHANNELS, Plan
from twin.model import TwinConfig
from twin.reading import check_jobs, read_jobs
from twin.window import Scaler, windows_of

Array = np.ndarray

_CHUNK = 256
"""Jobs read at a time: some tens of MB of windows."""


@dataclass(frozen=True, eq=False)
class Scores:
    """What a scorer says of some jobs; more is harder, the unit is its own."""

    per_joint: Array
    """[job, joint]."""
    total: Array
    """[job]."""


class Scorer(Protocol):
    """Says how hard jobs are, after it was fitted or without."""

    @property
    def name(self) -> str:
        """As tables call it."""
        ...

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job, a plan done so many times.

        Raises:
            ValueError: no jobs, repetitions < 1, or a plan without motion, not finite or of other joints.
        """
        ...


@dataclass(frozen=True, eq=False)
class Known:
    """Cool motion as every rival learns it: windows in z-scores, cut like a twin's."""

    config: TwinConfig
    scaler: Scaler
    z: Array
    """float32 [batch, time, joint, channel]."""


def known(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> Known:
    """Training windows of records [time, 3, joint]; at most `config.max_windows`, drawn by the seed.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
    """
    windows = windows_of(
        records, from_hz=config.record_hz, rate_hz=config.rate_hz, window=config.window, stride=config.stride
    )
    if len(windows) > config.max_windows:
        rng = np.random.default_rng(seed)
        windows = windows[np.sort(rng.choice(len(windows), config.max_windows, replace=False))]
    scaler = Scaler.fit(windows)
    return Known(config, scaler, scaler.to_z(windows))


class Judge(Protocol):
    """Says of each sample how far it is from what is known."""

    def __call__(self, z: Array) -> Array:
        """Windows in z-scores [batch, time, joint, channel] to [batch, time, joint]."""
        ...


@dataclass(frozen=True, eq=False)
class ByWindow:
    """The mean of a judgement over the job's time; the total is the sum over joints."""

    name: str
    config: TwinConfig
    scaler: Scaler
    judge: Judge
    saturates: bool = False
    """Report 1 − exp(−mean), as the difficulty does, in place of the mean."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job, a plan done so many times; raises as `Scorer` says."""
        check_jobs(plans, repetitions)
        firsts = range(0, len(plans), _CHUNK)
        mean = np.concatenate([self._mean(plans[i : i + _CHUNK], repetitions[i : i + _CHUNK]) for i in firsts])
        per_joint = difficulty_of_error(mean) if self.saturates else mean
        return Scores(per_joint, per_joint.sum(axis=1))

    def _mean(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        reading = read_jobs(plans, repetitions, self.config)
        if reading.windows.shape[2] != self.scaler.joints:
            raise ValueError(f"'{self.name}' knows {self.scaler.joints} joints, a plan has {reading.windows.shape[2]}.")
        return reading.mean(self.judge(self.scaler.to_z(reading.windows)))


@dataclass(frozen=True, eq=False)
class Residual:
    """What the leading principal components of a joint's windows leave over, summed over the channels."""

    components: tuple[PCA, ...]

    def __call__(self, z: Array) -> Array:
        """Absolute error [batch, time, joint], in training standard deviations."""
        flat = z.astype(float).transpose(0, 2, 1, 3).reshape(len(z), z.shape[2], -1)
        made = [pca.inverse_transform(pca.transform(flat[:, j])) for j, pca in enumerate(self.components)]
        error = np.abs(flat - np.stack(made, axis=1)).reshape(len(z), z.shape[2], z.shape[1], z.shape[3])
        return error.sum(axis=-1).transpose(0, 2, 1)


def pca(cool: Known, components: int) -> ByWindow:
    """A linear autoencoder per joint, read as the twin is: 1 − exp(−mean absolute error).

    Raises:
        ValueError: fewer training windows or samples per window than components.
    """
    flat = cool.z.astype(float).transpose(0, 2, 1, 3).reshape(len(cool.z), cool.scaler.joints, -1)
    if not 1 <= components <= min(flat.shape[0], flat.shape[2]):
        raise ValueError(
            f"PCA needs 1 to {min(flat.shape[0], flat.shape[2])} components for {flat.shape[0]} windows of "
            f"{flat.shape[2]} numbers (got {components})."
        )
    fitted = tuple(PCA(components, svd_solver="full").fit(flat[:, j]) for j in range(cool.scaler.joints))
    return ByWindow(f"PCA-{components}", cool.config, cool.scaler, Residual(fitted), saturates=True)


@dataclass(frozen=True, eq=False)
class Modelled:
    """What a difficulty model says, joint by joint: a twin, `rc`, the oracle."""

    name: str
    model: DifficultyModel
    worst: bool = False
    """The total is the worst joint, in place of the sum over joints."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job, a plan done so many times; also raises where the model has no opinion."""
        check_jobs(plans, repetitions)
        said = [self.model.score(plan, times) for plan, times in zip(plans, repetitions, strict=True)]
        if None in said:
            raise ValueError(f"'{self.name}' has no opinion on job {said.index(None)}.")
        per_joint = np.stack([each.per_joint for each in said if each is not None])
        return Scores(per_joint, per_joint.max(axis=1) if self.worst else per_joint.sum(axis=1))


def collapsed(config: TwinConfig) -> TwinConfig:
    """A VAE whose loss takes the mean of the squares, not their sum: KL outweighs them and the latent dies.

    mean (x − x̂)² + KL is ½ Σ (x − x̂)² + β·KL with β = samples · channels / 2, up to a factor.
    """
    return replace(config, beta=config.window * len(CHANNELS) / 2, restarts=1, allow_collapse=True)


def untrained(config: TwinConfig) -> TwinConfig:
    """A VAE left as it was born: one epoch at a rate below what its weights can resolve."""
    return replace(config, epochs=1, learning_rate=1e-12, restarts=1, allow_collapse=True)
