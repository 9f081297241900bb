"""Give a scenario's twins a probability of saturation, fitted on simulated past jobs of their arms.

An arm that has worked for weeks has such jobs in its records. Here they are simulated: the arm's own work and random
work with heavy payloads, for different durations and from different temperatures, critical jobs included.
"""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from fleet.planning.random_motions import RANDOM_MOTIONS_VERSION, random_jobs
from scenarios.prepare.model_cache import CachedModel, load_or_make
from scenarios.prepare.planned_arm import PlannedArm
from scenarios.prepare.simulated_history import experience, past_jobs
from scenarios.progress import Progress
from scenarios.schema import Scenario
from twin.saturation.fit import Experience, NotEnoughExperience, fit_saturation
from twin.saturation.model import CalibratedTwin, load_calibrated, save_saturation
from twin.vae.twin import Twin

RECIPE = 2
"""Raise it whenever the same twin and scenario would give other past jobs or another fit."""
PAST = 4
"""Spawn key, different from those of `scenarios.prepare.train_twins` for the same arm."""
PAST_JOBS = 300
"""Past jobs of each arm: enough that even a well-cooled arm has some in which a motor passed the limit."""
OWN = 0.5
"""Share of the past jobs that are the scenario's own work."""
HEAVY_KG = (2.0, 4.0)
"""Payloads of the other jobs: lighter ones say little about saturation."""


def calibrate_twins(
    scenario: Scenario,
    arms: Sequence[PlannedArm],
    twins: Sequence[Twin],
    folder: Path,
    progress: Progress,
    *,
    jobs: int = PAST_JOBS,
) -> list[CalibratedTwin | Twin]:
    """Every arm's twin with its probability of saturation, from the folder where possible.

    A twin whose past jobs say too little about saturation is returned without that probability; a warning says why.
    """
    models = [_model(scenario, arm, twin, folder, jobs) for arm, twin in zip(arms, twins, strict=True)]
    return load_or_make(models, "calibrating", progress)


def _model(
    scenario: Scenario, arm: PlannedArm, twin: Twin, folder: Path, jobs: int
) -> CachedModel[CalibratedTwin | Twin]:
    def load(home: Path) -> CalibratedTwin | Twin:
        return load_calibrated(twin, home) if home.is_dir() else twin

    def make(home: Path, _report: Callable[[float], None]) -> str | None:
        try:
            save_saturation(fit_saturation(simulate_experience(scenario, arm, twin, jobs=jobs)), home)
        except NotEnoughExperience as error:
            return f"{scenario.name}: arm '{arm.hardware.robot.name}' gets no probability of saturation. {error}"
        return None

    return CachedModel(folder / "saturation" / _key(scenario, arm, twin, jobs), load, make)


def simulate_experience(scenario: Scenario, arm: PlannedArm, twin: Twin, *, jobs: int = PAST_JOBS) -> Experience:
    """Simulated past jobs of an arm with its twin's features; the same for every seed of a run.

    A share `OWN` of the jobs is drawn from the arm's plans.
    """
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, arm.index], spawn_key=(PAST,)))
    plans = arm.all_plans
    count = round(OWN * jobs) if plans else 0
    own = [plans[i] for i in rng.integers(max(len(plans), 1), size=count)]
    mixed = (*own, *random_jobs(arm.hardware.robot, jobs - count, rng, payload_kg=HEAVY_KG))
    return experience(twin, past_jobs(arm.hardware, mixed, rng, warning_c=scenario.limits.warning_c))


def _key(scenario: Scenario, arm: PlannedArm, twin: Twin, jobs: int) -> str:
    """Cache key of a model: its twin, the arm's hardware and plans, and the recipe of the past jobs."""
    robot = arm.hardware.robot
    parts = [RECIPE, RANDOM_MOTIONS_VERSION, jobs, twin.version, scenario.spread.seed, scenario.limits.warning_c, robot]
    digest = hashlib.sha256(msgspec.json.encode(parts))
    digest.update(arm.hardware.content())
    for phase in (phase for plan in arm.all_plans for phase in plan.phases):
        digest.update(f"{phase.profile.shape}".encode())
        digest.update(np.ascontiguousarray(phase.profile).tobytes())
    return digest.hexdigest()[:32]
