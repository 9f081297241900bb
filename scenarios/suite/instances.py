"""Instances of the suite: layouts of cells, tasks of real trades, cells, and the axes on which instances differ.

A *group* of stations lies between two neighbouring arms. Its station `a` is nearer to one, `b` to the other, `c` to
neither. The dimensions keep arms at home apart, and let each arm work in a group while its neighbour works in the next.

A cell determines all that is prepared: plans, space and twins. Many instances share a cell; no two splits do. Instances
of a cell differ in jobs, ambient temperature, faults and bus.
"""

import json
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from importlib import resources
from itertools import pairwise
from math import ceil, cos, degrees, pi, sin
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import msgspec
import numpy as np

from fleet.arrivals import Arrivals
from fleet.bus.exchange.channel import Partition
from fleet.job import DWELL_S, Kind, Place
from fleet.robot import ThermalLimits, rotation
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import (
    SPLITS,
    Ambient,
    ArmSpec,
    BusSpec,
    JobStream,
    Scenario,
    SplitName,
    Spread,
    TwinSpec,
)

LayoutName = Literal["bench", "line", "ring", "gantry", "wall_ceiling"]
HOME = "retract"
DIGITS = 4
MOST_IN_ROW = 16
APART_M = 2.6
"""Distance between two rows of a line, beyond the reach of the arms."""
SIDE_M = 0.15
"""Distance of the stations a and b from the middle of their group."""


@dataclass(frozen=True)
class CellLayout:
    """Mounted arms and groups of stations."""

    arms: tuple[ArmSpec, ...]
    groups: tuple[tuple[Place, ...], ...]
    """Stations of each group: a, b, and c if there are three."""

    @property
    def places(self) -> tuple[Place, ...]:
        """All stations."""
        return tuple(place for group in self.groups for place in group)


def layout_of(
    name: LayoutName, arms: int, stations: int = 2, *, pitch_m: float = 0.8, front_m: float = 0.4
) -> CellLayout:
    """The layout of this name.

    Args:
        arms: At least 2; a bench and a ring have at least 4, and a bench an even number.
        stations: In each group, 2 or 3.
        pitch_m: Distance between neighbours.
        front_m: Distance of the stations in front of the line between two neighbours.
    """
    return _LAYOUTS[name](arms, stations, pitch_m, front_m)


def _line(arms: int, stations: int, pitch_m: float, front_m: float) -> CellLayout:
    """Arms on the floor in rows; the stations are in front of them."""
    rows = ceil(arms / MOST_IN_ROW)
    lengths = [arms // rows + (row < arms % rows) for row in range(rows)]
    spots = [(x, APART_M * (row - (rows - 1) / 2)) for row, n in enumerate(lengths) for x in _along(n, pitch_m)]
    mounted = tuple(_arm(i, (x, y, 0.0), (0.0, 0.0, 90.0)) for i, (x, y) in enumerate(spots))
    middles = [((x + next_x) / 2, y + front_m) for (x, y), (next_x, next_y) in pairwise(spots) if y == next_y]
    return CellLayout(mounted, tuple(_group(i, at, 0.0, 0.25, stations) for i, at in enumerate(middles)))


def _bench(arms: int, stations: int, pitch_m: float, front_m: float) -> CellLayout:
    """Two rows of arms facing each other across a bench; each group has stations on both sides of its middle."""
    across_m, columns = front_m + 0.15, arms // 2
    mounted = [
        _arm(2 * i + row, (x, side * across_m, 0.0), (0.0, 0.0, -90.0 * side))
        for i, x in enumerate(_along(columns, pitch_m))
        for row, side in enumerate((-1.0, 1.0))
    ]
    groups = [
        _group(2 * i + row, ((x + next_x) / 2, side * 0.15), 0.0, 0.25, stations)
        for i, (x, next_x) in enumerate(pairwise(_along(columns, pitch_m)))
        for row, side in enumerate((-1.0, 1.0))
    ]
    return CellLayout(tuple(mounted), tuple(groups))


def _ring(arms: int, stations: int, pitch_m: float, front_m: float) -> CellLayout:
    """Arms in a circle, facing outwards; the stations are around it."""
    radius_m = pitch_m / 2 / sin(pi / arms)
    around = [2 * pi * i / arms for i in range(arms)]
    bases = [(radius_m * cos(a), radius_m * sin(a), 0.0) for a in around]
    mounted = [_arm(i, base, (0.0, 0.0, degrees(a))) for i, (base, a) in enumerate(zip(bases, around, strict=True))]
    out_m = radius_m * cos(pi / arms) + front_m
    between = [a + pi / arms for a in around]
    groups = [_group(i, (out_m * cos(a), out_m * sin(a)), a - pi / 2, 0.25, stations) for i, a in enumerate(between)]
    return CellLayout(tuple(mounted), tuple(groups))


def _gantry(arms: int, stations: int, pitch_m: float, front_m: float) -> CellLayout:
    """Arms hanging from a beam in a row; the stations are below, in front of it."""
    along = _along(arms, pitch_m)
    mounted = tuple(_arm(i, (x, 0.0, 1.2), (180.0, 0.0, 90.0)) for i, x in enumerate(along))
    middles = [((x + next_x) / 2, front_m - 0.08) for x, next_x in pairwise(along)]
    return CellLayout(mounted, tuple(_group(i, at, 0.0, 0.45, stations) for i, at in enumerate(middles)))


def _wall_ceiling(arms: int, stations: int, pitch_m: float, front_m: float) -> CellLayout:
    """Arms alternately on a wall and on the ceiling; the stations are between wall and beam."""
    wall, ceiling = ((1.0, 0.5), (90.0, 0.0, 0.0)), ((0.1, 1.2), (180.0, 0.0, 90.0))
    along = _along(arms, pitch_m)
    mounts = [(x, *(wall, ceiling)[i % 2]) for i, x in enumerate(along)]
    mounted = tuple(_arm(i, (x, y, z), tilt) for i, (x, (y, z), tilt) in enumerate(mounts))
    middles = [((x + next_x) / 2, front_m) for x, next_x in pairwise(along)]
    return CellLayout(mounted, tuple(_group(i, at, 0.0, 0.45, stations) for i, at in enumerate(middles)))


_LAYOUTS: dict[LayoutName, Callable[[int, int, float, float], CellLayout]] = {
    "bench": _bench,
    "line": _line,
    "ring": _ring,
    "gantry": _gantry,
    "wall_ceiling": _wall_ceiling,
}


def _along(arms: int, pitch_m: float) -> list[float]:
    """Coordinates of a row of arms, centred at 0, m."""
    return [(i - (arms - 1) / 2) * pitch_m for i in range(arms)]


def _arm(number: int, at: tuple[float, float, float], tilt: tuple[float, float, float]) -> ArmSpec:
    return ArmSpec(name=f"arm_{number:02d}", position_m=_rounded(*at), tilt_deg=_rounded(*tilt), home=HOME)


def _group(number: int, middle: tuple[float, float], turn: float, height_m: float, stations: int) -> tuple[Place, ...]:
    """The stations around a middle; `turn` is the direction from a to b, rad."""
    turned = rotation((0.0, 0.0, degrees(turn)))
    spots = ((-SIDE_M, 0.0, 0.0), (SIDE_M, 0.0, 0.0), (0.0, 0.06, 0.1))[:stations]
    ends = [(middle[0], middle[1], height_m) + turned @ spot for spot in spots]
    return tuple(
        Place(name=f"{letter}_{number:02d}", position_m=_rounded(*map(float, end)))
        for letter, end in zip("abc", ends, strict=False)
    )


def _rounded(x: float, y: float, z: float) -> tuple[float, float, float]:
    return (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """One task type at a group of stations."""

    name: str
    kind: Kind
    at: tuple[Literal["a", "b", "c"], ...]
    """Stations of the group; c stands for b in a group of two."""
    payload_kg: tuple[float, ...] = (0.0,)
    repetitions: tuple[int, int]
    dwell_s: float = DWELL_S
    force_n: float = 0.0
    value: float
    due_s: float
    heats: bool = False
    """Whether the task loads a few joints for long; the share of such tasks grows with the heat severity."""
    after: str = ""
    """With precedence: the task whose job of the same number must be finished first."""


JUDGED = SPLITS[1:]
"""Splits whose results are reported."""
Unlike = Literal["alike", "usual", "mixed"]
SPREAD: dict[Unlike, float] = {"alike": 0.2, "usual": 0.7, "mixed": 0.7}
"""`spread.scale` of the arms."""


@dataclass(frozen=True, kw_only=True)
class SuiteCell:
    """A cell and the number of its instances."""

    name: str
    split: SplitName
    layout: LayoutName
    arms: int
    trade: str
    stations: int = 2
    """Number of stations in each group."""
    unlike: Unlike = "usual"
    """alike and usual: deviations by chance, small or as among Gen3 arms. mixed: besides, some arms are worn, some cool
    badly, one has a fan, and some carry less."""
    pitch_m: float = 0.8
    front_m: float = 0.4
    hours: float = 2.0
    slots: int = 24
    instances: int = 17
    seed: int = 0
    """Seed of the arms' deviations."""

    @property
    def stations_per_arm(self) -> float:
        """Number of stations divided by that of arms."""
        return len(layout(self).places) / self.arms


def _read_suite() -> tuple[dict[str, tuple[SuiteTask, ...]], tuple[SuiteCell, ...]]:
    """Tasks by trade, and cells."""
    content = tomllib.loads(resources.files("scenarios").joinpath("suite/cells.toml").read_text(encoding="utf-8"))
    cells = [
        each | {"split": split, "name": f"{each['layout']}_{each['arms']}_{each['trade']}"}
        for split, own in content["cells"].items()
        for each in own
    ]
    trades = msgspec.convert(content["trades"], dict[str, tuple[SuiteTask, ...]])
    return trades, msgspec.convert(cells, tuple[SuiteCell, ...])


TRADES, CELLS = _read_suite()


@lru_cache(maxsize=64)
def layout(cell: SuiteCell) -> CellLayout:
    """Arms and stations of a cell."""
    plain = layout_of(cell.layout, cell.arms, cell.stations, pitch_m=cell.pitch_m, front_m=cell.front_m)
    if cell.unlike != "mixed":
        return plain
    return replace(plain, arms=tuple(_altered(arm, i) for i, arm in enumerate(plain.arms)))


def _altered(arm: ArmSpec, number: int) -> ArmSpec:
    """The arm with the properties of its index in a mixed fleet: every eighth has a fan, and so on."""
    match number % 8:
        case 1 | 6:
            return replace(arm, wear=0.6)
        case 2 | 5:
            return replace(arm, cooling_factor=0.8)
        case 3:
            return replace(arm, cooling="forced_air")
        case 4:
            return replace(arm, payload_limit_kg=1.5)
        case _:
            return arm


Heat = Literal["mild", "warm", "hot", "severe"]
Due = Literal["loose", "usual", "tight", "hard"]
Arriving = Literal["poisson", "batch", "trace", "rush"]
Precedence = Literal["none", "chain"]
Air = Literal["cool", "warm", "hot", "rising"]
Faults = Literal["attended", "unattended", "noisy"]
Bus = Literal["perfect", "late", "lossy", "ring", "cut"]


SEVERITY: dict[Heat, tuple[float, float]] = {
    "mild": (0.4, 0.55),
    "warm": (0.55, 0.55),
    "hot": (0.75, 0.55),
    "severe": (1.0, 0.55),
}
"""Time loads (`scenarios.prepare.load_factor`) of the expected jobs that heat, and of the others. The resulting thermal
load factor depends on cell and ambient temperature; `thermofleet show` prints it."""
LEAST_JOBS = 0.25
"""Fewest expected jobs of a stream and payload, so that every task occurs."""
DUE: dict[Due, float] = {"loose": 2.0, "usual": 1.0, "tight": 0.5, "hard": 0.75}
"""Factor on the due times of the tasks; with `hard`, jobs that still wait at their due date expire."""
AIR_C: dict[Air, tuple[float, float]] = {
    "cool": (22.0, 22.0),
    "warm": (26.0, 26.0),
    "hot": (30.0, 30.0),
    "rising": (22.0, 31.0),
}
"""Ambient temperature at the beginning and, after two thirds of the shift, at the end, °C."""
PAST_AIR_C = (22.0, 31.0)
"""Range of the past jobs of the arms, the same for all instances of a cell."""
LIMITS = ThermalLimits(warning_c=52.0, error_c=59.0, restart_c=43.0)
"""Lower than the defaults, as for arms beside people, so that heat matters within an hour."""
UNATTENDED_S = 2400.0
"""unattended: time until a person clears the fault of a cooled arm and moves it home."""
NOISE_K = 2.0
"""noisy: standard deviation of the temperature readings of every second arm."""
BATCHES_S = 1500.0
"""batch: approximate time between two batches."""
RUSH, RUSH_SHARE = (0.35, 0.55), 0.5
"""rush: a share of all jobs arrives in this part of the shift."""
BUSES: dict[Bus, BusSpec] = {
    "perfect": BusSpec(),
    "late": BusSpec(delay_s=20.0, jitter_s=20.0),
    "lossy": BusSpec(loss=0.6),
    "ring": BusSpec(topology="ring", delay_s=10.0),
    "cut": BusSpec(),
}
"""cut: also, two halves of the fleet exchange no messages in the middle third of the shift."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Values of an instance on the axes of its cell."""

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
    """Values sampled independently."""
    values: dict[str, Any] = {}  # literals of several types
    for name, kind in get_type_hints(Axes).items():
        choices = list(get_args(kind))
        weights = np.array([len(choices) - 1.0 if choice == OFTEN.get(name) else 1.0 for choice in choices])
        values[name] = choices[int(rng.choice(len(choices), p=weights / weights.sum()))]
    return Axes(**values)


@cache
def time_loads() -> dict[str, tuple[float, float]]:
    """By cell, time load of one job of each stream and payload in a shift: of the tasks that heat, and of the others.

    As `benchmarks/freeze_suite.py` computed them.
    """
    text = resources.files("scenarios").joinpath("suite/time_loads.json").read_text(encoding="utf-8")
    return json.loads(text)


def expected_jobs(cell: SuiteCell, heat: Heat) -> tuple[float, float]:
    """Expected number of jobs of each stream and payload in a shift: of tasks that heat, of the others."""
    heating, rest = (wanted / one for wanted, one in zip(SEVERITY[heat], time_loads()[cell.name], strict=True))
    return max(LEAST_JOBS, heating), max(LEAST_JOBS, rest)


def scenario_of(name: str, cell: SuiteCell, axes: Axes, seed: int, jobs: tuple[float, float] | None = None) -> Scenario:
    """Scenario of a cell at these values, checked like a file.

    Args:
        seed: Of the sampled times of a trace.
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


def describe(cell: SuiteCell, axes: Axes) -> str:
    """Description of an instance in a sentence."""
    values = ", ".join(f"{name} {value}" for name, value in asdict(axes).items())
    return f"{cell.trade.replace('_', ' ')} by {cell.arms} {cell.unlike} arms ({cell.layout}): {values}."


def _bus(quality: Bus, arms: list[str], horizon_s: float) -> BusSpec:
    spec = BUSES[quality]
    if quality != "cut":
        return spec
    half = tuple(arms[: len(arms) // 2])
    return replace(spec, partitions=(Partition(horizon_s / 3, horizon_s * 2 / 3, (half,)),))


def _streams(
    cell: SuiteCell, axes: Axes, group: int, task: SuiteTask, expected: float, rng: np.random.Generator
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
    window = Arrivals(kind="poisson", every_s=every_s, start_s=begin_s, stop_s=end_s)
    after = tuple(f"rush_{name}" for name in stream.after)
    return [stream, replace(stream, name=f"rush_{stream.name}", arrivals=window, after=after)]


def _arrivals(kind: Arriving, expected: float, horizon_s: float, rng: np.random.Generator) -> Arrivals:
    """Arrivals of about `expected` jobs in a shift, or of what is not in the rush."""
    match kind:
        case "batch":
            count = max(1, round(expected * BATCHES_S / horizon_s))
            every_s = round(horizon_s * count / expected, 3)
            return Arrivals(
                kind="batch", count=count, every_s=every_s, start_s=round(every_s * float(rng.random()) ** 2, 3)
            )
        case "trace":
            return Arrivals(kind="trace", times_s=_trace(int(rng.poisson(expected)), horizon_s, rng))
        case "poisson" | "rush":
            share = 1.0 if kind == "poisson" else 1.0 - RUSH_SHARE
            return Arrivals(kind="poisson", every_s=round(horizon_s / (share * expected), 3))


def _trace(count: int, horizon_s: float, rng: np.random.Generator) -> tuple[float, ...]:
    """Arrival times of a shift with two busy periods and a break between them, s."""
    spells = ((0.2, 0.12), (0.65, 0.12))
    means, deviations = np.array(spells)[rng.integers(2, size=count)].T if count else (np.zeros(0), np.zeros(0))
    shares = np.clip(means + deviations * rng.standard_normal(count), 0.0, 0.95)
    return tuple(round(float(time), 1) for time in np.sort(shares) * horizon_s)
