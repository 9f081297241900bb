"""Motion sampled from the hot side of a twin's latent space is hot in the simulator: its share, against the cool side.

The side of a job is told by its latents alone: a linear discriminant of their means over the job, fitted on one half of
the test jobs. New motion is decoded from perturbed latents of the other half, its torque comes from MuJoCo's inverse
dynamics, and the true motors of the arm are heated with it. With one payload for all, the sides differ by motion only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sklearn.covariance import LedoitWolf

from fleet.errors import FleetError
from fleet.motion import Plan
from fleet.physics.models import ArmModel
from scenarios.motion.generate import Rejected, planned
from scenarios.prepare.cool_motion import cold_peaks
from scenarios.progress import Count, Progress, quiet
from scenarios.studies.benchmark import jobs_of
from scenarios.studies.setup import Study
from twin.saturation.reliability import wilson
from twin.vae.generate import Variation, vary
from twin.vae.twin import Twin

Array = np.ndarray

COMMON_KG = 2.0
"""Payload of all motions where only motion shall differ; jobs without payload get it too."""
MOST_DRAWS = 5
"""Most attempts per requested motion."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of the motions of one side get hot, with 95 % intervals (Wilson)."""

    motions: int
    rejected: int
    """Beyond joint or torque limits."""
    warm: tuple[float, float, float]
    """Share in which a motor passes the cool limit when the motion repeats over the horizon."""
    critical: tuple[float, float, float]
    """Share in which one reaches the warning limit."""
    peak_c: float
    """Median temperature of the hottest motor."""


@dataclass(frozen=True, kw_only=True)
class Sides:
    """Both sides of the latent space."""

    sources: dict[str, int]
    """Test jobs on each side."""
    source_critical: dict[str, float]
    """Share of them that are critical."""
    own: dict[str, Share]
    """With the payload of the source, by side."""
    common: dict[str, Share]
    """With `COMMON_KG` for all, by side."""


def sides(
    study: Study, twin: Twin, *, count: int = 40, s: float = 1.0, seed: int = 0, progress: Progress = quiet
) -> Sides:
    """Generate `count` motions from each side of the latent space and heat the arm with them.

    Args:
        s: Perturbation in posterior standard deviations.

    Raises:
        FleetError: a side has no jobs, or none of its motions is possible.
    """
    score, critical, rest = hot_side(study, twin)
    chosen = {"hot": rest[score[rest] > 0], "cool": rest[score[rest] <= 0]}
    if not all(map(len, chosen.values())):
        raise FleetError("All test jobs lie on one side of the latent space; take another arm or more test jobs.")
    model = ArmModel(study.robot)
    result: dict[str, dict[str, Share]] = {"own": {}, "common": {}}
    for number, (side, index) in enumerate(chosen.items()):
        rng = np.random.default_rng([seed, number])
        motions: dict[str, list[Plan]] = {name: [] for name in result}
        rejected = dict.fromkeys(result, 0)
        for _ in range(MOST_DRAWS * count):
            if len(motions["own"]) == count:
                break
            progress("generating", Count(number * count + len(motions["own"]), 2 * count))
            source = study.test.plans[int(rng.choice(index))]
            made = vary(twin, source, s, rng)
            for name, plans in motions.items():
                try:
                    plans.append(_realised(model, made, source, COMMON_KG if name == "common" else None))
                except Rejected:
                    rejected[name] += 1
        if not all(motions.values()):
            raise FleetError(f"No motion from the {side} side stays within the arm's limits; take a smaller --s.")
        for name, plans in motions.items():
            result[name][side] = _share(study, plans, rejected[name])
    return Sides(
        sources={side: len(index) for side, index in chosen.items()},
        source_critical={side: float(critical[index].mean()) for side, index in chosen.items()},
        **result,
    )


def hot_side(study: Study, twin: Twin) -> tuple[Array, Array, Array]:
    """A linear discriminant of critical jobs by their mean latents, fitted on every second test job.

    Returns:
        Discriminant of each test job, positive on the hot side, whether it is critical, each [job], and the indices of
        the jobs that it was not fitted on.
    """
    jobs = jobs_of(study.test, study.horizon_s)
    latent = twin.features(jobs.plans, jobs.repetitions).latent_moments[0].reshape(len(jobs.plans), -1)
    critical = study.critical
    fitted, rest = np.arange(0, len(latent), 2), np.arange(1, len(latent), 2)
    kinds = [latent[fitted][critical[fitted] == kind] for kind in (False, True)]
    if min(map(len, kinds)) < 2:
        raise FleetError(f"{critical.sum()} of {len(critical)} test jobs are critical: too few for a hot side.")
    cool, hot = (kind.mean(axis=0) for kind in kinds)
    within = LedoitWolf().fit(np.concatenate([kind - kind.mean(axis=0) for kind in kinds]))
    return (latent - (cool + hot) / 2) @ np.linalg.solve(within.covariance_, hot - cool), critical, rest


def _realised(model: ArmModel, made: Variation, source: Plan, payload_kg: float | None) -> Plan:
    """The plan of a variation, with another payload if one is given; raises Rejected."""
    if payload_kg is not None:
        phases = tuple(replace(part, payload_kg=np.full(len(part.payload_kg), payload_kg)) for part in made.phases)
        made = replace(made, phases=phases)
    return planned(made, source, model)


def _share(study: Study, plans: Sequence[Plan], rejected: int) -> Share:
    peak_c = cold_peaks(plans, study.motors, study.thermal, ambient_c=study.ambient_c, horizon_s=study.horizon_s).max(
        axis=1
    )
    return Share(
        motions=len(plans),
        rejected=rejected,
        warm=share_of(peak_c > study.cool_c),
        critical=share_of(peak_c >= study.warning_c),
        peak_c=float(np.median(peak_c)),
    )


def share_of(event: Array) -> tuple[float, float, float]:
    """Share of true values with its 95 % Wilson interval."""
    low, high = wilson(event.mean(keepdims=True), np.array([len(event)]))
    return float(event.mean()), float(low[0]), float(high[0])
