"""What happens in shifts besides the engine.

What arms tell each other over an exchange, how they move, events and records of single steps, and steps by themselves.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Protocol

import numpy as np

from fleet.bus.exchange.memory import Broadcast, Exchange, PeerView
from fleet.engine import tables as event_numbers
from fleet.engine.batch import Engine, Parts, RewardWeights, Shift, empty_parts
from fleet.engine.state import EXPIRED, GIVEN_UP, State
from fleet.engine.tables import TRACE, EventBuffer
from fleet.engine.world import World
from fleet.events import Event, EventKind
from fleet.motion import Drive
from fleet.observation import LONG_S, Layout
from fleet.robot import GEN3
from fleet.seeding import key_of
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray


def deliver(
    exchange: Exchange, engine: Engine, parts: Parts, names: Sequence[str], twins: tuple[str, ...], env: int = 0
) -> None:
    """Broadcast what the arms of an env know now, and replace what they know of each other by what was delivered.

    Args:
        parts: Observations of all envs, in a layout with `delivered`.
        names: Of the env's jobs, [job].
        twins: Version of each arm's difficulty model.
    """
    view = exchange.share(broadcast(engine, parts, names, twins, env))
    write_members(engine.layout, view, engine.offers.slot_job[env] >= 0, parts[1][env])


def broadcast(engine: Engine, parts: Parts, names: Sequence[str], twins: tuple[str, ...], env: int = 0) -> Broadcast:
    """What the arms of an env broadcast at this moment; arguments as in `deliver`."""
    layout, slots = engine.layout, engine.offers.slot_job[env]
    known = layout.read_parts(parts[0][env], parts[1][env], engine.mask[env])
    tables, fleet = engine.tables, engine.state.fleet[env]
    kinds = np.where(slots >= 0, engine.state.kind[env, slots], 0)
    filled = slots >= 0
    work = tables.work[fleet, kinds].swapaxes(0, 1)
    unknown = (work["risk"] < 0) & (work["peak"] < 0) & np.isnan(work["p_saturation"])  # [arm, slot, plan]
    duration_s, peak_c, p_saturation = (
        each.reshape(unknown.shape).astype(float) for each in (known.duration_s, known.peak_c, known.p_saturation)
    )
    has_plan = filled[..., None] & (duration_s > 0)
    return Broadcast(
        time_s=float(engine.state.tick[env] * tables.dt_s),
        mode=np.where(engine.state.absent[env] > 0, FAULTED, engine.state.mode[env]).astype(int),
        busy_s=known.busy_s.astype(float),
        temp_c=known.temp_c.astype(float),
        headroom_k=known.headroom_k.astype(float),
        jobs=tuple(names[j] if j >= 0 else "" for j in map(int, slots)),
        difficulty=np.fmin.reduce(np.where(filled[:, None], work["difficulty"], np.nan), axis=-1),
        duration_s=np.where(has_plan, duration_s, np.nan),
        peak_c=np.where(has_plan & (peak_c != 0), peak_c, np.nan),
        p_saturation=np.where(has_plan & ~unknown, p_saturation, np.nan),
        twin=twins,
    )


def write_members(layout: Layout, view: PeerView, filled: Array, own: Array) -> None:
    """Put what each arm received of its members into their parts of the observation, [arm, own].

    Args:
        filled: Whether a slot holds a job, bool [slot].
    """
    rows, members = np.arange(layout.arms)[:, None], layout.members

    def received(values: Array) -> Array:
        return values[rows, members]  # [arm, member, ...]

    age_s, mode = received(view.age_s), received(view.mode)
    never = np.isinf(age_s)
    fields = {
        "fleet_age_s": np.where(never, LONG_S, age_s),
        "fleet_working": ~never & (mode == WORKING),
        "fleet_faulted": ~never & (mode == FAULTED),
        "fleet_busy_s": np.nan_to_num(received(view.busy_s)),
        "fleet_headroom_k": np.nan_to_num(received(view.headroom_k)),
        "fleet_difficulty": np.where(filled, np.nan_to_num(received(view.difficulty), nan=-1.0), 0.0),
    }
    if layout.bids:
        duration_s, peak_c, p_saturation = map(received, (view.duration_s, view.peak_c, view.p_saturation))
        p_saturation = np.where(np.isnan(p_saturation) & (duration_s > 0), 0.5, p_saturation)
        bids = {"fleet_duration_s": duration_s, "fleet_peak_c": peak_c, "fleet_p_saturation": p_saturation}
        fields |= {name: np.nan_to_num(values).reshape(*age_s.shape, -1) for name, values in bids.items()}
    layout.write(own, fields)


@dataclass(frozen=True, eq=False)
class StepRecord:
    """How the arms of one env spent consecutive steps."""

    tick: Array
    """int [step]."""
    mode: Array
    """At the beginning, with the awards made, int [step, arm]."""
    plan: Array
    """Row of the plan table, int [step, arm]; −1 at home."""
    progress_s: Array
    """Time since leaving home, at the beginning, [step, arm]."""
    todo: Array
    """Cycles the arm set out to do, int [step, arm]."""
    home_s: Array
    """Seconds into the step at which the arm is free again; inf if not in it, [step, arm]."""
    cut_s: Array
    """Seconds the arm moved before a fault stopped it; the whole step if none did, [step, arm]."""
    heat_w: Array
    """Until the fault, [step, arm, node]."""
    start_c: Array
    """[step, arm, node]."""
    end_c: Array
    """[step, arm, node]."""


class Plant(Protocol):
    """Moves the arms of one env."""

    follows_plans: bool
    """Whether arms move as planned; then `drive` is not asked for."""
    most_steps: int
    """Steps that `motion` can give at a time, the latest ones."""

    def drive(self, world: World, state: State) -> Drive:
        """Mean heat drive over the coming step, each [env, arm, joint].

        Args:
            state: At the beginning of the step, with the awards made.
        """
        ...

    def motion(self, world: World, record: StepRecord, offsets_s: Array) -> Array:
        """Joint motion at moments of steps, [step, sample, arm, channel, joint]; called for each step once, in order.

        Args:
            offsets_s: Moments within each step, [sample], in (0, dt_s].
        """
        ...

    def contacts(self, world: World, record: StepRecord) -> Sequence[Event]:
        """Contacts that began in a step; called for each step once, in order, and only if events are kept."""
        ...


@dataclass(frozen=True, eq=False)
class Episode:
    """One shift, ready to run."""

    world: World
    plant: Plant
    twins: tuple[str, ...]
    """Version of each arm's difficulty model."""
    sensors: np.random.SeedSequence
    """Of the sensors' noise; `fleet.seeding.exchange_seed` follows from it."""

    @property
    def noise_key(self) -> int:
        """Key of the sensors' noise; see `fleet.seeding`."""
        return key_of(self.sensors)

    @property
    def shift(self) -> Shift:
        """As the engine has it, with the noise of its sensors."""
        return replace(self.world.shifts[0], noise_key=self.noise_key)

    @property
    def drive(self) -> Callable[[State], Drive] | None:
        """Heat drive of the coming step, from the state with the awards made; None if arms move as planned."""
        return None if self.plant.follows_plans else partial(self.plant.drive, self.world)


EpisodeFactory = Callable[[np.random.SeedSequence], Episode]
"""Makes the episode of a seed; the fleet must be the same for every seed."""
Watch = Callable[[StepRecord], None]


def events_of(world: World, state: State, buffer: EventBuffer) -> Iterator[Event]:
    """The events of the step that led to `state`; releases of jobs come last.

    Args:
        state: After the step.
    """
    count = int(buffer.used[0])
    what, numbers = buffer.what[:count], buffer.numbers[:count]
    began_s = (state.tick - 1) * world.dt_s
    # What becomes of the job follows the fault of its arm.
    of_fault = event_numbers.FAILURE, event_numbers.RETURN, event_numbers.GIVE_UP
    phase = np.where(np.isin(what[:, 0], of_fault), event_numbers.FAULT, what[:, 0])
    for row in np.lexsort((what[:, 2], what[:, 1], phase)).tolist():
        kind, e, a, j, joint = what[row].tolist()
        offset_s, value = numbers[row].tolist()
        plan, joint = (joint, -1) if kind == event_numbers.AWARD else (-1, joint)
        name, measured, reason = _described(world, state, kind, e, j, joint, value)
        common = {"time_s": float(began_s[e] + offset_s), "env": e, "arm": world.arms[a] if a >= 0 else ""}
        common["job"] = world.shifts[e].names[j] if j >= 0 else ""
        yield Event(kind=name, joint=joint + 1, value=measured, reason=reason, **common)
        if kind == event_numbers.AWARD:
            peak, most = world.fleet[a].driven(world.plans[plan])[3], GEN3.torque_warning
            over = peak - np.array(most)
            if (over > 0).any():
                k = int(over.argmax())
                text = f"joint {k + 1} reaches {peak[k]:.1f} N·m, warning at {most[k]:.1f}"
                yield Event(kind="torque_warning", joint=k + 1, value=float(peak[k]), reason=text, **common)
    yield from _releases(world, state)


def _described(
    world: World, state: State, kind: int, e: int, j: int, joint: int, value: float
) -> tuple[EventKind, float, str]:
    """Name, value and reason of an event."""
    tables = world.tables
    match kind:
        case event_numbers.AWARD:
            return "award", value, ""
        case event_numbers.LOST:
            return "lost", math.nan, "another arm claimed it, its station or the space"
        case event_numbers.ILLEGAL:
            return "illegal", math.nan, "action outside the mask: a wait"
        case event_numbers.WARNING:
            return "warning", tables.warning_c, f"joint {joint + 1} passed {tables.warning_c:g} °C"
        case event_numbers.FINISH:
            late_s = max(0.0, float(state.finished_s[e, j] - world.shifts[e].due_s[j]))
            return "finish", late_s, f"late by {late_s:.0f} s" if late_s else "on time"
        case event_numbers.HOME:
            return "home", math.nan, ""
        case event_numbers.FAULT:
            return "fault", tables.error_c, f"joint {joint + 1} passed {tables.error_c:g} °C"
        case event_numbers.RETURN | event_numbers.GIVE_BACK:
            kept = f"{state.cycles[e, j]} of {state.repetitions[e, j]} cycles kept"
            return "return" if kind == event_numbers.RETURN else "give_back", value, kept
        case event_numbers.GIVE_UP if value == event_numbers.FOLLOWS:
            before = [b for b in world.shifts[e].after[j].tolist() if b >= 0]
            lost = next(b for b in before if state.status[e, b] in (GIVEN_UP, EXPIRED))
            how = "expired" if state.status[e, lost] == EXPIRED else "was given up"
            return "give_up", math.nan, f"it waited for {world.shifts[e].names[lost]}, which {how}"
        case event_numbers.GIVE_UP:
            return "give_up", value, f"{state.returns[e, j]} faults; {state.cycles[e, j]} cycles done"
        case event_numbers.MOVED:
            return "moved", math.nan, "moved home by a person"
        case event_numbers.EXPIRE:
            return "expire", math.nan, "its due date passed while it waited"
        case event_numbers.FAILURE:
            return "failure", value, f"not by heat; repaired after {_minutes(value)}"
        case event_numbers.BREAK:
            return "break", value, f"for {_minutes(value)}"
        case event_numbers.BREAK_END:
            return "break_end", math.nan, ""
        case _ if math.isnan(value):
            return "recover", math.nan, "repaired"
        case _:
            return "recover", math.nan, f"every motor below {tables.restart_c:g} °C and the fault cleared"


def _minutes(time_s: float) -> str:
    return f"{round(time_s / 60, 1):g} min"


def _releases(world: World, state: State) -> Iterator[Event]:
    for e, (shift, tick) in enumerate(zip(world.shifts, state.tick.tolist(), strict=True)):
        start_s = (tick - 1) * world.dt_s
        new = (shift.release_s > start_s) & (shift.release_s <= start_s + world.dt_s)
        if start_s == 0:  # also the jobs that are there from the beginning
            new |= shift.release_s == 0
        for j in np.flatnonzero(new).tolist():
            at_s = start_s + (float(shift.release_s[j]) - start_s)
            yield Event(time_s=at_s, kind="release", env=e, arm="", job=shift.names[j])


def record_of(engine: Engine, env: int = 0) -> StepRecord:
    """The record of the last step of one env, with one step."""
    row = slice(env, env + 1)
    return _recorded(engine, engine.state.tick[row] - 1, row)


def _recorded(engine: Engine, tick: Array, rows: slice = slice(None)) -> StepRecord:
    traced = {name: engine.trace[name][rows].copy() for name in TRACE.names or ()}
    return StepRecord(tick=tick, end_c=engine.state.temp_c[rows].astype(float), **traced)


def stack_records(records: list[StepRecord]) -> StepRecord:
    """Records of consecutive steps as one."""
    return StepRecord(*(np.concatenate([getattr(r, name) for r in records]) for name in StepRecord.__annotations__))


@dataclass(frozen=True, eq=False)
class Stepped:
    """Result of `step`."""

    state: State
    """After the step."""
    record: StepRecord
    """Of each env, its only step: [env, arm, ...]."""


def step(
    world: World,
    before: State,
    actions: Array,
    plant: Plant,
    log: list[Event] | None = None,
    *,
    compiled: bool | None = None,
) -> Stepped:
    """One decision interval from a given state, which is left untouched.

    Args:
        actions: 0 waits or goes on, k claims option k - 1, the last action gives the job back, int [env, arm].
        log: Receives the events, if given.
        compiled: As in `Engine`; a single arm in real time runs uncompiled.
    """
    engine, out = _engine_of(world, compiled)
    engine.load(before)
    engine.observe(np.arange(engine.envs), out)  # offers of this state
    drive = None if plant.follows_plans else partial(plant.drive, world)
    engine.step(np.ascontiguousarray(actions, dtype=np.int64), out, drive=drive)
    if log is not None:
        log += events_of(world, engine.state, engine.events)
    return Stepped(engine.state.copy(jobs=slice(world.jobs)), _recorded(engine, before.tick.copy()))


def initial(world: World) -> State:
    """Every arm at home, at its start temperature; every job waiting."""
    engine, _ = _engine_of(world, False)
    engine.reset(np.arange(engine.envs), world.shifts)
    return engine.state.copy(jobs=slice(world.jobs))


def open_jobs(world: World, state: State, *, compiled: bool | None = None) -> tuple[Array, Array]:
    """Jobs in the slots, int [env, slot], and legal actions, int8 [env, arm, option + 2], in a state."""
    engine, out = _engine_of(world, compiled)
    engine.load(state)
    engine.observe(np.arange(engine.envs), out)
    return engine.offers.slot_job.copy(), engine.mask.copy()


@lru_cache(maxsize=4)
def _engine_of(world: World, compiled: bool | None) -> tuple[Engine, Parts]:
    """An engine for a world, and room for its observations."""
    envs, layout = len(world.shifts), Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    engine = Engine(
        world.tables, envs, layout, RewardWeights(), jobs=world.jobs, events=True, trace=True, compiled=compiled
    )
    engine.reset(np.arange(envs), world.shifts)
    return engine, empty_parts(layout, envs)
