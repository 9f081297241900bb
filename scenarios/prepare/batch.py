"""Scenarios for the batched environment: fleets planned and scored once, shifts sampled as arrays."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fleet.engine.batch import Shift
from fleet.engine.tables import stack_tables, tables_of
from fleet.env.vector import BatchEnv, Library
from fleet.errors import ScenarioError
from fleet.job import Job
from fleet.seeding import key_of, shift_seeds
from scenarios.cell_layout import near_of
from scenarios.prepare.fleet import Fleet, prepare, world_of
from scenarios.prepare.randomisation import Randomisation
from scenarios.progress import Progress, check_progress, quiet
from scenarios.spec.calendar import absences_of
from scenarios.spec.jobs import JobSampler, alternatives_of, weights_of
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
    bids: bool = False,
    threads: int = 1,
    progress: Progress = quiet,
    **overrides: Any,  # one type per field
) -> BatchEnv:
    """The batched environment of a scenario: `num_envs` shifts side by side in one process.

    Args:
        scenario, difficulty, risk, cache, peers, bids, overrides: As in `make_env`.
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
    options = {"max_cycles": max_cycles, "autoreset": autoreset, "stagger": stagger, "threads": threads, "bids": bids}
    return BatchEnv(library, num_envs, seed=seed, weights=weights_of(chosen), decisions=chosen.decisions, **options)


def library_of(fleet: Fleet) -> Library:
    """A fleet with its variants, and a sampler of their shifts.

    Raises:
        ScenarioError: the tables of a variant do not fit those of the fleet.
    """
    tables = [tables_of(world_of(each, _kinds(each.scenario))[0])[0] for each in fleet.all]
    try:
        table = stack_tables(tables)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    names = tuple(arm.name for arm in fleet.scenario.arms)
    return Library(names, fleet.scenario.slots, table, _ShiftSampler(fleet))


def _kinds(scenario: Scenario) -> list[Job]:
    """One job of every kind in a scenario's streams: each payload, each number of repetitions."""
    return [
        Job(name=f"{stream.name}/{p}/{repetitions}", work=work, alternatives=others, repetitions=repetitions,
            release_s=0.0, due_s=0.0, value=stream.value)
        for stream in scenario.jobs
        for p, payload_kg in enumerate(stream.payload_kg)
        for work, *rest in [alternatives_of(scenario, stream, payload_kg)]
        for others in [tuple(rest)]
        for repetitions in range(stream.repetitions[0], stream.repetitions[1] + 1)
    ]  # fmt: skip


class _ShiftSampler:
    """Samples the shift of a seed as arrays: the shift that `ShiftFactory` makes of it."""

    def __init__(self, fleet: Fleet) -> None:
        scenario, self._fleet = fleet.scenario, fleet
        self._jobs = JobSampler(scenario)
        self._first_kind = np.cumsum([0, *self._jobs.choices.prod(axis=1)])[:-1]
        """Where the kinds of each stream begin; see `_kinds`."""
        self._expires = np.array([stream.due == "hard" for stream in scenario.jobs])
        self._due_s = np.array([stream.due_s for stream in scenario.jobs], dtype=float)

    def __call__(self, seed: np.random.SeedSequence) -> Shift:
        conditions = self._fleet.conditions(seed)
        jobs_seed, sensor_seed = shift_seeds(seed)
        sampler, jobs = self._jobs, self._jobs.sample(jobs_seed, conditions.arrivals)
        stream = jobs.stream
        return Shift(
            fleet=conditions.fleet,
            ambient_offset_k=conditions.ambient_k,
            kind=self._first_kind[stream] + jobs.payload * sampler.choices[stream, 1] + jobs.extra,
            release_s=jobs.release_s,
            due_s=jobs.release_s + self._due_s[stream],
            repetitions=sampler.fewest[stream] + jobs.extra,
            expires=self._expires[stream],
            after=jobs.after,
            noise_key=key_of(sensor_seed),
            absences=absences_of(self._fleet.all[conditions.fleet].scenario, seed),
        )
