"""Give a scenario's twins a predicted peak and a probability of saturation, from simulated past jobs of their arms.

An arm that has worked for weeks has such jobs in its records. Here they are simulated: the arm's own work and random
work with heavy payloads, in every ambient temperature of its hall, from cold, idle and hot starts.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from fleet.job import Work
from fleet.motion import Plan
from fleet.offered_plans import offered_plans
from fleet.planning.random_motions import RANDOM_MOTIONS_VERSION, random_jobs
from scenarios.job_stream import works_of
from scenarios.prepare.identify_arms import identify_arms
from scenarios.prepare.model_cache import CachedModel, load_or_make
from scenarios.prepare.planned_arm import PlannedArm, air_offsets
from scenarios.prepare.simulated_history import PastJobs, experience, past_jobs, repetitions_for
from scenarios.progress import Progress
from scenarios.schema import Scenario
from scenarios.specs import RiskName
from twin.saturation.fit import NotEnoughExperience, fit_saturation
from twin.saturation.model import Evidence, SaturationModel, load_saturation, save_saturation
from twin.thermal.calibrated import CalibratedTwin
from twin.thermal.checkpoint import load_curve, save_curve
from twin.thermal.parameters import HeatModel
from twin.thermal.risk import PeakCurve
from twin.thermal.thermal_twin import RcTwin
from twin.vae.twin import Twin

Array = np.ndarray

RECIPE = 3
"""Raise it whenever the same twin and scenario would give other past jobs or another fit."""
PAST = 4
"""Spawn key, different from those of `scenarios.prepare.train_twins` for the same arm."""
PAST_JOBS = 400
"""Past jobs of each arm: enough that even a well-cooled arm has some in which a motor passed the limit."""
OWN = 0.6
"""Share of the past jobs that are the scenario's own work."""
HEAVY_KG = (2.0, 4.0)
"""Payloads of the other jobs: lighter ones say little about saturation."""
AIR_MARGIN_K = 3.0
"""By how much the ambient temperature of past jobs exceeds the scenario's range at either end."""


def calibrate_twins(
    scenario: Scenario,
    arms: Sequence[PlannedArm],
    twins: Sequence[Twin],
    folder: Path,
    progress: Progress,
    *,
    risk: RiskName = "rc",
    jobs: int = PAST_JOBS,
) -> list[CalibratedTwin]:
    """Every arm's twin with its predicted peak and probability of saturation, from the folder where possible.

    A twin whose past jobs say too little about saturation gets no probability; a warning says why.

    Args:
        arms: With their plans for all motion of the scenario, light loads included.
    """
    heats = calibrate_networks(scenario, arms, folder, progress, risk=risk, jobs=jobs)
    inputs = list(zip(arms, twins, heats, strict=True))
    if risk in ("rc", "rc-nominal"):
        return [CalibratedTwin(twin, heat) for _, twin, heat in inputs]
    models = [_saturation(scenario, a, t, heat, risk, folder, jobs) for a, t, heat in inputs]
    fitted = load_or_make(models, "calibrating", progress)
    return [CalibratedTwin(t, heat, model) for (_, t, heat), model in zip(inputs, fitted, strict=True)]


def calibrate_networks(
    scenario: Scenario,
    arms: Sequence[PlannedArm],
    folder: Path,
    progress: Progress,
    *,
    risk: RiskName = "rc",
    jobs: int = PAST_JOBS,
) -> list[RcTwin]:
    """Every arm's thermal network, identified for `rc`, else nominal; for `rc` and `rc-nominal` with its P(saturation).

    Arguments as in `calibrate_twins`.
    """
    robots, ambient_c = [arm.hardware.robot for arm in arms], scenario.twin.ambient_c
    if risk == "rc":
        heats = [RcTwin.of(found) for found in identify_arms(scenario, arms, folder, progress)]
    else:
        heats = [RcTwin.nominal(robot.name, ambient_c=ambient_c, cooling=robot.cooling) for robot in robots]
    heats = [replace(heat, warning_c=scenario.limits.warning_c) for heat in heats]
    if risk not in ("rc", "rc-nominal"):
        return heats
    makers = [_curve(scenario, arm, heat, folder, jobs) for arm, heat in zip(arms, heats, strict=True)]
    curves = load_or_make(makers, "calibrating", progress)
    return [replace(heat, curve=curve) for heat, curve in zip(heats, curves, strict=True)]


def _curve(scenario: Scenario, arm: PlannedArm, heat: RcTwin, folder: Path, jobs: int) -> CachedModel[PeakCurve]:
    def make(home: Path, _report: Callable[[float], None]) -> None:
        past = simulate_past(scenario, arm, heat.heat_model, jobs=jobs)
        fitted = heat.with_past_jobs(past.plans, past.repetitions, known_c=past.known_c, peak_c=past.hottest_c)
        assert fitted.curve is not None
        save_curve(fitted.curve, home)

    return CachedModel(folder / "saturation" / _key(scenario, arm, heat.version, jobs), load_curve, make)


def _saturation(
    scenario: Scenario, arm: PlannedArm, twin: Twin, heat: RcTwin, evidence: Evidence, folder: Path, jobs: int
) -> CachedModel[SaturationModel | None]:
    def load(home: Path) -> SaturationModel | None:
        return load_saturation(home) if home.is_dir() else None

    def make(home: Path, _report: Callable[[float], None]) -> str | None:
        past = simulate_past(scenario, arm, heat.heat_model, jobs=jobs)
        try:
            save_saturation(fit_saturation(experience(twin, past), evidence=evidence), home)
        except NotEnoughExperience as error:
            return f"{scenario.name}: arm '{arm.hardware.robot.name}' gets no probability of saturation. {error}"
        return None

    version = f"{evidence}-{twin.version}-{heat.version}"
    return CachedModel(folder / "saturation" / _key(scenario, arm, version, jobs), load, make)


def simulate_past(scenario: Scenario, arm: PlannedArm, known: HeatModel, *, jobs: int = PAST_JOBS) -> PastJobs:
    """Simulated past jobs of an arm that knows this of its heat; the same for every seed of a run.

    A share `OWN` of the jobs is drawn from the scenario's streams.
    """
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, arm.index], spawn_key=(PAST,)))
    own = _own_jobs(scenario, arm, round(OWN * jobs), rng)
    other = random_jobs(arm.hardware.robot, jobs - len(own), rng, payload_kg=HEAVY_KG)
    repetitions = [times for _, times in own] + repetitions_for(other, rng).tolist()
    return past_jobs(
        arm.hardware,
        [*(plan for plan, _ in own), *other],
        rng,
        limits=scenario.limits,
        ambient_c=_ambient_range(scenario, arm.index),
        repetitions=np.array(repetitions, dtype=int),
        known=known,
    )


def _own_jobs(scenario: Scenario, arm: PlannedArm, count: int, rng: np.random.Generator) -> list[tuple[Plan, int]]:
    """Plans that the arm offers for jobs of the scenario, with repetitions; none if it can do no work."""
    possible = [
        (repetitions, works)
        for repetitions, all_of_them in _kinds_of_jobs(scenario)
        if (works := [work for work in all_of_them if arm.plans.get(work)])
    ]
    jobs = []
    for _ in range(count if possible else 0):
        (fewest, most), works = possible[rng.integers(len(possible))]
        repetitions = int(rng.integers(fewest, most + 1))
        offered = offered_plans(arm.plans[works[rng.integers(len(works))]], repetitions)
        jobs.append((offered[rng.integers(len(offered))], repetitions))
    return jobs


def _kinds_of_jobs(scenario: Scenario) -> list[tuple[tuple[int, int], tuple[Work, ...]]]:
    """Repetitions and works of the streams, each once: arrivals, values and due dates do not matter to past jobs."""
    return list(dict.fromkeys((stream.repetitions, works_of(scenario, stream)) for stream in scenario.jobs))


def _ambient_range(scenario: Scenario, index: int) -> tuple[float, float]:
    """Ambient temperatures of past jobs at one arm: those of the scenario and a margin."""
    offset_k = float(air_offsets(scenario)[index])
    temps = [temp_c + offset_k for temp_c in scenario.twin.air_c or [temp_c for _, temp_c in scenario.ambient.points]]
    return min(temps) - AIR_MARGIN_K, max(temps) + AIR_MARGIN_K


def _key(scenario: Scenario, arm: PlannedArm, version: str, jobs: int) -> str:
    """Cache key of a model: the version of what it calibrates, the arm's hardware and plans, and the past jobs."""
    robot, air_c = arm.hardware.robot, _ambient_range(scenario, arm.index)
    parts = [RECIPE, RANDOM_MOTIONS_VERSION, jobs, version, scenario.spread.seed, scenario.limits, robot, air_c]
    digest = hashlib.sha256(msgspec.json.encode([*parts, _kinds_of_jobs(scenario)]))
    digest.update(arm.hardware.content())
    for phase in (phase for plan in arm.all_plans for phase in plan.phases):
        digest.update(f"{phase.profile.shape}".encode())
        digest.update(np.ascontiguousarray(phase.profile).tobytes())
    return digest.hexdigest()[:32]
