"""The axes on which the instances of a cell differ, and the scenario of a cell at given values."""

import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from fleet.bus.exchange.channel import Partition
from fleet.robot import ThermalLimits
from scenarios.parse import parse_scenario
from scenarios.schema import Ambient, ArrivalSpec, BusSpec, JobStream, Scenario, Spread, TwinSpec
from scenarios.suite.cells import SPREAD, Cell, layout
from scenarios.suite.trades import TRADES, Task

Heat = Literal["mild", "warm", "hot", "severe"]
Due = Literal["loose", "usual", "tight", "hard"]
Arriving = Literal["poisson", "batch", "trace", "rush"]
Precedence = Literal["none", "chain"]
Air = Literal["cool", "warm", "hot", "rising"]
Faults = Literal["attended", "unattended", "noisy"]
Bus = Literal["perfect", "late", "lossy", "ring", "cut"]


class Severity(NamedTuple):
    """What a heat severity asks of the arms, as time loads of the expected jobs (`scenarios.prepare.load_factor`)."""

    heating: float
    """Of the tasks that heat."""
    rest: float


SEVERITY: dict[Heat, Severity] = {
    "mild": Severity(0.4, 0.55),
    "warm": Severity(0.55, 0.55),
    "hot": Severity(0.75, 0.55),
    "severe": Severity(1.0, 0.55),
}
"""The thermal load factor that follows depends on cell and ambient temperature; `thermofleet show` tells it."""
LEAST_JOBS = 0.25
"""Fewest expected jobs of a stream and payload, so that every task occurs."""
DUE: dict[Due, float] = {"loose": 2.0, "usual": 1.0, "tight": 0.5, "hard": 0.75}
"""Factor on the due times of the tasks. hard: jobs that wait then expire."""
AIR_C: dict[Air, tuple[float, float]] = {
    "cool": (22.0, 22.0),
    "warm": (26.0, 26.0),
    "hot": (30.0, 30.0),
    "rising": (22.0, 31.0),
}
"""Ambient temperature at the beginning and, after two thirds of the shift, at the end, °C."""
PAST_AIR_C = (22.0, 31.0)
"""In the arms' past jobs, the same for all instances of a cell."""
LIMITS = ThermalLimits(warning_c=52.0, error_c=59.0, restart_c=43.0)
"""Lower than usual, as users set them where people work beside the arms: heat then decides within an hour."""
UNATTENDED_S = 2400.0
"""unattended: time until somebody clears a fault of an arm that is cool again, and moves it home."""
NOISE_K = 2.0
"""noisy: standard deviation of the temperature readings of every second arm."""
BATCHES_S = 1500.0
"""batch: about the time between two batches."""
RUSH, RUSH_SHARE = (0.35, 0.55), 0.5
"""rush: a share of all jobs arrives in this part of the shift."""
BUSES: dict[Bus, BusSpec] = {
    "perfect": BusSpec(),
    "late": BusSpec(delay_s=20.0, jitter_s=20.0),
    "lossy": BusSpec(loss=0.6),
    "ring": BusSpec(topology="ring", delay_s=10.0),
    "cut": BusSpec(),
}
"""cut: besides, the fleet falls into two halves in the middle third of the shift."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Where an instance lies on the axes of its cell."""

    heat: Heat
    due: Due
    arrivals: Arriving
    precedence: Precedence
    air: Air
    faults: Faults
    bus: Bus


OFTEN = {"faults": "attended", "bus": "perfect"}
"""Values that half of all instances have; all others are equally frequent."""


def draw_axes(rng: np.random.Generator) -> Axes:
    """Values drawn independently of each other."""
    values: dict[str, Any] = {}  # literals of several types
    for name, kind in get_type_hints(Axes).items():
        choices = list(get_args(kind))
        weights = np.array([len(choices) - 1.0 if choice == OFTEN.get(name) else 1.0 for choice in choices])
        values[name] = choices[int(rng.choice(len(choices), p=weights / weights.sum()))]
    return Axes(**values)


@cache
def time_loads() -> dict[str, tuple[float, float]]:
    """By cell, time load of one job of each stream and payload in a shift: of the tasks that heat, and of the others.

    As `scenarios.suite.freeze` computed them.
    """
    text = resources.files("scenarios").joinpath("suite/time_loads.json").read_text(encoding="utf-8")
    return json.loads(text)


def expected_jobs(cell: Cell, heat: Heat) -> tuple[float, float]:
    """Expected jobs of each stream and payload in a shift: of the tasks that heat, and of the others."""
    heating, rest = (wanted / one for wanted, one in zip(SEVERITY[heat], time_loads()[cell.name], strict=True))
    return max(LEAST_JOBS, heating), max(LEAST_JOBS, rest)


def scenario_of(name: str, cell: Cell, axes: Axes, seed: int, jobs: tuple[float, float] | None = None) -> Scenario:
    """The scenario of a cell at these values, checked like a file.

    Args:
        seed: Of what a trace draws.
        jobs: Expected jobs of each stream and payload, see `expected_jobs`; default: those.
    """
    horizon_s = 3600.0 * cell.hours
    hot, rest = jobs or expected_jobs(cell, axes.heat)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    streams: list[JobStream] = []
    for group in range(len(layout(cell).groups)):
        for task in TRADES[cell.trade]:
            expected = (hot if task.heats else rest) * len(task.payload_kg)
            streams += _streams(cell, axes, group, task, expected, rng)
    first_c, last_c = AIR_C[axes.air]
    points = ((0.0, first_c),) if first_c == last_c else ((0.0, first_c), (horizon_s * 2 / 3, last_c))
    limits = LIMITS
    if axes.faults == "unattended":
        limits = replace(limits, clear_s=UNATTENDED_S, move_home_s=UNATTENDED_S)
    arms = layout(cell).arms
    if axes.faults == "noisy":
        arms = tuple(replace(arm, sensor_noise_k=NOISE_K) if i % 2 else arm for i, arm in enumerate(arms))
    scenario = Scenario(
        name=name,
        description=describe(cell, axes),
        horizon_s=horizon_s,
        arms=arms,
        places=layout(cell).places,
        jobs=tuple(streams),
        slots=cell.slots,
        ambient=Ambient(points=points),
        limits=limits,
        twin=TwinSpec(size="quick", exploration=32, air_c=PAST_AIR_C),
        spread=Spread(scale=SPREAD[cell.unlike], seed=cell.seed),
        bus=_bus(axes.bus, [arm.name for arm in arms], horizon_s),
    )  # fmt: skip
    return parse_scenario(msgspec.to_builtins(scenario), Path(f"{name}.toml"))


def describe(cell: Cell, axes: Axes) -> str:
    """A sentence about an instance."""
    values = ", ".join(f"{name} {value}" for name, value in asdict(axes).items())
    return f"{cell.trade.replace('_', ' ')} by {cell.arms} {cell.unlike} arms ({cell.layout}): {values}."


def _bus(quality: Bus, arms: list[str], horizon_s: float) -> BusSpec:
    spec = BUSES[quality]
    if quality != "cut":
        return spec
    half = tuple(arms[: len(arms) // 2])
    return replace(spec, partitions=(Partition(horizon_s / 3, horizon_s * 2 / 3, (half,)),))


def _streams(
    cell: Cell, axes: Axes, group: int, task: Task, expected: float, rng: np.random.Generator
) -> list[JobStream]:
    """The stream of a task at a group of stations; with a rush, a second one for it."""
    spots = {place.name[0]: place.name for place in layout(cell).groups[group]}
    horizon_s = 3600.0 * cell.hours
    stream = JobStream(
        name=f"{task.name}_{group:02d}",
        kind=task.kind,
        places=tuple(spots.get(letter, spots["b"]) for letter in task.at),
        payload_kg=task.payload_kg,
        repetitions=task.repetitions,
        dwell_s=task.dwell_s,
        force_n=task.force_n,
        value=task.value,
        due_s=task.due_s * DUE[axes.due],
        due="hard" if axes.due == "hard" else "soft",
        after=(f"{task.after}_{group:02d}",) if task.after and axes.precedence == "chain" else (),
        arrivals=_arrivals(axes.arrivals, expected, horizon_s, rng),
    )
    if axes.arrivals != "rush":
        return [stream]
    begin_s, end_s = (share * horizon_s for share in RUSH)
    every_s = round((end_s - begin_s) / (RUSH_SHARE * expected), 3)
    window = ArrivalSpec(kind="poisson", every_s=every_s, start_s=begin_s, stop_s=end_s)
    after = tuple(f"rush_{name}" for name in stream.after)
    return [stream, replace(stream, name=f"rush_{stream.name}", arrivals=window, after=after)]


def _arrivals(kind: Arriving, expected: float, horizon_s: float, rng: np.random.Generator) -> ArrivalSpec:
    """Arrivals of about `expected` jobs in a shift, or of what is not in the rush."""
    match kind:
        case "batch":
            count = max(1, round(expected * BATCHES_S / horizon_s))
            every_s = round(horizon_s * count / expected, 3)
            return ArrivalSpec(
                kind="batch", count=count, every_s=every_s, start_s=round(every_s * float(rng.random()) ** 2, 3)
            )
        case "trace":
            return ArrivalSpec(kind="trace", times_s=_trace(int(rng.poisson(expected)), horizon_s, rng))
        case "poisson" | "rush":
            share = 1.0 if kind == "poisson" else 1.0 - RUSH_SHARE
            return ArrivalSpec(kind="poisson", every_s=round(horizon_s / (share * expected), 3))


def _trace(count: int, horizon_s: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Times of a shift with two busy spells and a break between them, s."""
    spells = ((0.2, 0.12), (0.65, 0.12))
    means, deviations = np.array(spells)[rng.integers(2, size=count)].T if count else (np.zeros(0), np.zeros(0))
    shares = np.clip(means + deviations * rng.standard_normal(count), 0.0, 0.95)
    return tuple(round(float(time), 1) for time in np.sort(shares) * horizon_s)
