"""Scenarios for the batched environment: fleets planned and scored once, shifts drawn as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from fleet.env.engine import Shift
from fleet.env.vector import BatchEnv, Library
from fleet.errors import ScenarioError
from fleet.job import Job
from fleet.seeds import child
from fleet.sim.tables import stacked, tables_of
from scenarios.build import DifficultyName, Fleet, Progress, chosen_of, prepare, quiet, world_of
from scenarios.cell import near_of
from scenarios.draw import QuickSource, children_of
from scenarios.jobs import works_of
from scenarios.load import override
from scenarios.scenario import Ambient, Scenario

Array = np.ndarray


MOST_ARRIVALS = 100.0
"""So many times as often may jobs come, lest the queue outgrow the memory."""


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """How far the shifts of a batch differ beyond their jobs; each shift draws for itself."""

    ambient_k: tuple[float, float] = (0.0, 0.0)
    """The air of the cell is warmer by something between these, K."""
    arrivals: tuple[float, float] = (1.0, 1.0)
    """Jobs of a stream come so many times as often; a trace stays as it is."""
    variants: Sequence[Mapping[str, Any]] = ()
    """Fleets to choose from besides the scenario's own, as overrides of its top-level fields: `arms` with other
    mounts, wear or cooling, `spread` with another seed. Each is planned and scored once."""

    def __post_init__(self) -> None:
        for name in ("ambient_k", "arrivals"):
            try:
                low, high = getattr(self, name)
            except (TypeError, ValueError) as error:
                raise ValueError(f"Randomisation.{name} must be (low, high) (got {getattr(self, name)!r}).") from error
            if not all(isinstance(end, int | float | np.integer | np.floating) for end in (low, high)):
                raise ValueError(f"Randomisation.{name} must be two numbers (got {low!r}, {high!r}).")
            if not low <= high:
                raise ValueError(f"Randomisation.{name} needs low <= high (got {low}, {high}).")
            if not (isfinite(low) and isfinite(high)):
                raise ValueError(f"Randomisation.{name} must be finite (got {low}, {high}).")
        if self.arrivals[0] <= 0:
            raise ValueError(f"Randomisation.arrivals must be > 0 (got {self.arrivals}).")
        if self.arrivals[1] > MOST_ARRIVALS:
            raise ValueError(f"Randomisation.arrivals must be at most {MOST_ARRIVALS:g} (got {self.arrivals}).")
        if not isinstance(self.variants, list | tuple) or not all(isinstance(v, Mapping) for v in self.variants):
            raise ValueError(
                f"Randomisation.variants must be a list of dictionaries, one for each fleet (got {self.variants!r})."
            )


_SINGLE = frozenset({"plant", "bus", "channel", "render_mode", "mask_in"})
"""What the single env takes beside the overrides, and a batch does not."""


def make_batch(
    scenario: str | Path | Scenario,
    num_envs: int,
    seed: int | Sequence[int] | None = None,
    *,
    difficulty: DifficultyName = "twin",
    randomise: Randomisation | None = None,
    cache: str | Path | None = None,
    max_cycles: int | None = None,
    autoreset: bool = True,
    stagger: bool = False,
    peers: int | None = None,
    progress: Progress = quiet,
    **overrides: Any,
) -> BatchEnv:
    """The batched environment of a scenario: `num_envs` shifts side by side in one process and one thread.

    Args:
        scenario, difficulty, cache, peers, overrides: As in `make_env`.
        seed: Env e begins the shift of `seed + e` (or of `seed[e]`): that of `make_env(…).reset(seed=…)`.
        randomise: Beyond what a scenario draws: air, arrivals, fleets.
        max_cycles, autoreset, stagger: As in `fleet.env.vector.BatchEnv`.

    Raises:
        ScenarioError: a variant that is no fleet of the same arms and jobs, or an option that only `make_env` has.
    """
    if single := sorted(_SINGLE & set(overrides)):
        raise ScenarioError(f"make_batch() takes no {single[0]}; only make_env() does.")
    if not isinstance(randomise, Randomisation | None):
        raise ScenarioError(f"randomise must be a scenarios.batch.Randomisation (got {randomise!r}).")
    chosen = chosen_of(scenario, overrides, make_batch)
    randomise, near = randomise or Randomisation(), near_of(chosen, peers)
    specs = [chosen, *(override(chosen, **variant) for variant in randomise.variants)]
    for spec in specs:
        _check_air(spec, randomise)
    fleets = [
        prepare(
            spec, difficulty=difficulty, cache=cache, progress=lambda what, s, i=i: progress(what, (i + s) / len(specs))
        )
        for i, spec in enumerate(specs)
    ]
    library = replace(library_of(fleets, randomise), near=near)
    options = {"max_cycles": max_cycles, "autoreset": autoreset, "stagger": stagger}
    return BatchEnv(library, num_envs, seed=seed, weights=chosen.reward, **options)


def _check_air(scenario: Scenario, randomise: Randomisation) -> None:
    for warmer_k in randomise.ambient_k:
        try:
            Ambient(points=tuple((time_s, air_c + warmer_k) for time_s, air_c in scenario.ambient.points))
        except ValueError as error:
            raise ScenarioError(
                f"{scenario.name}: Randomisation.ambient_k {randomise.ambient_k} goes too far: {error}."
            ) from error


def library_of(fleets: Sequence[Fleet], randomise: Randomisation | None = None) -> Library:
    """What the shifts of one fleet, or of several with the same arms and jobs, are drawn from.

    Raises:
        ScenarioError: they are not of the same arms and jobs.
    """
    scenario = fleets[0].scenario
    tables = []
    for fleet in fleets:
        other = fleet.scenario
        for what, one, two in (
            ("slots", scenario.slots, other.slots),
            ("jobs", scenario.jobs, other.jobs),
            ("names of arms", [arm.name for arm in scenario.arms], [arm.name for arm in other.arms]),
        ):
            if one != two:
                raise ScenarioError(f"{other.name}: a variant must keep the {what} of its scenario.")
        world, _ = world_of(fleet, _kinds(other))
        tables.append(tables_of(world)[0])
    try:
        table = stacked(tables)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    names = tuple(arm.name for arm in scenario.arms)
    return Library(names, scenario.slots, table, _Draw(scenario, len(fleets), randomise or Randomisation()))


def _kinds(scenario: Scenario) -> list[Job]:
    """One job of every kind that a scenario's streams can ask for: each work, each number of repetitions."""
    return [
        Job(name=f"{stream.name}/{p}/{repetitions}", work=work, repetitions=repetitions, release_s=0.0, due_s=0.0,
            value=stream.value)
        for stream in scenario.jobs
        for p, work in enumerate(works_of(scenario, stream))
        for repetitions in range(stream.repetitions[0], stream.repetitions[1] + 1)
    ]  # fmt: skip


_SENSORS = np.array([[1]])
"""The second child of a shift's seed is its sensors'; see `scenarios.build.children`."""


class _Draw:
    """Draws the shift of a seed: the same jobs as `ShiftFactory` makes of it, as arrays."""

    def __init__(self, scenario: Scenario, lots: int, randomise: Randomisation) -> None:
        self._lots, self._randomise = lots, randomise
        self._wild = lots > 1 or randomise != Randomisation()
        self._source = QuickSource(scenario)
        self._first = np.cumsum([0, *self._source.spans.prod(axis=1)])[:-1]
        """Where the kinds of each stream begin; see `_kinds`."""
        self._due_s = np.array([stream.due_s for stream in scenario.jobs], dtype=float)

    def __call__(self, seed: np.random.SeedSequence) -> Shift:
        lot, air_k, often = self._varied(seed) if self._wild else (0, 0.0, 1.0)
        source, drawn = self._source, self._source.draw(seed, often)
        stream = drawn.stream
        return Shift(
            lot=lot,
            air_k=air_k,
            kind=self._first[stream] + drawn.payload * source.spans[stream, 1] + drawn.more,
            release_s=drawn.release_s,
            due_s=drawn.release_s + self._due_s[stream],
            repetitions=source.lowest[stream] + drawn.more,
            after=drawn.after,
            key=children_of(seed, _SENSORS)[0][0],
        )

    def _varied(self, seed: np.random.SeedSequence) -> tuple[int, float, float]:
        """Fleet, warmer air in K, and how many times as often jobs come."""
        rng = np.random.default_rng(child(seed, 2))
        air_k, often = rng.uniform(*self._randomise.ambient_k), rng.uniform(*self._randomise.arrivals)
        return int(rng.integers(self._lots)), float(air_k), float(often)
