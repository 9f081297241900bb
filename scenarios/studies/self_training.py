"""Autonomy: quality that remains when a twin is trained again on nothing but motion that it generated."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fleet.motion import Plan
from scenarios.motion.generate import Verification, generate
from scenarios.motion.perform import bare_arm
from scenarios.prepare.cool_motion import records
from scenarios.prepare.train_twins import train_or_load
from scenarios.studies.benchmark import Make, TwinScorer, difficulty, jobs_of
from scenarios.studies.ranking import Judged, QualityTable, judge, table
from scenarios.studies.setup import Study, make_study
from twin.vae.model import TwinConfig
from twin.vae.twin import Twin

Array = np.ndarray

OWN, GENERATED, PRIOR = "real motion", "generated motion", "prior samples"
"""Training data of a twin; the scorers' names in the table."""
COUNT = 150
"""Generated jobs that the second twin is trained on."""

Propose = Callable[[Study, Twin, int, int], Sequence[Plan]]
"""Plans from a study and its twin; their number, and a seed."""


def generated_plans(study: Study, twin: Twin, count: int, seed: int) -> Sequence[Plan]:
    """Verified motion near what the twin knows: executable and predicted to stay cool."""
    arm = bare_arm(study.robot, study.motors, study.thermal)
    verification = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    return generate(twin, arm, study.train.plans, count=count, seed=seed, verification=verification).plans


def prior_records(twin: Twin, count: int, rng: np.random.Generator) -> list[Array]:
    """Windows decoded from latents of the prior, profiles [time, 3, joint] at `twin.config.rate_hz`.

    The joints of one window are drawn independently.
    """
    latent = rng.standard_normal((count, twin.config.networks(twin.joints), twin.config.latent))
    return list(twin.decode(latent.astype(np.float32)).transpose(0, 1, 3, 2))


def autonomy(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    propose: Propose = generated_plans,
    count: int = COUNT,
) -> QualityTable:
    """Detection by twins trained on real, on generated and on prior-sampled motion, with a study per seed.

    Raises:
        ValueError: no seeds, or count < 1.
        FleetError: no generated motion passes verification, or no test job is critical.
    """
    if count < 1:
        raise ValueError(f"A twin learns from at least one generated job (got {count}).")
    return table([_judge(seed, config, folder, make, propose, count) for seed in seeds])


def _judge(
    seed: np.random.SeedSequence, config: TwinConfig, folder: Path, make: Make, propose: Propose, count: int
) -> Judged:
    study = make(seed)
    sources = {"arm": study.robot.name, "folder": folder}
    own = train_or_load(study.train.records(), config, seed, **sources)
    generated = records(propose(study, own, count, int(seed.generate_state(1)[0])))
    sampled = prior_records(own, config.max_windows, np.random.default_rng(seed))
    twins = {
        OWN: own,
        GENERATED: train_or_load(generated, config, seed, **sources),
        PRIOR: train_or_load(sampled, replace(config, record_hz=config.rate_hz), seed, **sources),
    }
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
    scorers = [TwinScorer(name, twin, difficulty) for name, twin in twins.items()]
    return judge(scorers, test=test, reference=reference, novel=novel, limit_c=study.warning_c)


def remaining(quality: QualityTable, question: str, scorer: str = GENERATED) -> dict[str, Array]:
    """Share of the quality of training on real motion that a scorer keeps, by measure, [seed]; AUROC above chance."""
    own, again = quality.row(OWN, question), quality.row(scorer, question)
    chance = {"auroc": 0.5, "auprc": 0.0, "spearman": 0.0}
    return {name: (again.values(name) - least) / (own.values(name) - least) for name, least in chance.items()}
