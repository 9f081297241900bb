"""Randomisation of shifts beyond what a scenario draws: its ambient temperature, its arrivals, its fleet."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from sys import float_info
from typing import Any, NamedTuple

import numpy as np

from fleet.errors import ScenarioError
from fleet.seeding import child
from scenarios.spec.parse import override, plain_values
from scenarios.spec.schema import Ambient, Scenario

MOST_ARRIVALS = 100.0
"""Largest factor on the rate of arrivals, which bounds the memory of the queue."""


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Ranges from which each shift is sampled."""

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
            if not (numbers and len(given) == 2 and -float_info.max <= given[0] <= given[1] <= float_info.max):
                raise ValueError(f"Randomisation.{name} must be two finite numbers, low <= high (got {given!r}).")
            object.__setattr__(self, name, (float(given[0]), float(given[1])))
        if not 0 < self.arrivals[0] <= self.arrivals[1] <= MOST_ARRIVALS:
            raise ValueError(f"Randomisation.arrivals must be > 0 and at most {MOST_ARRIVALS:g} (got {self.arrivals}).")
        if not isinstance(self.variants, list | tuple) or not all(isinstance(v, Mapping) for v in self.variants):
            raise ValueError(
                f"Randomisation.variants must be a list of dictionaries, one for each fleet (got {self.variants!r})."
            )
        try:
            object.__setattr__(self, "variants", tuple(plain_values(variant) for variant in self.variants))
        except TypeError as error:
            raise ValueError(f"Randomisation.variants: {error}.") from error

    def __bool__(self) -> bool:
        """Whether anything is randomised."""
        return self != _NOTHING

    def __hash__(self) -> int:
        return hash((self.ambient_k, self.arrivals, repr(self.variants)))

    @property
    def text(self) -> str:
        """What is randomised, in words."""
        default, parts = _NOTHING, list[str]()
        if self.ambient_k != default.ambient_k:
            parts.append("ambient temperature {:+g} to {:+g} K".format(*self.ambient_k))
        if self.arrivals != default.arrivals:
            parts.append("arrival rate times {:g} to {:g}".format(*self.arrivals))
        if self.variants:
            parts.append(f"one of {1 + len(self.variants)} fleets")
        return ", ".join(parts) or "none"

    def scenarios_of(self, scenario: Scenario) -> tuple[Scenario, ...]:
        """The scenario and its variants.

        Raises:
            ScenarioError: a variant with other arms or jobs, or an ambient temperature out of bounds.
        """
        all_of_them = (scenario, *(override(scenario, **variant) for variant in self.variants))
        for each in all_of_them:
            self._check_ambient(each)
            for what, one, two in (
                ("slots", scenario.slots, each.slots),
                ("decisions", scenario.decisions, each.decisions),
                ("jobs", scenario.jobs, each.jobs),
                ("names of arms", [arm.name for arm in scenario.arms], [arm.name for arm in each.arms]),
            ):
                if one != two:
                    raise ScenarioError(f"{each.name}: a variant must keep the {what} of its scenario.")
        return all_of_them

    def sample(self, seed: np.random.SeedSequence, fleets: int) -> "ShiftConditions":
        """The conditions of the shift of a seed, among a number of fleets."""
        if fleets == 1 and not self:
            return ShiftConditions(0, 0.0, 1.0)
        rng = np.random.default_rng(child(seed, 2))
        warmer_k, rate = rng.uniform(*self.ambient_k), rng.uniform(*self.arrivals)
        return ShiftConditions(int(rng.integers(fleets)), float(warmer_k), float(rate))

    def _check_ambient(self, scenario: Scenario) -> None:
        for warmer_k in self.ambient_k:
            try:
                Ambient(points=tuple((time_s, air_c + warmer_k) for time_s, air_c in scenario.ambient.points))
            except ValueError as error:
                raise ScenarioError(
                    f"{scenario.name}: Randomisation.ambient_k {self.ambient_k} goes too far: {error}."
                ) from error


_NOTHING = Randomisation()


def randomisation_of(given: object) -> Randomisation:
    """The randomisation that was given; None is one that changes nothing.

    Raises:
        ScenarioError: something else was given.
    """
    if not isinstance(given, Randomisation | None):
        raise ScenarioError(f"randomise must be a scenarios.prepare.randomisation.Randomisation (got {given!r}).")
    return given or _NOTHING


class ShiftConditions(NamedTuple):
    """What is sampled for one shift besides its jobs."""

    fleet: int
    """0: the scenario's own; others: the variants."""
    ambient_k: float
    """Added to the ambient temperature of the cell."""
    arrivals: float
    """Factor on the rate of arrivals."""
