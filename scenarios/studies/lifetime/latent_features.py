"""Latent means as input of a ridge regression of temperature rise, payload and friction, cross-validated by job.

Compared with the means of an untrained encoder of the same twin and with plain features of the same windows. Every job
is done by an arm in another state of wear, and the torque is computed from the motor current, which overcomes friction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from sklearn.metrics import r2_score, root_mean_squared_error
from sklearn.model_selection import KFold

from fleet.motion import Plan
from fleet.motor import Motors
from fleet.seeding import child
from scenarios.prepare.cool_motion import cold_peaks, records
from scenarios.progress import Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.lifetime.arm_transfer import SHORT, with_steps
from scenarios.studies.lifetime.sensed_torque import sensed
from scenarios.studies.ranking import Jobs
from scenarios.studies.setup import Study, make_study
from scenarios.studies.transfer import fit, job_inputs
from twin.baselines.reconstruction import untrained_config
from twin.vae.config import TwinConfig
from twin.vae.train import train

Array = np.ndarray

WEAR = (0.0, 1.5)
"""Range of the wear of the arm in the jobs."""
FOLDS = 5
INPUTS = ("latent", "untrained", "raw", "latent and raw")
TARGETS = ("temperature rise, K", "payload, kg", "friction, share of wear")


@dataclass(frozen=True, kw_only=True)
class FeatureSize:
    """Numbers of jobs and training steps."""

    labels: tuple[int, ...] = (50, 400)
    """Jobs of a cross-validation, ascending."""
    train: int = 120
    """Cool jobs that train the twin."""
    steps: int = 600
    config: TwinConfig = field(default_factory=lambda: TwinConfig(batch=32, max_windows=100_000, allow_collapse=True))

    @classmethod
    def quick(cls) -> "FeatureSize":
        """Smaller networks and half the jobs."""
        return cls(labels=(50, 200), train=80, steps=400, config=SHORT)


@dataclass(frozen=True)
class Estimate:
    """Quality of one regression on jobs that it was not fitted on."""

    target: str
    inputs: str
    labels: int
    """Jobs; four fifths are fitted on at a time."""
    seed: int
    r2: float
    rmse: float
    """In the unit of the target."""


def latent_features(seeds: Sequence[int], size: FeatureSize, *, progress: Progress = quiet) -> tuple[Estimate, ...]:
    """Every target from every input, by number of labelled jobs and seed.

    Raises:
        ValueError: fewer labels than folds.
    """
    if min(size.labels) < 2 * FOLDS:
        raise ValueError(f"A cross-validation needs {2 * FOLDS} jobs or more (got {min(size.labels)}).")
    found = []
    for done, seed in enumerate(seeds):
        progress("features", done / len(seeds))
        root = np.random.SeedSequence(seed)
        study = make_study(child(root, 0), train=size.train, reference=0, test=max(size.labels), novel=0)
        parts = records(sensed(study.train.plans, study.motors))
        config = with_steps(size.config, parts, size.steps)
        twin = train(parts, config, child(root, 1), arm="arm")
        untrained = train(parts, untrained_config(config), child(root, 1), arm="arm")
        jobs, targets = worn_jobs(study, np.random.default_rng(child(root, 2)))
        known = job_inputs(twin, jobs)
        inputs = {
            "latent": known["latent"],
            "untrained": job_inputs(untrained, jobs)["latent"],
            "raw": known["raw"],
            "latent and raw": known["both"],
        }
        found += cross_validated(inputs, targets, size.labels, seed)
    return tuple(found)


def worn_jobs(study: Study, rng: np.random.Generator) -> tuple[Jobs, dict[str, Array]]:
    """The study's test jobs as recorded by the arm in random states of wear, and their targets [job] by name."""
    jobs = jobs_of(study.test, study.horizon_s)
    wear = rng.uniform(*WEAR, len(jobs.plans))
    worn = [with_wear(study.motors, share) for share in wear]
    plans = tuple(sensed([plan], motors)[0] for plan, motors in zip(jobs.plans, worn, strict=True))
    peak_c = np.array([_peak(plan, motors, study) for plan, motors in zip(jobs.plans, worn, strict=True)])
    payload_kg = np.array([plan.work.payload_kg for plan in jobs.plans])
    return Jobs(plans, jobs.repetitions, peak_c), {
        TARGETS[0]: peak_c.max(axis=1) - study.ambient_c,
        TARGETS[1]: payload_kg,
        TARGETS[2]: wear,
    }


def with_wear(motors: Motors, wear: float) -> Motors:
    """The motors with their friction increased by the share `wear`."""
    return replace(
        motors,
        coulomb_nm=motors.coulomb_nm * (1.0 + wear),
        viscous_nms_per_rad=motors.viscous_nms_per_rad * (1.0 + wear),
    )


def _peak(plan: Plan, motors: Motors, study: Study) -> Array:
    return cold_peaks([plan], motors, study.thermal, ambient_c=study.ambient_c, horizon_s=study.horizon_s)[0]


def cross_validated(
    inputs: Mapping[str, Array], targets: Mapping[str, Array], labels: Sequence[int], seed: int
) -> list[Estimate]:
    """Ridge regressions on the first jobs of a random order, judged on the jobs of the other folds.

    All windows of a job are in one row, so no job is on both sides.

    Args:
        inputs: [job, feature] by name.
        targets: [job] by name.
    """
    order = np.random.default_rng(seed).permutation(len(next(iter(targets.values()))))
    found = []
    for count in labels:
        some = order[:count]
        for target, y in targets.items():
            for name, x in inputs.items():
                guess = np.empty(count)
                for fitted, other in KFold(FOLDS).split(some):
                    model = fit("ridge", x[some[fitted]], y[some[fitted]], seed)
                    guess[other] = model.predict(x[some[other]])
                found.append(
                    Estimate(
                        target=target,
                        inputs=name,
                        labels=count,
                        seed=seed,
                        r2=float(r2_score(y[some], guess)),
                        rmse=float(root_mean_squared_error(y[some], guess)),
                    )
                )
    return found
