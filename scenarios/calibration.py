"""The past jobs that calibrate a scenario's twins: rehearsed in simulation, labelled by what they did to the motors.

An arm that has worked for weeks has such jobs in its records. One that has not rehearses: its own work and random work
with heavy payloads, for times and from temperatures of all kinds, critical ones among them.
"""

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from joblib import Parallel, cpu_count, delayed

from fleet.errors import CheckpointError
from fleet.job import Work
from fleet.motion import Plan
from fleet.sim.exercise import EXERCISE_VERSION, random_jobs
from scenarios.cool import Body
from scenarios.past_jobs import past_jobs
from scenarios.saturation_study import seen
from scenarios.scenario import Scenario
from scenarios.study import Sample, Study
from twin.calibrate import Experience, NotEnoughExperience, fit_saturation
from twin.saturation import CalibratedTwin
from twin.saturation_file import load_calibrated, save_saturation
from twin.score import Twin

log = logging.getLogger(__name__)

RECIPE = 2
"""Raised whenever the same twin and scenario would rehearse other jobs or fit another model."""
PAST = 4
"""Keeps this draw apart from those of `scenarios.rehearse` for the same arm."""
REHEARSED = 300
"""Past jobs of each arm: also one that hardly anything heats then has some in which a motor passed the limit."""
OWN = 0.5
"""Share of the rehearsed jobs that are the scenario's own work."""
HEAVY_KG = (2.0, 4.0)
"""Payloads of the other jobs: lighter ones say little of what leads to saturation."""


def calibrated_twins(
    scenario: Scenario,
    bodies: Sequence[Body],
    plans: Sequence[Mapping[Work, tuple[Plan, ...]]],
    twins: Sequence[Twin],
    folder: Path,
    progress: Callable[[str, float], None],
    *,
    jobs: int = REHEARSED,
    arms: Sequence[int] | None = None,
) -> list[CalibratedTwin | Twin]:
    """Every arm's twin with the probability of saturation that its rehearsal taught; from the folder where possible.

    An arm whose rehearsal says too little of what leads to saturation keeps its twin as it is, which has no such
    probability; a warning says why.

    Args:
        arms: Whose these bodies, plans and twins are, by place in the scenario; by default all of it, in order.
    """
    places = range(len(bodies)) if arms is None else arms
    homes = [
        folder / "saturation" / _key(scenario, body, own, twin, jobs)
        for body, own, twin in zip(bodies, plans, twins, strict=True)
    ]
    kept = [_stored(twin, home) for twin, home in zip(twins, homes, strict=True)]
    missing = [i for i, model in enumerate(kept) if model is None]
    progress("calibrating", 1.0 - len(missing) / len(bodies))
    if missing:
        tasks = (delayed(_fit)(scenario, places[i], bodies[i], plans[i], twins[i], homes[i], jobs) for i in missing)
        with Parallel(n_jobs=min(len(missing), cpu_count()), return_as="generator_unordered") as pool:
            for done, why_not in enumerate(pool(tasks), start=1):
                progress("calibrating", 1.0 - (len(missing) - done) / len(bodies))
                if why_not:
                    log.warning("%s", why_not)
        for i in missing:
            kept[i] = _stored(twins[i], homes[i])
    return [model or twin for model, twin in zip(kept, twins, strict=True)]


def rehearse_saturation(
    scenario: Scenario,
    index: int,
    body: Body,
    plans: Mapping[Work, tuple[Plan, ...]],
    twin: Twin,
    *,
    jobs: int = REHEARSED,
) -> Experience:
    """Past jobs of the arm of this index as its twin saw them; the same for every seed of a run.

    Args:
        plans: How it would do the scenario's work; `OWN` of the jobs are drawn from all variants.
    """
    robot, motors, thermal = body
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, index], spawn_key=(PAST,)))
    every = [plan for variants in plans.values() for plan in variants]
    count = round(OWN * jobs) if every else 0
    own = [every[i] for i in rng.integers(max(len(every), 1), size=count)]
    mixed = (*own, *random_jobs(robot, jobs - count, rng, payload_kg=HEAVY_KG))
    none = Sample((), np.empty((0, motors.idle_w.size)))
    spec = scenario.twin
    arm = Study(
        robot=robot,
        motors=motors,
        thermal=thermal,
        ambient_c=spec.ambient_c,
        horizon_s=spec.horizon_s,
        cool_c=spec.cool_c,
        warning_c=scenario.limits.warning_c,
        train=none,
        reference=none,
        test=none,
        novel=none,
    )
    return seen(twin, past_jobs(arm, mixed, rng))


def _fit(
    scenario: Scenario,
    index: int,
    body: Body,
    plans: Mapping[Work, tuple[Plan, ...]],
    twin: Twin,
    home: Path,
    jobs: int,
) -> str | None:
    """Fit and keep the model of one arm; why that cannot be, if it cannot."""
    try:
        model = fit_saturation(rehearse_saturation(scenario, index, body, plans, twin, jobs=jobs))
    except NotEnoughExperience as error:
        return f"{scenario.name}: arm '{body[0].name}' cannot say how probable saturation is. {error}"
    save_saturation(model, home)
    return None


def _stored(twin: Twin, home: Path) -> CalibratedTwin | None:
    if not home.is_dir():
        return None
    try:
        return load_calibrated(twin, home)
    except CheckpointError as error:
        log.warning("The stored saturation model cannot be used (%s); fitting anew.", error)
        return None


def _key(scenario: Scenario, body: Body, plans: Mapping[Work, tuple[Plan, ...]], twin: Twin, jobs: int) -> str:
    """Equal keys mean equal models: by the twin, the arm's body, its plans, and what is rehearsed."""
    robot, motors, thermal = body
    parts = [RECIPE, EXERCISE_VERSION, jobs, twin.version, scenario.spread.seed, scenario.limits.warning_c, robot]
    digest = hashlib.sha256(msgspec.json.encode(parts))
    for value in (*vars(motors).values(), *vars(thermal).values()):
        digest.update(np.asarray(value, dtype=float).tobytes())
    for variants in plans.values():
        for phase in (phase for plan in variants for phase in plan.phases):
            digest.update(f"{phase.profile.shape}".encode())
            digest.update(np.ascontiguousarray(phase.profile).tobytes())
    return digest.hexdigest()[:32]
