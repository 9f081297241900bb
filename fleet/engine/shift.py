"""What arms tell each other over an exchange, and how it enters their observations.

One shift, step by step: the engine with one row, a plant, an exchange, an event log and a watcher.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from fleet.bus.exchange.memory import Broadcast, Exchange, PeerView
from fleet.engine.batch import Engine, Parts, RewardWeights, empty_parts, shifts_of
from fleet.engine.state import State, World
from fleet.engine.tables import TRACE, events_of, tables_of
from fleet.events import Event
from fleet.motion import Drive
from fleet.observation import LONG_S, Layout
from fleet.seeding import exchange_seed, key_of
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


EpisodeFactory = Callable[[np.random.SeedSequence], Episode]
"""Makes the episode of a seed; the fleet must be the same for every seed."""
Watch = Callable[[StepRecord], None]


class ShiftRunner:
    """Steps one shift.

    Args:
        exchange: Carries what arms tell each other; perfect and immediate if not given.
        keep_events: Collect events in `events`.
        watch: Called with the record of every step.
        layout: Of the observation; all peers if not given.
        compiled: As in `Engine`.
    """

    def __init__(
        self,
        episode: Episode,
        weights: RewardWeights,
        *,
        exchange: Exchange | None = None,
        keep_events: bool = False,
        watch: Watch | None = None,
        layout: Layout | None = None,
        compiled: bool | None = None,
    ) -> None:
        world = episode.world
        self._episode, self._watch = episode, watch
        at_once = exchange is None or exchange.perfect
        layout = layout or Layout(len(world.arms), world.slots, plans=world.plans_per_job)
        layout = replace(layout, delivered=not at_once)
        self._reports_contacts = keep_events and not episode.plant.follows_plans
        self._exchange = None if at_once else exchange
        self._delivered_before = 0
        if self._exchange is not None:
            self._exchange.begin(np.random.default_rng(exchange_seed(episode.sensors)))
            self._delivered_before = self._exchange.delivered
        self.events: list[Event] = []
        tables, drawn = tables_of(world)
        room = world.jobs.exists.shape[1]
        trace = watch is not None or self._reports_contacts
        self._engine = Engine(tables, 1, layout, weights, jobs=room, events=keep_events, trace=trace, compiled=compiled)
        self._engine.reset(_FIRST, shifts_of(drawn, [episode.noise_key]))
        self._parts = empty_parts(layout, 1)
        self._engine.observe(_FIRST, self._parts)
        self._deliver()

    @cached_property
    def state(self) -> State:
        """The simulator's state, [1, ...]; views that the next step overwrites."""
        return _without_room(self._engine.state, self._episode.world)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "state"}  # a copy has views of its own

    @property
    def layout(self) -> Layout:
        """Of the observation."""
        return self._engine.layout

    @property
    def parts(self) -> Parts:
        """What the arms know, float32 [shared] and [arm, own]; the next step overwrites it."""
        return self._parts[0][0], self._parts[1][0]

    @property
    def mask(self) -> Array:
        """Legal actions, int8 [arm, option + 2]; the next step overwrites it."""
        return self._engine.mask[0]

    @property
    def choice(self) -> bool:
        """Whether an arm may claim a job, or one at work has just passed the warning limit."""
        return bool(self._engine.choice[0])

    @property
    def slot_job(self) -> Array:
        """Jobs in the slots, int [slot], −1 for an empty one; the next step overwrites it."""
        return self._engine.offers.slot_job[0]

    @property
    def messages(self) -> int:
        """Messages delivered to a peer."""
        if self._exchange is not None:
            return self._exchange.delivered - self._delivered_before
        return self.layout.arms * (self.layout.arms - 1) * (self.tick + 1)

    @property
    def infos(self) -> list[tuple[float, float, float, float]]:
        """Faults, illegal actions, hottest motor, °C, and s above the warning limit of each arm so far."""
        return self._engine.infos[0].tolist()

    @property
    def tick(self) -> int:
        """Decision intervals that are over."""
        return int(self._engine.state.tick[0])

    @property
    def engine(self) -> Engine:
        """The engine, with one row."""
        return self._engine

    def step(self, actions: Array | None) -> Array:
        """One decision interval; returns its outcome, [OUTCOME], as `Engine.step` does.

        Args:
            actions: int64 [arm]. None: no claims, and the outcome of the last ones remains.
        """
        engine, world, plant = self._engine, self._episode.world, self._episode.plant
        chosen = None if actions is None else actions[None]
        outcome = _stepped(engine, world, plant, chosen, self._parts)[0]
        if len(engine.events.what):
            self.events += events_of(world, engine.state, engine.events)
        if self._reports_contacts:
            self.events += plant.contacts(world, record_of(engine))
        if self._watch is not None:
            self._watch(record_of(engine))
        self._deliver()
        return outcome

    def _deliver(self) -> None:
        """Replace what the arms observe of their peers by what the exchange delivered."""
        if self._exchange is not None:
            names, twins = self._episode.world.jobs.names[0], self._episode.twins
            deliver(self._exchange, self._engine, self._parts, names, twins)


_FIRST = np.zeros(1, dtype=int)


def _stepped(engine: Engine, world: World, plant: Plant, actions: Array | None, out: Parts) -> Array:
    if plant.follows_plans:
        return engine.step(actions, out)
    engine.claim(actions)
    return engine.move(plant.drive(world, engine.state), out)


def _without_room(state: State, world: World) -> State:
    """Views of the state with as many jobs as the world has; an engine may have room for more."""
    jobs = world.jobs.exists.shape[1]
    return state.of_jobs(slice(0, jobs))


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
    engine.observe(np.arange(world.envs), out)  # offers of this state
    _stepped(engine, world, plant, np.ascontiguousarray(actions, dtype=np.int64), out)
    if log is not None:
        log += events_of(world, engine.state, engine.events)
    return Stepped(_without_room(engine.state, world).copy(), _recorded(engine, before.tick.copy()))


def initial(world: World) -> State:
    """Every arm at home, at its start temperature; every job waiting."""
    engine, _ = _engine_of(world, False)
    engine.reset(np.arange(world.envs), shifts_of(tables_of(world)[1], [0] * world.envs))
    return _without_room(engine.state, world).copy()


def open_jobs(world: World, state: State, *, compiled: bool | None = None) -> tuple[Array, Array]:
    """Jobs in the slots, int [env, slot], and legal actions, int8 [env, arm, option + 2], in a state."""
    engine, out = _engine_of(world, compiled)
    engine.load(state)
    engine.observe(np.arange(world.envs), out)
    return engine.offers.slot_job.copy(), engine.mask.copy()


@lru_cache(maxsize=4)
def _engine_of(world: World, compiled: bool | None) -> tuple[Engine, Parts]:
    """An engine for a world, and room for its observations."""
    tables, drawn = tables_of(world)
    layout = Layout(len(world.arms), world.slots, plans=world.plans_per_job)
    room = world.jobs.exists.shape[1]
    engine = Engine(tables, world.envs, layout, RewardWeights(), jobs=room, events=True, trace=True, compiled=compiled)
    engine.reset(np.arange(world.envs), shifts_of(drawn, [0] * world.envs))
    return engine, empty_parts(layout, world.envs)
