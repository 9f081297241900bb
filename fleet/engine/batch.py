"""The engine: any number of shifts side by side in arrays, stepped by the same loops for one env or a thousand.

Rows are reset here, and reward terms, named and weighted in the scenario, are summed here and reported apart.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, field, fields
from typing import Any

import numpy as np

from fleet.engine.claims import set_phase
from fleet.engine.corrections import line_of
from fleet.engine.crossings import hottest
from fleet.engine.observe import average_excess, excess_of
from fleet.engine.state import ABSENCE, DONE, RUNNING, WAITING, State, no_absences
from fleet.engine.step import (
    BLOCK,
    CLAIM,
    MOVE,
    OBSERVE,
    OFFER,
    OUTCOME,
    PLAY,
    ROUNDING_S,
    step_rows,
)
from fleet.engine.tables import (
    DRIVE,
    INFO,
    NO_SCRIPT,
    PER_ARM,
    TRACE,
    OpenJobs,
    Plans,
    Room,
    Script,
    Simulation,
    Tables,
    empty_state,
    event_buffer,
    form_of,
    room_for,
    script_of,
)
from fleet.heat.thermal import NODES
from fleet.jit import kernel, nonnegative
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
    absences: Array,
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
        absences: `ABSENCE` [row, absence].
    """
    t, s = sim.tables, sim.state
    for n in range(len(rows)):
        e, at, count = nonnegative(rows[n]), first[n], first[n + 1] - first[n]
        env, jobs, queue = s.env[e], s.jobs[e], s.queue[e]
        env["fleet"], env["ambient_offset_k"], env["noise_key"] = fleet[n], ambient_offset_k[n], noise_key[n]
        env["number"] = env["unfinished"] = count
        env["tick"] = env["given_up"] = env["head"] = env["turn"] = 0
        env["alarm"], env["changed"] = False, True
        for j in range(len(jobs)):
            job, exists = jobs[j], j < count
            job["kind"], job["repetitions"], job["expires"] = 0, 1, False
            job["release_s"] = job["due_s"] = np.inf
            job["status"], job["cycles"], job["returns"], job["finished_s"] = WAITING, 0, 0, np.nan
            job["passes"] = 0
            s.failed_arm[e, j] = -1
            s.after[e, j] = -1
            if exists:
                i = at + j
                job["kind"], job["repetitions"], job["expires"] = kind[i], repetitions[i], expires[i]
                job["release_s"], job["due_s"] = release_s[i], due_s[i]
                for w in range(after.shape[1]):
                    s.after[e, j, w] = after[i, w]
                place = j
                while place > 0 and jobs[queue[place - 1]]["release_s"] > job["release_s"]:
                    queue[place] = queue[place - 1]
                    place -= 1
                queue[place] = j
            job["queued_s"] = job["release_s"]
        for i in range(s.absences.shape[1]):
            s.absences[e, i]["kind"] = 0
            if i < absences.shape[1]:
                s.absences[e, i] = absences[n, i]
        for a in range(s.arms.shape[1]):
            s.arms[e, a] = t.start[fleet[n], a]
            arm, net = s.arms[e, a], t.modal[fleet[n], a]
            for node in range(NODES):
                arm["temp_c"][node] = net["start_c"][node] + ambient_offset_k[n]
            for k in range(JOINTS):
                arm["housing_c"][k] = net["start_housing_c"][k] + ambient_offset_k[n]
            arm["peak_c"] = hottest(arm["temp_c"])
            if t.learns:
                for i in range(sim.moments.shape[2]):
                    sim.moments[e, a, i] = 0.0
                for work in range(sim.excess.shape[2]):
                    sim.excess[e, a, work] = np.nan
                for k in range(JOINTS):
                    sim.assumed_c[e, a, k] = arm["temp_c"][k]
                    sim.assumed_c[e, a, JOINTS + k] = arm["housing_c"][k]


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


@dataclass(frozen=True, eq=False, kw_only=True)
class Shift:
    """What was drawn for one shift; arrays [job], in the order of release."""

    kind: Array
    release_s: Array
    due_s: Array
    repetitions: Array
    expires: Array
    """bool [job]."""
    after: Array
    """int [job, n], −1 for none."""
    fleet: int = 0
    """Which fleet of the tables."""
    ambient_offset_k: float = 0.0
    """Added to the fleet's ambient temperature."""
    noise_key: int = 0
    """Of the sensor noise, 64 bits; see `fleet.seeding`."""
    absences: Array = field(default_factory=no_absences)
    """Breaks and failures of the arms, `ABSENCE` [absence]."""
    names: tuple[str, ...] = ()
    """Of the jobs, for people; may be left out."""


Parts = tuple[Array, Array]
"""Both parts of observations (`fleet.observation`): float32 [env, shared] and [env, arm, own]."""


def empty_parts(layout: Layout, envs: int) -> Parts:
    """Room for the observations of some envs."""
    own = (envs, layout.arms, layout.size - layout.shared)
    return np.empty((envs, layout.shared), np.float32), np.empty(own, np.float32)


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
        path: Keep the temperatures at the end of all intervals of a shift in `path_c`.
        shares_heat: Whether arms tell each other at once what heat they measure, if all hear all without delay.
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
        path: bool = False,
        shares_heat: bool = True,
        compiled: bool | None = None,
        threads: int = 1,
    ) -> None:
        arms, slots, jobs = layout.arms, layout.slots, max(jobs, FEWEST_JOBS)
        self.tables, self.layout = tables, layout
        self._options = (events, trace, compiled, threads)
        self._all = np.arange(envs)
        offers = OpenJobs(
            slot_job=np.full((envs, slots), -1, np.int32),
            mask=np.zeros((envs, arms, layout.actions), np.int8),
            group=np.zeros((envs, slots), np.int32),
            station_free=np.zeros((envs, slots), bool),
            closed=np.zeros((envs, tables.excluded.shape[1]), np.uint64),
        )
        offers.mask[:, :, 0] = 1
        works, nodes = (int(tables.alike.max()) + 1, NODES) if tables.learns else (0, 0)
        self._simulation = Simulation(
            tables,
            empty_state(envs, arms, jobs, 0),
            offers,
            event_buffer(envs * (arms * PER_ARM + jobs) if events else 0),
            np.zeros((envs if trace else 0, arms), TRACE),
            np.zeros((0, arms), DRIVE),
            np.zeros((envs, arms), INFO),
            np.zeros((envs if path else 0, tables.ticks, arms, NODES), np.float32),
            np.full((envs, arms, works), np.nan, np.float32),
            np.zeros((envs, arms, nodes), np.float32),
            np.zeros((envs, arms, 4), np.float32),
            form_of(layout, shares_heat=shares_heat),
            room_for(arms, slots, tables.stations.shape[2], min(envs, BLOCK), works),
            weights_per_unit(weights),
            NO_SCRIPT,
        )
        self._prepare()

    def _prepare(self) -> None:
        _, _, compiled, threads = self._options
        self._step, self._reset = step_rows.chosen(compiled), reset_rows.chosen(compiled)
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        size = -(-len(self._all) // (threads * BLOCK)) * BLOCK if threads > 1 else len(self._all)
        self._shares = [self._all[first : first + size] for first in range(0, len(self._all), size)]
        mine, room = self._simulation, self._simulation.room
        rooms = [room, *(Room(*(each.copy() for each in room)) for _ in self._shares[1:])]
        self._bundles = [self._bundle(mine._replace(room=each)) for each in rooms]
        """One for each thread."""

    def _bundle(self, simulation: Simulation) -> Any:  # numba's where the loops are compiled
        if self._step is step_rows.interpreted:
            return simulation
        from fleet.engine.bundle import bundle_of

        return bundle_of(simulation)

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
        return self.mask[:, :, 1:-1].any(axis=(1, 2)) | self.state.env["alarm"]

    @property
    def state(self) -> State:
        """The state itself; views that the next step overwrites. After writing into it call `refresh`."""
        return self._simulation.state

    @property
    def events(self) -> Any:  # numba's where the loops are compiled
        """The `EventBuffer` of the last step."""
        return self._simulation.events

    @property
    def trace(self) -> Array:
        """How each arm spent the last step, `TRACE` [env, arm]."""
        return self._simulation.trace

    @property
    def path_c(self) -> Array:
        """Temperatures at the end of each interval of the present shifts, °C, float32 [env, tick, arm, node]."""
        return self._simulation.path_c

    @property
    def infos(self) -> Array:
        """What had become of each arm after the last step, `INFO` [env, arm]; the next step overwrites it."""
        return self._simulation.infos

    def measured(self, env: int, kinds: Sequence[int]) -> tuple[Array, Array]:
        """What the arms of a row, which learn, know of their heat by measurement.

        Returns:
            Excess of heat for some kinds of jobs, [arm, kind], see `fleet.engine.observe.excess_of`; and the offset of
            the sensors, K, [arm].
        """
        mine, arms = self._simulation, range(self.layout.arms)
        average_excess(mine, env, mine.room.excess)
        lines = [line_of(each) for each in mine.moments[env]]
        excess = [[float(excess_of(mine, env, arm, kind, lines[arm][0])) for kind in kinds] for arm in arms]
        return np.array(excess), np.array([offset_k for _, offset_k in lines])

    def reset(self, envs: Array, shifts: Sequence[Shift]) -> None:
        """Put a new shift into each of some rows; `observe` then gives what their arms know."""
        first = np.cumsum([0, *(len(shift.kind) for shift in shifts)])
        most = max(shift.after.shape[1] for shift in shifts)
        after = np.concatenate([_widen(shift.after, most) for shift in shifts])
        waits = int((after >= 0).sum(axis=1).max(initial=0))
        after = -np.sort(-after, axis=1)[:, :waits]
        jobs = int(np.diff(first).max())
        longest = max(len(shift.absences) for shift in shifts)
        absences = np.zeros((len(shifts), longest), ABSENCE)
        for row, shift in zip(absences, shifts, strict=True):
            row[: len(shift.absences)] = shift.absences
        self._make_room(jobs, waits, longest)

        def of_all(name: str) -> Array:
            return np.concatenate([getattr(shift, name) for shift in shifts])

        self._reset(
            self._bundles[0], envs,
            np.array([shift.fleet for shift in shifts]), np.array([shift.ambient_offset_k for shift in shifts]),
            np.array([shift.noise_key for shift in shifts], np.uint64), first,
            of_all("kind"), of_all("release_s"), of_all("due_s"), of_all("repetitions"), of_all("expires"), after,
            absences,
        )  # fmt: skip

    def observe(self, envs: Array, out: Parts) -> None:
        """Put what the arms of some envs know now into `out`, and what has become of them into `infos`."""
        self._run(OFFER + OBSERVE, _NO_ACTIONS, np.empty((self.envs, OUTCOME)), envs, out)

    def step(
        self,
        actions: Array | None,
        out: Parts,
        until: Array | None = None,
        *,
        drive: Callable[[State], Drive] | None = None,
    ) -> Array:
        """One decision interval of every env, or more.

        Args:
            actions: int64 [env, arm]; anything outside the mask is a wait, and counted. None: no claims, and the
                outcome of the last claims remains.
            out: Receives what the arms know afterwards.
            until: Go on while no arm has a `choice`, to this tick at most, int64 [env]. The events and the trace are
                then those of the last interval alone.
            drive: Returns the mean heat drive over the coming interval, each [env, arm, joint], from the state with the
                awards made; without it the arms move as planned.

        Returns:
            Outcomes, [env, OUTCOME]: weighted reward terms, and the columns of `fleet.engine.step.OUTCOME`.
        """
        self._simulation.events.used[0] = 0
        claims = CLAIM if actions is not None else 0
        actions = _NO_ACTIONS if actions is None else actions
        if drive is not None:
            if claims:
                self._run(claims, actions, _no_terms(self.envs), self._all, _NO_VECTORS)
            self._keep_drive(drive(self.state))
            claims = 0
        return self._stepped(claims + MOVE + OFFER + OBSERVE, actions, out, until)

    def _keep_drive(self, drive: Drive) -> None:
        measured = self._simulation.drive
        if not len(measured):
            measured = np.zeros((self.envs, self.layout.arms), DRIVE)
            self._simulation = self._simulation._replace(drive=measured)
            self._prepare()
        measured["current_sq"][..., :JOINTS], measured["friction_w"][..., :JOINTS] = drive.current_sq, drive.friction_w

    def play(self, schedules: Plans, discount: Array) -> Script:
        """Execute one schedule in each of the first rows, from the present state to the end of the shift.

        Args:
            discount: Factor on the reward of each step of a shift, [tick]; a shorter one ends the execution.
        """
        script = script_of(schedules, discount)
        terms, actions = np.empty((self.envs, OUTCOME)), np.zeros((self.envs, self.layout.arms), np.int64)
        until = np.full(self.envs, len(discount))
        over = (self.state.tick >= until) | ((self.state.unfinished == 0) & (self.state.number > 0))
        rows = np.flatnonzero(~over[: len(script.reward)])
        self._run(OFFER, actions, terms, rows, _NO_VECTORS)
        bundle = self._bundle(self._simulation._replace(script=script))
        self._step(bundle, PLAY + CLAIM + MOVE + OFFER, actions, terms, until, rows, *_NO_VECTORS)
        return script

    def _stepped(self, parts: int, actions: Array, out: Parts, until: Array | None = None) -> Array:
        terms = np.empty((self.envs, OUTCOME))
        if self._pool is None:
            self._run(parts, actions, terms, self._all, out, until)
        else:
            own, *others = self._shares
            done = [
                self._pool.submit(self._run, parts, actions, terms, share, out, until, thread=thread)
                for thread, share in enumerate(others, 1)
            ]
            self._run(parts, actions, terms, own, out, until)
            for each in done:
                each.result()
        return terms

    def _run(
        self,
        parts: int,
        actions: Array,
        terms: Array,
        rows: Array,
        out: Parts,
        until: Array | None = None,
        thread: int = 0,
    ) -> None:
        until = _ONE_INTERVAL if until is None else until
        self._step(self._bundles[thread], parts, actions, terms, until, rows, *out)

    def load(self, state: State) -> None:
        """Take over a state, of one env for all or of each, and what follows from it."""
        jobs, waits, absences = state.jobs.shape[1], state.after.shape[2], state.absences.shape[1]
        self._make_room(jobs, waits, absences)
        mine = self.state
        mine.env[:], mine.arms[:] = state.env, state.arms
        mine.jobs[:, :jobs], mine.failed_arm[:, :jobs] = state.jobs, state.failed_arm
        mine.after[:, :jobs], mine.absences["kind"] = -1, 0
        mine.after[:, :jobs, :waits], mine.absences[:, :absences] = state.after, state.absences
        self.refresh()

    def refresh(self) -> None:
        """Derive queue, counts and phases again from the other fields of the state."""
        state = self.state
        room, env = state.jobs.shape[1], np.arange(self.envs)[:, None]
        exists = np.arange(room) < state.number[:, None]
        waiting = exists & (state.status == WAITING)
        order = np.argsort(np.where(waiting, state.queued_s, -np.inf), axis=1, kind="stable")
        # Waiting jobs fill a row up to its last job.
        for e in range(self.envs):
            count, n = int(state.number[e]), int(waiting[e].sum())
            state.queue[e, count - n : count] = order[e, room - n :]
            state.env["head"][e] = count - n
        state.env["unfinished"] = (exists & (state.status < DONE)).sum(axis=1)
        state.env["given_up"] = (exists & (state.status > DONE)).sum(axis=1)
        state.env["changed"], state.env["turn"] = True, 0
        working = (state.mode == WORKING) & (state.job >= 0)
        state.arms["kind"] = np.where(working, state.kind[env, state.job], self.tables.work.shape[1])
        times_s = self.tables.plans["times_s"][state.plan]
        ends_s = times_s[..., 0] + state.todo * times_s[..., 1]
        # An arm on its way home may still have the number of a job that it finished or gave back.
        state.arms["pending"] = (
            working & (state.status[env, state.job] == RUNNING) & (state.progress_s < ends_s - ROUNDING_S)
        )
        home = self.tables.start[state.fleet]
        for name in ("current_sq", "friction_w"):
            state.arms[name] = np.where((state.mode == IDLE)[..., None], home[name], 0.0)
        state.arms["phase_end_s"] = np.inf
        for e, a in np.argwhere(state.mode == WORKING).tolist():
            set_phase(self.tables.plans, state.arms[e, a])

    def _make_room(self, jobs: int, waits: int, absences: int) -> None:
        """For more jobs a shift, a tenth more than asked for, or absences, keeping what is there."""
        room, now = self.state.jobs.shape[1], self.state
        if jobs > room or waits > now.after.shape[2] or absences > now.absences.shape[1]:
            jobs = jobs + jobs // 10 if jobs > room else room
            self._move(jobs, max(now.after.shape[2], waits), max(now.absences.shape[1], absences))

    def _move(self, jobs: int, waits: int, absences: int) -> None:
        """Move the state to arrays with room for these."""
        before = self._simulation
        envs, arms = before.state.arms.shape
        state = empty_state(envs, arms, jobs, waits, absences)
        events = event_buffer(envs * (arms * PER_ARM + jobs) if len(before.events.what) else 0)
        for new, old in zip((*state, *events), (*before.state, *before.events), strict=True):
            new[tuple(slice(0, n) for n in old.shape)] = old
        self._simulation = before._replace(state=state, events=events)
        self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k not in ("_step", "_reset", "_bundles", "_pool", "_shares")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        now = self.state  # its unpickled arrays no longer lie job by job
        self._move(now.jobs.shape[1], now.after.shape[2], now.absences.shape[1])


_NO_ACTIONS = np.zeros((0, 0), np.int64)
_NO_VECTORS, _ONE_INTERVAL = (np.zeros((0, 0), np.float32), np.zeros((0, 0, 0), np.float32)), np.zeros(0, np.int64)


def _no_terms(envs: int) -> Array:
    return np.zeros((envs, 0))


def _widen(after: Array, waits: int) -> Array:
    wide = np.full((len(after), waits), -1)
    wide[:, : after.shape[1]] = after
    return wide
