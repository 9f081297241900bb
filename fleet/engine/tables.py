"""The arrays that the engine's kernels read and write, by name, and the events that they record.

Axis `fleet`: one fleet as it is built; all envs of one fleet have the same arms. Axis `kind`: one kind of job, its work
and its number of repetitions. Last axes `lane` and `wide` are joints and nodes padded with zeros to what a processor
takes at once. Every array is contiguous and owned, so one compilation serves all scenarios. Kernels record events as
numbers, which are turned into `Event`s for reports.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from fleet.difficulty import extend_curve, forecast_arrays
from fleet.engine.state import State, World
from fleet.events import Event, EventKind
from fleet.jit import jit
from fleet.observation import Layout, Offsets
from fleet.robot import JOINTS

Array = np.ndarray

AWARD, LOST, ILLEGAL, WARNING, FINISH, HOME, FAULT, RETURN, GIVE_UP, RECOVER, MOVED, GIVE_BACK, EXPIRE = range(13)
"""Kinds of recorded events, in the order in which those of one step are reported."""
PER_ARM = 10
"""Most events of one arm in one step; besides, every job may expire."""


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


def events_of(world: World, state: State, buffer: EventBuffer) -> Iterator[Event]:
    """The events of the step that led to `state`; releases of jobs come last.

    Args:
        state: After the step.
    """
    count = int(buffer.used[0])
    what, numbers = buffer.what[:count], buffer.numbers[:count]
    began_s = (state.tick - 1) * world.dt_s
    # What becomes of the job follows the fault of its arm.
    phase = np.where((what[:, 0] == RETURN) | (what[:, 0] == GIVE_UP), FAULT, what[:, 0])
    for row in np.lexsort((what[:, 2], what[:, 1], phase)).tolist():
        kind, e, a, j, joint = what[row].tolist()
        offset_s, value = numbers[row].tolist()
        plan, joint = (joint, -1) if kind == AWARD else (-1, joint)
        name, measured, reason = _described(world, state, kind, e, j, joint, value)
        common = {"time_s": float(began_s[e] + offset_s), "env": e, "arm": world.arms[a] if a >= 0 else ""}
        common["job"] = world.jobs.names[e][j] if j >= 0 else ""
        yield Event(kind=name, joint=joint + 1, value=measured, reason=reason, **common)
        if kind == AWARD:
            peak = world.plans.peak_tau[plan]
            over = peak - world.torque_warning
            if (over > 0).any():
                k = int(over.argmax())
                text = f"joint {k + 1} reaches {peak[k]:.1f} N·m, warning at {world.torque_warning[k]:.1f}"
                yield Event(kind="torque_warning", joint=k + 1, value=float(peak[k]), reason=text, **common)
    yield from _releases(world, state)


def _described(
    world: World, state: State, kind: int, e: int, j: int, joint: int, value: float
) -> tuple[EventKind, float, str]:
    """Name, value and reason of an event."""
    limits = world.limits
    match kind:
        case 0:
            return "award", value, ""
        case 1:
            return "lost", math.nan, "another arm claimed it, its station or the space"
        case 2:
            return "illegal", math.nan, "action outside the mask: a wait"
        case 3:
            return "warning", limits.warning_c, f"joint {joint + 1} passed {limits.warning_c:g} °C"
        case 4:
            late_s = max(0.0, float(state.finished_s[e, j] - world.jobs.due_s[e, j]))
            return "finish", late_s, f"late by {late_s:.0f} s" if late_s else "on time"
        case 5:
            return "home", math.nan, ""
        case 6:
            return "fault", limits.error_c, f"joint {joint + 1} passed {limits.error_c:g} °C"
        case 7:
            return "return", value, f"{state.cycles[e, j]} of {world.jobs.repetitions[e, j]} cycles kept"
        case 8:
            return "give_up", value, f"{state.returns[e, j]} faults; {state.cycles[e, j]} cycles done"
        case 10:
            return "moved", math.nan, "moved home by a person"
        case 11:
            return "give_back", value, f"{state.cycles[e, j]} of {world.jobs.repetitions[e, j]} cycles kept"
        case 12:
            return "expire", math.nan, "its due date passed before an arm began it"
        case _:
            return "recover", math.nan, f"every motor below {limits.restart_c:g} °C and the fault cleared"


def _releases(world: World, state: State) -> Iterator[Event]:
    start_s = ((state.tick - 1) * world.dt_s)[:, None]
    release_s = world.jobs.release_s
    # The first step also takes the jobs that are there from the beginning.
    new = world.jobs.exists & (release_s <= start_s + world.dt_s)
    new &= (release_s > start_s) | ((start_s == 0) & (release_s == 0))
    for e, j in np.argwhere(new).tolist():
        at_s = float(start_s[e, 0]) + (float(release_s[e, j]) - float(start_s[e, 0]))
        yield Event(time_s=at_s, kind="release", env=e, arm="", job=world.jobs.names[e][j])


LANES, WIDE = JOINTS + 1, 16
"""Padded lengths of the joint and the node axis."""

WORK = np.dtype(
    [(name, "f8") for name in ("travel_s", "cycle_s", "difficulty", "p_saturation")]
    + [(name, "i8") for name in ("risk", "peak", "plan", "volume")]
)
"""What an arm knows of a plan for a kind of job, one cache line: seconds of approach and retreat, and of one
repetition, both 0 where it has none; difficulty; P(saturation) from models that ignore the start temperature, both NaN
where not known; rows of the forecasts of P and of the peak temperature, −1 for none; row of the plan tables, −1 where
it has none; the volume that the plan takes, counted for each fleet."""


class Tables(NamedTuple):
    """What does not change from shift to shift; see `World` for the meaning."""

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
    ambient_c: Array
    """[fleet, tick, arm]."""
    thermal_step: Array
    """Exact thermal step, [fleet, arm, from, wide]: rows 0..13 Φ transposed (temperatures), 14..27 Γ (loads)."""
    to_ambient: Array
    """Conductance to ambient, W/K, [fleet, arm, node]."""
    root_capacity: Array
    """Square root of the heat capacities, [fleet, arm, node]."""
    rates: Array
    """Inverse time constants of the thermal modes, 1/s, [fleet, arm, mode]."""
    modes: Array
    """[fleet, arm, node, mode]."""
    sensor_noise_k: Array
    copper_w_per_a2: Array
    idle_w: Array
    rest_current_sq: Array
    rest_friction_w: Array
    """[fleet, arm, lane], as are the four before."""
    start_c: Array
    """[fleet, arm, node]."""
    times_s: Array
    """[plan, phase]."""
    current_sq: Array
    friction_w: Array
    """[plan, phase, lane], as is the one before."""
    excluded: Array
    """Volumes that no other arm can take meanwhile, one bit each, uint64 [plan, word]."""
    work: Array
    """What an arm knows of its plans for a kind of job, the fastest first, `WORK` [fleet, arm, kind, plan]."""
    housing_keep: Array
    """The arms' observers of their housings, see `fleet.heat.thermal`; [fleet, arm, from, lane]."""
    housing_gain: Array
    """[fleet, arm, from, lane]."""
    housing_winding: Array
    housing_ambient: Array
    """W/K, [fleet, arm, lane], as is the one before."""
    housing_idle_w: Array
    """[fleet, arm, lane]."""
    start_housing_c: Array
    """[fleet, arm, joint]."""
    forecast_first: Array
    """Where the blocks of each forecast begin, int [forecast + 1]; see `fleet.difficulty.forecast_arrays`."""
    forecast_block: Array
    """Pieces, [block, 2 + known, lane]."""
    forecast_curve: Array
    """[forecast, knot, 2]; no knots where no forecast has a curve."""
    too_heavy: Array
    """Whether the load of a kind of job exceeds an arm's rating, bool [fleet, kind, arm]."""
    feasible: Array
    """Whether an arm can do a kind of job at all, bool [fleet, kind, arm]."""
    stations: Array
    """Stations of a kind of job, one bit each, uint64 [fleet, kind + 1, word]; the last row, no job, has none."""
    payload_kg: Array
    value: Array
    """[fleet, kind], as is the one before."""


class Jobs(NamedTuple):
    """What was drawn for the shift of each env."""

    fleet: Array
    """int [env]."""
    ambient_offset_k: Array
    """Added to the ambient temperature of the tables, [env]."""
    noise_key: Array
    """Of the sensor noise, uint64 [env]."""
    number: Array
    """Number of jobs, int [env]; they come first in their row."""
    kind: Array
    """int [env, job]."""
    release_s: Array
    due_s: Array
    """[env, job], as is the one before."""
    repetitions: Array
    """int [env, job]."""
    expires: Array
    """Whether a job expires at its due date if no arm has begun it, bool [env, job]."""
    after: Array
    """Jobs that must be done first, int [env, job, n], −1 for none."""


class OpenJobs(NamedTuple):
    """Jobs that can be claimed, and what follows from the state but is slow to look up."""

    slot_job: Array
    """int [env, slot], −1 for an empty slot."""
    mask: Array
    """Legal actions, int8 [env, arm, option + 2]."""
    alarm: Array
    """Whether an arm at work has passed the warning limit in the last step, bool [env]."""
    station_free: Array
    """Whether no arm occupies the stations of a slot's job, bool [env, slot]."""
    unfinished: Array
    """Jobs neither done nor given up, int [env]."""
    given_up: Array
    """Jobs given up, int [env]."""
    queue: Array
    """Waiting jobs, released or not, by queueing time, int32 [env, job], at the end of each row."""
    head: Array
    """Where in its row the queue begins, int [env]."""
    current_kind: Array
    """Kind of an arm's current job, int [env, arm]; the number of kinds if it has none."""
    closed: Array
    """Volumes that arms away from home exclude, one bit each, uint64 [env, word]."""
    pending: Array
    """Whether the current job is still to be finished, bool [env, arm]; False on the way home."""


class Trace(NamedTuple):
    """How each arm spent the last step; arrays without rows record nothing."""

    mode: Array
    """At the beginning, with the awards made, int [env, arm]."""
    plan: Array
    """Row of the plan tables, int [env, arm]; −1 at home."""
    progress_s: Array
    """At the beginning, [env, arm]."""
    todo: Array
    """int [env, arm]."""
    home_s: Array
    """Seconds into the step at which the arm is free again; inf if not in it, [env, arm]."""
    cut_s: Array
    """Seconds the arm moved before a fault stopped it; the whole step if none did, [env, arm]."""
    heat_w: Array
    """Until the fault, [env, arm, node]."""
    start_c: Array
    """[env, arm, node]."""


class MeasuredDrive(NamedTuple):
    """Heat drive from a plant that computes the motion; without rows the planned drive counts."""

    current_sq: Array
    """Mean over the step, [env, arm, lane]."""
    friction_w: Array
    """Mean over the step, [env, arm, lane]."""


class Form(NamedTuple):
    """A `Layout` as the kernels want it."""

    offsets: Offsets
    """Where each field begins in the vector; unsigned, so that the compiler omits checks for negative indices."""
    low: Array
    """Bounds of the vector, float32 [size]."""
    high: Array
    first_change: Array
    """Where the rows of an arm begin in `change`, int [arm + 1]."""
    who: Array
    """The peers of each arm, int [arm, peer]."""
    change: Array
    """Place among the peers and peer, where an arm's peers differ from those of the arm before, int [change, 2]."""


class Simulation(NamedTuple):
    """Everything that a kernel works on."""

    tables: Tables
    jobs: Jobs
    state: State
    offers: OpenJobs
    events: EventBuffer
    trace: Trace
    drive: MeasuredDrive
    form: Form


def form_of(layout: Layout) -> Form:
    """Every peer of the first arm is a change; in a fleet where each arm observes all others, later arms have one."""
    changes: list[tuple[int, int]] = []
    first, shown = [0], [-1] * layout.peers
    for peers in layout.who.tolist():
        changes += [(place, arm) for place, arm in enumerate(peers) if shown[place] != arm]
        first.append(len(changes))
        shown = peers
    low, high = layout.bounds
    offsets = Offsets(*map(np.uint32, layout.offsets))
    return Form(offsets, low, high, np.array(first), layout.who, np.array(changes, dtype=int).reshape(-1, 2))


def tables_of(world: World) -> tuple[Tables, Jobs]:
    """A world as tables: each env is a fleet of its own, and each job a kind."""
    envs, jobs = world.envs, world.jobs
    count = jobs.exists.sum(axis=1)
    if not np.array_equal(jobs.exists, np.arange(jobs.exists.shape[1]) < count[:, None]):
        raise ValueError("The jobs of an env must be the first of its row.")

    def per_fleet(values: Array) -> Array:
        return np.repeat(values[None], envs, axis=0)

    limits, motors, offers, rest = world.limits, world.motors, world.offers, world.rest
    can = offers.plan >= 0
    times_s = np.where(can[..., None], world.plans.times_s[offers.plan], 0.0)
    work = np.zeros(can.shape, WORK)
    work["travel_s"], work["cycle_s"] = times_s[..., 0] + times_s[..., 2], times_s[..., 1]
    work["difficulty"], work["p_saturation"] = offers.difficulty, offers.p_saturation
    work["risk"], work["peak"], work["plan"] = offers.risk, offers.peak, offers.plan
    work["volume"] = np.where(can, world.plans.volume[offers.plan], 0)
    forecasts, observer = forecast_arrays(offers.forecasts, LANES), world.observer
    thermal_step = np.concatenate([world.phi, world.gamma], axis=-1).swapaxes(-1, -2)
    tables = Tables(
        dt_s=float(world.dt_s),
        ticks=int(world.ticks),
        warning_c=float(limits.warning_c),
        error_c=float(limits.error_c),
        restart_c=float(limits.restart_c),
        clear_s=float(limits.clear_s),
        move_home_s=float(limits.move_home_s),
        power_off=bool(limits.power_off_on_fault),
        alpha_cu_per_k=float(motors.alpha_cu_per_k),
        alpha_kt_per_k=float(motors.alpha_kt_per_k),
        reference_c=float(motors.reference_c),
        ambient_c=per_fleet(world.ambient_c),
        thermal_step=per_fleet(pad(thermal_step, -1, WIDE)),
        to_ambient=per_fleet(world.thermal.to_ambient),
        root_capacity=per_fleet(np.sqrt(world.thermal.capacity)),
        rates=per_fleet(world.thermal.rates),
        modes=per_fleet(world.thermal.modes),
        sensor_noise_k=per_fleet(pad(motors.sensor_noise_k)),
        copper_w_per_a2=per_fleet(pad(motors.copper_w_per_a2)),
        idle_w=per_fleet(pad(motors.idle_w)),
        rest_current_sq=per_fleet(pad(rest.current_sq)),
        rest_friction_w=per_fleet(pad(rest.friction_w)),
        start_c=per_fleet(world.start_c),
        times_s=world.plans.times_s,
        current_sq=pad(world.plans.current_sq),
        friction_w=pad(world.plans.friction_w),
        excluded=bits(world.conflicts[world.plans.volume]),
        work=work,
        housing_keep=per_fleet(pad(observer.keep.swapaxes(-1, -2))),
        housing_gain=per_fleet(pad(observer.gain.swapaxes(-1, -2))),
        housing_winding=per_fleet(pad(observer.from_winding)),
        housing_ambient=per_fleet(pad(observer.from_ambient)),
        housing_idle_w=per_fleet(pad(observer.idle_w)),
        start_housing_c=per_fleet(world.start_housing_c),
        too_heavy=offers.too_heavy.swapaxes(-1, -2),
        **forecasts,
        feasible=np.any(can, axis=-1).swapaxes(-1, -2),
        stations=bits(_one_hot(jobs.stations, len(world.stations))),
        payload_kg=jobs.payload_kg,
        value=jobs.value,
    )
    drawn = Jobs(
        fleet=np.arange(envs),
        ambient_offset_k=np.zeros(envs),
        noise_key=np.zeros(envs, np.uint64),
        number=count,
        kind=np.repeat(np.arange(jobs.exists.shape[1])[None], envs, axis=0),
        release_s=jobs.release_s,
        due_s=jobs.due_s,
        repetitions=jobs.repetitions,
        expires=jobs.expires,
        after=jobs.after,
    )
    return owned(tables), owned(drawn)


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


def _one_hot(stations: Array, count: int) -> Array:
    """Which stations each kind of job occupies, bool [fleet, kind + 1, station]; the last row, no job, has none."""
    flags = np.zeros((stations.shape[0], stations.shape[1] + 1, count), bool)
    fleet, kind, n = np.nonzero(stations >= 0)
    flags[fleet, kind, stations[fleet, kind, n]] = True
    return flags


_FORECAST = tuple(forecast_arrays(None, LANES))
Arrays = TypeVar("Arrays", Tables, Jobs)


def owned(arrays: Arrays) -> Arrays:
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
    plans = np.cumsum([0, *(len(each.times_s) for each in fleets)])
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
