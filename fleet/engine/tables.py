"""The arrays that the engine's kernels read, by name, and the events that they record.

Axis `fleet`: one fleet as it is built; all envs of one fleet have the same arms. Axis `kind`: one kind of job, its work
and its number of repetitions. Last axes `lane` and `wide` are joints and nodes padded with zeros to what a processor
takes at once. Every array is contiguous and owned, so one compilation serves all scenarios. Kernels record events as
numbers, which are turned into `Event`s for reports.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from fleet.difficulty import KNOWN, extend_curve, forecast_arrays
from fleet.engine.state import ABSENCE, ARM, ENV, JOB, LANES, State
from fleet.heat.thermal import NODES
from fleet.jit import jit
from fleet.job import MOST_FAULTS
from fleet.observation import FIELDS, Layout, Offsets
from fleet.robot import JOINTS

Array = np.ndarray

AWARD, LOST, ILLEGAL, WARNING, FINISH, HOME, FAULT, RETURN, GIVE_UP, RECOVER, MOVED, GIVE_BACK, EXPIRE = range(13)
FAILURE, BREAK, BREAK_END = range(13, 16)
"""Kinds of recorded events, in the order in which those of one step are reported."""
FOLLOWS = -1.0
"""Value of the GIVE_UP of a job that waited for one that was given up."""
PER_ARM = 10
"""Most events of one arm in one step; besides, every job may expire or be given up."""


class EventBuffer(NamedTuple):
    """Events of one step; a buffer without rows records nothing."""

    used: Array
    """Rows in use, int [1]."""
    what: Array
    """Kind (see `fleet.engine.tables`), env, arm, job, joint, int [row, 5]; −1 for none."""
    numbers: Array
    """Seconds into the step, value, [row, 2]."""


def event_buffer(rows: int) -> EventBuffer:
    """An empty buffer; without rows it records nothing."""
    return EventBuffer(np.zeros(1, int), np.zeros((rows, 5), int), np.zeros((rows, 2)))


@jit
def record_event(
    events: EventBuffer, kind: int, e: int, a: int, job: int, joint: int, offset_s: float, value: float
) -> None:
    """Append an event of the present step; an award has the row of its plan in place of a joint."""
    row = events.used[0]
    events.what[row, 0], events.what[row, 1], events.what[row, 2] = kind, e, a
    events.what[row, 3], events.what[row, 4] = job, joint
    events.numbers[row, 0], events.numbers[row, 1] = offset_s, value
    events.used[0] = row + 1


WIDE = 16
"""Nodes padded to what a processor takes at once."""

LAW = np.dtype(
    [
        ("step", "f4", (2 * NODES, WIDE)),
        ("to_ambient", "f4", WIDE),
        ("housing_keep", "f4", (LANES, LANES)),
        ("housing_gain", "f4", (LANES, LANES)),
        ("housing_winding", "f4", LANES),
        ("housing_ambient", "f4", LANES),
        ("housing_idle_w", "f4", LANES),
        ("copper_w_per_a2", "f4", LANES),
        ("idle_w", "f4", LANES),
        ("sensor_noise_k", "f4", LANES),
        ("drift_k_per_s", "f4"),
    ],
    align=True,
)
"""How an arm heats up. `step` [from, to] gives the change in an exact step: rows 0..13 Φ − 1 transposed (temperatures),
14..27 Γ (loads). Then conductances to ambient, W/K; the observer of its housings, see `fleet.heat.thermal`; and its
motors."""

MODAL = np.dtype(
    [
        ("root_capacity", "f8", NODES),
        ("rates", "f8", NODES),
        ("modes", "f8", (NODES, NODES)),
        ("to_ambient", "f8", NODES),
        ("idle_w", "f8", JOINTS),
        ("start_c", "f8", NODES),
        ("start_housing_c", "f8", JOINTS),
    ],
    align=True,
)
"""The thermal network by its modes [node, mode], for the moments at which a limit is crossed: square roots of the heat
capacities, inverse time constants, 1/s, conductances to ambient, W/K, and idle heat, W. Then the temperatures at the
start of a shift, and what the arm estimates those of its housings to be, without the shift's offset of the ambient."""

PLAN = np.dtype(
    [("times_s", "f8", 3), ("current_sq", "f4", (3, LANES)), ("friction_w", "f4", (3, LANES)), ("excess", "f4")],
    align=True,
)
"""Durations and mean heat drives of the phases of a plan: approach, one cycle, retreat; then the excess of heat that
its arm measures over that which it expects, less 1."""

WORK = np.dtype(
    [(name, "f4") for name in ("travel_s", "cycle_s", "difficulty", "p_saturation")]
    + [(name, "i4") for name in ("risk", "peak", "plan", "volume")]
)
"""What an arm knows of a plan for a kind of job, half a cache line: seconds of approach and retreat, and of one
repetition, both 0 where it has none; difficulty; P(saturation) from models that ignore the start temperature, both NaN
where not known; rows of the forecasts of P and of the peak temperature, −1 for none; row of the plan tables, −1 where
it has none; the volume that the plan takes, counted for each fleet."""


class Tables(NamedTuple):
    """What does not change from shift to shift."""

    dt_s: float
    ticks: int
    warning_c: float
    error_c: float
    restart_c: float
    clear_s: float
    move_home_s: float
    power_off: bool
    alpha_cu_per_k: float
    alpha_kt_per_k: float
    reference_c: float
    learns: bool
    """Whether the arms correct their predictions by what they measure."""
    ambient_c: Array
    """[fleet, tick, arm]."""
    law: Array
    """`LAW` [fleet, arm]."""
    believed: Array
    """What the arms believe it to be, where they learn, `LAW` [fleet, arm]."""
    modal: Array
    """`MODAL` [fleet, arm]."""
    start: Array
    """An arm at the start of a shift, at home, `ARM` [fleet, arm]; its temperatures are in `modal`."""
    plans: Array
    """`PLAN` [plan]."""
    excluded: Array
    """Volumes that no other arm can take meanwhile, one bit each, uint64 [plan, word]."""
    work: Array
    """What an arm knows of its plans for a kind of job, the fastest first, `WORK` [fleet, kind, arm, plan]."""
    forecast_first: Array
    """Where the blocks of each forecast begin, int [forecast + 1]; see `fleet.difficulty.forecast_arrays`."""
    forecast_block: Array
    """Pieces, float32 [block, 3 + known, lane]."""
    forecast_curve: Array
    """float32 [forecast, knot, 2]; no knots where no forecast has a curve."""
    least: Array
    """Least difficulty of an arm's plans for a kind of job, float32 [fleet, kind, arm]; −1 where there is none."""
    stations: Array
    """Stations of a kind of job, one bit each, uint64 [fleet, kind + 1, word]; the last row, no job, has none."""
    payload_kg: Array
    value: Array
    """[fleet, kind], as is the one before."""
    alike: Array
    """Kinds of one work have the same number, int [fleet, kind]."""


class OpenJobs(NamedTuple):
    """Jobs that can be claimed, and by whom."""

    slot_job: Array
    """int32 [env, slot], −1 for an empty slot."""
    mask: Array
    """Legal actions, int8 [env, arm, option + 2]."""
    group: Array
    """Jobs that share a station have the same number, int32 [env, slot], from 1; 0 for an empty slot."""
    station_free: Array
    """Whether no arm occupies the stations of a slot's job, bool [env, slot]."""
    closed: Array
    """Volumes that arms away from home exclude, one bit each, uint64 [env, word]."""


TRACE = np.dtype(
    [
        ("mode", "i4"),
        ("plan", "i4"),
        ("todo", "i4"),
        ("progress_s", "f8"),
        ("home_s", "f8"),
        ("cut_s", "f8"),
        ("heat_w", "f8", NODES),
        ("start_c", "f8", NODES),
    ],
    align=True,
)
"""How an arm spent the last step: its mode at the beginning, with the awards made; row of the plan tables, −1 at home;
cycles to do; progress at the beginning; seconds into the step at which it is free again, inf if not in it; seconds it
moved before a fault stopped it, the whole step if none did; heat until the fault, W, and temperatures at the beginning,
[node]."""

DRIVE = np.dtype([("current_sq", "f4", LANES), ("friction_w", "f4", LANES)])
"""Mean heat drive of an arm over a step, from a plant that computes the motion, [lane]."""


def drive_of(records: Array) -> tuple[Array, Array]:
    """Mean squared currents and friction heat in records of arms or plans, each [..., joint]."""
    return records["current_sq"][..., :JOINTS].astype(float), records["friction_w"][..., :JOINTS].astype(float)


INFO = np.dtype([("faults", "f8"), ("illegal", "f8"), ("peak_c", "f8"), ("above_warning_s", "f8")])
"""What has become of an arm so far; see `State`."""


class Form(NamedTuple):
    """A `Layout` as the kernels want it."""

    offsets: Offsets
    """Where each field begins in its part; unsigned, so that the compiler omits checks for negative indices."""
    inverse: Offsets
    """What the values of each field are multiplied with, float32."""
    members: Array
    """The members of each arm, int [arm, member]."""
    alike: Array
    """1 where what the arms share is the same for all of them, else 0, int [1]."""
    ahead_s: Array
    """Arms that are home later than this have no options, float32 [1]."""
    bids: Array
    """1 where members share their bids, else 0, int [1]."""
    shares_heat: Array
    """1 where arms tell each other at once what heat they measure, else 0, int [1]."""


class Script(NamedTuple):
    """Schedules (`agents.schedules.Schedules`), one for each env, and their results; without rows there is none."""

    arm: Array
    """int [env, job]."""
    option: Array
    """int [env, job]."""
    order: Array
    """[env, job]."""
    not_before_s: Array
    """[env, job]."""
    discount: Array
    """Factor on the reward of each step of a shift, [tick]."""
    reward: Array
    """Discounted, [env]."""
    start_s: Array
    """When each job was last awarded, inf if never, [env, job]."""
    claims: Array
    """The claims that were won, in the order of time: decision interval, arm and action, int [env, claim, 3]."""
    won: Array
    """Their number, int [env]."""


Plans = tuple[Array, Array, Array, Array]
"""Arm, option, order and earliest time of each job of schedules, [schedule, job]."""


def script_of(schedules: Plans, discount: Array) -> Script:
    """A script of schedules [schedule, job], not yet played."""
    given, jobs = schedules[0].shape
    claims, won = np.zeros((given, MOST_FAULTS * jobs, 3), np.int64), np.zeros(given, np.int64)
    return Script(*schedules, discount, np.zeros(given), np.full((given, jobs), np.inf), claims, won)


NO_SCRIPT = script_of((np.zeros((0, 0), int), np.zeros((0, 0), int), np.zeros((0, 0)), np.zeros((0, 0))), np.zeros(0))


class Room(NamedTuple):
    """Arrays in which the loops of one thread keep what they need for a moment."""

    rows: Array
    """int [block]."""
    busy: Array
    """Stations that are taken, uint64 [word]."""
    slot_kind: Array
    """Kinds of the jobs in the slots, int [slot]."""
    behind: Array
    """Jobs that were passed over, in the order of the queue, int [slot]."""
    left: Array
    """Repetitions that are left of the jobs in the slots, float32 [slot]."""
    key: Array
    """By which claims are ordered, [arm]."""
    order: Array
    """Arms in this order, int [arm]."""
    measured_c: Array
    """Motor temperatures of arms, float32 [arm, lane]."""
    hottest_c: Array
    """float32 [arm]."""
    busy_s: Array
    """Time until each arm is home, float32 [arm]."""
    known_c: Array
    """What predictions begin at, float32 [KNOWN]."""
    lanes: Array
    """Heat drive of an arm, loads of its housings and values of pieces, float32 [4, lane]."""
    begin: Array
    """Temperatures, loads, padding, float32 [from]."""
    end: Array
    """float32 [wide]."""
    modal: Array
    """See `fleet.engine.crossings`, [6, node]."""
    excess: Array
    """Mean excess of heat that arms have measured, NaN for none yet, float32 [number]."""


def room_for(arms: int, slots: int, words: int, rows: int, works: int) -> Room:
    """Room for some arms, slots, words of stations, rows at a time, and numbers of works."""
    return Room(
        rows=np.zeros(rows, int),
        busy=np.zeros(words, np.uint64),
        slot_kind=np.zeros(slots, int),
        behind=np.zeros(slots, int),
        left=np.zeros(slots, np.float32),
        key=np.zeros(arms),
        order=np.zeros(arms, int),
        measured_c=np.zeros((arms, LANES), np.float32),
        hottest_c=np.zeros(arms, np.float32),
        busy_s=np.zeros(arms, np.float32),
        known_c=np.zeros(KNOWN, np.float32),
        lanes=np.zeros((4, LANES), np.float32),
        begin=np.zeros(2 * NODES + LANES, np.float32),
        end=np.zeros(WIDE, np.float32),
        modal=np.zeros((6, NODES)),
        excess=np.zeros(works, np.float32),
    )


class Simulation(NamedTuple):
    """Everything that a kernel works on."""

    tables: Tables
    state: State
    offers: OpenJobs
    events: EventBuffer
    trace: Array
    """`TRACE` [env, arm]; without rows nothing is recorded."""
    drive: Array
    """`DRIVE` [env, arm]; without rows the planned drive counts."""
    infos: Array
    """`INFO` [env, arm]."""
    path_c: Array
    """Temperatures at the end of each interval of a shift, float32 [env, tick, arm, node]; without rows none."""
    excess: Array
    """Excess of heat that each arm has measured in works of each number, NaN for none yet, float32 [env, arm, number];
    without columns no arm learns."""
    assumed_c: Array
    """Temperatures that each arm should have by what it believes and by the currents that it measures, from the start
    of the shift, float32 [env, arm, node]; without columns no arm learns."""
    moments: Array
    """Of the differences of measured and assumed motor temperatures, see `fleet.engine.corrections.compare`, float32
    [env, arm, 4]."""
    form: Form
    room: Room
    weights: Array
    """Reward per unit of each term, [term], in the order of `fleet.engine.batch.TERMS`."""
    script: Script


def form_of(layout: Layout, *, shares_heat: bool) -> Form:
    """A layout as the kernels want it."""
    scales = Offsets(*(np.float32(1.0 / field.scale if layout.scaled else 1.0) for field in FIELDS))
    offsets = Offsets(*map(np.uint32, layout.offsets))
    alike, ahead_s = np.array([layout.is_shared], int), np.array([layout.ahead_s], np.float32)
    bids, tells = np.array([layout.bids], int), np.array([shares_heat and layout.is_shared], int)
    return Form(offsets, scales, layout.members, alike, ahead_s, bids, tells)


def empty_state(envs: int, arms: int, jobs: int, waits: int, absences: int = 0) -> State:
    """Room for a number of jobs, each of which waits for up to `waits` others, and of absences; there are none yet."""
    state = State(
        env=_aligned((envs,), ENV),
        arms=_aligned((envs, arms), ARM),
        jobs=_aligned((envs, jobs), JOB),
        failed_arm=np.full((envs, jobs, MOST_FAULTS - 1), -1, np.int32),
        after=np.full((envs, jobs, waits), -1, np.int32),
        queue=np.zeros((envs, jobs), np.int32),
        absences=np.zeros((envs, absences), ABSENCE),
    )
    state.jobs["release_s"] = state.jobs["due_s"] = np.inf
    state.jobs["repetitions"] = 1
    return state


_CACHE_LINE = 64


def _aligned(shape: tuple[int, ...], kind: np.dtype) -> Array:
    """Zeros whose records do not straddle more cache lines than they must."""
    size = math.prod(shape) * kind.itemsize
    room = np.zeros(size + _CACHE_LINE, np.uint8)
    first = -room.ctypes.data % _CACHE_LINE
    return room[first : first + size].view(kind).reshape(shape)


def pad(values: Array, axis: int = -1, size: int = LANES, fill: float = 0.0) -> Array:
    """The values with an axis padded to a size."""
    shape = list(values.shape)
    shape[axis] = size
    padded = np.full(shape, fill, values.dtype)
    padded.swapaxes(axis, -1)[..., : values.shape[axis]] = values.swapaxes(axis, -1)
    return padded


def bits(flags: Array) -> Array:
    """Flags as bits, uint64 [..., word], of bool [..., n]."""
    words = max(1, -(-flags.shape[-1] // 64))
    packed = np.packbits(pad(flags, size=64 * words, fill=False), axis=-1, bitorder="little")
    return np.ascontiguousarray(packed).view("<u8").astype(np.uint64)


_FORECAST = tuple(forecast_arrays(None, LANES))


def owned(arrays: Tables) -> Tables:
    """The same with every array contiguous, writeable and owned."""
    return arrays._replace(
        **{name: np.array(v, order="C") for name, v in arrays._asdict().items() if isinstance(v, np.ndarray)}
    )


_SCALARS = tuple(name for name, kind in Tables.__annotations__.items() if kind is not Array)
_RENUMBERED = ("stations", "excluded", *_FORECAST)


def stack_tables(fleets: Sequence[Tables]) -> Tables:
    """The tables of several fleets as one.

    Raises:
        ValueError: they differ in what they share: the length of a step or a shift, limits, arms, or kinds of jobs.
    """
    first = fleets[0]
    for other in fleets[1:]:
        for name in _SCALARS:
            if getattr(other, name) != getattr(first, name):
                raise ValueError(
                    f"Fleets of one batch must agree in {name} ({getattr(first, name)}, {getattr(other, name)})."
                )
        for name in ("ambient_c", "work"):
            if getattr(other, name).shape != getattr(first, name).shape:
                raise ValueError(f"Fleets of one batch must have as many arms and kinds of jobs as the first ({name}).")
    plans = np.cumsum([0, *(len(each.plans) for each in fleets)])
    forecasts = np.cumsum([0, *(len(each.forecast_curve) for each in fleets)])
    blocks = np.cumsum([0, *(len(each.forecast_block) for each in fleets)])
    knots = max(each.forecast_curve.shape[1] for each in fleets)

    def shifted(each: Iterable[Array], by: Array) -> Array:
        return np.concatenate([np.where(v >= 0, v + n, -1) for v, n in zip(each, by, strict=False)])

    joined = {
        name: np.concatenate([getattr(each, name) for each in fleets])
        for name in Tables._fields
        if name not in (*_SCALARS, *_RENUMBERED)
    }
    for name, rows in (("risk", forecasts), ("peak", forecasts), ("plan", plans)):
        joined["work"][name] = shifted((t.work[name] for t in fleets), rows)
    return owned(
        first._replace(
            **joined,
            forecast_first=np.concatenate(
                [[0], *(t.forecast_first[1:] + n for t, n in zip(fleets, blocks, strict=False))]
            ),
            forecast_block=np.concatenate([t.forecast_block for t in fleets]),
            forecast_curve=np.concatenate([extend_curve(t.forecast_curve, knots) for t in fleets]),
            stations=_same_words([t.stations for t in fleets]),
            excluded=_same_words([t.excluded for t in fleets]),
        )
    )


def _same_words(fleets: Sequence[Array]) -> Array:
    """Bits of several fleets, [fleet or plan, ..., word], one after the other."""
    words = max(each.shape[-1] for each in fleets)
    return np.concatenate([pad(each, size=words) for each in fleets])
