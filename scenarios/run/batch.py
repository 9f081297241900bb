"""Scenarios for the batched environment: fleets planned and scored once, shifts drawn as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from fleet.engine.batch import Shift
from fleet.engine.tables import stack_tables, tables_of
from fleet.env.vector import BatchEnv, Library
from fleet.errors import ScenarioError
from fleet.job import Job
from fleet.seeding import child, key_of, shift_seeds
from scenarios.cell_layout import near_of
from scenarios.fault_price import weights_of
from scenarios.job_stream import JobSampler, works_of
from scenarios.load import override
from scenarios.prepare.fleet import RISK, DifficultyName, Fleet, RiskName, prepare, scenario_with, world_of
from scenarios.progress import Progress, check_progress, quiet
from scenarios.schema import Ambient, Scenario

Array = np.ndarray


MOST_ARRIVALS = 100.0
"""Largest factor on the rate of arrivals, which bounds the memory of the queue."""


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Ranges from which each shift of a batch is drawn."""

    ambient_k: tuple[float, float] = (0.0, 0.0)
    """Added to the ambient temperature of the cell, K."""
    arrivals: tuple[float, float] = (1.0, 1.0)
    """Factor on the rates of Poisson streams and repeated batches."""
    variants: Sequence[Mapping[str, Any]] = ()
    """Fleets to choose from besides the scenario's own, as overrides of its top-level fields: `arms` with other
    mounts, wear or cooling, `spread` with another seed. Each is planned and scored once."""

    def __post_init__(self) -> None:
        for name in ("ambient_k", "arrivals"):
            given = getattr(self, name)
            numbers = isinstance(given, tuple | list) and all(isinstance(end, Real) for end in given)
            if not (numbers and len(given) == 2 and -inf < given[0] <= given[1] < inf):
                raise ValueError(f"Randomisation.{name} must be two finite numbers, low <= high (got {given!r}).")
        if not 0 < self.arrivals[0] <= self.arrivals[1] <= MOST_ARRIVALS:
            raise ValueError(f"Randomisation.arrivals must be > 0 and at most {MOST_ARRIVALS:g} (got {self.arrivals}).")
        if not isinstance(self.variants, list | tuple) or not all(isinstance(v, Mapping) for v in self.variants):
            raise ValueError(
                f"Randomisation.variants must be a list of dictionaries, one for each fleet (got {self.variants!r})."
            )


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
    threads: int = 1,
    progress: Progress = quiet,
    **overrides: Any,  # one type per field
) -> BatchEnv:
    """The batched environment of a scenario: `num_envs` shifts side by side in one process.

    Args:
        scenario, difficulty, risk, cache, peers, overrides: As in `make_env`.
        seed: Env e begins the shift of `seed + e` (or of `seed[e]`): that of `make_env(…).reset(seed=…)`.
        randomise: Beyond what a scenario draws: ambient temperature, arrivals, fleets.
        max_cycles, autoreset, stagger, threads: As in `fleet.env.vector.BatchEnv`.

    Raises:
        ScenarioError: a variant that is no fleet of the same arms and jobs, or an option that only `make_env` has.
    """
    if single := sorted(_SINGLE & set(overrides)):
        raise ScenarioError(f"make_batch() takes no {single[0]}; only make_env() does.")
    if not isinstance(randomise, Randomisation | None):
        raise ScenarioError(f"randomise must be a scenarios.run.batch.Randomisation (got {randomise!r}).")
    check_progress(progress)
    chosen = scenario_with(scenario, overrides, make_batch)
    randomise, near = randomise or Randomisation(), near_of(chosen, peers)
    specs = [chosen, *(override(chosen, **variant) for variant in randomise.variants)]
    for spec in specs:
        _check_ambient(spec, randomise)
    fleets = [
        prepare(
            spec,
            difficulty=difficulty,
            risk=risk,
            cache=cache,
            progress=lambda what, s, i=i: progress(what, (i + s) / len(specs)),
        )
        for i, spec in enumerate(specs)
    ]
    library = replace(library_of(fleets, randomise), near=near)
    options = {"max_cycles": max_cycles, "autoreset": autoreset, "stagger": stagger, "threads": threads}
    return BatchEnv(library, num_envs, seed=seed, weights=weights_of(chosen), decisions=chosen.decisions, **options)


def _check_ambient(scenario: Scenario, randomise: Randomisation) -> None:
    for warmer_k in randomise.ambient_k:
        try:
            Ambient(points=tuple((time_s, air_c + warmer_k) for time_s, air_c in scenario.ambient.points))
        except ValueError as error:
            raise ScenarioError(
                f"{scenario.name}: Randomisation.ambient_k {randomise.ambient_k} goes too far: {error}."
            ) from error


def library_of(fleets: Sequence[Fleet], randomise: Randomisation | None = None) -> Library:
    """Fleets with the same arms and jobs, and a sampler of their shifts.

    Raises:
        ScenarioError: they are not of the same arms and jobs.
    """
    scenario = fleets[0].scenario
    tables = []
    for fleet in fleets:
        other = fleet.scenario
        for what, one, two in (
            ("slots", scenario.slots, other.slots),
            ("decisions", scenario.decisions, other.decisions),
            ("jobs", scenario.jobs, other.jobs),
            ("names of arms", [arm.name for arm in scenario.arms], [arm.name for arm in other.arms]),
        ):
            if one != two:
                raise ScenarioError(f"{other.name}: a variant must keep the {what} of its scenario.")
        world, _ = world_of(fleet, _kinds(other))
        tables.append(tables_of(world)[0])
    try:
        table = stack_tables(tables)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    names = tuple(arm.name for arm in scenario.arms)
    return Library(names, scenario.slots, table, _ShiftSampler(scenario, len(fleets), randomise or Randomisation()))


def _kinds(scenario: Scenario) -> list[Job]:
    """One job of every kind in a scenario's streams: each work, each number of repetitions."""
    return [
        Job(name=f"{stream.name}/{p}/{repetitions}", work=work, repetitions=repetitions, release_s=0.0, due_s=0.0,
            value=stream.value)
        for stream in scenario.jobs
        for p, work in enumerate(works_of(scenario, stream))
        for repetitions in range(stream.repetitions[0], stream.repetitions[1] + 1)
    ]  # fmt: skip


class _ShiftSampler:
    """Draws the shift of a seed as arrays: the shift that `ShiftFactory` makes of it."""

    def __init__(self, scenario: Scenario, fleets: int, randomise: Randomisation) -> None:
        self._fleets, self._randomise = fleets, randomise
        self._varies = fleets > 1 or randomise != Randomisation()
        self._jobs = JobSampler(scenario)
        self._first_kind = np.cumsum([0, *self._jobs.choices.prod(axis=1)])[:-1]
        """Where the kinds of each stream begin; see `_kinds`."""
        self._expires = np.array([stream.due == "hard" for stream in scenario.jobs])
        self._due_s = np.array([stream.due_s for stream in scenario.jobs], dtype=float)

    def __call__(self, seed: np.random.SeedSequence) -> Shift:
        fleet, warmer_k, rate = self._variation(seed) if self._varies else (0, 0.0, 1.0)
        jobs_seed, sensor_seed = shift_seeds(seed)
        sampler, jobs = self._jobs, self._jobs.sample(jobs_seed, rate)
        stream = jobs.stream
        return Shift(
            fleet=fleet,
            ambient_offset_k=warmer_k,
            kind=self._first_kind[stream] + jobs.payload * sampler.choices[stream, 1] + jobs.extra,
            release_s=jobs.release_s,
            due_s=jobs.release_s + self._due_s[stream],
            repetitions=sampler.fewest[stream] + jobs.extra,
            expires=self._expires[stream],
            after=jobs.after,
            noise_key=key_of(sensor_seed),
        )

    def _variation(self, seed: np.random.SeedSequence) -> tuple[int, float, float]:
        """Fleet, warmer ambient in K, and factor on the rate of arrivals."""
        rng = np.random.default_rng(child(seed, 2))
        warmer_k, rate = rng.uniform(*self._randomise.ambient_k), rng.uniform(*self._randomise.arrivals)
        return int(rng.integers(self._fleets)), float(warmer_k), float(rate)
