"""The engine: any number of shifts side by side in arrays, stepped by the same loops for one env or a thousand.

Rows are reset here, and reward terms, named and weighted in the scenario, are summed here and reported apart.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, fields
from typing import Any

import numpy as np

from fleet.engine.crossings import hottest
from fleet.engine.play import Executed, Plans, execute
from fleet.engine.state import DONE, RUNNING, WAITING, State
from fleet.engine.step import BLOCK, CLAIM, MOVE, OBSERVE, ROUNDING_S, step_rows
from fleet.engine.tables import (
    LANES,
    PER_ARM,
    Jobs,
    MeasuredDrive,
    OpenJobs,
    Simulation,
    Tables,
    Trace,
    event_buffer,
    form_of,
)
from fleet.heat.thermal import NODES
from fleet.jit import kernel, nonnegative
from fleet.job import MOST_FAULTS
from fleet.motion import Drive
from fleet.observation import Layout
from fleet.robot import JOINTS
from fleet.telemetry import IDLE, WORKING

Array = np.ndarray


@kernel
def reset_rows(
    sim: Simulation,
    rows: Array,
    fleet: Array,
    ambient_offset_k: Array,
    noise_key: Array,
    first: Array,
    kind: Array,
    release_s: Array,
    due_s: Array,
    repetitions: Array,
    expires: Array,
    after: Array,
) -> None:
    """Put new shifts into some envs.

    Args:
        rows: Envs, int [row].
        fleet: Which fleet of the tables, int [row].
        ambient_offset_k: Added to the fleet's ambient temperature, [row].
        noise_key: Of the sensor noise, uint64 [row].
        first: Where the jobs of each row begin in the arrays below, and where the last end, int [row + 1].
        kind: Jobs of all these shifts, int [job]; likewise the following.
        release_s: [job].
        due_s: [job].
        repetitions: int [job].
        expires: bool [job].
        after: int [job, n], −1 for none.
    """
    t, d, s, o = sim.tables, sim.jobs, sim.state, sim.offers
    arms, room, waits = nonnegative(s.mode.shape[1]), nonnegative(d.kind.shape[1]), nonnegative(d.after.shape[2])
    own = nonnegative(after.shape[1])
    for n in range(len(rows)):
        e, at, count = nonnegative(rows[n]), first[n], first[n + 1] - first[n]
        d.fleet[e], d.ambient_offset_k[e], d.noise_key[e], d.number[e] = (
            fleet[n],
            ambient_offset_k[n],
            noise_key[n],
            count,
        )
        o.alarm[e] = False
        s.tick[e], o.unfinished[e], o.given_up[e], o.head[e] = 0, count, 0, 0
        for j in range(count):
            i = at + j
            d.kind[e, j], d.repetitions[e, j], d.expires[e, j] = kind[i], repetitions[i], expires[i]
            d.release_s[e, j], d.due_s[e, j], s.queued_s[e, j] = release_s[i], due_s[i], release_s[i]
            place = j
            while place > 0 and release_s[at + o.queue[e, place - 1]] > release_s[i]:
                o.queue[e, place] = o.queue[e, place - 1]
                place -= 1
            o.queue[e, place] = j
        for j in range(count, room):
            d.kind[e, j], d.repetitions[e, j], d.expires[e, j] = 0, 1, False
            d.release_s[e, j] = d.due_s[e, j] = s.queued_s[e, j] = np.inf
        for j in range(room):
            s.status[e, j], s.cycles[e, j], s.returns[e, j], s.finished_s[e, j] = WAITING, 0, 0, np.nan
            for w in range(MOST_FAULTS - 1):
                s.failed_arm[e, j, w] = -1
            for w in range(waits):
                d.after[e, j, w] = after[at + j, w] if j < count and w < own else -1
        for a in range(arms):
            s.mode[e, a], s.job[e, a], s.plan[e, a] = IDLE, -1, -1
            s.clear_at_s[e, a] = s.moved_at_s[e, a] = np.inf
            o.current_kind[e, a], o.pending[e, a] = t.feasible.shape[1], False
            s.todo[e, a] = s.last_award[e, a] = s.faults[e, a] = s.illegal[e, a] = 0
            s.progress_s[e, a] = s.above_warning_s[e, a] = s.busy_s[e, a] = s.lost_s[e, a] = s.energy_j[e, a] = 0.0
            for node in range(NODES):
                s.temp_c[e, a, node] = t.start_c[fleet[n], a, node] + ambient_offset_k[n]
            for k in range(JOINTS):
                s.housing_c[e, a, k] = t.start_housing_c[fleet[n], a, k] + ambient_offset_k[n]
            s.peak_c[e, a] = hottest(s.temp_c[e, a])


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """What each term is worth to the fleet; all arms share one reward."""

    finished_value: float = 1.0
    """Per unit of value of a finished job."""
    tardiness: float = -0.01
    """Per unit of value and minute by which a job was finished late."""
    above_warning: float = -0.05
    """Per minute an arm has a motor above the warning limit."""
    faults: float = -5.0
    """Per fault; a scenario without `reward.faults` takes the price of a fault, see `FaultPrice`."""
    energy: float = -0.001
    """Per W·h turned to heat."""


@dataclass(frozen=True)
class FaultPrice:
    """What a fault costs a fleet: the value of the jobs that arrive while the arm is expected to be lost."""

    value_per_s: float
    """Expected value of arriving jobs, 1/s."""
    downtime_s: float
    """Expected time from a fault until the arm works again."""

    @property
    def price(self) -> float:
        """The product of both, in units of value."""
        return self.value_per_s * self.downtime_s


TERMS = tuple(f.name for f in fields(RewardWeights))
_UNITS = np.array([1.0, 1.0, 60.0, 1.0, 3600.0])
"""The weights count minutes and watt hours, the simulator seconds and joules."""


def weights_per_unit(weights: RewardWeights) -> np.ndarray:
    """Reward per unit of value, value times minutes late, s above warning, faults and J, [term]."""
    return np.array(astuple(weights)) / _UNITS


FEWEST_JOBS = 2
"""Arrays of one job would count as contiguous, which the kernels would be compiled for once more."""


@dataclass(frozen=True, eq=False)
class Shift:
    """What was drawn for one shift; arrays [job], in the order of release."""

    fleet: int
    """Which fleet of the tables."""
    ambient_offset_k: float
    """Added to the fleet's ambient temperature."""
    kind: Array
    release_s: Array
    due_s: Array
    repetitions: Array
    expires: Array
    """bool [job]."""
    after: Array
    """int [job, n], −1 for none."""
    noise_key: int
    """Of the sensor noise, 64 bits; see `fleet.seeding`."""


class Engine:
    """Steps shifts in place; `reset` puts a new shift into a row.

    Args:
        tables: What does not change.
        envs: Number of rows.
        layout: Of the observation.
        weights: Of the reward terms.
        jobs: Room for this many jobs a shift from the start; more is made when needed.
        events: Record the events of each step in `events`.
        trace: Record in `trace` how each arm spent the last step.
        compiled: Compile the loops, or run them in plain Python; by default as `Kernel.chosen` decides.
        threads: Rows are divided among this many threads; results do not depend on it.
    """

    def __init__(
        self,
        tables: Tables,
        envs: int,
        layout: Layout,
        weights: RewardWeights,
        *,
        jobs: int = 1,
        events: bool = False,
        trace: bool = False,
        compiled: bool | None = None,
        threads: int = 1,
    ) -> None:
        arms, slots, jobs = layout.arms, layout.slots, max(jobs, FEWEST_JOBS)
        self.tables, self.layout = tables, layout
        self._options = (events, trace, compiled, threads)
        self._weights = weights_per_unit(weights)
        self._all = np.arange(envs)
        offers = OpenJobs(
            slot_job=np.full((envs, slots), -1),
            mask=np.zeros((envs, arms, layout.actions), np.int8),
            alarm=np.zeros(envs, bool),
            station_free=np.zeros((envs, slots), bool),
            unfinished=np.zeros(envs, int),
            given_up=np.zeros(envs, int),
            queue=np.zeros((envs, jobs), np.int32),
            head=np.zeros(envs, int),
            current_kind=np.full((envs, arms), tables.feasible.shape[1]),
            closed=np.zeros((envs, tables.excluded.shape[1]), np.uint64),
            pending=np.zeros((envs, arms), bool),
        )
        offers.mask[:, :, 0] = 1
        drawn, state = _arrays(envs, arms, jobs, 0)
        traced = envs if trace else 0
        self._simulation = Simulation(
            tables,
            drawn,
            state,
            offers,
            event_buffer(envs * (arms * PER_ARM + jobs) if events else 0),
            _trace(traced, arms),
            MeasuredDrive(*(np.zeros((0, arms, LANES)) for _ in range(2))),
            form_of(layout),
        )
        self._prepare()

    def _prepare(self) -> None:
        _, _, compiled, threads = self._options
        self._step, self._reset = step_rows.chosen(compiled), reset_rows.chosen(compiled)
        self._bundle: Any = self._simulation  # numba's where the loops are compiled
        if self._step is not step_rows.interpreted:
            from fleet.engine.bundle import bundle_of

            self._bundle = bundle_of(self._simulation)
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        size = -(-len(self._all) // (threads * BLOCK)) * BLOCK if threads > 1 else len(self._all)
        self._shares = [self._all[first : first + size] for first in range(0, len(self._all), size)]

    @property
    def envs(self) -> int:
        """Number of rows."""
        return len(self._all)

    @property
    def offers(self) -> OpenJobs:
        """Jobs that can be claimed now, and the action mask; views that the next step overwrites."""
        return self._simulation.offers

    @property
    def mask(self) -> Array:
        """Legal actions now, int8 [env, arm, option + 2]; a view that the next step overwrites."""
        return self._simulation.offers.mask

    @property
    def choice(self) -> Array:
        """Whether an arm may claim a job, or one at work has just passed the warning limit, bool [env]."""
        offers = self._simulation.offers
        return offers.mask[:, :, 1:-1].any(axis=(1, 2)) | offers.alarm

    @property
    def state(self) -> State:
        """The state itself; views that the next step overwrites. After writing into it call `refresh`."""
        return self._simulation.state

    @property
    def jobs(self) -> Jobs:
        """The jobs of the shifts; not to be written into."""
        return self._simulation.jobs

    @property
    def unfinished(self) -> Array:
        """Jobs neither done nor given up, int [env]."""
        return self._simulation.offers.unfinished

    @property
    def done(self) -> Array:
        """Jobs done, int [env]."""
        return self.jobs.number - self.unfinished - self._simulation.offers.given_up

    @property
    def events(self) -> Any:  # numba's where the loops are compiled
        """The `EventBuffer` of the last step."""
        return self._simulation.events

    @property
    def trace(self) -> Trace:
        """How each arm spent the last step."""
        return self._simulation.trace

    def reset(self, envs: Array, shifts: Sequence[Shift]) -> None:
        """Put a new shift into each of some rows; `observe` then gives what their arms know."""
        first = np.cumsum([0, *(len(shift.kind) for shift in shifts)])
        most, room = max(shift.after.shape[1] for shift in shifts), self.jobs.kind.shape[1]
        after = np.concatenate([_widen(shift.after, most) for shift in shifts])
        waits = int((after >= 0).sum(axis=1).max(initial=0))
        after = -np.sort(-after, axis=1)[:, :waits]
        jobs = int(np.diff(first).max())
        if jobs > room or waits > self.jobs.after.shape[2]:
            self._make_room(jobs, waits)

        def of_all(name: str) -> Array:
            return np.concatenate([getattr(shift, name) for shift in shifts])

        self._reset(
            self._bundle, envs,
            np.array([shift.fleet for shift in shifts]), np.array([shift.ambient_offset_k for shift in shifts]),
            np.array([shift.noise_key for shift in shifts], np.uint64), first,
            of_all("kind"), of_all("release_s"), of_all("due_s"), of_all("repetitions"), of_all("expires"), after,
        )  # fmt: skip

    def observe(self, envs: Array, out: Array) -> None:
        """Put what the arms of some envs know now into `out`, float32 [env, arm, size]."""
        self._run(OBSERVE, _NO_ACTIONS, _NO_TERMS, envs, out)

    def step(self, actions: Array | None, out: Array, until: Array | None = None) -> tuple[Array, Array, Array]:
        """One decision interval of every env, or more.

        Args:
            actions: int64 [env, arm]; anything outside the mask is a wait, and counted. None: no claims, and the
                outcome of the last claims remains.
            out: Receives what the arms know afterwards, float32 [env, arm, size].
            until: Go on while no arm has a `choice`, to this tick at most, int64 [env]. The events and the trace are
                then those of the last interval alone.

        Returns:
            Weighted reward terms [env, term], their sum [env], and which envs have done all their jobs, bool [env].
        """
        self._clear_events()
        if actions is None:
            return self._stepped(MOVE + OBSERVE, _NO_ACTIONS, out, until)
        return self._stepped(CLAIM + MOVE + OBSERVE, actions, out, until)

    def claim(self, actions: Array | None) -> None:
        """The first part of `step` alone: award jobs. `move` must follow."""
        self._clear_events()
        if actions is not None:
            self._run(CLAIM, actions, _NO_TERMS, self._all, _NO_VECTORS)

    def move(self, drive: Drive, out: Array) -> tuple[Array, Array, Array]:
        """The rest of `step`, for arms that were seen to move.

        Args:
            drive: Mean heat drive over the step, each [env, arm, joint].
            out: As in `step`, like the result.
        """
        measured = self._simulation.drive
        if not len(measured.current_sq):
            measured = MeasuredDrive(*(np.zeros((self.envs, self.layout.arms, LANES)) for _ in range(2)))
            self._simulation = self._simulation._replace(drive=measured)
            self._prepare()
        measured.current_sq[..., :JOINTS], measured.friction_w[..., :JOINTS] = drive.current_sq, drive.friction_w
        return self._stepped(MOVE + OBSERVE, _NO_ACTIONS, out)

    def play(self, schedules: Plans, discount: Array) -> Executed:
        """Execute one schedule in each of the first rows, from the present state to the end of the shift.

        Args:
            discount: Factor on the reward of each step of a shift, [tick].
        """
        return execute(self._bundle, self._weights, self.envs, schedules, discount, compiled=self._options[2])

    def _stepped(
        self, parts: int, actions: Array, out: Array, until: Array | None = None
    ) -> tuple[Array, Array, Array]:
        terms = np.empty((self.envs, len(TERMS) + 1))
        if self._pool is None:
            self._run(parts, actions, terms, self._all, out, until)
        else:
            own, *others = self._shares
            done = [self._pool.submit(self._run, parts, actions, terms, share, out, until) for share in others]
            self._run(parts, actions, terms, own, out, until)
            for each in done:
                each.result()
        return terms[:, :-1], terms[:, -1], (self.unfinished == 0) & (self.jobs.number > 0)

    def _clear_events(self) -> None:
        self._simulation.events.used[0] = 0

    def _run(
        self, parts: int, actions: Array, terms: Array, rows: Array, out: Array, until: Array | None = None
    ) -> None:
        until = _ONE_INTERVAL if until is None else until
        self._step(self._bundle, parts, actions, self._weights, terms, until, rows, out)

    def load(self, state: State) -> None:
        """Take over a state with at most as many jobs, and what follows from it."""
        for mine, given in zip(self.state, state, strict=True):
            mine[tuple(slice(0, n) for n in given.shape)] = given
        self.refresh()

    def refresh(self) -> None:
        """Derive queue and current jobs again from the state."""
        state, jobs, offers = self.state, self.jobs, self.offers
        room = state.status.shape[1]
        exists = np.arange(room) < jobs.number[:, None]
        waiting = exists & (state.status == WAITING)
        order = np.argsort(np.where(waiting, state.queued_s, -np.inf), axis=1, kind="stable")
        # Waiting jobs fill a row up to its last job.
        for e in range(self.envs):
            count, n = int(jobs.number[e]), int(waiting[e].sum())
            offers.queue[e, count - n : count] = order[e, room - n :]
            offers.head[e] = count - n
        offers.unfinished[:] = (exists & (state.status < DONE)).sum(axis=1)
        offers.given_up[:] = (exists & (state.status > DONE)).sum(axis=1)
        env = np.arange(self.envs)[:, None]
        working = (state.mode == WORKING) & (state.job >= 0)
        offers.current_kind[:] = np.where(working, jobs.kind[env, state.job], self.tables.feasible.shape[1])
        times_s = self.tables.times_s[state.plan]
        ends_s = times_s[..., 0] + state.todo * times_s[..., 1]
        # An arm on its way home may still have the number of a job that it finished or gave back.
        offers.pending[:] = (
            working & (state.status[env, state.job] == RUNNING) & (state.progress_s < ends_s - ROUNDING_S)
        )

    def _make_room(self, jobs: int, waits: int) -> None:
        """For more jobs a shift, a tenth more than asked for, keeping what is there."""
        room = self.jobs.kind.shape[1]
        jobs = jobs + jobs // 10 if jobs > room else room
        waits = max(self.jobs.after.shape[2], waits)
        envs, arms = self.state.mode.shape
        drawn, state = _arrays(envs, arms, jobs, waits)
        queue = np.zeros((envs, jobs), np.int32)
        before = self._simulation
        for new, old in zip((*drawn, *state, queue), (*before.jobs, *before.state, before.offers.queue), strict=True):
            new[tuple(slice(0, n) for n in old.shape)] = old
        events = event_buffer(envs * (arms * PER_ARM + jobs) if len(before.events.what) else 0)
        for new, old in zip(events, before.events, strict=True):
            new[: len(old)] = old
        offers = before.offers._replace(queue=queue)
        self._simulation = before._replace(jobs=drawn, state=state, offers=offers, events=events)
        self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k not in ("_step", "_reset", "_bundle", "_pool", "_shares")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make_room(0, 0)  # unpickled arrays no longer lie job by job; prepares too


_NO_ACTIONS, _NO_TERMS = np.zeros((0, 0), np.int64), np.zeros((0, 0))
_NO_VECTORS, _ONE_INTERVAL = np.zeros((0, 0, 0), np.float32), np.zeros(0, np.int64)


def _widen(after: Array, waits: int) -> Array:
    return np.pad(after, ((0, 0), (0, waits - after.shape[1])), constant_values=-1)


def _trace(envs: int, arms: int) -> Trace:
    whole = {name: np.zeros((envs, arms), int) for name in ("mode", "plan", "todo")}
    times = {name: np.zeros((envs, arms)) for name in ("progress_s", "home_s", "cut_s")}
    return Trace(**whole, **times, heat_w=np.zeros((envs, arms, NODES)), start_c=np.zeros((envs, arms, NODES)))


CACHE_LINE = 64
_RECORD = ("release_s", "due_s", "queued_s", "kind", "repetitions", "cycles", "returns", "status")
"""What is looked up together of a job lies in one cache line."""


def _arrays(envs: int, arms: int, jobs: int, waits: int) -> tuple[Jobs, State]:
    """Arrays for a number of jobs, each of which waits for up to `waits` others; there are none yet."""
    line = CACHE_LINE // 8
    room = np.zeros(envs * jobs * line + line)
    first = -room.ctypes.data % CACHE_LINE // 8
    records = room[first : first + envs * jobs * line].reshape(envs, jobs, line)
    job = {
        name: (records if name.endswith("_s") else records.view(np.int64))[..., place]
        for place, name in enumerate(_RECORD)
    }
    job["release_s"][:], job["due_s"][:], job["repetitions"][:] = np.inf, np.inf, 1
    drawn = Jobs(
        fleet=np.zeros(envs, int),
        ambient_offset_k=np.zeros(envs),
        noise_key=np.zeros(envs, np.uint64),
        number=np.zeros(envs, int),
        expires=np.zeros((envs, jobs), bool),
        after=np.full((envs, jobs, waits), -1),
        **{name: job[name] for name in ("kind", "release_s", "due_s", "repetitions")},
    )
    seconds = ("progress_s", "clear_at_s", "moved_at_s", "above_warning_s", "busy_s", "lost_s")
    per_arm = {name: np.zeros((envs, arms)) for name in (*seconds, "peak_c", "energy_j")}
    whole = ("mode", "job", "plan", "todo", "last_award", "faults", "illegal")
    counts = {name: np.zeros((envs, arms), int) for name in whole}
    state = State(
        tick=np.zeros(envs, int),
        temp_c=np.zeros((envs, arms, NODES)),
        housing_c=np.zeros((envs, arms, JOINTS)),
        **per_arm,
        **counts,
        finished_s=np.zeros((envs, jobs)),
        failed_arm=np.zeros((envs, jobs, MOST_FAULTS - 1), int),
        **{name: job[name] for name in ("status", "queued_s", "cycles", "returns")},
    )
    return drawn, state


def shifts_of(drawn: Jobs, noise_keys: Sequence[int]) -> list[Shift]:
    """The shifts of a world as `tables_of` gives it, with the keys of their sensor noise."""
    return [
        Shift(
            fleet=int(drawn.fleet[e]),
            ambient_offset_k=float(drawn.ambient_offset_k[e]),
            kind=drawn.kind[e, :count],
            release_s=drawn.release_s[e, :count],
            due_s=drawn.due_s[e, :count],
            repetitions=drawn.repetitions[e, :count],
            expires=drawn.expires[e, :count],
            after=drawn.after[e, :count],
            noise_key=key,
        )
        for e, (count, key) in enumerate(zip(drawn.number.tolist(), noise_keys, strict=True))
    ]
