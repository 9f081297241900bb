"""Scenarios for the batched environment: fleets planned and scored once, shifts sampled as arrays."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fleet.engine.tables import stack_tables
from fleet.env.vector import BatchEnv, Library
from fleet.errors import ScenarioError
from scenarios.cell_layout import near_of
from scenarios.prepare.fleet import Fleet, ShiftFactory, prepare
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, check_progress, quiet
from scenarios.spec.jobs import weights_of
from scenarios.spec.load import scenario_with
from scenarios.spec.options import RISK, DifficultyName, RiskName
from scenarios.spec.schema import Scenario

_SINGLE = frozenset({"plant", "bus", "channel", "render_mode", "mask_in"})
"""Options of `make_env` that a batch does not have."""


def make_batch(
    scenario: str | Path | Scenario,
    num_envs: int,
    seed: int | Sequence[int] | None = None,
    *,
    difficulty: DifficultyName = "twin",
    risk: RiskName = RISK,
    randomise: Randomisation | None = None,
    cache: str | Path | None = None,
    max_cycles: int | None = None,
    autoreset: bool = True,
    stagger: bool = False,
    peers: int | None = None,
    scaled: bool = True,
    ahead_s: float = 0.0,
    bids: bool = False,
    threads: int = 1,
    progress: Progress = quiet,
    **overrides: Any,  # one type per field
) -> BatchEnv:
    """The batched environment of a scenario: `num_envs` shifts side by side in one process.

    Args:
        scenario, difficulty, risk, cache, peers, scaled, ahead_s, bids, overrides: As in `make_env`.
        seed: Env e begins the shift of `seed + e` (or of `seed[e]`): that of `make_env(…).reset(seed=…)`.
        randomise: In addition to what a scenario samples: ambient temperature, arrivals, fleets.
        max_cycles, autoreset, stagger, threads: As in `fleet.env.vector.BatchEnv`.

    Raises:
        ScenarioError: a variant that is no fleet of the same arms and jobs, or an option that only `make_env` has.
    """
    if single := sorted(_SINGLE & set(overrides)):
        raise ScenarioError(f"make_batch() takes no {single[0]}; only make_env() does.")
    check_progress(progress)
    chosen = scenario_with(scenario, overrides, make_batch)
    near = near_of(chosen, peers)
    fleet = prepare(chosen, difficulty=difficulty, risk=risk, randomise=randomise, cache=cache, progress=progress)
    library = replace(library_of(fleet), near=near)
    options = {"max_cycles": max_cycles, "autoreset": autoreset, "stagger": stagger, "threads": threads}
    options |= {"scaled": scaled, "ahead_s": ahead_s, "bids": bids}
    return BatchEnv(library, num_envs, seed=seed, weights=weights_of(chosen), decisions=chosen.decisions, **options)


def library_of(fleet: Fleet) -> Library:
    """A fleet with its variants, and a sampler of their shifts.

    Raises:
        ScenarioError: the tables of a variant do not fit those of the fleet.
    """
    factory = ShiftFactory(fleet)
    try:
        tables = stack_tables([world.tables for world in factory.worlds])
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    return Library(factory.worlds[0].arms, fleet.scenario.slots, tables, factory.draw)
