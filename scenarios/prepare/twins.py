"""Twins of the arms of a scenario, or of logs of a real arm: trained on motion that stays cool, cached, and saved.

Planned motion is cool if it can repeat over a whole horizon from a cold start, by the true motors: a heavy job
begins cool, too. Training data hold the arm's own cool motion and random light motions of other kinds. Without the
latter, every new motion would score as difficult.
"""

import json
import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import quote, unquote

import numpy as np

from fleet.arm.plan_cache import RANDOM_MOTIONS_VERSION
from fleet.errors import CheckpointError, FleetError, nearest
from fleet.fields import MAX_SEED, check_instance, check_value
from fleet.files import cache_folder
from fleet.heat.motor import Motors
from fleet.heat.thermal import NODES, ThermalModel
from fleet.motion import RATE_HZ, Plan
from scenarios.extras import require_extra
from scenarios.prepare.arms import ArmHardware, PlannedArm, plan_arms
from scenarios.prepare.oracle import peaks
from scenarios.progress import Count, Progress, quiet
from scenarios.result_folder import ResultKind
from scenarios.spec.jobs import rehearsal_works
from scenarios.spec.schema import Scenario, TwinSpec
from twin.logs.recording import NothingCool, Recording, Stretch, check_log, cool_stretches
from twin.vae.config import TwinConfig, training_key
from twin.vae.measures import Features
from twin.vae.twin import CARD as TWIN_CARD
from twin.vae.twin import Twin, load, net_names, save
from twin.verdict import log_features

Array = np.ndarray

RECORDED_S = 12.0
"""Recorded part of a phase: later samples of a hold that lasts a minute show nothing new."""


def records(plans: Iterable[Plan]) -> list[Array]:
    """Training data of a twin, [time, 3, joint] for each phase of each plan, so that windows are cut as in scoring."""
    samples = int(RECORDED_S * RATE_HZ)
    return [phase.profile[:samples] for plan in plans for phase in plan.phases]


def cold_peaks(
    plans: Sequence[Plan], motors: Motors, thermal: ThermalModel, *, ambient_c: float, horizon_s: float
) -> Array:
    """Hottest winding temperatures when each plan's cycle repeats over the horizon from ambient, °C, [plan, joint]."""
    cold_c, lasts_s = np.full(NODES, ambient_c), [horizon_s] * len(plans)
    return peaks(plans, lasts_s, motors=motors, thermal=thermal, start_c=cold_c, ambient_c=ambient_c)


def cool_plans(plans: Sequence[Plan], hardware: ArmHardware, spec: TwinSpec) -> tuple[Plan, ...]:
    """The plans in which no motor of this arm passes `cool_c` over the horizon."""
    highest = cold_peaks(plans, hardware.motors, hardware.thermal, ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    cool = highest.max(axis=1, initial=-np.inf) <= spec.cool_c
    return tuple(plan for plan, stays_cool in zip(plans, cool, strict=True) if stays_cool)


def require_cool_plans(plans: Sequence[Plan], hardware: ArmHardware, scenario: Scenario) -> tuple[Plan, ...]:
    """The cool plans of a scenario's arm; without any it cannot know what is normal.

    Raises:
        FleetError: no plan stays cool.
    """
    spec = scenario.twin
    cool = cool_plans(plans, hardware, spec)
    if not cool:
        raise FleetError(
            f"{scenario.name}: arm '{hardware.robot.name}' has no motion that stays below {spec.cool_c:g} °C for "
            f"{spec.horizon_s:g} s, so its twin has no training data. Raise twin.cool_c, or give twin.payload_kg "
            "lighter loads."
        )
    return cool


log = logging.getLogger(__name__)

Model = TypeVar("Model")


@dataclass(frozen=True)
class CachedModel(Generic[Model]):
    """One model: its folder, whose name stands for everything the model depends on, and how to load and make it."""

    folder: Path
    load: Callable[[Path], Model]
    """Raises `CheckpointError` for damaged files."""
    make: Callable[[Path, Callable[[float], None]], str | None]
    """Make the model and save it in the folder, reporting the fraction done. Return a reason if it cannot be made;
    `load` must then handle the missing folder."""


def load_or_make(models: Sequence[CachedModel[Model]], stage: str, progress: Progress = quiet) -> list[Model]:
    """Every model: from its folder if it is there and intact, else made now, several at a time."""
    loaded = [_load_intact(model) for model in models]
    missing = [model for model, ready in zip(models, loaded, strict=True) if ready is None]

    def report(made: float, at_once: int = 1) -> None:
        progress(stage, Count(len(models) - len(missing) + made, len(models), at_once))

    report(0)
    if missing:
        require_extra("twin")
    reasons: list[str | None] = []
    if len(missing) == 1:  # in this process, which can report progress within one model
        reasons = [missing[0].make(missing[0].folder, report)]
        report(1)
    elif missing:
        from joblib import cpu_count, delayed

        from scenarios.processes import worker_processes

        workers = min(len(missing), cpu_count())
        with worker_processes(workers) as pool:
            for reason in pool(delayed(model.make)(model.folder, _ignore) for model in missing):
                reasons.append(reason)
                report(len(reasons), workers)
    for reason in filter(None, reasons):
        log.warning("%s", reason)
    return [model.load(model.folder) if ready is None else ready for model, ready in zip(models, loaded, strict=True)]


def _load_intact(model: CachedModel[Model]) -> Model | None:
    if not model.folder.is_dir():
        return None
    try:
        return model.load(model.folder)
    except CheckpointError as error:
        log.warning("A cached model is damaged (%s); making it again.", error)
        return None


def _ignore(_fraction: float) -> None:
    """Progress of a worker process, which nobody reads."""


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
    """The twin of an arm; its key is that of its own motion, and of everything that determines its exploration."""
    own, spec = require_cool_plans(arm.all_plans, arm.hardware, scenario), scenario.twin
    training_seed = arm_seed(seed, arm.index)

    def make(home: Path, report: Callable[[float], None]) -> None:
        save(train_twin(own, config, training_seed, scenario=scenario, arm=arm, progress=report), home)

    key = training_key(records(own), config, training_seed)
    if spec.exploration:
        parts = [key, REHEARSAL_VERSION, RANDOM_MOTIONS_VERSION, asdict(spec), asdict(arm.hardware.robot)]
        if seed != scenario.spread.seed:
            parts.append(scenario.spread.seed)
        key = arm.hardware.key(parts)
    return CachedModel(folder / "twins" / key, load, make)


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
    from twin.vae.train import train

    trained_on = [*records(own), *exploration_records(scenario, arm)]
    twin = train(trained_on, config, seed, arm=arm.hardware.robot.name, progress=progress)
    kinds = [[(plan, 1) for plan in plans] for plans in held_out(scenario, arm)]
    return twin.with_calibration(*kinds) if min(map(len, kinds)) >= FEWEST_HELD_OUT else twin


def held_out(scenario: Scenario, arm: PlannedArm, *key: int) -> tuple[tuple[Plan, ...], tuple[Plan, ...]]:
    """Cool light motions and cool random work of an arm that its twin is not trained on.

    Args:
        key: Other spawn keys give other draws.
    """
    from fleet.arm.random_motions import random_jobs  # loads MuJoCo, which an arm with a trained twin does not need

    work = np.random.default_rng(arm_seed(scenario.spread.seed, arm.index, HELD_OUT_WORK, *key))
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
    from fleet.arm.random_motions import light_jobs

    rng = np.random.default_rng(arm_seed(scenario.spread.seed, arm.index, *draw))
    light = light_jobs(arm.hardware.robot, scenario.twin.exploration, rng)
    return cool_plans(light, arm.hardware, scenario.twin)


def arm_seed(seed: int, index: int, *draw: int) -> np.random.SeedSequence:
    """The seed of an arm's training, or of another draw, by its index in the scenario, whichever other arms there are.

    Args:
        draw: Spawn key.
    """
    return np.random.SeedSequence([seed, index], spawn_key=draw)


def train_or_load(
    records: list[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str, folder: Path
) -> Twin:
    """The twin of these records: from the folder while its inputs are unchanged, else trained and kept there."""
    from twin.vae.train import train

    def make(home: Path, _report: Callable[[float], None]) -> None:
        save(train(records, config, seed, arm=arm), home)

    home = folder / "twins" / training_key(records, config, seed)
    of_same_joints = partial(load, joints=records[0].shape[-1])
    return load_or_make([CachedModel(home, of_same_joints, make)], "training")[0]


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
    """Train an arm's twin on the parts of its recordings after which no large motor became warm.

    Some of the recordings that are cool from start to end are held out, sampled by the seed, and calibrate the twin.

    Args:
        hold_out: Share of the cool recordings that are held out.

    Raises:
        FleetError: an argument is not allowed, a recording has no temperatures, nothing stayed cool, or the latent
            space of a joint collapsed.
    """
    check_log(recordings)
    check_instance("config", config, TwinConfig, "TwinConfig.quick()")
    seed = check_value("seed", seed, int, low=0, high=MAX_SEED)
    cool_c = check_value("cool_c", cool_c, float, low=0, high=200)
    hold_out = check_value("hold_out", hold_out, float, low=0, high=0.9)
    blind = [recording.name for recording in recordings if recording.temp_c is None]
    if blind:
        raise FleetError(
            f"'{blind[0]}' has no motor temperatures, so its cool parts are unknown; leave it out, or log temp_c."
        )
    names = arms_of(recordings)
    if len(names) > 1:
        raise FleetError(f"The log holds several arms ({', '.join(names)}); train on the log of one arm.")
    from twin.vae.train import train

    config = replace(config, record_hz=config.rate_hz)
    held_out = _held_out(recordings, config, hold_out, np.random.default_rng(arm_seed(seed, 0, 0)), cool_c)
    reserved = {recording.name for recording in held_out}
    own = [recording for recording in recordings if recording.name not in reserved]
    progress("learning the log", 0.0)
    twin = train(
        [stretch.profile for stretch in _cool_stretches(own, config, cool_c)],
        config,
        arm_seed(seed, 0),
        arm=names[0],
        progress=lambda share: progress("learning the log", share),
    )
    if not held_out:
        return twin
    reference = np.stack([log_features(twin, recording).packed for recording in held_out])
    return twin.calibrated_on(Features(reference), np.zeros(len(reference), int))


def _cool_stretches(recordings: Sequence[Recording], config: TwinConfig, cool_c: float) -> list[Stretch]:
    """Stretches of a window or more after which no large motor gets warm; raises as `cool_stretches`."""
    least_s = config.window / config.rate_hz
    return cool_stretches(recordings, config.rate_hz, cool_c=cool_c, joints=LOADED, least_s=least_s)


def _held_out(
    recordings: Sequence[Recording], config: TwinConfig, share: float, rng: np.random.Generator, cool_c: float
) -> list[Recording]:
    """Recordings that are cool from start to end and last a window, to be held out; none if too few are."""
    cool = list[Recording]()
    for recording in recordings:
        assert recording.temp_c is not None
        if len(recording.time_s) and recording.temp_c[:, list(LOADED)].max() < cool_c:
            with suppress(NothingCool):
                _cool_stretches([recording], config, cool_c)
                cool.append(recording)
    count = round(share * len(cool))
    if count < FEWEST_RECORDINGS:
        return []
    return [cool[i] for i in np.sort(rng.permutation(len(cool))[:count])]


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
    homes = {unquote(home.name.removesuffix(".twin")): home for home in sorted(folder.glob("*.twin"))}
    if not homes:
        raise CheckpointError(f"'{folder}' holds no twin ({TWIN_CARD}, or folders ARM.twin).")
    if arm is None and len(homes) > 1:
        raise CheckpointError(f"'{folder}' holds {len(homes)} twins; choose one with --arm: {', '.join(homes)}.")
    name = next(iter(homes)) if arm is None else arm
    if name not in homes:
        raise CheckpointError(f"No twin of arm '{name}' in '{folder}'{nearest(name, homes)}")
    return load(homes[name])
