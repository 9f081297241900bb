"""Baselines for a twin: a linear autoencoder, and any difficulty model.

Every scorer gives one score per joint and one per job: means over the job's time, with its phases weighted as in the
twin's own score. Novelty detectors are in `twin.baselines.detectors`, torque rules in `twin.baselines.torque`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from sklearn.decomposition import PCA

from fleet.difficulty import DifficultyModel, difficulty_of_error
from fleet.motion import CHANNELS, Plan
from twin.vae.config import TwinConfig
from twin.vae.window import Scaler, check_jobs, cut_jobs, draw_windows, windows_of

Array = np.ndarray

_CHUNK = 256
"""Jobs per pass: some tens of MB of windows."""

SampleError = Callable[[Array], Array]
"""Windows in z-scores [batch, time, joint, channel] to an error per sample, [batch, time, joint]."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of some jobs, larger for harder ones, in the scorer's own unit."""

    per_joint: Array
    """[job, joint]."""
    total: Array
    """[job]."""


class Scorer(Protocol):
    """Scores how hard jobs are."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job, a repeated plan.

        Raises:
            ValueError: no jobs, repetitions < 1, or a plan without motion, not finite or of other joints.
        """
        ...


@dataclass(frozen=True, eq=False)
class CoolWindows:
    """Training windows in z-scores, cut like a twin's."""

    config: TwinConfig
    scaler: Scaler
    z: Array
    """float32 [batch, time, joint, channel]."""


def cool_windows(records: Sequence[Array], config: TwinConfig, seed: np.random.SeedSequence) -> CoolWindows:
    """Training windows of records [time, 3, joint]; at most `config.max_windows`, sampled by the seed.

    Raises:
        ValueError: no records, or one that is misshapen or not finite.
    """
    windows = draw_windows(windows_of(records, config), config.max_windows, seed)
    scaler = Scaler.fit(windows)
    return CoolWindows(config, scaler, scaler.to_z(windows))


@dataclass(frozen=True, eq=False)
class WindowScorer:
    """The mean of a sample error over each job's time; the total is the sum over joints."""

    name: str
    config: TwinConfig
    scaler: Scaler
    error: SampleError
    saturates: bool = False
    """Report 1 − exp(−mean), as the difficulty does, instead of the mean."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `Scorer` does."""
        check_jobs(plans, repetitions)
        firsts = range(0, len(plans), _CHUNK)
        mean = np.concatenate([self._mean(plans[i : i + _CHUNK], repetitions[i : i + _CHUNK]) for i in firsts])
        per_joint = difficulty_of_error(mean) if self.saturates else mean
        return Scores(per_joint, per_joint.sum(axis=1))

    def _mean(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Array:
        jobs = cut_jobs(plans, repetitions, self.config)
        if jobs.windows.shape[2] != self.scaler.joints:
            raise ValueError(
                f"'{self.name}' was trained on {self.scaler.joints} joints, a plan has {jobs.windows.shape[2]}."
            )
        return jobs.mean(self.error(self.scaler.to_z(jobs.windows)))


@dataclass(frozen=True, eq=False)
class _PcaError:
    """Residual of each joint's window after its leading principal components, summed over channels."""

    components: tuple[PCA, ...]

    def __call__(self, z: Array) -> Array:
        flat = _flat_windows(z)
        projected = [pca.inverse_transform(pca.transform(flat[:, j])) for j, pca in enumerate(self.components)]
        error = np.abs(flat - np.stack(projected, axis=1)).reshape(len(z), z.shape[2], z.shape[1], z.shape[3])
        return error.sum(axis=-1).transpose(0, 2, 1)


def _flat_windows(z: Array) -> Array:
    """[batch, joint, time · channel]."""
    return z.astype(float).transpose(0, 2, 1, 3).reshape(len(z), z.shape[2], -1)


def pca(cool: CoolWindows, components: int) -> WindowScorer:
    """A linear autoencoder per joint, scored as a twin is: 1 − exp(−mean absolute error).

    Raises:
        ValueError: fewer training windows or samples per window than components.
    """
    flat = _flat_windows(cool.z)
    if not 1 <= components <= min(flat.shape[0], flat.shape[2]):
        raise ValueError(
            f"PCA needs 1 to {min(flat.shape[0], flat.shape[2])} components for {flat.shape[0]} windows of "
            f"{flat.shape[2]} numbers (got {components})."
        )
    fitted = tuple(PCA(components, svd_solver="full").fit(flat[:, j]) for j in range(cool.scaler.joints))
    return WindowScorer(f"PCA-{components}", cool.config, cool.scaler, _PcaError(fitted), saturates=True)


@dataclass(frozen=True, eq=False)
class ModelScorer:
    """Difficulty by a difficulty model, such as a twin, `rc` or the oracle."""

    name: str
    model: DifficultyModel
    worst: bool = False
    """The total is the worst joint instead of the sum over joints."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `Scorer` does, and ValueError if the model has no score for a job."""
        check_jobs(plans, repetitions)
        difficulties = [self.model.score(plan, times) for plan, times in zip(plans, repetitions, strict=True)]
        if None in difficulties:
            raise ValueError(f"'{self.name}' has no score for job {difficulties.index(None)}.")
        per_joint = np.stack([difficulty.per_joint for difficulty in difficulties if difficulty is not None])
        return Scores(per_joint, per_joint.max(axis=1) if self.worst else per_joint.sum(axis=1))


def collapsed_config(config: TwinConfig) -> TwinConfig:
    """A VAE whose loss is the mean instead of the sum of squares: the KL outweighs it and the posterior collapses.

    mean (x − x̂)² + KL is ½ Σ (x − x̂)² + β·KL with β = samples · channels / 2, up to a factor.
    """
    return replace(config, beta=config.window * len(CHANNELS) / 2, restarts=1, allow_collapse=True)


def untrained_config(config: TwinConfig) -> TwinConfig:
    """A VAE with its initial weights: one epoch at a rate below what the weights can resolve."""
    return replace(config, epochs=1, learning_rate=1e-12, restarts=1, allow_collapse=True)
