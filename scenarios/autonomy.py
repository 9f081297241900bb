"""Autonomy: how much of a twin's sight remains when it learns again from nothing but motion it made up itself."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from fleet.difficulty import Blind
from fleet.motion import Plan
from fleet.sim.models import ArmModel
from fleet.sim.world import Arm
from scenarios.contest import Make, TwinScorer, difficulty, jobs_of
from scenarios.generate import Verification, generate
from scenarios.quality import Judged, QualityTable, judge, table
from scenarios.records import records
from scenarios.rehearse import trained
from scenarios.study import Study, make_study
from twin.model import TwinConfig
from twin.score import Twin

Array = np.ndarray

OWN, GENERATED, PRIOR = "real motion", "generated motion", "prior samples"
"""What a twin was trained on; the scorers' names in the table."""
COUNT = 150
"""Generated jobs that a twin learns from again."""

Propose = Callable[[Study, Twin, int, int], Sequence[Plan]]
"""So many plans (third argument) out of a study's twin, drawn by a seed (fourth)."""


def proposed(study: Study, twin: Twin, count: int, seed: int) -> Sequence[Plan]:
    """Motion near what the twin knows, as the arm would hand it out: executable and predicted to stay cool."""
    home_q = study.robot.home_q()
    arm = Arm(
        robot=study.robot,
        motors=study.motors,
        thermal=study.thermal,
        rest_tau=ArmModel(study.robot).gravity_torque(home_q),
        model=Blind(),
        plans={},
    )
    asked = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    return generate(twin, arm, study.train.plans, count=count, seed=seed, verification=asked).plans


def prior_records(twin: Twin, count: int, rng: np.random.Generator) -> list[Array]:
    """Windows that latents drawn from the prior stand for, profiles [time, 3, joint] at `twin.config.rate_hz`.

    Each network draws for itself, so the joints of one window know nothing of each other.
    """
    latent = rng.standard_normal((count, twin.config.networks(twin.joints), twin.config.latent))
    return list(twin.decode(latent.astype(np.float32)).transpose(0, 1, 3, 2))


def autonomy(
    seeds: Sequence[np.random.SeedSequence],
    *,
    config: TwinConfig,
    folder: Path,
    make: Make = make_study,
    propose: Propose = proposed,
    count: int = COUNT,
    processes: int = 1,
) -> QualityTable:
    """Detection by twins trained on real, on generated and on prior-sampled motion, each seed a study of its own.

    Raises:
        ValueError: no seeds, or count < 1.
        FleetError: nothing that the twin proposes passes, or no test job is critical.
    """
    if count < 1:
        raise ValueError(f"A twin learns from at least one generated job (got {count}).")
    per_seed: list[Judged] = []
    with Parallel(n_jobs=processes, return_as="generator") as pool:
        for done in pool(delayed(_of_seed)(seed, config, folder, make, propose, count) for seed in seeds):
            assert done is not None
            per_seed.append(done)
    return table(per_seed)


def _of_seed(
    seed: np.random.SeedSequence, config: TwinConfig, folder: Path, make: Make, propose: Propose, count: int
) -> Judged:
    study = make(seed)
    own = trained(study.train.records(), config, seed, arm=study.robot.name, folder=folder)
    made_up = records(propose(study, own, count, int(seed.generate_state(1)[0])))
    sampled = prior_records(own, config.max_windows, np.random.default_rng(seed))
    sampled_config = replace(config, record_hz=config.rate_hz)
    twins = {
        OWN: own,
        GENERATED: trained(made_up, config, seed, arm=study.robot.name, folder=folder),
        PRIOR: trained(sampled, sampled_config, seed, arm=study.robot.name, folder=folder),
    }
    test, reference, novel = (jobs_of(part, study.horizon_s) for part in (study.test, study.reference, study.novel))
    scorers = [TwinScorer(name, twin, difficulty) for name, twin in twins.items()]
    return judge(scorers, test=test, reference=reference, novel=novel, limit_c=study.warning_c)


def remaining(quality: QualityTable, question: str, scorer: str = GENERATED) -> dict[str, Array]:
    """Share of the real twin's quality that a scorer keeps, by measure, [seed]; of AUROC, the part above chance."""
    own, again = quality.row(OWN, question), quality.row(scorer, question)
    chance = {"auroc": 0.5, "auprc": 0.0, "spearman": 0.0}
    return {name: (again.values(name) - least) / (own.values(name) - least) for name, least in chance.items()}
