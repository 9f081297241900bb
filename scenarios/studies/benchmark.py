"""Benchmark of the twin, its variants and baselines on identical data: the same cool training and test jobs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fleet.difficulty import difficulty_of_error
from fleet.motion import CHANNELS, Plan
from fleet.motor import gen3_motors
from fleet.thermal import gen3_network, thermal_model
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.ranking import Jobs, Judged, QualityTable, judge, table
from scenarios.studies.setup import Sample, Study, make_study
from scenarios.studies.simulated_logs import AIR_SD_K, own_logs
from twin.baselines.detectors import isolation_forest, mahalanobis, nearest_neighbours
from twin.baselines.reconstruction import (
    ModelScorer,
    Scorer,
    Scores,
    collapsed_config,
    cool_windows,
    pca,
    untrained_config,
)
from twin.baselines.torque import torque_over_continuous, torque_over_known
from twin.thermal.identify import identify
from twin.thermal.thermal_twin import RcTwin
from twin.vae.measures import Calibration, Features
from twin.vae.model import TwinConfig
from twin.vae.twin import Twin
from twin.vae.window import check_jobs

Array = np.ndarray

VAE = "VAE"
TAU = CHANNELS.index("tau")
BASELINES = (
    "AE",
    "collapsed VAE",
    "untrained VAE",
    "PCA-2",
    "PCA-8",
    "kNN-5",
    "Mahalanobis",
    "isolation forest",
    "RMS torque / known",
    "RMS torque / continuous",
    "rc nominal",
    "rc identified",
)
"""Scorers that are not the twin."""
THERMAL = ("RMS torque / continuous", "rc nominal", "rc identified")
"""Scorers that were given motor data and the thermal law; all others saw nothing but cool motion."""
LOGS = 6
"""Training jobs that are logged with their temperatures, half an hour each, to identify the arm."""


@dataclass(frozen=True, eq=False)
class TwinScorer:
    """One score of a trained twin; the total is the sum over joints."""

    name: str
    twin: Twin
    of_features: Callable[[Features], Array]
    """Score [job, joint] from features of jobs."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `twin.baselines.reconstruction.Scorer` says."""
        check_jobs(plans, repetitions)
        per_joint = self.of_features(self.twin.features(plans, repetitions))
        return Scores(per_joint, per_joint.sum(axis=1))


def difficulty(features: Features) -> Array:
    """d_k of the paper, [job, joint]."""
    return features.difficulty


def torque_difficulty(features: Features) -> Array:
    """d_k from the torque channel alone, [job, joint]."""
    return difficulty_of_error(features.errors[..., TAU])


def jobs_of(sample: Sample, horizon_s: float) -> Jobs:
    """The jobs of a sample, each repeated to fill the horizon."""
    times = [max(1, int(np.ceil(horizon_s / plan.cycle.duration_s))) for plan in sample.plans]
    return Jobs(sample.plans, tuple(times), sample.peak_c)


def variants(config: TwinConfig) -> dict[str, TwinConfig]:
    """Configurations of the trained networks, by name."""
    return {
        VAE: config,
        "VAE z=8": replace(config, latent=8),
        "VAE whole arm": replace(config, scope="arm", hidden=64, latent=8),
        "AE": replace(config, kind="ae"),
        "collapsed VAE": collapsed_config(config),
        "untrained VAE": untrained_config(config),
    }


def twin_scorers(twins: dict[str, Twin], reference: Jobs) -> list[Scorer]:
    """Every score of the trained networks.

    Args:
        twins: By the names of `variants`.
        reference: Held-out cool jobs, that define the usual level for d_cal.
    """
    vae = twins[VAE]
    calibration = Calibration(vae.features(reference.plans, reference.repetitions))
    scorers: list[Scorer] = [
        TwinScorer(VAE, vae, difficulty),
        TwinScorer("VAE d_cal", vae, calibration.difficulty),
        TwinScorer("VAE torque channel", vae, torque_difficulty),
        TwinScorer("VAE one-sided torque", vae, lambda features: features.load),
        TwinScorer("VAE excess torque²", vae, lambda features: features.excess_sq),
    ]
    for name, twin in twins.items():
        if name != VAE:
            scorers.append(TwinScorer(name, twin, difficulty))
        if twin.config.scope == "arm":
            scorers.append(TwinScorer(f"{name}, one-sided torque", twin, lambda features: features.load))
    return scorers


def baseline_scorers(study: Study, config: TwinConfig, seed: np.random.SeedSequence, logs: int = LOGS) -> list[Scorer]:
    """All baselines without a trained network; thermal ones know a nominal Gen3 or the arm's logs, not its truth."""
    records = study.train.records()
    cool = cool_windows(records, replace(config, max_windows=TwinConfig().max_windows), seed)
    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    return [
        pca(cool, 2),
        pca(cool, 8),
        nearest_neighbours(cool),
        mahalanobis(cool),
        isolation_forest(cool, seed),
        torque_over_known(records),
        torque_over_continuous(motors, thermal, limit_c=study.warning_c, ambient_c=study.ambient_c),
        _physical("rc nominal", RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c), study),
        _physical("rc identified", identified_twin(study, seed, logs), study),
    ]


def identified_twin(study: Study, seed: np.random.SeedSequence, logs: int = LOGS) -> RcTwin:
    """Thermal twin identified from logs of the arm's cool training jobs; none of them overheats."""
    recordings = own_logs(study, study.train.plans[:logs], np.random.default_rng(seed))
    return RcTwin.of(identify(recordings, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K))


def _physical(name: str, rc: RcTwin, study: Study) -> ModelScorer:
    return ModelScorer(name, replace(rc, warning_c=study.warning_c), worst=True)


Make = Callable[..., Study]
"""Makes the study of a seed; sizes as in `make_study`."""


def benchmark(
    seed: np.random.SeedSequence,
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    networks: Sequence[str] | None = None,
    logs: int = LOGS,
) -> Judged:
    """Quality of every scorer under one seed, with its own study and trainings.

    Args:
        folder: Cache of trained twins.
        networks: Names of the `variants` to train, the VAE among them; all by default.
        logs: Training jobs that are logged to identify the arm.

    Raises:
        ValueError: an unknown network, or no VAE.
        FleetError: no test job is critical, or all are.
    """
    configs = chosen_variants(config, networks)
    study = make(seed)
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
    records = study.train.records()
    twins = {
        name: train_or_load(records, variant, seed, arm=study.robot.name, folder=folder)
        for name, variant in configs.items()
    }
    scorers = [*twin_scorers(twins, reference), *baseline_scorers(study, config, seed, logs)]
    return judge(scorers, test=test, reference=reference, novel=novel, limit_c=study.warning_c)


def chosen_variants(config: TwinConfig, networks: Sequence[str] | None) -> dict[str, TwinConfig]:
    """The named `variants`, or all.

    Raises:
        ValueError: an unknown network, or no VAE.
    """
    every = variants(config)
    names = list(every) if networks is None else networks
    if VAE not in names or not set(names) <= set(every):
        raise ValueError(f"A benchmark takes '{VAE}' and any of {', '.join(every)} (got {', '.join(names)}).")
    return {name: variant for name, variant in every.items() if name in names}


def quality(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    networks: Sequence[str] | None = None,
    logs: int = LOGS,
) -> QualityTable:
    """The benchmark under every seed; raises as `benchmark`, and without seeds."""
    per_seed = [
        benchmark(seed, config=config, folder=folder, make=make, networks=networks, logs=logs) for seed in seeds
    ]
    return table(per_seed, thermal=THERMAL)
