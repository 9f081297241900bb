"""Synthetic cool motion of a twin as further training data of a temperature regressor: whether it helps.

An arm has a few cool jobs with measured peak temperatures. Its twin, trained on these jobs alone, generates motion near
them. The arm labels that motion with the peaks that a nominal thermal network predicts, or performs it. Controls add as
many noisy copies of its jobs, random light motions with predicted peaks, or measured jobs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from sklearn.metrics import root_mean_squared_error

from fleet.motion import Plan
from fleet.physics.models import ArmModel
from fleet.planning.random_motions import light_jobs
from fleet.seeding import child
from scenarios.motion.generate import MOST_DRAWS, GenerationError, Verification, propose
from scenarios.prepare.cool_motion import cold_peaks, records
from scenarios.progress import Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.lifetime.arm_transfer import SHORT, with_steps
from scenarios.studies.setup import Sample, Study, make_study
from scenarios.studies.transfer import REGRESSORS, fit, job_inputs
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.twin import Twin

Array = np.ndarray

REAL = "measured jobs only"
COPIES = "+ noisy copies"
RANDOM = "+ random light motion, predicted peaks"
PREDICTED = "+ synthetic motion, predicted peaks"
PERFORMED = "+ synthetic motion, measured peaks"
MORE = "+ as many measured jobs"
DATA = (REAL, COPIES, RANDOM, PREDICTED, PERFORMED, MORE)
NETWORK = "nominal thermal network, no regression"
JITTER = 0.1
"""Noise of the copies, in standard deviations of each feature."""


@dataclass(frozen=True, kw_only=True)
class AugmentationSize:
    """Numbers of jobs and training steps."""

    measured: tuple[int, ...] = (10, 20, 40)
    """Cool jobs with measured peaks."""
    added: int = 80
    held_out: int = 100
    test: int = 300
    s: float = 1.0
    """Perturbation of generated motion, posterior standard deviations."""
    steps: int = 300
    config: TwinConfig = field(default_factory=lambda: TwinConfig(batch=32, max_windows=100_000, allow_collapse=True))

    @classmethod
    def quick(cls) -> "AugmentationSize":
        """Smaller networks and fewer jobs."""
        return cls(measured=(10, 30), added=60, held_out=60, test=150, steps=200, config=SHORT)


@dataclass(frozen=True)
class Fitted:
    """Errors of one regressor of the hottest motor's peak temperature."""

    seed: int
    measured: int
    data: str
    """One of `DATA`, or `NETWORK`."""
    regressor: str
    cool_rmse_k: float
    """On held-out cool jobs."""
    all_rmse_k: float
    """On jobs of the natural mix, hot ones included."""


def augmentation(seeds: Sequence[int], size: AugmentationSize, *, progress: Progress = quiet) -> tuple[Fitted, ...]:
    """Every kind of training data with every regressor, by number of measured jobs and seed."""
    found = []
    for done, seed in enumerate(seeds):
        progress("augmentation", done / len(seeds))
        root = np.random.SeedSequence(seed)
        study = make_study(
            child(root, 0),
            train=max(size.measured) + size.added,
            reference=size.held_out,
            test=size.test,
            novel=0,
        )
        for count in size.measured:
            found += _fits(study, seed, count, size, child(root, 1, count))
    return tuple(found)


def _fits(
    study: Study, seed: int, count: int, size: AugmentationSize, random: np.random.SeedSequence
) -> Iterator[Fitted]:
    rng, own = np.random.default_rng(child(random, 0)), study.train.plans[:count]
    parts = records(own)
    twin = train(parts, with_steps(size.config, parts, size.steps), child(random, 1), arm=study.robot.name)
    nominal = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)

    def predicted(plans: Sequence[Plan]) -> Array:
        return cold_peaks(
            plans, nominal.motors, nominal.thermal, ambient_c=study.ambient_c, horizon_s=study.horizon_s
        ).max(axis=1)

    def features(plans: Sequence[Plan]) -> Array:
        return job_inputs(twin, jobs_of(Sample(tuple(plans), np.zeros((len(plans), 7))), study.horizon_s))["raw"]

    synthetic = tuple(islice(synthetic_motion(twin, study, own, nominal, size.s, rng), size.added))
    light = light_jobs(study.robot, size.added, rng)
    x, y = features(study.train.plans), study.train.peak_c.max(axis=1)
    copied = rng.integers(count, size=size.added)
    noise = JITTER * x[:count].std(axis=0) * rng.standard_normal((size.added, x.shape[1]))
    x_synthetic = features(synthetic)
    true_c = cold_peaks(
        synthetic, study.motors, study.thermal, ambient_c=study.ambient_c, horizon_s=study.horizon_s
    ).max(axis=1)
    added = {
        REAL: (x[:0], y[:0]),
        COPIES: (x[copied] + noise, y[copied]),
        RANDOM: (features(light), predicted(light)),
        PREDICTED: (x_synthetic, predicted(synthetic)),
        PERFORMED: (x_synthetic, true_c),
        MORE: (x[count : count + size.added], y[count : count + size.added]),
    }
    judged = [(features(part.plans), part.peak_c.max(axis=1)) for part in (study.reference, study.test)]
    for name, (more_x, more_y) in added.items():
        for regressor in REGRESSORS:
            both_x, both_y = np.concatenate([x[:count], more_x]), np.concatenate([y[:count], more_y])
            model = fit(regressor, both_x, both_y, seed)
            errors = [float(root_mean_squared_error(peak, model.predict(of))) for of, peak in judged]
            yield Fitted(seed, count, name, regressor, *errors)
    errors = [
        float(root_mean_squared_error(part.peak_c.max(axis=1), predicted(part.plans)))
        for part in (study.reference, study.test)
    ]
    yield Fitted(seed, count, NETWORK, "none", *errors)


def synthetic_motion(
    twin: Twin, study: Study, sources: Sequence[Plan], nominal: Verification, s: float, rng: np.random.Generator
) -> Iterator[Plan]:
    """Generated motion within the limits of the arm that the nominal network predicts to stay cool, without end.

    Clearance and closed-loop tracking are not checked here, unlike in `scenarios.motion.generate.generate`.

    Raises:
        GenerationError: `MOST_DRAWS` times as many draws as sources in a row gave no such motion.
    """
    model, barren = ArmModel(study.robot), 0
    while barren < MOST_DRAWS * len(sources):
        source = sources[int(rng.integers(len(sources)))]
        plan = propose(twin, source, s, rng, model)
        if plan is not None and nominal.peak_c(plan).max() <= nominal.cool_c - nominal.margin_k:
            barren = 0
            yield plan
        else:
            barren += 1
    raise GenerationError(f"{barren} motions in a row of arm '{study.robot.name}' passed a limit; lower s (got {s:g}).")
