"""Rehearsal: what each arm has done in jobs whose whole horizon stayed cool, and the twin it learns from that.

Besides the motion of its work an arm explores with light motions of other kinds: a twin that knows only work takes
whatever is new for a danger. `scenarios/coverage.py` measures what that is worth.
"""

import hashlib
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import msgspec
import numpy as np
from joblib import Parallel, delayed

from fleet.errors import CheckpointError, FleetError
from fleet.job import Work
from fleet.motion import Plan
from fleet.motor import Motors
from fleet.robot import Robot
from fleet.sim.exercise import EXERCISE_VERSION, light_jobs
from fleet.sim.oracle import peaks
from fleet.thermal import NODES, ThermalModel
from scenarios.records import records
from scenarios.scenario import Scenario, TwinSpec
from twin.checkpoint import load, save
from twin.model import TwinConfig
from twin.score import Twin
from twin.train import train, training_key

Array = np.ndarray
log = logging.getLogger(__name__)

Body = tuple[Robot, Motors, ThermalModel]


def cool_records(
    plans: Mapping[Work, tuple[Plan, ...]], motors: Motors, thermal: ThermalModel, scenario: Scenario
) -> list[Array]:
    """Phases [time, 3, joint] of the plans that stay cool when repeated over the whole horizon from a cold start.

    Chosen by the horizon, never by the temperature at the moment: a heavy job too begins cool.
    """
    return records(_cool([plan for variants in plans.values() for plan in variants], motors, thermal, scenario.twin))


def explored_records(scenario: Scenario, index: int, body: Body) -> list[Array]:
    """The same of the light motions with which the arm of this index explores, on its own mount; none if it does not.

    They are the same for every seed of a run.
    """
    robot, motors, thermal = body
    rng = np.random.default_rng(np.random.SeedSequence([scenario.spread.seed, index], spawn_key=(EXPLORATION,)))
    light = light_jobs(robot, scenario.twin.exploration, rng)
    return records(_cool(light, motors, thermal, scenario.twin))


EXPLORATION = 1
"""Keeps these draws apart from others of the same arm."""


def _cool(plans: Sequence[Plan], motors: Motors, thermal: ThermalModel, spec: TwinSpec) -> Iterable[Plan]:
    highest = peaks(
        plans,
        [spec.horizon_s] * len(plans),
        motors=motors,
        thermal=thermal,
        start_c=np.full(NODES, spec.ambient_c),
        ambient_c=spec.ambient_c,
    ).max(axis=1, initial=-np.inf)
    return (plan for plan, peak in zip(plans, highest, strict=True) if peak <= spec.cool_c)


def twins(
    scenario: Scenario,
    bodies: Sequence[Body],
    plans: Sequence[Mapping[Work, tuple[Plan, ...]]],
    folder: Path,
    progress: Callable[[str, float], None],
) -> list[Twin]:
    """The twin of every arm: from the cache while its inputs are unchanged, else trained, arms side by side.

    Raises:
        FleetError: an arm has no motion that stays cool, so it cannot know what is normal.
    """
    config = TwinConfig.quick() if scenario.twin.size == "quick" else TwinConfig()
    own = []
    for (robot, motors, thermal), possible in zip(bodies, plans, strict=True):
        cool = cool_records(possible, motors, thermal, scenario)
        if not cool:
            raise FleetError(
                f"{scenario.name}: arm '{robot.name}' has no motion that stays below {scenario.twin.cool_c:g} °C for "
                f"{scenario.twin.horizon_s:g} s, so its twin has nothing to learn from. Raise twin.cool_c, or give "
                "twin.payload_kg lighter loads."
            )
        own.append(cool)
    seeds = [np.random.SeedSequence([scenario.spread.seed, i]) for i in range(len(bodies))]
    keys = [training_key(r, config, s) for r, s in zip(own, seeds, strict=True)]
    homes = [folder / "twins" / _key(k, scenario.twin, body) for k, body in zip(keys, bodies, strict=True)]
    missing = [i for i, home in enumerate(homes) if _stored(home) is None]
    progress("training", 1.0 - len(missing) / len(bodies))
    if missing:
        jobs = (delayed(_rehearse)(own[i], config, seeds[i], homes[i], scenario, i, bodies[i]) for i in missing)
        with Parallel(n_jobs=min(len(missing), _cores()), return_as="generator_unordered") as pool:
            for done, _ in enumerate(pool(jobs), start=1):
                progress("training", 1.0 - (len(missing) - done) / len(bodies))
    return [load(home) for home in homes]


def _rehearse(
    own: list[Array],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    home: Path,
    scenario: Scenario,
    index: int,
    body: Body,
) -> None:
    _train([*own, *explored_records(scenario, index, body)], config, seed, body[0].name, home)


def _key(own: str, spec: TwinSpec, body: Body) -> str:
    """Key of a twin by that of its own motion and by what decides on its exploration, which is not drawn for it."""
    if not spec.exploration:
        return own
    robot, motors, thermal = body
    digest = hashlib.sha256(msgspec.json.encode([own, EXERCISE_VERSION, asdict(spec), asdict(robot)]))
    for value in (*vars(motors).values(), *vars(thermal).values()):
        digest.update(np.asarray(value, dtype=float).tobytes())
    return digest.hexdigest()[: len(own)]


def _train(learned: list[Array], config: TwinConfig, seed: np.random.SeedSequence, arm: str, home: Path) -> None:
    save(train(learned, config, seed, arm=arm), home)


def trained(records: list[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str, folder: Path) -> Twin:
    """The twin of these records: from the folder while all it depends on is unchanged, else trained and kept there."""
    home = folder / "twins" / training_key(records, config, seed)
    kept = _stored(home)
    if kept is None:
        _train(records, config, seed, arm, home)
        kept = load(home)
    return kept


def _stored(home: Path) -> Twin | None:
    if not home.is_dir():
        return None
    try:
        return load(home)
    except CheckpointError as error:
        log.warning("The stored twin cannot be used (%s); training anew.", error)
        return None


def _cores() -> int:
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
