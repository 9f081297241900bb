"""Autonomy: quality that remains when a twin is trained again on nothing but motion that it generated."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fleet.motion import Plan
from scenarios.motion.generate import Verification, generate
from scenarios.motion.perform import bare_arm
from scenarios.prepare.cool_motion import records
from scenarios.studies.benchmark import TwinScorer, judge_on
from scenarios.studies.ranking import Quality, side_by_side
from scenarios.studies.setup import Bench, Study
from twin.vae.twin import Twin

Array = np.ndarray

OWN, GENERATED, PRIOR = "real motion", "generated motion", "prior samples"
"""Training data of a twin; the scorers' names in the table."""
COUNT = 150
"""Generated jobs that the second twin is trained on."""

Propose = Callable[[Study, Twin, int, int], Sequence[Plan]]
"""Plans from a study and its twin; their number, and a seed."""


def generated_plans(study: Study, twin: Twin, count: int, seed: int) -> Sequence[Plan]:
    """Verified motion near the twin's training data: executable and predicted to stay cool."""
    arm = bare_arm(study.robot, study.motors, study.thermal)
    verification = Verification.nominal(study.robot, study.ambient_c, cool_c=study.cool_c, horizon_s=study.horizon_s)
    return generate(twin, arm, study.train.plans, count=count, seed=seed, verification=verification).plans


def prior_records(twin: Twin, count: int, rng: np.random.Generator) -> list[Array]:
    """Windows decoded from latents of the prior, profiles [time, 3, joint] at `twin.config.rate_hz`.

    The joints of one window are drawn independently.
    """
    latent = rng.standard_normal((count, twin.config.networks(twin.joints), twin.config.latent))
    return list(twin.decode(latent.astype(np.float32)).transpose(0, 1, 3, 2))


def autonomy(bench: Bench, *, propose: Propose = generated_plans, count: int = COUNT) -> Quality:
    """Detection by twins trained on real, on generated and on prior-sampled motion.

    Raises:
        ValueError: no seeds, or count < 1.
        FleetError: no generated motion passes verification, or no test job is critical.
    """
    if count < 1:
        raise ValueError(f"A twin learns from at least one generated job (got {count}).")
    config, per_seed = bench.config, []
    for seed, study, own in bench.studies():
        generated = records(propose(study, own, count, int(seed.generate_state(1)[0])))
        sampled = prior_records(own, config.max_windows, np.random.default_rng(seed))
        twins = {
            OWN: own,
            GENERATED: bench.train(generated, study, seed),
            PRIOR: bench.train(sampled, study, seed, replace(config, record_hz=config.rate_hz)),
        }
        per_seed.append(judge_on(study, [TwinScorer(name, twin) for name, twin in twins.items()]))
    return side_by_side(per_seed)


def remaining(scorers: dict[str, dict[str, Array]]) -> dict[str, Array]:
    """Share of the quality of training on real motion that generated motion keeps, [seed]; AUROC above chance.

    Args:
        scorers: [scorer][measure] → [seed], of one question.
    """
    chance = {"auroc": 0.5, "auprc": 0.0, "spearman": 0.0}
    return {m: (scorers[GENERATED][m] - least) / (scorers[OWN][m] - least) for m, least in chance.items()}
