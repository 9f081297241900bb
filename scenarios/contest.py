"""The twin, its variants and its rivals on one study: each learns from the same cool jobs, all are asked the same."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from fleet.difficulty import difficulty_of_error
from fleet.motion import CHANNELS, Plan
from fleet.motor import gen3_motors
from fleet.thermal import gen3_network, thermal_model
from scenarios.own_logs import AIR_SD_K, own_logs
from scenarios.quality import Jobs, Judged, QualityTable, judge, table
from scenarios.rehearse import trained
from scenarios.study import Sample, Study, make_study
from twin.identify import identify
from twin.measures import Calibration, Features
from twin.model import TwinConfig
from twin.nominal import torque_over_continuous, torque_over_known
from twin.novelty import isolation_forest, mahalanobis, nearest_neighbours
from twin.rc import RcTwin
from twin.reading import check_jobs
from twin.rivals import Modelled, Scorer, Scores, collapsed, known, pca, untrained
from twin.score import Twin

Array = np.ndarray

VAE = "VAE"
TAU = CHANNELS.index("tau")
RIVALS = (
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
"""What is not the twin."""
TOLD_OF_HEAT = ("RMS torque / continuous", "rc nominal", "rc identified")
"""Who was given motor data and the thermal law; all others saw nothing but cool motion."""
LOGS = 6
"""Training jobs that the arm does for half an hour each, logged with its temperatures, for identification."""


@dataclass(frozen=True, eq=False)
class TwinScorer:
    """One way to read a trained twin; the total is the sum over joints."""

    name: str
    twin: Twin
    read: Callable[[Features], Array]
    """Features of jobs to a score, [job, joint]."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `twin.rivals.Scorer` says."""
        check_jobs(plans, repetitions)
        per_joint = self.read(self.twin.features(plans, repetitions))
        return Scores(per_joint, per_joint.sum(axis=1))


def difficulty(features: Features) -> Array:
    """d_k of the paper, [job, joint]."""
    return features.difficulty


def torque_difficulty(features: Features) -> Array:
    """d_k from the torque channel alone, [job, joint]."""
    return difficulty_of_error(features.errors[..., TAU])


def jobs_of(sample: Sample, horizon_s: float) -> Jobs:
    """A study's jobs, each done as often as fills the horizon."""
    times = [max(1, int(np.ceil(horizon_s / plan.cycle.duration_s))) for plan in sample.plans]
    return Jobs(sample.plans, tuple(times), sample.peak_c)


def variants(config: TwinConfig) -> dict[str, TwinConfig]:
    """Configurations of the networks that take part, by name."""
    return {
        VAE: config,
        "VAE z=8": replace(config, latent=8),
        "VAE whole arm": replace(config, scope="arm", hidden=64, latent=8),
        "AE": replace(config, kind="ae"),
        "collapsed VAE": collapsed(config),
        "untrained VAE": untrained(config),
    }


def readings(twins: dict[str, Twin], reference: Jobs) -> list[Scorer]:
    """Every way in which the trained networks are read.

    Args:
        twins: By the names of `variants`.
        reference: Held-out cool jobs, from which d_cal takes what is usual.
    """
    vae = twins[VAE]
    usual = Calibration(vae.features(reference.plans, reference.repetitions))
    ways: list[Scorer] = [
        TwinScorer(VAE, vae, difficulty),
        TwinScorer("VAE d_cal", vae, usual.difficulty),
        TwinScorer("VAE torque channel", vae, torque_difficulty),
        TwinScorer("VAE one-sided torque", vae, lambda features: features.load),
        TwinScorer("VAE excess torque²", vae, lambda features: features.excess_sq),
    ]
    for name, twin in twins.items():
        if name != VAE:
            ways.append(TwinScorer(name, twin, difficulty))
        if twin.config.scope == "arm":
            ways.append(TwinScorer(f"{name}, one-sided torque", twin, lambda features: features.load))
    return ways


def rivals(study: Study, config: TwinConfig, seed: np.random.SeedSequence, logs: int = LOGS) -> list[Scorer]:
    """Everything that needs no network; what is told of heat knows a nominal Gen3 or the arm's logs, not its truth."""
    records = study.train.records()
    cool = known(records, replace(config, max_windows=TwinConfig().max_windows), seed)
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
        _physical("rc identified", identified(study, seed, logs), study),
    ]


def identified(study: Study, seed: np.random.SeedSequence, logs: int = LOGS) -> RcTwin:
    """The arm as logs of its cool training jobs tell it; it has seen no job that overheats, as the others have not."""
    told = own_logs(study, study.train.plans[:logs], np.random.default_rng(seed))
    return RcTwin.of(identify(told, arm=study.robot.name, ambient_c=study.ambient_c, ambient_sd_k=AIR_SD_K))


def _physical(name: str, rc: RcTwin, study: Study) -> Modelled:
    return Modelled(name, replace(rc, warning_c=study.warning_c), worst=True)


Make = Callable[[np.random.SeedSequence], Study]


def contest(
    seed: np.random.SeedSequence,
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    networks: Sequence[str] | None = None,
    logs: int = LOGS,
) -> Judged:
    """Everybody's quality under one seed: a study and trainings of its own; trained twins are kept in the folder.

    Args:
        networks: Which of the `variants` take part, the VAE among them; all by default.
        logs: Training jobs that are logged to identify the arm.

    Raises:
        ValueError: an unknown network, or no VAE.
        FleetError: no test job is critical, or all are.
    """
    configs = chosen(config, networks)
    study = make(seed)
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
    records = study.train.records()
    twins = {
        name: trained(records, variant, seed, arm=study.robot.name, folder=folder) for name, variant in configs.items()
    }
    scorers = [*readings(twins, reference), *rivals(study, config, seed, logs)]
    return judge(scorers, test=test, reference=reference, novel=novel, limit_c=study.warning_c)


def chosen(config: TwinConfig, networks: Sequence[str] | None) -> dict[str, TwinConfig]:
    """Those of the `variants` that are named, or all.

    Raises:
        ValueError: an unknown network, or no VAE.
    """
    every = variants(config)
    names = list(every) if networks is None else networks
    if VAE not in names or not set(names) <= set(every):
        raise ValueError(f"A contest is of the '{VAE}' and any of {', '.join(every)} (got {', '.join(names)}).")
    return {name: variant for name, variant in every.items() if name in names}


def quality(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    networks: Sequence[str] | None = None,
    logs: int = LOGS,
    processes: int = 1,
) -> QualityTable:
    """The contest under every seed, side by side in so many processes; raises as `contest`, and without seeds."""
    alike = {"config": config, "folder": folder, "make": make, "networks": networks, "logs": logs}
    under = (delayed(contest)(seed, **alike) for seed in seeds)
    per_seed: list[Judged] = []
    with Parallel(n_jobs=processes, return_as="generator") as pool:
        for done in pool(under):
            assert done is not None
            per_seed.append(done)
    return table(per_seed, told_of_heat=TOLD_OF_HEAT)
