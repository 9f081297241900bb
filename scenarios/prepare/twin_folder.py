"""Folders of twins that were trained on request, from a scenario or from logs of a real arm."""

import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from fleet.errors import CheckpointError, FleetError, nearest
from fleet.files import cache_folder
from scenarios.job_stream import rehearsal_works
from scenarios.prepare.planned_arm import plan_arms
from scenarios.prepare.train_twins import train_twins
from scenarios.progress import Progress, quiet
from scenarios.result_folder import ResultKind
from scenarios.schema import Scenario
from twin.logs.recording import Recording
from twin.training_data import NothingCool, cool_stretches
from twin.vae.checkpoint import CARD as TWIN_CARD
from twin.vae.checkpoint import load, save
from twin.vae.config import TwinConfig
from twin.vae.measures import Features
from twin.vae.train import train
from twin.vae.twin import Twin, net_names
from twin.verdict.log_features import log_features

Array = np.ndarray

CARD = "twins.json"
TWINS = ResultKind(name="training", card=CARD, files=(CARD, "*.twin"))
"""A folder of twins: a folder `ARM.twin` for each, and a card with their quality."""


def train_arms(
    scenario: Scenario, arms: Sequence[int], config: TwinConfig, seed: int | None = None, progress: Progress = quiet
) -> list[Twin]:
    """The twins of some arms of a scenario, trained on the same data as the twins of its fleet.

    With the scenario's own configuration and seed they are the twins of its fleet. They come from the cache if they
    are in it.

    Args:
        arms: Indices in the scenario. The twin of an arm does not depend on the other arms in the list.
        seed: Of weights and training; default: the scenario's own.

    Raises:
        FleetError: an arm has no motion that stays cool, or the latent space of a joint collapsed.
    """
    planned = plan_arms(scenario, arms, rehearsal_works(scenario), cache_folder(), progress)
    return train_twins(scenario, planned, cache_folder(), progress, config=config, seed=seed)


LOG_INPUT = {"rate_hz": 2.0, "window": 50, "hidden": 32}
"""Twins of logs: at the common rate of Gen3 loggers a second has two samples only, so windows last 25 s."""
LOADED = (0, 1, 2, 3)
"""The large motors, index 0..6, which determine whether a log is cool: idle wrists are above 40 °C."""


HOLD_OUT = 0.3
"""Share of the cool recordings that calibrate the twin of a log and are not trained on."""
FEWEST_RECORDINGS = 4
"""With fewer held-out recordings the twin of a log stays uncalibrated and is trained on all of them."""


def train_log(
    recordings: Sequence[Recording],
    config: TwinConfig,
    seed: int,
    *,
    cool_c: float,
    hold_out: float = HOLD_OUT,
    progress: Progress = quiet,
) -> Twin:
    """The twin of the arm of some recordings, trained on the parts after which no large motor got warm.

    Some of the recordings that are cool from start to end are held out, drawn by the seed, and calibrate the twin.

    Args:
        hold_out: Share of the cool recordings that are held out.

    Raises:
        FleetError: a recording has no temperatures, nothing stayed cool, or the latent space of a joint collapsed.
    """
    blind = [recording.name for recording in recordings if recording.temp_c is None]
    if blind:
        raise FleetError(
            f"'{blind[0]}' has no motor temperatures, so its cool parts are unknown; leave it out, or log temp_c."
        )
    names = arms_of(recordings)
    if len(names) > 1:
        raise FleetError(f"The log holds several arms ({', '.join(names)}); train on the log of one arm.")
    config = replace(config, record_hz=config.rate_hz)
    entropy = np.random.SeedSequence([seed, 0])
    held_out = _held_out(recordings, config, hold_out, np.random.default_rng(entropy.spawn(1)[0]), cool_c)
    reserved = {recording.name for recording in held_out}
    own = [recording for recording in recordings if recording.name not in reserved]
    least_s = config.window / config.rate_hz
    cool = cool_stretches(own, config.rate_hz, cool_c=cool_c, horizon_s=np.inf, joints=LOADED, least_s=least_s)
    progress("learning the log", 0.0)
    twin = train(
        [stretch.profile for stretch in cool],
        config,
        np.random.SeedSequence([seed, 0]),
        arm=names[0],
        progress=lambda share: progress("learning the log", share),
    )
    if not held_out:
        return twin
    features = [log_features(twin, recording) for recording in held_out]
    return twin.calibrated_on(Features(np.stack([each.packed for each in features])), np.zeros(len(features), int))


def _held_out(
    recordings: Sequence[Recording], config: TwinConfig, share: float, rng: np.random.Generator, cool_c: float
) -> list[Recording]:
    """Recordings that are cool from start to end and last a window, to be held out; none if too few are."""
    cool = [r for r in recordings if _is_cool(r, config, cool_c)]
    count = round(share * len(cool))
    if count < FEWEST_RECORDINGS:
        return []
    return [cool[i] for i in np.sort(rng.permutation(len(cool))[:count])]


def _is_cool(recording: Recording, config: TwinConfig, cool_c: float) -> bool:
    assert recording.temp_c is not None
    if not len(recording.time_s) or recording.temp_c[:, list(LOADED)].max() >= cool_c:
        return False
    try:
        least_s = config.window / config.rate_hz
        cool_stretches([recording], config.rate_hz, cool_c=cool_c, horizon_s=np.inf, joints=LOADED, least_s=least_s)
    except NothingCool:
        return False
    return True


def arms_of(recordings: Sequence[Recording]) -> list[str]:
    """Names of the arms of some recordings: the part after the slash in a file with several arms, else `arm`."""
    return list(dict.fromkeys(r.name.rpartition("/")[2] if "/" in r.name else "arm" for r in recordings))


def quality(twin: Twin) -> dict[str, Any]:  # JSON
    """Origin of a twin and the fit of each network, as JSON values."""
    return {
        "arm": twin.arm,
        "version": twin.version,
        "data_hash": twin.data_hash,
        "seed": twin.seed,
        "calibrated_on": 0 if twin.calibration is None else len(twin.calibration.reference.packed),
        "networks": [
            {"name": name, **{field: value for field, value in vars(fit).items() if field != "restart_elbos"}}
            for name, fit in zip(net_names(twin.config, twin.joints), twin.fits, strict=True)
        ],
    }


def save_twins(twins: Sequence[Twin], folder: Path, source: str) -> dict[str, Any]:  # JSON
    """Save twins in an existing folder; return the card with their origin and quality.

    Args:
        source: The scenario or the log that they were trained on, as text.
    """
    for twin in twins:
        save(twin, folder / f"{quote(twin.arm, safe='')}.twin")
    card = {
        "status": "finished",
        "source": source,
        "thermofleet": version("thermofleet"),
        "twins": [quality(twin) for twin in twins],
    }
    (folder / CARD).write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return card


def open_twin(folder: Path, arm: str | None = None) -> Twin:
    """One twin of a folder: a twin's own folder, or a folder that `save_twins` wrote.

    Raises:
        CheckpointError: there is no twin, it is damaged, or there are several and `arm` names none of them.
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
