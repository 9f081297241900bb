"""Other uses of a twin: its latent as `features`, its motion as further training data (`augmentation`).

`features`: latent means as input of a ridge regression of temperature rise, payload and friction, cross-validated by
job, compared with the means of an untrained encoder of the same twin and with plain features of the same windows. Every
job is done by an arm in another state of wear, and the torque is computed from the motor current, which overcomes
friction.

`augmentation`: an arm has a few cool jobs with measured peak temperatures. Its twin, trained on these jobs alone,
generates motion near them. The arm labels that motion with the peaks that a nominal thermal network predicts, or
performs it. Controls add the same number of noisy copies of its jobs, random light motions with predicted peaks, or
measured jobs.
"""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import RidgeCV
from sklearn.metrics import r2_score, root_mean_squared_error
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks.paper.harness import (
    matching,
    seeded,
    table_of,
)
from benchmarks.paper.subjects import SHORT, Sample, Study, make_study, sensed, with_steps
from fleet.arm.model import ArmModel
from fleet.arm.random_motions import light_jobs
from fleet.errors import FleetError
from fleet.heat.motor import Motors
from fleet.motion import Plan
from fleet.seeding import child
from scenarios.evaluate.statistics import interval
from scenarios.json_rows import Row
from scenarios.motion.generate import MOST_DRAWS, GenerationError, Rejected, Verification, planned
from scenarios.prepare.twins import cold_peaks, records
from scenarios.table import Table
from twin.baselines import untrained_config
from twin.vae.config import TwinConfig
from twin.vae.generate import vary
from twin.vae.train import train
from twin.vae.twin import Twin
from twin.vae.window import JobWindows, cut_jobs

Array = np.ndarray

REGRESSORS: Mapping[str, Callable[[int], RidgeCV | MLPRegressor]] = {
    "ridge": lambda _: RidgeCV(alphas=np.logspace(-2, 4, 13)),  # leave-one-out
    "MLP": lambda seed: MLPRegressor(
        hidden_layer_sizes=(32,), alpha=1.0, solver="lbfgs", max_iter=300, random_state=seed
    ),
}
"""By name, from a seed."""
CHUNK = 256
"""Jobs read at a time."""
WEAR = (0.0, 1.5)
"""Range of the wear of the arm in the jobs."""
FOLDS = 5
INPUTS = ("latent", "untrained", "raw", "latent and raw")
TARGETS = ("temperature rise, K", "payload, kg", "friction, share of wear")


def job_inputs(twin: Twin, jobs: Sample) -> dict[str, Array]:
    """Inputs of a regressor for each job, [job, feature], by the names of `INPUTS`.

    For each window the posterior means (latent), or mean, standard deviation and RMS of each channel in SI units
    (raw); then the mean and the standard deviation of these over the job's time.
    """
    parts = []
    for first in range(0, len(jobs.plans), CHUNK):
        some = slice(first, first + CHUNK)
        reading = cut_jobs(jobs.plans[some], jobs.repetitions[some], twin.config)
        parts.append(
            (over_time(reading, twin.posterior(reading.windows)[0]), over_time(reading, moments(reading.windows)))
        )
    latent, raw = (np.concatenate(kind) for kind in zip(*parts, strict=True))
    return {"latent": latent, "raw": raw, "both": np.concatenate([latent, raw], axis=1)}


def moments(windows: Array) -> Array:
    """Mean, standard deviation and RMS over the time of windows [batch, time, joint, channel], [batch, joint, 9]."""
    parts = (windows.mean(axis=1), windows.std(axis=1), np.sqrt(np.square(windows).mean(axis=1)))
    return np.concatenate(parts, axis=-1)


def over_time(reading: JobWindows, values: Array) -> Array:
    """Mean and standard deviation over each job's time of one vector per window [batch, ...], [job, 2 · size]."""
    flat = values.reshape(len(values), 1, -1).astype(float)
    mean = reading.mean(flat)
    variance = reading.mean((flat - mean[reading.job][:, None]) ** 2)
    return np.concatenate([mean, np.sqrt(variance)], axis=1)


def fit(regressor: str, x: Array, y: Array, seed: int) -> TransformedTargetRegressor:
    """A regressor of `REGRESSORS` for y [job] fitted on x [job, feature], both standardised."""
    pipeline = make_pipeline(StandardScaler(), REGRESSORS[regressor](seed))
    model = TransformedTargetRegressor(pipeline, transformer=StandardScaler())
    with warnings.catch_warnings():
        # The iterations are limited on purpose, as early stopping.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(x, y)


@dataclass(frozen=True, kw_only=True)
class FeatureSize:
    """Numbers of jobs and training steps."""

    labels: tuple[int, ...] = (50, 200)
    """Jobs of a cross-validation, ascending."""
    train: int = 80
    """Cool jobs that train the twin."""
    steps: int = 400
    config: TwinConfig = SHORT

    def __post_init__(self) -> None:
        if min(self.labels) < 2 * FOLDS:
            raise FleetError(f"--labels must be {2 * FOLDS} or more for a cross-validation (got {min(self.labels)}).")


def worn_jobs(study: Study, rng: np.random.Generator) -> tuple[Sample, dict[str, Array]]:
    """The study's test jobs as recorded by the arm in random states of wear, and their targets [job] by name."""
    jobs = study.test
    wear = rng.uniform(*WEAR, len(jobs.plans))
    worn = [with_wear(study.motors, share) for share in wear]
    plans = tuple(sensed([plan], motors)[0] for plan, motors in zip(jobs.plans, worn, strict=True))
    peak_c = np.array([_peak(plan, motors, study) for plan, motors in zip(jobs.plans, worn, strict=True)])
    payload_kg = np.array([plan.work.payload_kg for plan in jobs.plans])
    return Sample(plans, peak_c, study.horizon_s), {
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
) -> list[Row]:
    """Ridge regressions on the first jobs of a random order, judged on the jobs of the other folds.

    All windows of a job are in one row, so no job is on both sides.

    Args:
        inputs: [job, feature] by name.
        targets: [job] by name.

    Returns:
        R² and RMSE, the latter in the unit of the target, of each target, input and number of jobs, of which four
        fifths are fitted on at a time.
    """
    order = np.random.default_rng(seed).permutation(len(next(iter(targets.values()))))
    found: list[Row] = []
    for count in labels:
        some = order[:count]
        for target, y in targets.items():
            for name, x in inputs.items():
                guess = np.empty(count)
                for fitted, other in KFold(FOLDS).split(some):
                    model = fit("ridge", x[some[fitted]], y[some[fitted]], seed)
                    guess[other] = model.predict(x[some[other]])
                quality = {"r2": r2_score(y[some], guess), "rmse": root_mean_squared_error(y[some], guess)}
                found.append({"target": target, "inputs": name, "labels": count, **quality})
    return found


def feature_rows(seed: int, size: FeatureSize, _wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Every target from every input, by number of labelled jobs."""
    root = np.random.SeedSequence(seed)
    study = make_study(child(root, 0), train=size.train, reference=0, test=max(size.labels), novel=0)
    parts = records(sensed(study.train.plans, study.motors))
    config = with_steps(size.config, parts, size.steps)
    twin = train(parts, config, child(root, 1), arm="arm")
    untrained = train(parts, untrained_config(config), child(root, 1), arm="arm")
    jobs, targets = worn_jobs(study, np.random.default_rng(child(root, 2)))
    known = job_inputs(twin, jobs)
    values = (known["latent"], job_inputs(untrained, jobs)["latent"], known["raw"], known["both"])
    inputs: dict[str, Array] = dict(zip(INPUTS, values, strict=True))
    yield "", {"seed": seed, "estimates": cross_validated(inputs, targets, size.labels, seed)}


def feature_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """R² by target, number of jobs and input."""
    found = [each for row in rows for each in row["estimates"]]
    keys = dict.fromkeys((each["target"], each["labels"]) for each in found)

    def r2(target: str, labels: int, inputs: str) -> str:
        own = matching(found, target=target, labels=labels, inputs=inputs)
        return interval([each["r2"] for each in own], most=1.0).text()

    lines = [(f"{t}, {n} jobs", *(r2(t, n, each) for each in INPUTS)) for t, n in keys]
    return {
        "features_r2": table_of(("target, jobs", *INPUTS), lines, "R² of ridge regressions, cross-validated by job")
    }


FEATURES = seeded(
    "The latent as input of regressions of temperature, payload and friction.\n\nA seed takes 10 s of one core.",
    FeatureSize,
    3,
    feature_rows,
    feature_tables,
)

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

    measured: tuple[int, ...] = (10, 30)
    """Cool jobs with measured peaks."""
    added: int = 60
    held_out: int = 60
    test: int = 150
    s: float = 1.0
    """Perturbation of generated motion, posterior standard deviations."""
    steps: int = 200
    config: TwinConfig = SHORT


def _fits(study: Study, seed: int, count: int, size: AugmentationSize, random: np.random.SeedSequence) -> Iterator[Row]:
    rng, own = np.random.default_rng(child(random, 0)), study.train.plans[:count]
    parts = records(own)
    twin = train(parts, with_steps(size.config, parts, size.steps), child(random, 1), arm=study.robot.name)
    nominal = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)

    def predicted(plans: Sequence[Plan]) -> Array:
        return cold_peaks(
            plans, nominal.motors, nominal.thermal, ambient_c=study.ambient_c, horizon_s=study.horizon_s
        ).max(axis=1)

    def features(plans: Sequence[Plan]) -> Array:
        return job_inputs(twin, Sample(tuple(plans), np.zeros((len(plans), 7)), study.horizon_s))["raw"]

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
    judged = [features(part.plans) for part in (study.reference, study.test)]

    def fitted(data: str, regressor: str, predictions: Sequence[Array]) -> Row:
        """RMSE on held-out cool jobs, and on jobs of the natural mix, hot ones included."""
        true_c = (part.peak_c.max(axis=1) for part in (study.reference, study.test))
        errors = [float(root_mean_squared_error(*pair)) for pair in zip(true_c, predictions, strict=True)]
        named = dict(zip(("cool_rmse_k", "all_rmse_k"), errors, strict=True))
        return {"measured": count, "data": data, "regressor": regressor, **named}

    for name, (more_x, more_y) in added.items():
        for regressor in REGRESSORS:
            both_x, both_y = np.concatenate([x[:count], more_x]), np.concatenate([y[:count], more_y])
            model = fit(regressor, both_x, both_y, seed)
            yield fitted(name, regressor, [model.predict(inputs) for inputs in judged])
    yield fitted(NETWORK, "none", [predicted(part.plans) for part in (study.reference, study.test)])


def synthetic_motion(
    twin: Twin, study: Study, sources: Sequence[Plan], nominal: Verification, s: float, rng: np.random.Generator
) -> Iterator[Plan]:
    """Generated motion within the limits of the arm that the nominal network predicts to stay cool, without end.

    Clearance and closed-loop tracking are not checked here, unlike in `scenarios.motion.generate.generate`.

    Raises:
        GenerationError: `MOST_DRAWS` samples per source in a row gave no such motion.
    """
    model, barren = ArmModel(study.robot), 0
    while barren < MOST_DRAWS * len(sources):
        source = sources[int(rng.integers(len(sources)))]
        try:
            plan = planned(vary(twin, source, s, rng), source, model)
        except Rejected:
            plan = None
        if plan is not None and nominal.peak_c(plan).max() <= nominal.cool_c - nominal.margin_k:
            barren = 0
            yield plan
        else:
            barren += 1
    raise GenerationError(f"{barren} motions in a row of arm '{study.robot.name}' passed a limit; lower s (got {s:g}).")


def augmentation_rows(seed: int, size: AugmentationSize, _wanted: Collection[str]) -> Iterator[tuple[str, Row]]:
    """Every kind of training data with every regressor, by number of measured jobs."""
    root, most = np.random.SeedSequence(seed), max(size.measured) + size.added
    study = make_study(child(root, 0), train=most, reference=size.held_out, test=size.test, novel=0)
    fits = [fit for count in size.measured for fit in _fits(study, seed, count, size, child(root, 1, count))]
    yield "", {"seed": seed, "fits": fits}


def augmentation_tables(rows: Sequence[Row]) -> dict[str, Table]:
    """Error by training data, and its paired difference to the measured jobs alone."""
    fits = [each for row in rows for each in row["fits"]]
    counts = list(dict.fromkeys(each["measured"] for each in fits))

    def values(count: int, data: str, regressor: str, name: str) -> Array:
        return np.array([e[name] for e in matching(fits, measured=count, data=data, regressor=regressor)])

    def cells(count: int, data: str, regressor: str) -> Iterator[str]:
        for name in ("cool_rmse_k", "all_rmse_k"):
            own, base = values(count, data, regressor, name), values(count, REAL, regressor, name)
            yield from (f"{own.mean():.2f}", "" if data == REAL else interval(own - base).text())

    lines = [
        (f"{count} jobs, {regressor}: {data}", *cells(count, data, regressor))
        for count in counts
        for regressor in REGRESSORS
        for data in DATA
    ]
    cool, every = (f"{values(counts[0], NETWORK, 'none', n).mean():.2f}" for n in ("cool_rmse_k", "all_rmse_k"))
    lines.append((NETWORK, cool, "", every, ""))
    heads = ("measured jobs, regressor: data", "cool jobs, K", "difference", "all jobs, K", "difference")
    caption = "RMSE of the peak temperature, and its paired difference to the measured jobs only"
    return {"augmentation_errors": table_of(heads, lines, caption)}


AUGMENTATION = seeded(
    "Synthetic cool motion of a twin as training data of a temperature regressor.\n\n"
    "A seed takes half a minute of one core.",
    AugmentationSize,
    5,
    augmentation_rows,
    augmentation_tables,
)
