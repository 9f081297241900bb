"""The twin, its variants and its rivals on one study: each learns from the same cool jobs, all are asked the same."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from fleet.difficulty import difficulty_of_error
from fleet.motion import CHANNELS, Plan
from fleet.motor import gen3_motors
from fleet.robot import JOINTS
from fleet.sim.oracle import Oracle
from fleet.thermal import gen3_network, node_heat, thermal_model
from scenarios.quality import Jobs, Judged, QualityTable, judge, table
from scenarios.rehearse import trained
from scenarios.study import Sample, Study, make_study
from twin.measures import Calibration, Features
from twin.model import TwinConfig
from twin.nominal import torque_over_continuous, torque_over_known
from twin.novelty import isolation_forest, mahalanobis, nearest_neighbours
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
    "rc, nominal",
    "rc, identified",
)
"""What is not the twin; `rc, identified` takes part where somebody brings it."""


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


def rivals(study: Study, config: TwinConfig, seed: np.random.SeedSequence) -> list[Scorer]:
    """Everything that needs no network; torque over continuous and rc know a nominal Gen3, not the true arm."""
    records = study.train.records()
    cool = known(records, replace(config, max_windows=TwinConfig().max_windows), seed)
    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    rc = Oracle(
        motors=motors,
        thermal=thermal,
        start_c=thermal.steady(node_heat(np.zeros(JOINTS), motors.idle_w), study.ambient_c),
        ambient_c=study.ambient_c,
        warning_c=study.warning_c,
        version="rc, nominal",
    )
    return [
        pca(cool, 2),
        pca(cool, 8),
        nearest_neighbours(cool),
        mahalanobis(cool),
        isolation_forest(cool, seed),
        torque_over_known(records),
        torque_over_continuous(motors, thermal, limit_c=study.warning_c, ambient_c=study.ambient_c),
        Modelled(rc.version, rc, worst=True),
    ]


Bring = Callable[[Study], Sequence[Scorer]]
"""Further scorers of a study, as `rc, identified` for one whose logs were read."""
Make = Callable[[np.random.SeedSequence], Study]


def contest(
    seed: np.random.SeedSequence,
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    bring: Bring | None = None,
    networks: Sequence[str] | None = None,
) -> Judged:
    """Everybody's quality under one seed: a study and trainings of its own; trained twins are kept in the folder.

    Args:
        networks: Which of the `variants` take part, the VAE among them; all by default.

    Raises:
        ValueError: an unknown network, or no VAE.
        FleetError: no test job is critical, or all are.
    """
    chosen = _chosen(config, networks)
    study = make(seed)
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
    records = study.train.records()
    twins = {
        name: trained(records, variant, seed, arm=study.robot.name, folder=folder) for name, variant in chosen.items()
    }
    scorers = [*readings(twins, reference), *rivals(study, config, seed), *(bring(study) if bring else ())]
    return judge(scorers, test=test, reference=reference, novel=novel, limit_c=study.warning_c)


def _chosen(config: TwinConfig, networks: Sequence[str] | None) -> dict[str, TwinConfig]:
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
    bring: Bring | None = None,
    networks: Sequence[str] | None = None,
    processes: int = 1,
) -> QualityTable:
    """The contest under every seed, side by side in so many processes; raises as `contest`, and without seeds."""
    alike = {"config": config, "folder": folder, "make": make, "bring": bring, "networks": networks}
    under = (delayed(contest)(seed, **alike) for seed in seeds)
    per_seed: list[Judged] = []
    with Parallel(n_jobs=processes, return_as="generator") as pool:
        for done in pool(under):
            assert done is not None
            per_seed.append(done)
    return table(per_seed)
