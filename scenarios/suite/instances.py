"""Instances of the suite: layouts of cells, tasks of real trades, cells, and the axes on which instances differ.

Every arm has a group of stations in front of it: a and b near to it, c far. A job may be done at any group, each with
the same stations, so an arm does it at its own; only in a control with one able arm a job names its group.

- *Light* work, which every arm can do cool, is worth slightly more per time, and often comes in waves.
- *Heavy* work heats, is worth less, and expires if no arm begins it soon. Arms with a fan or on a wall stay coolest.

A greedy arm chooses light work. When heavy work arrives, it is busy: another arm overheats, or the job expires. A cell
determines all that is prepared: plans, space and twins. Many instances share a cell; no two splits do. Instances of a
cell differ in heat, jobs, faults and bus. The ambient temperature of each level of heat is calibrated by outcome: see
`FAULTS`.
"""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from importlib import resources
from math import ceil, cos, degrees, pi, sin
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from fleet.arrivals import Arrivals
from fleet.bus.exchange.channel import Channel, Partition
from fleet.job import DWELL_S, Kind, Place
from fleet.robot import ThermalLimits, rotation
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import (
    SPLITS,
    Ambient,
    ArmSpec,
    JobStream,
    Scenario,
    SplitName,
    Spread,
    Surprise,
    SurpriseKind,
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
    """Mounted arms, and the group of stations in front of each."""

    arms: tuple[ArmSpec, ...]
    groups: tuple[tuple[Place, ...], ...]
    """Stations of each group: a, b, c."""

    @property
    def places(self) -> tuple[Place, ...]:
        """All stations."""
        return tuple(place for group in self.groups for place in group)


@dataclass(frozen=True)
class _Front:
    """Where the stations of an arm are: distances from its base on the floor, and heights, m."""

    near_m: float
    far_m: float
    near_z_m: float
    far_z_m: float


_FLOOR, _CEILING, _WALL = _Front(0.55, 0.66, 0.25, 0.35), _Front(0.45, 0.70, 0.5, 0.75), _Front(0.5, 0.68, 0.45, 0.5)
_Mounted = tuple[tuple[float, float, float], tuple[float, float, float], float, _Front]
"""Position of a base, tilt, direction in which the stations are, deg, and their distances."""


def layout_of(name: LayoutName, arms: int, *, pitch_m: float = 0.85) -> CellLayout:
    """The layout of this name.

    Args:
        arms: At least 2; a bench has an even number.
        pitch_m: Distance between neighbours.
    """
    mounted = _LAYOUTS[name](arms, pitch_m)
    specs = [
        ArmSpec(name=f"arm_{i:02d}", position_m=_rounded(*at), tilt_deg=_rounded(*tilt), home=HOME)
        for i, (at, tilt, _, _) in enumerate(mounted)
    ]
    groups = [_group(i, at, outwards, front) for i, (at, _, outwards, front) in enumerate(mounted)]
    return CellLayout(tuple(specs), tuple(groups))


def _line(arms: int, pitch_m: float) -> list[_Mounted]:
    """Arms on the floor in rows."""
    rows = ceil(arms / MOST_IN_ROW)
    lengths = [arms // rows + (row < arms % rows) for row in range(rows)]
    spots = [(x, APART_M * (row - (rows - 1) / 2)) for row, n in enumerate(lengths) for x in _along(n, pitch_m)]
    return [((x, y, 0.0), (0.0, 0.0, 90.0), 90.0, _FLOOR) for x, y in spots]


def _bench(arms: int, pitch_m: float) -> list[_Mounted]:
    """Two rows of arms facing each other across a bench."""
    across_m = _FLOOR.far_m + 0.25
    return [
        ((x, side * across_m, 0.0), (0.0, 0.0, -90.0 * side), -90.0 * side, _FLOOR)
        for x in _along(arms // 2, pitch_m)
        for side in (-1.0, 1.0)
    ]


def _ring(arms: int, pitch_m: float) -> list[_Mounted]:
    """Arms in a circle, facing outwards."""
    radius_m = pitch_m / 2 / sin(pi / arms)
    around = [2 * pi * i / arms for i in range(arms)]
    return [((radius_m * cos(a), radius_m * sin(a), 0.0), (0.0, 0.0, degrees(a)), degrees(a), _FLOOR) for a in around]


def _gantry(arms: int, pitch_m: float) -> list[_Mounted]:
    """Arms hanging from a beam in a row."""
    return [((x, 0.0, 1.2), (180.0, 0.0, 90.0), 90.0, _CEILING) for x in _along(arms, pitch_m)]


def _wall_ceiling(arms: int, pitch_m: float) -> list[_Mounted]:
    """Arms alternately on a wall and on the ceiling."""
    return [
        ((x, 0.1, 1.2), (180.0, 0.0, 90.0), 90.0, _CEILING)
        if i % 2
        else ((x, 1.0, 0.5), (90.0, 0.0, 0.0), -90.0, _WALL)
        for i, x in enumerate(_along(arms, pitch_m))
    ]


_LAYOUTS: dict[LayoutName, Callable[[int, float], list[_Mounted]]] = {
    "bench": _bench,
    "line": _line,
    "ring": _ring,
    "gantry": _gantry,
    "wall_ceiling": _wall_ceiling,
}


def _along(arms: int, pitch_m: float) -> list[float]:
    """Coordinates of a row of arms, centred at 0, m."""
    return [(i - (arms - 1) / 2) * pitch_m for i in range(arms)]


def _group(number: int, base: tuple[float, float, float], outwards_deg: float, front: _Front) -> tuple[Place, ...]:
    """The stations in front of an arm."""
    spots = (
        (front.near_m, -SIDE_M, front.near_z_m),
        (front.near_m, SIDE_M, front.near_z_m),
        (front.far_m, 0.0, front.far_z_m),
    )
    ends = [(base[0], base[1], 0.0) + rotation((0.0, 0.0, outwards_deg)) @ spot for spot in spots]
    return tuple(
        Place(name=f"{letter}_{number:02d}", position_m=_rounded(*map(float, end)))
        for letter, end in zip("abc", ends, strict=True)
    )


def _rounded(x: float, y: float, z: float) -> tuple[float, float, float]:
    return (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """One task type, at any group of stations."""

    name: str
    kind: Kind
    at: tuple[Literal["a", "b", "c"], ...]
    """Stations of the group."""
    payload_kg: tuple[float, ...]
    repetitions: tuple[int, int]
    dwell_s: float = DWELL_S
    heavy: bool = False


JUDGED = SPLITS[1:]
"""Splits whose results are reported."""
Asks = Literal["advantage", "equal_arms", "overload", "one_able_arm", "light_work"]
"""advantage: who does what matters. Controls, in which sharing cannot pay: arms that differ by chance only; more jobs
than anybody could do; jobs that one arm alone can do; no heavy work."""


@dataclass(frozen=True, kw_only=True)
class SuiteCell:
    """A cell and the number of its instances."""

    name: str
    split: SplitName
    layout: LayoutName
    arms: int
    trade: str
    asks: Asks = "advantage"
    pitch_m: float = 0.85
    hours: float = 2.0
    slots: int = 24
    instances: int = 24
    seed: int = 0
    """Seed of the arms' deviations."""


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
SPREAD = 0.3
"""`spread.scale`: every parameter of an arm deviates 0.3 times as much as among real Gen3 arms."""
_PLAIN: dict[str, Any] = {}
ARMS: tuple[dict[str, Any], ...] = (
    _PLAIN,
    {"cooling": "forced_air"},
    {"wear": 0.5},
    _PLAIN,
    {"cooling": "forced_air"},
    {"cooling_factor": 0.9},
    _PLAIN,
    {"payload_limit_kg": 1.5},
)
"""What is particular to each arm of a fleet, in turn: of eight, two have a fan, one is worn, one cools badly, and one
carries less (Any: fields of several types)."""


@lru_cache(maxsize=64)
def layout(cell: SuiteCell) -> CellLayout:
    """Arms and stations of a cell."""
    plain = layout_of(cell.layout, cell.arms, pitch_m=cell.pitch_m)
    if cell.asks == "equal_arms":
        return plain
    return replace(plain, arms=tuple(replace(arm, **ARMS[i % len(ARMS)]) for i, arm in enumerate(plain.arms)))


def tasks_of(cell: SuiteCell) -> tuple[SuiteTask, ...]:
    """The tasks of a cell."""
    return tuple(task for task in TRADES[cell.trade] if not (task.heavy and cell.asks == "light_work"))


Level = Literal["cool", "warm", "hot", "severe"]
FAULTS: dict[Level, float] = {"cool": 0.0, "warm": 0.5, "hot": 1.5, "severe": 4.0}
"""Expected faults of the policy `wspt`, which ignores heat, in a shift: the ambient temperature of each level and cell
is set so, whatever the number of arms. `benchmarks/freeze_suite.py` does it, and checks it on other seeds."""
Arriving = Literal["waves", "poisson", "trace", "rush"]
Due = Literal["usual", "tight"]
Faults = Literal["attended", "unattended", "noisy"]
Bus = Literal["perfect", "late", "lossy", "ring", "cut"]
Surprising = Literal["nothing", SurpriseKind]

LIGHT_LOAD = 0.55
HEAVY_LOAD: dict[Level, float] = {"cool": 0.3, "warm": 0.3, "hot": 0.35, "severe": 0.5}
"""Shares of the time of all arms that light and heavy work take, if all is done."""
OVERLOAD = 1.8
"""Factor on both in an overloaded cell."""
LIGHT_WORTH, HEAVY_WORTH = 0.45, 0.42
"""Value of a minute of work."""
LIGHT_DUE_S: dict[Due, float] = {"usual": 2400.0, "tight": 1200.0}
HEAVY_DUE_S: dict[Due, float] = {"usual": 150.0, "tight": 90.0}
"""Time in which an arm must begin a heavy job; then it expires."""
LEAST_JOBS = 0.25
"""Fewest expected jobs of a stream, so that every task occurs."""
PAST_AIR_C = (15.0, 35.0)
"""Range of the ambient temperature of the past jobs of the arms, the same for all instances of a cell."""
COOL_C = 12.0
"""Highest ambient temperature of the level cool."""
LIMITS = ThermalLimits(warning_c=52.0, error_c=59.0, restart_c=43.0)
"""Lower than the defaults, as for arms beside people, so that heat matters within an hour."""
UNATTENDED_S = 2400.0
"""unattended: time until a person clears the fault of a cooled arm and moves it home."""
NOISE_K = 2.0
"""noisy: standard deviation of the temperature readings of every second arm."""
WAVES_S = 1200.0
"""waves: approximate time between two waves of light jobs."""
RUSH, RUSH_SHARE = (0.35, 0.55), 0.5
"""rush: this share of the light jobs arrives in this part of the shift, besides those that arrive all the time."""
BUSES: dict[Bus, Channel] = {
    "perfect": Channel(),
    "late": Channel(delay_s=20.0, jitter_s=20.0),
    "lossy": Channel(loss=0.6),
    "ring": Channel(topology="ring", delay_s=10.0),
    "cut": Channel(),
}
"""cut: also, two halves of the fleet exchange no messages in the middle third of the shift."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Values of an instance on the axes of its cell."""

    heat: Level
    arrivals: Arriving
    due: Due
    faults: Faults
    bus: Bus
    surprise: Surprising = "nothing"
    """What the arms believe is wrong: see `scenarios.spec.schema.Surprise`."""


PAYLOAD_FACTORS, FRICTION_SHARES, DRIFTS_K_PER_H = (1.15, 1.3), (1.5, 3.0), (6.0, 12.0)
"""Ranges of the sizes of surprises; a sensor drifts upwards or, three times as often, downwards."""
READS_LESS = 0.75
SURPRISED_ARMS = 1 / 3
"""Share of the arms whose friction has grown, or whose sensors drift, at least one."""


def _surprises(cell: SuiteCell, kind: Surprising, streams: Sequence[JobStream], seed: int) -> tuple[Surprise, ...]:
    """What surprises the arms in an instance."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 2]))
    arms = layout(cell).arms
    few = np.sort(rng.choice(len(arms), max(1, round(SURPRISED_ARMS * len(arms))), replace=False))
    match kind:
        case "nothing":
            return ()
        case "payload":
            heavy = tuple(task.name for task in tasks_of(cell) if task.heavy)
            factor = round(rng.uniform(*PAYLOAD_FACTORS), 3)
            chosen = [each.name for each in streams if each.name.startswith(heavy)] if heavy else [streams[0].name]
            return tuple(Surprise(kind="payload", jobs=name, size=factor) for name in chosen)
        case "friction":
            sizes = rng.uniform(*FRICTION_SHARES, len(few)).round(3).tolist()
            return tuple(Surprise(kind=kind, arm=arms[i].name, size=size) for i, size in zip(few, sizes, strict=True))
        case "fan":
            return tuple(Surprise(kind=kind, arm=arm.name) for arm in arms if arm.cooling == "forced_air")
        case "sensor":
            sign = np.where(rng.random(len(few)) < READS_LESS, -1.0, 1.0)
            sizes = (sign * rng.uniform(*DRIFTS_K_PER_H, len(few))).round(3).tolist()
            return tuple(Surprise(kind=kind, arm=arms[i].name, size=size) for i, size in zip(few, sizes, strict=True))


@dataclass(frozen=True)
class Calibration:
    """What was measured in a cell, for all of its instances."""

    minutes: dict[str, float]
    """Mean duration of a job of each task, min, over payloads, repetitions and able arms."""
    ambient_c: dict[Level, float]
    """Ambient temperature of each level."""


@cache
def calibrations() -> dict[str, Calibration]:
    """By cell, as `benchmarks/freeze_suite.py` computed them."""
    content = resources.files("scenarios").joinpath("suite/calibration.json").read_bytes()
    return msgspec.json.decode(content, type=dict[str, Calibration])


def scenario_of(name: str, cell: SuiteCell, axes: Axes, seed: int, known: Calibration | None = None) -> Scenario:
    """Scenario of a cell at these values, checked like a file.

    Args:
        seed: Of the sampled times of a trace.
        known: Calibration of the cell; default: the stored one.
    """
    horizon_s = 3600.0 * cell.hours
    known = known or calibrations()[cell.name]
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    streams: list[JobStream] = []
    for task in tasks_of(cell):
        streams += _streams(cell, axes, task, known.minutes[task.name], rng)
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
        ambient=Ambient(points=((0.0, known.ambient_c[axes.heat]),)),
        limits=limits,
        twin=TwinSpec(size="quick", exploration=32, air_c=PAST_AIR_C),
        spread=Spread(scale=SPREAD, seed=cell.seed),
        bus=_bus(axes.bus, [arm.name for arm in arms], horizon_s),
        surprises=_surprises(cell, axes.surprise, streams, seed),
    )  # fmt: skip
    return parse_scenario(msgspec.to_builtins(scenario), Path(f"{name}.toml"))


def describe(cell: SuiteCell, axes: Axes) -> str:
    """Description of an instance in a sentence."""
    values = ", ".join(f"{name} {value}" for name, value in asdict(axes).items() if value != "nothing")
    trade, asks = (text.replace("_", " ") for text in (cell.trade, cell.asks))
    return f"{trade} by {cell.arms} arms ({cell.layout}; {asks}): {values}."


def _bus(quality: Bus, arms: list[str], horizon_s: float) -> Channel:
    spec = BUSES[quality]
    if quality != "cut":
        return spec
    half = tuple(arms[: len(arms) // 2])
    return replace(spec, partitions=(Partition(horizon_s / 3, horizon_s * 2 / 3, (half,)),))


def _streams(cell: SuiteCell, axes: Axes, task: SuiteTask, minutes: float, rng: np.random.Generator) -> list[JobStream]:
    """The streams of a task: one for each group if one arm alone can do it; with a rush, a second one for it."""
    places = [tuple(f"{letter}_{group:02d}" for letter in task.at) for group in range(cell.arms)]
    horizon_s, due = 3600.0 * cell.hours, HEAVY_DUE_S if task.heavy else LIGHT_DUE_S
    load = (HEAVY_LOAD[axes.heat] if task.heavy else LIGHT_LOAD) * (OVERLOAD if cell.asks == "overload" else 1.0)
    expected = max(LEAST_JOBS, load * cell.arms * horizon_s / 60.0 / minutes)
    arrivals = "poisson" if task.heavy else axes.arrivals
    stream = JobStream(
        name=task.name,
        kind=task.kind,
        places=tuple(places),
        payload_kg=task.payload_kg,
        repetitions=task.repetitions,
        dwell_s=task.dwell_s,
        value=round((HEAVY_WORTH if task.heavy else LIGHT_WORTH) * minutes, 2),
        due_s=due[axes.due],
        due="hard" if task.heavy else "soft",
        arrivals=Arrivals(kind="poisson", every_s=horizon_s),
    )
    alone = [replace(stream, name=f"{task.name}_{i:02d}", places=(each,)) for i, each in enumerate(places)]
    own = alone if cell.asks == "one_able_arm" else [stream]
    made: list[JobStream] = []
    for each in own:
        made.append(replace(each, arrivals=_arrivals(arrivals, expected / len(own), horizon_s, rng)))
        if arrivals == "rush":
            begin_s, end_s = (share * horizon_s for share in RUSH)
            every_s = round((end_s - begin_s) / (RUSH_SHARE * expected / len(own)), 3)
            window = Arrivals(kind="poisson", every_s=every_s, start_s=begin_s, stop_s=end_s)
            made.append(replace(each, name=f"rush_{each.name}", arrivals=window))
    return made


def _arrivals(kind: Arriving, expected: float, horizon_s: float, rng: np.random.Generator) -> Arrivals:
    """Arrivals of about `expected` jobs in a shift, or of what is not in the rush."""
    match kind:
        case "waves":
            count = max(1, round(expected * WAVES_S / horizon_s))
            every_s = round(horizon_s * count / expected, 3)
            return Arrivals(kind="batch", count=count, every_s=every_s, start_s=round(0.1 * every_s * rng.random(), 3))
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
