"""Transfer: a twin's latent as input of a small regressor of the temperature rise, against plain features.

The twin was trained without labels; the regressor gets a few jobs with their true temperature rise.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import RidgeCV
from sklearn.metrics import r2_score, root_mean_squared_error
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from fleet.errors import FleetError
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import Make, jobs_of
from scenarios.studies.ranking import Jobs
from scenarios.studies.setup import make_study
from twin.vae.model import TwinConfig
from twin.vae.twin import Twin
from twin.vae.window import JobWindows, cut_jobs

Array = np.ndarray

LABELS = (10, 50, 200)
DRAWS = 10
"""Random choices of the labelled jobs per number and seed."""
INPUTS = ("latent", "raw", "both")
REGRESSORS = ("ridge", "MLP")
_CHUNK = 256
"""Jobs read at a time."""


@dataclass(frozen=True, kw_only=True)
class TransferRow:
    """Errors on held-out jobs, one entry per seed and draw of labels."""

    inputs: str
    regressor: str
    labels: int
    rmse_k: tuple[float, ...]
    r2: tuple[float, ...]


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


def fit(regressor: str, x: Array, y: Array, seed: int) -> Callable[[Array], Array]:
    """A regressor of y [job] fitted on x [job, feature], both standardised inside.

    Raises:
        ValueError: an unknown regressor.
    """
    if regressor == "ridge":
        model = RidgeCV(alphas=np.logspace(-2, 4, 13))  # leave-one-out
    elif regressor == "MLP":
        model = MLPRegressor(hidden_layer_sizes=(32,), alpha=1.0, solver="lbfgs", max_iter=300, random_state=seed)
    else:
        raise ValueError(f"No regressor '{regressor}'. Allowed: {', '.join(REGRESSORS)}.")
    mean, scale = float(y.mean()), float(y.std()) or 1.0
    pipeline = make_pipeline(StandardScaler(), model)
    with warnings.catch_warnings():
        # The iterations are limited on purpose, as early stopping.
        warnings.simplefilter("ignore", ConvergenceWarning)
        pipeline.fit(x, (y - mean) / scale)
    return lambda new: mean + scale * np.asarray(pipeline.predict(new))


def compare(
    inputs: dict[str, Array],
    rise_k: Array,
    rng: np.random.Generator,
    *,
    labels: Sequence[int] = LABELS,
    draws: int = DRAWS,
) -> list[TransferRow]:
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
    rows = []
    for name, x in inputs.items():
        for regressor in REGRESSORS:
            for n, picks in chosen.items():
                predictions = [fit(regressor, x[some], rise_k[some], seed)(x[held_out]) for some, seed in picks]
                rows.append(
                    TransferRow(
                        inputs=name,
                        regressor=regressor,
                        labels=n,
                        rmse_k=tuple(float(root_mean_squared_error(rise_k[held_out], y)) for y in predictions),
                        r2=tuple(float(r2_score(rise_k[held_out], y)) for y in predictions),
                    )
                )
    return rows


def transfer(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    labels: Sequence[int] = LABELS,
    draws: int = DRAWS,
) -> list[TransferRow]:
    """Latent against raw features for the rise of the hottest winding, with a study and a twin per seed.

    Raises:
        ValueError: no seeds.
        FleetError: fewer than twice as many test jobs as labels.
    """
    if not seeds:
        raise ValueError("Transfer needs at least one seed.")
    per_seed = []
    for seed in seeds:
        study = make(seed)
        twin = train_or_load(study.train.records(), config, seed, arm=study.robot.name, folder=folder)
        rise_k = study.test.peak_c.max(axis=1) - study.ambient_c
        inputs = job_inputs(twin, jobs_of(study.test, study.horizon_s))
        per_seed.append(compare(inputs, rise_k, np.random.default_rng(seed), labels=labels, draws=draws))
    return [
        replace(
            rows[0],
            rmse_k=tuple(value for row in rows for value in row.rmse_k),
            r2=tuple(value for row in rows for value in row.r2),
        )
        for rows in zip(*per_seed, strict=True)
    ]
