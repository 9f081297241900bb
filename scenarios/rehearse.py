"""Rehearsal: what each arm has done in jobs whose whole horizon stayed cool, and the twin it learns from that."""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from fleet.errors import CheckpointError, FleetError
from fleet.job import Work
from fleet.motion import RATE_HZ, Plan
from fleet.motor import Motors
from fleet.robot import Robot
from fleet.sim.oracle import peaks
from fleet.thermal import NODES, ThermalModel
from scenarios.scenario import Scenario
from twin.checkpoint import load, save
from twin.model import TwinConfig
from twin.score import Twin
from twin.train import train, training_key

Array = np.ndarray
log = logging.getLogger(__name__)

STANDING_S = 12.0
"""Of a phase, at most so long goes into the record: a hold of a minute shows nothing new after that."""


def cool_records(
    plans: Mapping[Work, tuple[Plan, ...]], motors: Motors, thermal: ThermalModel, scenario: Scenario
) -> list[Array]:
    """Phases [time, 3, joint] of the plans that stay cool when repeated over the whole horizon from a cold start.

    Chosen by the horizon, never by the temperature at the moment: a heavy job too begins cool.
    """
    spec = scenario.twin
    every = [plan for variants in plans.values() for plan in variants]
    highest = peaks(
        every,
        [spec.horizon_s] * len(every),
        motors=motors,
        thermal=thermal,
        start_c=np.full(NODES, spec.ambient_c),
        ambient_c=spec.ambient_c,
    ).max(axis=1, initial=-np.inf)
    most = int(STANDING_S * RATE_HZ)
    # Phase by phase, so that training windows are cut and padded as those of a plan that is scored.
    return [
        phase.profile[:most]
        for plan, peak in zip(every, highest, strict=True)
        if peak <= spec.cool_c
        for phase in plan.phases
    ]


def twins(
    scenario: Scenario,
    bodies: Sequence[tuple[Robot, Motors, ThermalModel]],
    plans: Sequence[Mapping[Work, tuple[Plan, ...]]],
    folder: Path,
    progress: Callable[[str, float], None],
) -> list[Twin]:
    """The twin of every arm: from the cache while its inputs are unchanged, else trained, arms side by side.

    Raises:
        FleetError: an arm has no motion that stays cool, so it cannot know what is normal.
    """
    config = TwinConfig.quick() if scenario.twin.size == "quick" else TwinConfig()
    records = []
    for (robot, motors, thermal), own in zip(bodies, plans, strict=True):
        cool = cool_records(own, motors, thermal, scenario)
        if not cool:
            raise FleetError(
                f"{scenario.name}: arm '{robot.name}' has no motion that stays below {scenario.twin.cool_c:g} °C for "
                f"{scenario.twin.horizon_s:g} s, so its twin has nothing to learn from. Raise twin.cool_c, or give "
                "twin.payload_kg lighter loads."
            )
        records.append(cool)
    seeds = [np.random.SeedSequence([scenario.spread.seed, i]) for i in range(len(bodies))]
    homes = [folder / "twins" / training_key(r, config, s) for r, s in zip(records, seeds, strict=True)]
    missing = [i for i, home in enumerate(homes) if _stored(home) is None]
    progress("training", 1.0 - len(missing) / len(bodies))
    if missing:
        names = [body[0].name for body in bodies]
        jobs = (delayed(_train)(records[i], config, seeds[i], names[i], homes[i]) for i in missing)
        with Parallel(n_jobs=min(len(missing), _cores()), return_as="generator_unordered") as pool:
            for done, _ in enumerate(pool(jobs), start=1):
                progress("training", 1.0 - (len(missing) - done) / len(bodies))
    return [load(home) for home in homes]


def _train(records: list[Array], config: TwinConfig, seed: np.random.SeedSequence, arm: str, home: Path) -> None:
    save(train(records, config, seed, arm=arm), home)


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
