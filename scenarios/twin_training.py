"""Twins trained on request: of a scenario's arms or of a real arm's logs, kept in one folder and found there again."""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from joblib import Parallel, delayed

from fleet.errors import CheckpointError, FleetError, nearest
from fleet.motion import Plan
from fleet.sim.oracle import peaks
from fleet.thermal import NODES
from scenarios.build import Progress, body_of, cache_folder, plan_works, quiet
from scenarios.folder import Kind
from scenarios.jobs import rehearsal_works
from scenarios.records import records
from scenarios.scenario import Scenario
from twin.checkpoint import CARD as TWIN_CARD
from twin.checkpoint import load, save
from twin.cool import cool_stretches
from twin.model import TwinConfig
from twin.recording import Recording
from twin.score import Twin, net_names
from twin.train import train

Array = np.ndarray

CARD = "twins.json"
TWINS = Kind(what="training", card=CARD, holds=(CARD, "*.twin"))
"""A folder of twins: one folder `ARM.twin` each, and the card with their quality."""


def arm_index(scenario: Scenario, name: str) -> int:
    """Where an arm stands in its scenario.

    Raises:
        FleetError: it has no such arm; names those it has.
    """
    names = [arm.name for arm in scenario.arms]
    if name not in names:
        raise FleetError(f"No arm '{name}' in {scenario.name}{nearest(name, names)}")
    return names.index(name)


HELD_OUT = 0.2
"""Share of an arm's cool plans that its twin is not trained on, but takes what is usual from."""
FEWEST_HELD_OUT = 8
"""With fewer, nothing is held out and the twin stays without a calibration."""


def train_arms(
    scenario: Scenario, arms: Sequence[int], config: TwinConfig, seed: int, progress: Progress = quiet
) -> list[Twin]:
    """The twins of some arms of a scenario, each trained on its own rehearsal, side by side.

    Args:
        arms: Which, by their place in the scenario; the twin of an arm does not depend on who is trained with it.

    Raises:
        FleetError: an arm has no motion that stays cool, or the latent of a joint collapsed.
    """
    seeds = [np.random.SeedSequence([seed, index]) for index in arms]
    prepared = []
    for done, (index, own) in enumerate(zip(arms, seeds, strict=True)):
        share = lambda s, done=done: progress("planning", (done + s) / len(arms))  # noqa: E731
        prepared.append(_cool_plans(scenario, index, own, share))
    names = [scenario.arms[index].name for index in arms]
    progress("training", 0.0)
    if len(arms) == 1:  # in this process, so that the bar moves within the training
        told = lambda share: progress("training", share)  # noqa: E731
        return [_calibrated(prepared[0], config, seeds[0], names[0], told)]
    work = (delayed(_calibrated)(cool, config, s, n) for cool, s, n in zip(prepared, seeds, names, strict=True))
    twins = []
    with Parallel(n_jobs=min(len(arms), _cores()), return_as="generator") as pool:
        for twin in pool(work):
            twins.append(twin)
            progress("training", len(twins) / len(arms))
    return twins


def _cool_plans(
    scenario: Scenario, index: int, seed: np.random.SeedSequence, progress: Callable[[float], None]
) -> tuple[list[Plan], list[Plan]]:
    """An arm's rehearsed plans that stay cool: to learn from, and held out for what is usual."""
    robot, motors, thermal = body_of(scenario, index)
    possible, _ = plan_works(robot, rehearsal_works(scenario), scenario, cache_folder(), progress)
    every = [plan for variants in possible.values() for plan in variants]
    spec = scenario.twin
    highest = peaks(
        every,
        [spec.horizon_s] * len(every),
        motors=motors,
        thermal=thermal,
        start_c=np.full(NODES, spec.ambient_c),
        ambient_c=spec.ambient_c,
    ).max(axis=1, initial=-np.inf)
    cool = [plan for plan, peak in zip(every, highest, strict=True) if peak <= spec.cool_c]
    if not cool:
        raise FleetError(
            f"{scenario.name}: arm '{robot.name}' has no motion that stays below {spec.cool_c:g} °C for "
            f"{spec.horizon_s:g} s, so its twin has nothing to learn from. Raise twin.cool_c, or give "
            "twin.payload_kg lighter loads."
        )
    held_out = int(HELD_OUT * len(cool)) if HELD_OUT * len(cool) >= FEWEST_HELD_OUT else 0
    order = np.random.default_rng(seed).permutation(len(cool))
    return [cool[i] for i in sorted(order[held_out:])], [cool[i] for i in sorted(order[:held_out])]


def _calibrated(
    cool: tuple[list[Plan], list[Plan]],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    arm: str,
    progress: Callable[[float], None] | None = None,
) -> Twin:
    known, held_out = cool
    twin = train(records(known), config, seed, arm=arm, progress=progress)
    return twin.calibrated([(plan, 1) for plan in held_out]) if held_out else twin


LOG_RATE_HZ = 2.0
"""What loggers of a Gen3 commonly reach; a window of 50 samples then shows 25 s."""
LOADED = (0, 1, 2, 3)
"""Motors by which a log is judged cool, index 0..6: the large ones. Wrists sit above 40 °C without any work."""


def log_config(base: TwinConfig) -> TwinConfig:
    """A configuration fit for logs: their rate, and windows taken from many places of few hours."""
    return replace(base, rate_hz=LOG_RATE_HZ)


def train_log(
    recordings: Sequence[Recording], config: TwinConfig, seed: int, *, cool_c: float, progress: Progress = quiet
) -> Twin:
    """The twin of the arm that made some recordings, from those parts after which no large motor got warm.

    Raises:
        FleetError: a recording without temperatures, or nothing stayed cool, or the latent of a joint collapsed.
    """
    blind = [recording.name for recording in recordings if recording.temp_c is None]
    if blind:
        raise FleetError(
            f"'{blind[0]}' has no motor temperatures, so nobody knows what of it was cool; leave it out, or log temp_c."
        )
    names = arms_of(recordings)
    if len(names) > 1:
        raise FleetError(f"The log holds several arms ({', '.join(names)}); train on the log of one arm.")
    config = replace(config, record_hz=config.rate_hz)
    least_s = config.window / config.rate_hz
    cool = cool_stretches(recordings, config.rate_hz, cool_c=cool_c, horizon_s=np.inf, joints=LOADED, least_s=least_s)
    progress("training", 0.0)
    own = np.random.SeedSequence([seed, 0])
    return train(
        [stretch.profile for stretch in cool],
        config,
        own,
        arm=names[0],
        progress=lambda share: progress("training", share),
    )


def arms_of(recordings: Sequence[Recording]) -> list[str]:
    """Names of the arms of some recordings: behind the slash where a file holds several, else just `arm`."""
    return list(dict.fromkeys(r.name.rpartition("/")[2] if "/" in r.name else "arm" for r in recordings))


def quality(twin: Twin) -> dict[str, Any]:
    """Where a twin came from and how well each joint knows its data, as plain values."""
    return {
        "arm": twin.arm,
        "version": twin.version,
        "data_hash": twin.data_hash,
        "seed": twin.seed,
        "calibrated_on": 0 if twin.calibration is None else len(twin.calibration.reference.packed),
        "networks": [
            {
                "name": name,
                "elbo": fit.elbo,
                "kl": fit.kl,
                "active_units": fit.active_units,
                "mean_squared_error": fit.mean_squared_error,
                "restart": fit.restart,
            }
            for name, fit in zip(net_names(twin.config, twin.joints), twin.fits, strict=True)
        ],
    }


def save_twins(twins: Sequence[Twin], folder: Path, source: str) -> dict[str, Any]:
    """Lay twins down in an existing folder; returns the card that says what they are.

    Args:
        source: The scenario or the log that they were trained on, in words.
    """
    for twin in twins:
        save(twin, folder / _home(twin.arm))
    card = {
        "status": "finished",
        "source": source,
        "thermofleet": version("thermofleet"),
        "twins": [quality(twin) for twin in twins],
    }
    (folder / CARD).write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return card


def open_twin(folder: Path, arm: str | None = None) -> Twin:
    """One twin of a folder: of a twin's own, or of one that `save_twins` wrote.

    Raises:
        CheckpointError: there is none, it is damaged, or there are several and `arm` names none of them.
    """
    if not folder.is_dir():
        raise CheckpointError(f"There is no folder '{folder}'; make one with: thermofleet twin train … --out {folder}.")
    if (folder / TWIN_CARD).exists():
        return load(folder)
    homes = {home.name.removesuffix(".twin"): home for home in sorted(folder.glob("*.twin"))}
    if not homes:
        raise CheckpointError(f"'{folder}' holds no twin ({TWIN_CARD}, or folders ARM.twin).")
    if arm is None and len(homes) > 1:
        raise CheckpointError(f"'{folder}' holds {len(homes)} twins; choose one with --arm: {', '.join(homes)}.")
    name = next(iter(homes)) if arm is None else quote(arm, safe="")
    if name not in homes:
        raise CheckpointError(f"No twin of arm '{arm}' in '{folder}'{nearest(name, homes)}")
    return load(homes[name])


def _home(arm: str) -> str:
    return f"{quote(arm, safe='')}.twin"


def _cores() -> int:
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
