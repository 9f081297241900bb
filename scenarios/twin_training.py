"""Twins trained on request: of a scenario's arms or of a real arm's logs, kept in one folder and found there again."""

import json
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from fleet.errors import CheckpointError, FleetError, nearest
from scenarios.build import Progress, body_of, cache_folder, plan_works, quiet
from scenarios.folder import Kind
from scenarios.jobs import rehearsal_works
from scenarios.rehearse import twins
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


def train_arms(
    scenario: Scenario, arms: Sequence[int], config: TwinConfig, seed: int | None = None, progress: Progress = quiet
) -> list[Twin]:
    """The twins of some arms of a scenario, side by side, each taught what the fleet's twin of that arm is taught.

    With the scenario's own configuration and seed they are the twins with which its fleet works. All are taken from
    the cache while their inputs are unchanged, and else trained and kept there.

    Args:
        arms: Which, by their place in the scenario; the twin of an arm does not depend on who is trained with it.
        seed: Of weights and training; by default the scenario's own.

    Raises:
        FleetError: an arm has no motion that stays cool, or the latent of a joint collapsed.
    """
    bodies = [body_of(scenario, index) for index in arms]
    plans = []
    for done, body in enumerate(bodies):

        def share(s: float, done: int = done) -> None:
            progress("planning", (done + s) / len(arms))

        plans.append(plan_works(body[0], rehearsal_works(scenario), scenario, cache_folder(), share)[0])
    return twins(scenario, bodies, plans, cache_folder(), progress, arms=arms, config=config, seed=seed)


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
    progress("learning the log", 0.0)
    own = np.random.SeedSequence([seed, 0])
    return train(
        [stretch.profile for stretch in cool],
        config,
        own,
        arm=names[0],
        progress=lambda share: progress("learning the log", share),
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
