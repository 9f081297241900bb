"""Rehearsal: what each arm has done in jobs whose whole horizon stayed cool, and the twin it learns from that.

Besides the motion of its work an arm explores with light motions of other kinds: a twin that knows only work takes
whatever is new for a danger. `scenarios/coverage.py` measures what that is worth.
"""

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import msgspec
import numpy as np
from joblib import Parallel, cpu_count, delayed

from fleet.errors import CheckpointError
from fleet.job import Work
from fleet.motion import Plan
from fleet.sim.exercise import EXERCISE_VERSION, light_jobs
from scenarios.cool import Body, cool_plans, some_cool_plans
from scenarios.records import records
from scenarios.scenario import Scenario, TwinSpec
from twin.checkpoint import load, save
from twin.model import TwinConfig
from twin.score import Twin
from twin.train import train, training_key

Array = np.ndarray
log = logging.getLogger(__name__)

REHEARSAL_VERSION = 3
"""Raised whenever the same arm would be taught another thing, or told another thing is usual."""


def cool_motion(plans: Mapping[Work, tuple[Plan, ...]], body: Body, scenario: Scenario) -> tuple[Plan, ...]:
    """The plans that stay cool when repeated over the whole horizon from a cold start.

    Raises:
        FleetError: none does.
    """
    return some_cool_plans([plan for variants in plans.values() for plan in variants], body, scenario)


def explored_records(scenario: Scenario, index: int, body: Body) -> list[Array]:
    """The same of the light motions with which the arm of this index explores, on its own mount; none if it does not.

    They are the same for every seed of a run.
    """
    return records(_explored(scenario, index, body, EXPLORATION))


def taught(
    own: Sequence[Plan],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    *,
    scenario: Scenario,
    index: int,
    body: Body,
    progress: Callable[[float], None] | None = None,
) -> Twin:
    """The twin of an arm: trained on its own cool motion and its exploration, and told what is usual.

    Usual is fresh exploration, on which it was not trained, and as much of its own work, on which it was: that comes
    again as it is, and measured against slow exploration alone a fifth of fast cool work would count as unusual.

    Args:
        own: As `cool_motion` gives it.
        index: Which arm of the scenario it is.
        progress: Told the share of the training that is done.
    """
    learned = [*records(own), *explored_records(scenario, index, body)]
    twin = train(learned, config, seed, arm=body[0].name, progress=progress)
    fresh = _explored(scenario, index, body, HELD_OUT)
    if len(fresh) < FEWEST_HELD_OUT:
        return twin
    rng = np.random.default_rng(_draw_seed(scenario, index, USUAL))
    chosen = rng.choice(len(own), size=min(len(own), len(fresh)), replace=False)
    return twin.calibrated([(plan, 1) for plan in (*fresh, *(own[i] for i in chosen))])


EXPLORATION, HELD_OUT, USUAL = 1, 2, 3
"""Keep these draws apart from others of the same arm."""
FEWEST_HELD_OUT = 8
"""With fewer held-out motions a twin stays without a calibration."""


def _explored(scenario: Scenario, index: int, body: Body, draw: int) -> tuple[Plan, ...]:
    rng = np.random.default_rng(_draw_seed(scenario, index, draw))
    return cool_plans(light_jobs(body[0], scenario.twin.exploration, rng), body, scenario.twin)


def _draw_seed(scenario: Scenario, index: int, draw: int) -> np.random.SeedSequence:
    return np.random.SeedSequence([scenario.spread.seed, index], spawn_key=(draw,))


def twins(
    scenario: Scenario,
    bodies: Sequence[Body],
    plans: Sequence[Mapping[Work, tuple[Plan, ...]]],
    folder: Path,
    progress: Callable[[str, float], None],
    *,
    arms: Sequence[int] | None = None,
    config: TwinConfig | None = None,
    seed: int | None = None,
) -> list[Twin]:
    """The twin of every arm: from the cache while its inputs are unchanged, else trained, arms side by side.

    Args:
        arms: Whose these bodies and plans are, by place in the scenario; by default all of it, in order.
        config: By default of the size that the scenario says, as its fleet works with.
        seed: Of weights and training; by default the scenario's own. What an arm is taught does not depend on it.

    Raises:
        FleetError: an arm has no motion that stays cool, so it cannot know what is normal.
    """
    if config is None:
        config = TwinConfig.quick() if scenario.twin.size == "quick" else TwinConfig()
    own = [cool_motion(possible, body, scenario) for body, possible in zip(bodies, plans, strict=True)]
    places = range(len(bodies)) if arms is None else arms
    seeds = [arm_seed(scenario.spread.seed if seed is None else seed, index) for index in places]
    keys = [training_key(records(o), config, s) for o, s in zip(own, seeds, strict=True)]
    drawn = scenario.spread.seed if seed not in (None, scenario.spread.seed) else None
    homes = [folder / "twins" / _key(k, scenario.twin, body, drawn) for k, body in zip(keys, bodies, strict=True)]
    kept = [_stored(home) for home in homes]
    missing = [i for i, twin in enumerate(kept) if twin is None]
    progress("training", 1.0 - len(missing) / len(bodies))
    jobs = ((own[i], config, seeds[i], homes[i], scenario, places[i], bodies[i]) for i in missing)
    if len(missing) == 1:  # in this process, so that progress is told within the training
        before = 1.0 - 1.0 / len(bodies)
        _rehearse(*next(jobs), lambda share: progress("training", before + share / len(bodies)))
        progress("training", 1.0)
    elif missing:
        with Parallel(n_jobs=min(len(missing), cpu_count()), return_as="generator_unordered") as pool:
            for done, _ in enumerate(pool(delayed(_rehearse)(*job) for job in jobs), start=1):
                progress("training", 1.0 - (len(missing) - done) / len(bodies))
    return [twin or load(home) for twin, home in zip(kept, homes, strict=True)]


def _rehearse(
    own: Sequence[Plan],
    config: TwinConfig,
    seed: np.random.SeedSequence,
    home: Path,
    scenario: Scenario,
    index: int,
    body: Body,
    progress: Callable[[float], None] | None = None,
) -> None:
    save(taught(own, config, seed, scenario=scenario, index=index, body=body, progress=progress), home)


def arm_seed(seed: int, index: int) -> np.random.SeedSequence:
    """Of the training of an arm, by its place in the scenario; who else is trained does not matter."""
    return np.random.SeedSequence([seed, index])


def _key(own: str, spec: TwinSpec, body: Body, drawn: int | None = None) -> str:
    """Key of a twin by that of its own motion and by what decides on its exploration, which is not drawn for it.

    Args:
        drawn: Seed of the exploration where the key of the own motion names another one.
    """
    if not spec.exploration:
        return own
    robot, motors, thermal = body
    of = [own, REHEARSAL_VERSION, EXERCISE_VERSION, asdict(spec), asdict(robot)]
    digest = hashlib.sha256(msgspec.json.encode(of if drawn is None else [*of, drawn]))
    for value in (*vars(motors).values(), *vars(thermal).values()):
        digest.update(np.asarray(value, dtype=float).tobytes())
    return digest.hexdigest()[: len(own)]


def trained(records: list[Array], config: TwinConfig, seed: np.random.SeedSequence, *, arm: str, folder: Path) -> Twin:
    """The twin of these records: from the folder while all it depends on is unchanged, else trained and kept there."""
    home = folder / "twins" / training_key(records, config, seed)
    kept = _stored(home)
    if kept is None:
        save(train(records, config, seed, arm=arm), home)
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
