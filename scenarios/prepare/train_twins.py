"""Train the twin of every arm on motion whose whole horizon stays cool.

Training data hold the motion of the arm's work and random light motions of other kinds. Without the latter, every new
motion would score as difficult. `benchmarks/paper/saturation.py` measures the gain.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from fleet.motion import Plan
from fleet.planning.random_motions import RANDOM_MOTIONS_VERSION, light_jobs, random_jobs
from scenarios.prepare.cool_motion import cool_plans, records, require_cool_plans
from scenarios.prepare.model_cache import CachedModel, load_or_make
from scenarios.prepare.planned_arm import ArmHardware, PlannedArm
from scenarios.progress import Progress
from scenarios.schema import Scenario, TwinSpec
from twin.vae.checkpoint import load, save
from twin.vae.config import TwinConfig
from twin.vae.training_key import training_key
from twin.vae.twin import Twin

Array = np.ndarray

REHEARSAL_VERSION = 4
"""Raise it whenever the same arm would get other training or calibration data."""

EXPLORATION, HELD_OUT, HELD_OUT_WORK = 1, 2, 3
"""Spawn keys that keep the random draws of one arm apart."""
FEWEST_HELD_OUT = 8
"""With fewer held-out motions of a kind a twin stays uncalibrated."""
MOST_DRAWS = 12
"""Most draws of work per held-out job: little work of an arm in a hot place stays cool."""


TRAINING_STEP = 1000
"""Between the seeds of two trainings; the first one is the scenario's own."""


def training_seed(scenario: Scenario, training: int) -> int:
    """Seed of the twins' k-th training, from 0."""
    return scenario.spread.seed + TRAINING_STEP * training


def train_twins(
    scenario: Scenario,
    arms: Sequence[PlannedArm],
    folder: Path,
    progress: Progress,
    *,
    config: TwinConfig | None = None,
    seed: int | None = None,
) -> list[Twin]:
    """The twin of every arm: from the cache while its inputs are unchanged, else trained, several arms at a time.

    Args:
        config: Default: the size that the scenario names.
        seed: Of weights and training; default: the scenario's own. The training data do not depend on it.

    Raises:
        FleetError: an arm has no motion that stays cool.
    """
    if config is None:
        config = TwinConfig.quick() if scenario.twin.size == "quick" else TwinConfig()
    own_seed = scenario.spread.seed
    models = [_model(scenario, arm, folder, config, own_seed if seed is None else seed) for arm in arms]
    return load_or_make(models, "training", progress)


def _model(scenario: Scenario, arm: PlannedArm, folder: Path, config: TwinConfig, seed: int) -> CachedModel[Twin]:
    own = require_cool_plans(arm.all_plans, arm.hardware, scenario)
    training_seed = arm_seed(seed, arm.index)

    def make(home: Path, report: Callable[[float], None]) -> None:
        save(train_twin(own, config, training_seed, scenario=scenario, arm=arm, progress=report), home)

    key = training_key(records(own), config, training_seed)
    exploration_seed = scenario.spread.seed if seed != scenario.spread.seed else None
    return CachedModel(folder / "twins" / _key(key, scenario.twin, arm.hardware, exploration_seed), load, make)


def train_twin(
    own: Sequence[Plan],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    scenario: Scenario,
    arm: PlannedArm,
    progress: Callable[[float], None] = lambda share: None,
) -> Twin:
    """The twin of an arm: trained on its own cool motion and its exploration, and calibrated.

    It is calibrated on cool jobs of two kinds, on none of which it was trained: light motions, and random work.

    Args:
        own: The arm's cool plans.
        progress: Called with the fraction of the training that is done.
    """
    trained_on = [*records(own), *exploration_records(scenario, arm)]
    from twin.vae.train import train  # imports torch, which scoring does not need

    twin = train(trained_on, config, seed, arm=arm.hardware.robot.name, progress=progress)
    kinds = [[(plan, 1) for plan in plans] for plans in held_out(scenario, arm)]
    return twin.with_calibration(*kinds) if min(map(len, kinds)) >= FEWEST_HELD_OUT else twin


def held_out(scenario: Scenario, arm: PlannedArm, *key: int) -> tuple[tuple[Plan, ...], tuple[Plan, ...]]:
    """Cool light motions and cool random work of an arm that its twin is not trained on.

    Args:
        key: Other spawn keys give other draws.
    """
    work = np.random.default_rng(_draw_seed(scenario, arm, HELD_OUT_WORK, *key))
    robot, wanted = arm.hardware.robot, scenario.twin.exploration
    jobs = list[Plan]()
    for _ in range(MOST_DRAWS):
        if len(jobs) < wanted:
            jobs += cool_plans(random_jobs(robot, wanted, work), arm.hardware, scenario.twin)
    return _cool_exploration(scenario, arm, HELD_OUT, *key), tuple(jobs[:wanted])


def exploration_records(scenario: Scenario, arm: PlannedArm) -> list[Array]:
    """Training data of the arm's exploration, [time, 3, joint] each; the same for every seed of a run."""
    return records(_cool_exploration(scenario, arm, EXPLORATION))


def _cool_exploration(scenario: Scenario, arm: PlannedArm, *draw: int) -> tuple[Plan, ...]:
    rng = np.random.default_rng(_draw_seed(scenario, arm, *draw))
    light = light_jobs(arm.hardware.robot, scenario.twin.exploration, rng)
    return cool_plans(light, arm.hardware, scenario.twin)


def _draw_seed(scenario: Scenario, arm: PlannedArm, *draw: int) -> np.random.SeedSequence:
    return np.random.SeedSequence([scenario.spread.seed, arm.index], spawn_key=draw)


def arm_seed(seed: int, index: int) -> np.random.SeedSequence:
    """The seed of an arm's training, by its place in the scenario, whichever other arms are trained."""
    return np.random.SeedSequence([seed, index])


def _key(own: str, spec: TwinSpec, hardware: ArmHardware, exploration_seed: int | None = None) -> str:
    """Cache key of a twin: the key of its own motion, and everything that determines its exploration.

    Args:
        exploration_seed: Seed of the exploration if it is not the one in the key of the own motion.
    """
    if not spec.exploration:
        return own
    parts = [own, REHEARSAL_VERSION, RANDOM_MOTIONS_VERSION, asdict(spec), asdict(hardware.robot)]
    digest = hashlib.sha256(msgspec.json.encode(parts if exploration_seed is None else [*parts, exploration_seed]))
    digest.update(hardware.content())
    return digest.hexdigest()[: len(own)]


def train_or_load(
    records: list[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str, folder: Path
) -> Twin:
    """The twin of these records: from the folder while its inputs are unchanged, else trained and kept there."""

    def make(home: Path, _report: Callable[[float], None]) -> None:
        from twin.vae.train import train  # imports torch

        save(train(records, config, seed, arm=arm), home)

    home = folder / "twins" / training_key(records, config, seed)
    of_same_joints = partial(load, joints=records[0].shape[-1])
    return load_or_make([CachedModel(home, of_same_joints, make)], "training")[0]
