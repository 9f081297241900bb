"""Benchmark of the twin, its variants and baselines on identical data: the same cool training and test jobs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from fleet.difficulty import difficulty_of_error
from fleet.motion import CHANNELS, Plan
from fleet.motor import gen3_motors
from fleet.thermal import gen3_network, thermal_model
from scenarios.prepare.simulated_logs import LOGS, identify_from_work
from scenarios.studies.ranking import Jobs, Judged, Quality, judge, side_by_side
from scenarios.studies.setup import Bench, Sample, Study
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
from twin.thermal.thermal_twin import RcTwin
from twin.vae.config import TwinConfig
from twin.vae.measures import Calibration, Features
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
"""Scorers that use motor data and the thermal law; all others use cool motion alone."""


@dataclass(frozen=True, eq=False)
class TwinScorer:
    """One score of a trained twin; the total is the sum over joints, without weights unless `weighted`."""

    name: str
    twin: Twin
    of_features: Callable[[Features], Array] = attrgetter("difficulty")
    """Score [job, joint] from features of jobs; by default d_k of the paper."""
    weighted: bool = False
    """Whether the weights of d count in the total."""

    def scores(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> Scores:
        """Score of each job; raises as `twin.baselines.reconstruction.Scorer` says."""
        check_jobs(plans, repetitions)
        per_joint = self.of_features(self.twin.features(plans, repetitions))
        total = per_joint @ self.twin.joint_weight if self.weighted else per_joint.sum(axis=1)
        return Scores(per_joint, total)


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
    known = vae.features(reference.plans, reference.repetitions)
    calibration = Calibration(known, np.zeros(len(known.packed), int))
    scorers: list[Scorer] = [
        TwinScorer(VAE, vae),
        TwinScorer("VAE weighted", vae, weighted=True),
        TwinScorer("VAE d_cal", vae, calibration.difficulty),
        TwinScorer("VAE torque channel", vae, lambda features: difficulty_of_error(features.errors[..., TAU])),
        TwinScorer("VAE one-sided torque", vae, attrgetter("load")),
        TwinScorer("VAE excess torque²", vae, attrgetter("excess_sq")),
        TwinScorer("VAE load", vae, attrgetter("one_sided"), weighted=True),
        TwinScorer("VAE latent", vae, calibration.latent, weighted=True),
    ]
    for name, twin in twins.items():
        if name != VAE:
            scorers.append(TwinScorer(name, twin))
        if twin.config.scope == "arm":
            scorers.append(TwinScorer(f"{name}, one-sided torque", twin, attrgetter("load")))
    return scorers


def baseline_scorers(study: Study, config: TwinConfig, seed: np.random.SeedSequence) -> list[Scorer]:
    """All baselines without a trained network; thermal ones use a nominal Gen3 or the arm's logs, not its truth."""
    records = study.train.records()
    cool = cool_windows(records, replace(config, max_windows=TwinConfig().max_windows), seed)
    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    networks = {
        "rc nominal": RcTwin.nominal(study.robot.name, ambient_c=study.ambient_c),
        "rc identified": RcTwin.of(
            identify_from_work(
                study.hardware, study.train.plans[:LOGS], np.random.default_rng(seed), ambient_c=study.ambient_c
            )
        ),
    }
    return [
        pca(cool, 2),
        pca(cool, 8),
        nearest_neighbours(cool),
        mahalanobis(cool),
        isolation_forest(cool, seed),
        torque_over_known(records),
        torque_over_continuous(motors, thermal, limit_c=study.warning_c, ambient_c=study.ambient_c),
        *(ModelScorer(name, replace(rc, warning_c=study.warning_c), worst=True) for name, rc in networks.items()),
    ]


def quality(bench: Bench, networks: Sequence[str] | None = None) -> Quality:
    """Quality of every scorer under every seed.

    Args:
        networks: Names of the `variants` to train, the VAE among them; all by default.

    Raises:
        ValueError: an unknown network, no VAE, or no seeds.
        FleetError: no test job is critical, or all are.
    """
    configs, per_seed = chosen_variants(bench.config, networks), []
    for seed, study, vae in bench.studies():
        records = study.train.records()
        others = {name: bench.train(records, study, seed, each) for name, each in configs.items() if name != VAE}
        own = twin_scorers({VAE: vae, **others}, jobs_of(study.reference, study.horizon_s))
        per_seed.append(judge_on(study, [*own, *baseline_scorers(study, bench.config, seed)]))
    return side_by_side(per_seed)


def judge_on(study: Study, scorers: Sequence[Scorer]) -> Judged:
    """Quality of the scorers on the study's test jobs; raises as `judge`."""
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
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
