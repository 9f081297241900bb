"""The thermal network of each arm of a scenario, identified from simulated logs of its own cool work."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from scenarios.prepare.cool_motion import records, require_cool_plans
from scenarios.prepare.model_cache import CachedModel, load_or_make
from scenarios.prepare.planned_arm import PlannedArm
from scenarios.prepare.simulated_logs import identify_from_work
from scenarios.progress import Progress
from scenarios.schema import Scenario
from twin.thermal.checkpoint import load, save
from twin.thermal.result import Identified

RECIPE = 1
"""Raise it whenever the same arm would get other logs or another result."""
LOGGED = 5
"""Spawn key, different from those of `scenarios.prepare.train_twins` and `calibrate_twins` for the same arm."""
LOGS = 4
"""Recordings, half an hour each."""
STEP_S = 20.0
"""Step of the identification: a tenth of a winding's time constant."""


def identify_arms(scenario: Scenario, arms: Sequence[PlannedArm], folder: Path, progress: Progress) -> list[Identified]:
    """The identified network of every arm: from the cache while its inputs are unchanged.

    Raises:
        FleetError: an arm has no motion that stays cool.
    """
    return load_or_make([_model(scenario, arm, folder) for arm in arms], "identifying", progress)


def _model(scenario: Scenario, arm: PlannedArm, folder: Path) -> CachedModel[Identified]:
    cool, ambient_c = require_cool_plans(arm.all_plans, arm.hardware, scenario), scenario.twin.ambient_c
    seed = [scenario.spread.seed, arm.index]

    def make(home: Path, _report: Callable[[float], None]) -> None:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LOGGED,)))
        chosen = rng.choice(len(cool), size=min(LOGS, len(cool)), replace=False)
        plans = [cool[i] for i in chosen]
        save(identify_from_work(arm.hardware, plans, rng, ambient_c=ambient_c, step_s=STEP_S), home)

    digest = hashlib.sha256(msgspec.json.encode([RECIPE, seed, ambient_c, arm.hardware.robot]))
    digest.update(arm.hardware.content())
    for record in records(cool):
        digest.update(np.ascontiguousarray(record).tobytes())
    return CachedModel(folder / "identified" / digest.hexdigest()[:32], load, make)
