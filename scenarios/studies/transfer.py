"""Transfer: a twin's latent as input of small regressors, against plain features.

The twin was trained without labels; a regressor gets a few jobs with their true temperature rise, payload or friction.
"""

import warnings
from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from sklearn.compose import TransformedTargetRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import RidgeCV
from sklearn.metrics import r2_score, root_mean_squared_error
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from fleet.errors import FleetError
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.ranking import Jobs
from scenarios.studies.setup import Bench
from twin.vae.twin import Twin
from twin.vae.window import JobWindows, cut_jobs

Array = np.ndarray

LABELS = (10, 50, 200)
DRAWS = 10
"""Random choices of the labelled jobs per number and seed."""
INPUTS = ("latent", "raw", "both")
REGRESSORS: dict[str, Callable[[int], RidgeCV | MLPRegressor]] = {
    "ridge": lambda _: RidgeCV(alphas=np.logspace(-2, 4, 13)),  # leave-one-out
    "MLP": lambda seed: MLPRegressor(
        hidden_layer_sizes=(32,), alpha=1.0, solver="lbfgs", max_iter=300, random_state=seed
    ),
}
"""By name, from a seed."""
_CHUNK = 256
"""Jobs read at a time."""


Errors = dict[tuple[str, str, int], dict[str, list[float]]]
"""[inputs, regressor, number of labels][measure] → one value per seed and draw of labels, on held-out jobs."""
MEASURES = {"rmse_k": root_mean_squared_error, "r2": r2_score}


def job_inputs(twin: Twin, jobs: Jobs) -> dict[str, Array]:
    """Inputs of a regressor for each job, [job, feature], by the names of `INPUTS`.

    For each window the posterior means (latent), or mean, standard deviation and RMS of each channel in SI units
    (raw); then the mean and the standard deviation of these over the job's time.
    """
    parts = []
    for first in range(0, len(jobs.plans), _CHUNK):
        some = slice(first, first + _CHUNK)
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


def compare(
    inputs: dict[str, Array],
    rise_k: Array,
    rng: np.random.Generator,
    *,
    labels: Sequence[int] = LABELS,
    draws: int = DRAWS,
) -> Errors:
    """Errors of every input and regressor by number of labels; all get the same draws, and half of the jobs test.

    Args:
        inputs: [job, feature] by name.
        rise_k: True temperature rise, [job].

    Raises:
        FleetError: fewer than twice as many jobs as labels.
    """
    if len(rise_k) < 2 * max(labels):
        raise FleetError(f"{max(labels)} labels need {2 * max(labels)} jobs, half of them to test on ({len(rise_k)}).")
    order = rng.permutation(len(rise_k))
    pool, held_out = order[: len(order) // 2], order[len(order) // 2 :]
    chosen = {n: [(rng.permutation(pool)[:n], int(rng.integers(2**31))) for _ in range(draws)] for n in labels}
    errors: Errors = {}
    for (name, x), regressor, (n, picks) in product(inputs.items(), REGRESSORS, chosen.items()):
        predictions = [fit(regressor, x[some], rise_k[some], seed).predict(x[held_out]) for some, seed in picks]
        errors[name, regressor, n] = {
            measure: [float(of(rise_k[held_out], y)) for y in predictions] for measure, of in MEASURES.items()
        }
    return errors


def transfer(bench: Bench, *, labels: Sequence[int] = LABELS, draws: int = DRAWS) -> Errors:
    """Latent against raw features for the rise of the hottest winding.

    Raises:
        ValueError: no seeds.
        FleetError: fewer than twice as many test jobs as labels.
    """
    per_seed = []
    for seed, study, twin in bench.studies():
        rise_k = study.test.peak_c.max(axis=1) - study.ambient_c
        inputs = job_inputs(twin, jobs_of(study.test, study.horizon_s))
        per_seed.append(compare(inputs, rise_k, np.random.default_rng(seed), labels=labels, draws=draws))
    return {
        row: {measure: [value for errors in per_seed for value in errors[row][measure]] for measure in MEASURES}
        for row in per_seed[0]
    }
