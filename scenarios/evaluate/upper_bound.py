"""A linear relaxation of one shift in which everything is known.

Time is cut into periods. A piece is a share y of a job that an arm does by one of its plans in one period. Every shift
that the simulator can produce gives pieces that satisfy all rows, with a worth of at least its reward. So the largest
worth of the relaxation is an upper bound of the reward of every policy. The argument:

- A visit is the time of an arm from an award, at the beginning of a decision interval, until the interval in which it
  is home again. If it does k of a job's n cycles, the share k/n is spread evenly over the visit, which lasts at least
  ⌈approach + k cycle + retreat⌉ (whole intervals). So a share y on this arm costs at least y · d seconds of the arm,
  of its stations and of its space, with d = min over k of n/k times that. Jobs that are never finished have no pieces.
- A fault ends a visit early, but costs the price of a fault. Each fault then gives every row the longest retreat, and
  one interval, as extra time.
- Rows of the resources: arms, stations and space are cliques of plans that no two arms (and no arm twice) can execute
  at a time. Every maximal clique is a row in every period. Where there are too many, each plan's clique with its arm
  and with each of its stations remain.
- Worth: a job is done at C, which is at most its last retreat and one interval before the end E of its last visit. The
  density of its shares is at most 1/p, where p is n times its shortest cycle, since its stations keep visits apart. Let
  due' be the due date plus that retreat and interval, and κ the loss of worth per second. The staircase
  ρ(t) = value − κ p ⌈(t − due')/p⌉ for t > due', else the value, does not rise, and its mean over [E − p, E] is the
  worth of a job with end E. Shares that come before E with a density of at most 1/p have at least this mean. So
  Σ ρ y is at least the worth of the job, in each period with the ρ of the beginning.
- A job begins at the first interval after its release, or after the earliest end of the jobs before it; one that
  expires has no visit that begins after its due date. A job is done at most as far as those before it.
- Energy: every motor has at least the smallest heat of resting and of all plans, at the lowest temperature, until the
  last job that waits for no other is released; each cycle adds its surplus over that. A faulted arm may have none.
- A job counts only if all of it is done: its shares add up to a whole number, 0 or 1.
- The motion is as planned (the plant `profile`).
- What remains of heat: `HeatBudget`. What is left out: slots, the number of visits, and the
  order within a period.

Heat budgets: rows of the relaxation that keep the mean temperature of a motor within its limits.

The network of an arm is C T' = −L T + g Ta + P with heat P >= 0. By linearity the mean temperature of motor k in a
window is that of an arm with only the smallest heat (`Relaxation.base_w`), plus the sum over all earlier heat beyond it
of λ(s) · ΔP(s), where λ(s) >= 0 is the effect of a joule at time s in each node (the adjoint of the network, which has
no negative off-diagonal conductance). Three facts make it a row in the columns of the relaxation:

- A share y of a job brings at least the surplus heat of its cycles at the lowest temperatures, at most the longest
  approach or retreat away from where the share lies. So λ is the smallest value within that distance of its period.
- While an arm has lost its time to a fault it may lack the smallest heat, at most the largest λ times it. One fault
  loses at most the time in which the hottest possible arm cools below the restart limit, plus the time to clear it.
- Motor k is below the warning limit, or the time counts as above it and the motor is below a temperature that it cannot
  exceed: the error limit, or what the heat of the housings alone can cause after a fault.

Nothing else about temperature enters: heat at the true temperature is larger than at the lowest one.

Upper bound of the reward of a shift.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import networkx as nx
import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, vstack

from fleet.engine.batch import RewardWeights, Shift
from fleet.engine.tables import drive_of
from fleet.engine.world import World
from fleet.heat.motor import magnet_factor
from fleet.heat.thermal import HOUSING, WINDING, advance, node_heat
from fleet.robot import JOINTS

Array = np.ndarray


MOST_CLIQUES = 400
"""Maximal cliques beyond this number are not used."""
ROUNDING_S = 1e-6
"""Durations are rounded up to whole intervals but for this."""


def check_signs(weights: RewardWeights) -> None:
    """Check that finished jobs earn and everything else costs.

    Raises:
        ValueError: a weight has the other sign.
    """
    if weights.finished_value < 0 or max(weights.tardiness, weights.above_warning, weights.faults, weights.energy) > 0:
        given = ", ".join(f"{name} = {value:g}" for name, value in vars(weights).items())
        raise ValueError(f"Bounds need a reward.finished_value >= 0 and all other weights <= 0 (got {given}).")


@dataclass(frozen=True, eq=False)
class Pieces:
    """The possible pieces of jobs; arrays [piece]."""

    arm: Array
    job: Array
    plan: Array
    """Row of the plan table."""
    period: Array
    seconds: Array
    """Of arm, stations and space for a whole job."""
    most: Array
    """Largest share."""
    worth: Array
    """Of a whole job, without heat."""
    cycles_s: Array
    """Time of all cycles of the job."""

    def __len__(self) -> int:
        return len(self.arm)


class Columns(NamedTuple):
    """Numbers of the columns after the pieces."""

    jobs: Array
    """Whether each job is done, 0 or 1, int [job]."""
    faults: Array
    """Faults, int [arm]."""
    lost: Array
    """Seconds lost to faults, int [arm, period]."""
    above: Array
    """Seconds above the warning limit, int [arm, period]."""
    total: int
    """Of all columns."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """The relaxation of env 0 of a world.

    Args:
        period_s: Length of a period, rounded to whole decision intervals.
    """

    world: World
    weights: RewardWeights
    period_s: float = 300.0

    def __post_init__(self) -> None:
        check_signs(self.weights)

    @cached_property
    def edges_s(self) -> Array:
        """Beginning of every period and the end of the last, [period + 1]."""
        length_s = max(1, round(self.period_s / self.world.dt_s)) * self.world.dt_s
        return np.append(np.arange(0.0, self.world.horizon_s - ROUNDING_S, length_s), self.world.horizon_s)

    @property
    def shift(self) -> Shift:
        return self.world.shifts[0]

    @cached_property
    def offered(self) -> Array:
        """Rows of the plan table that each arm has for each job, int [arm, job, plan]; −1 for none."""
        return self.world.tables.work["plan"][0, self.shift.kind].swapaxes(0, 1)

    @cached_property
    def times_s(self) -> Array:
        """Durations of the phases of each plan, [plan, phase]."""
        return self.world.tables.plans["times_s"]

    @cached_property
    def start_c(self) -> Array:
        """Temperatures at the start of the shift, [arm, node]."""
        return self.world.tables.modal["start_c"][0] + self.shift.ambient_offset_k

    @cached_property
    def ambient_c(self) -> Array:
        """Ambient temperature at each arm during each tick, [tick, arm]."""
        return self.world.tables.ambient_c[0] + self.shift.ambient_offset_k

    @property
    def periods(self) -> int:
        return len(self.edges_s) - 1

    @cached_property
    def tail_s(self) -> float:
        """Longest retreat and one interval: what a visit may last beyond its last cycle."""
        return float(self.times_s[:, 2].max()) + self.world.dt_s

    @cached_property
    def base_w(self) -> Array:
        """Smallest heat of a powered arm, resting or at work, W, [arm, node]."""
        world = self.world
        base = self._heat_w(np.arange(len(world.arms)), *drive_of(world.tables.start[0]))
        for arm in range(len(world.arms)):
            rows = np.unique(self.offered[arm])
            for phase in range(3):
                plans = rows[rows >= 0]
                of_plans = self.plan_heat_w(np.full(len(plans), arm), plans, phase)
                base[arm] = np.minimum(base[arm], of_plans.min(axis=0, initial=np.inf))
        return base

    def plan_heat_w(self, arm: Array, plan: Array, phase: int = 1) -> Array:
        """Smallest heat in a phase of plans (the cycle) of arms, W, [n, node], at the lowest temperatures."""
        current_sq, friction_w = drive_of(self.world.tables.plans[plan])
        return self._heat_w(arm, current_sq[:, phase], friction_w[:, phase])

    def _heat_w(self, arm: Array, current_sq: Array, friction_w: Array) -> Array:
        motors = self.world.motors
        coldest_c = min(float(self.start_c.min()), float(self.ambient_c.min()))
        # The coldest magnets are the strongest: their torque constant falls with the temperature.
        assert motors.alpha_kt_per_k <= 0 <= motors.alpha_cu_per_k
        resistance = motors.copper_w_per_a2[arm] * (1.0 + motors.alpha_cu_per_k * (coldest_c - motors.reference_c))
        warm_sq = current_sq / magnet_factor(coldest_c, motors) ** 2
        return node_heat(resistance * warm_sq, friction_w + motors.idle_w[arm])

    @cached_property
    def release_s(self) -> Array:
        """When an arm can begin each job at the earliest, [job]; inf for one that cannot be done within the shift."""
        world, shift, plan = self.world, self.shift, self.offered
        begin_s = np.ceil(shift.release_s / world.dt_s - ROUNDING_S) * world.dt_s
        times_s = self.times_s[plan]
        whole_s = times_s[..., 0] + shift.repetitions[:, None] * times_s[..., 1]
        shortest_s = np.where(plan >= 0, whole_s, np.inf).min(axis=(0, 2))
        for _ in range(self.jobs):
            done_s = np.append(begin_s + shortest_s, -np.inf)  # the last one for "no job before"
            later_s = np.maximum(begin_s, done_s[shift.after].max(axis=1))
            if np.array_equal(later_s, begin_s):
                break
            begin_s = later_s
        return np.where(begin_s + shortest_s <= world.horizon_s + ROUNDING_S, begin_s, np.inf)

    @property
    def jobs(self) -> int:
        return len(self.shift.kind)

    @cached_property
    def pieces(self) -> Pieces:
        """All pieces that jobs of a positive worth can have."""
        columns = [piece for job in range(self.jobs) for piece in self._pieces_of(job)]
        if not columns:
            columns = [np.empty((8, 0))]
        arm, job, plan, period, *rest = np.concatenate(columns, axis=1)
        return Pieces(*(column.astype(int) for column in (arm, job, plan, period)), *rest)

    def _pieces_of(self, job: int) -> list[Array]:
        shift, edges_s, dt_s = self.shift, self.edges_s, self.world.dt_s
        offered = self.offered[:, job]
        rows, begin_s, times_s = offered[offered >= 0], self.release_s[job], self.times_s
        if not len(rows) or begin_s >= edges_s[-1]:
            return []
        count = int(shift.repetitions[job])
        cycles = np.arange(1, count + 1)
        tail_s = times_s[rows, 2].max() + dt_s
        due_s, value = shift.due_s[job], self.world.kinds[shift.kind[job]].value
        step_s = count * max(float(times_s[rows, 1].min()), ROUNDING_S)
        start_s = np.maximum(edges_s[:-1], begin_s)
        steps = np.where(start_s >= due_s + tail_s, np.floor((start_s - due_s - tail_s) / step_s) + 1.0, 0.0)
        worth = value * (self.weights.finished_value + self.weights.tardiness / 60.0 * step_s * steps)
        # A job of a positive worth has no share in a period that is more than a step below zero.
        least = value * self.weights.tardiness / 60.0 * step_s
        possible = (edges_s[1:] > begin_s) & (worth >= least - 1e-9)
        if shift.expires[job]:
            longest_s = (times_s[rows, 0] + count * times_s[rows, 1]).max() + tail_s
            possible &= edges_s[:-1] <= due_s + longest_s
        period = np.flatnonzero(possible)
        room_s = (np.append(edges_s[1:-1], edges_s[-1] + self.tail_s) - start_s)[period]
        found = []
        for arm, plan in ((a, p) for a, plans in enumerate(offered) for p in plans if p >= 0):
            visit_s = times_s[plan, 0] + times_s[plan, 2] + cycles * times_s[plan, 1]
            seconds = float((np.ceil((visit_s - ROUNDING_S) / dt_s) * dt_s * count / cycles).min())
            cycles_s = count * float(times_s[plan, 1])
            surplus_w = self.plan_heat_w(np.array([arm]), np.array([plan]))[0] - self.base_w[arm]
            energy = self.weights.energy / 3600.0 * cycles_s * float(surplus_w.sum())
            most = np.minimum(1.0, room_s / max(cycles_s, ROUNDING_S))
            parts = np.broadcast_arrays(arm, job, plan, period, seconds, most, worth[period] + energy, cycles_s)
            found.append(np.stack(parts).astype(float))
        return found

    @cached_property
    def columns(self) -> Columns:
        """The columns after the pieces."""
        arms = len(self.world.arms)
        ends = np.cumsum([len(self.pieces), self.jobs, arms, arms * self.periods, arms * self.periods])
        jobs, faults, lost, above = (np.arange(begin, end) for begin, end in pairwise(ends.tolist()))
        shape = (arms, self.periods)
        return Columns(jobs, faults, lost.reshape(shape), above.reshape(shape), total=int(ends[-1]))

    @cached_property
    def worth(self) -> Array:
        """Worth per unit of each column, [column]."""
        columns, weights = self.columns, self.weights
        worth = np.zeros(columns.total)
        worth[: len(self.pieces)] = self.pieces.worth
        worth[columns.faults] = weights.faults
        worth[columns.lost] = -weights.energy / 3600.0 * self.base_w.sum(axis=1, keepdims=True)
        worth[columns.above] = weights.above_warning / 60.0
        return worth

    @cached_property
    def most(self) -> Array:
        """Largest value of each column, [column]."""
        arms, length_s = len(self.world.arms), np.diff(self.edges_s)
        jobs = np.isfinite(self.release_s).astype(float)
        return np.concatenate(
            [self.pieces.most, jobs, np.full(arms, float(self.world.ticks)), np.tile(length_s, 2 * arms)]
        )

    @cached_property
    def constant(self) -> float:
        """Worth that every shift has: the least energy until its end at the earliest."""
        released_s, first = 0.0, (self.shift.after < 0).all(axis=1)
        if first.any():
            released_s = float(self.shift.release_s[first].max())
        end_s = min(released_s, self.world.horizon_s)
        return self.weights.energy / 3600.0 * float(self.base_w.sum()) * end_s

    @cached_property
    def cliques(self) -> list[set[int]]:
        """Sets of plans of which only one can be executed at a time."""
        world, pieces = self.world, self.pieces
        stations: dict[int, set[str]] = {}
        arm_of: dict[int, int] = {}
        for plan, arm, job in np.unique(np.stack([pieces.plan, pieces.arm, pieces.job]), axis=1).T.tolist():
            arm_of[plan] = arm
            needed = set(world.kinds[self.shift.kind[job]].stations)
            stations[plan] = stations.get(plan, needed) & needed
        graph: nx.Graph[int] = nx.Graph()
        graph.add_nodes_from(arm_of)
        conflicts = world.conflicts
        graph.add_edges_from(
            (p, q)
            for p in arm_of
            for q in arm_of
            if p < q and (arm_of[p] == arm_of[q] or stations[p] & stations[q] or conflicts[p, q])
        )
        found = []
        for clique in nx.find_cliques(graph):
            found.append(set(clique))
            if len(found) > MOST_CLIQUES:
                by_arm = [{p for p in arm_of if arm_of[p] == arm} for arm in set(arm_of.values())]
                used = sorted(set().union(*stations.values()))
                return by_arm + [{p for p in arm_of if station in stations[p]} for station in used]
        return found

    @cached_property
    def rows(self) -> tuple[csr_array, Array]:
        """The rows A x <= b without heat budgets: A, sparse [row, column], and b, [row]."""
        pieces, count = self.pieces, len(self.pieces)
        table = _Rows(self.columns.total)
        room_s = np.diff(self.edges_s)
        room_s[-1] += self.tail_s
        for clique in self.cliques:
            inside = np.flatnonzero(np.isin(pieces.plan, list(clique)))
            involved = np.unique(pieces.arm[inside])
            faults = self.columns.faults[involved]
            every = np.repeat(np.arange(self.periods), len(involved))
            table.add(
                np.concatenate([pieces.period[inside], every]),
                np.concatenate([inside, np.tile(faults, self.periods)]),
                np.concatenate([pieces.seconds[inside], np.full(len(every), -self.tail_s)]),
                room_s,
            )
        jobs = np.arange(self.jobs)
        for sign in (1.0, -1.0):  # the shares of a job add up to 1, or to 0
            table.add(
                np.concatenate([pieces.job, jobs]),
                np.concatenate([np.arange(count), self.columns.jobs]),
                np.concatenate([np.full(count, sign), np.full(self.jobs, -sign)]),
                np.zeros(self.jobs),
            )
        waits = [(job, other) for job, before in enumerate(self.shift.after.tolist()) for other in before if other >= 0]
        for job, other in waits:
            table.add_row(self.columns.jobs[[job, other]], np.array([1.0, -1.0]))
        self.add_losses(table, self.world.horizon_s)
        return table.matrix()

    def add_losses(self, table: "_Rows", most_s: float) -> None:
        """Add rows that limit the time that each fault costs an arm."""
        for lost, faults in zip(self.columns.lost, self.columns.faults, strict=True):
            table.add_row(np.append(lost, faults), np.append(np.ones(len(lost)), -most_s))


class _Rows:
    """Collects rows of a sparse matrix."""

    def __init__(self, columns: int) -> None:
        self._columns, self._count = columns, 0
        self._parts: list[tuple[Array, Array, Array]] = []
        self._bounds: list[Array] = []

    def add(self, row: Array, column: Array, value: Array, bound: Array) -> None:
        """Rows from 0 to the length of `bound`, which is their right side."""
        self._parts.append((row + self._count, column, value))
        self._bounds.append(bound)
        self._count += len(bound)

    def add_row(self, columns: Array, values: Array, bound: float = 0.0) -> None:
        """One row."""
        self.add(np.zeros(len(columns), int), columns, values, np.array([bound]))

    def matrix(self) -> tuple[csr_array, Array]:
        """All rows and their right sides."""
        row, column, value = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        return csr_array((value, (row, column)), shape=(self._count, self._columns)), np.concatenate(self._bounds)


WINDOWS_S = (2700.0, 7200.0)
"""Lengths of the windows, which begin every half of it."""
MOST_PER_ARM = 2
"""Budgets of one arm and one length of window that are added at a time, the most violated ones."""
VIOLATED_K = 0.01
"""Smaller violations of a mean temperature do not count."""
GRID = 4
"""Points per decision interval at which λ is computed."""


@dataclass(frozen=True, eq=False)
class HeatBudget:
    """The heat budgets of a relaxation."""

    relaxation: Relaxation

    @cached_property
    def base_integral(self) -> Array:
        """As of `_integral`, with the smallest heat."""
        return self._integral(np.repeat(self.relaxation.base_w[:, None], self.relaxation.world.ticks, axis=1))

    def _integral(self, heat_w: Array) -> Array:
        """Integral of the temperatures over every interval, K·s, [arm, tick, node], with some heat, W, likewise."""
        world, thermal, ambient_c = self.relaxation.world, self.relaxation.world.thermal, self.relaxation.ambient_c
        temp_c = np.empty((heat_w.shape[0], world.ticks + 1, heat_w.shape[2]))
        temp_c[:, 0] = self.relaxation.start_c
        for tick in range(world.ticks):
            temp_c[:, tick + 1] = advance(
                temp_c[:, tick], heat_w[:, tick], ambient_c[tick], *self._step, thermal.to_ambient
            )
        load_w = heat_w + thermal.to_ambient[:, None] * ambient_c.T[..., None]
        stored_j = thermal.capacity[:, None] * np.diff(temp_c, axis=1)
        return np.linalg.solve(thermal.laplacian[:, None], (world.dt_s * load_w - stored_j)[..., None])[..., 0]

    @cached_property
    def _step(self) -> tuple[Array, Array]:
        """Matrices of a step, [arm, node, node]."""
        return self.relaxation.world.thermal.step_matrices(self.relaxation.world.dt_s)

    @cached_property
    def highest_c(self) -> float:
        """A temperature that no motor exceeds."""
        world, start_c, ambient_c = self.relaxation.world, self.relaxation.start_c, self.relaxation.ambient_c
        friction_w = [drive_of(each)[1].reshape(-1, JOINTS) for each in (world.tables.plans, world.tables.start)]
        housing_w = np.zeros_like(start_c)
        housing_w[:, HOUSING] = np.concatenate(friction_w).max(axis=0) + world.motors.idle_w
        settled_c = world.thermal.steady(housing_w, np.full(len(world.arms), ambient_c.max()))
        return float(max(world.tables.error_c, settled_c.max(), start_c.max(), ambient_c.max()))

    @cached_property
    def longest_loss_s(self) -> float:
        """Longest time that one fault can cost an arm."""
        world, limits = self.relaxation.world, self.relaxation.world.tables
        temp_c = np.full_like(self.relaxation.start_c, self.highest_c)
        brakes_w = np.zeros_like(temp_c)
        if not limits.power_off:
            brakes_w[:, HOUSING] = world.motors.idle_w
        air_c = self.relaxation.ambient_c.max(axis=0)
        for tick in range(world.ticks):
            if temp_c[:, WINDING].max() < limits.restart_c:
                return min(world.horizon_s, (tick + 1) * world.dt_s + limits.clear_s)
            temp_c = advance(temp_c, brakes_w, air_c, *self._step, world.thermal.to_ambient)
        return world.horizon_s

    def violated(self, shares: Array) -> list[tuple[Array, Array, float]]:
        """Budgets that a solution [column] violates most: columns, their values, and the bound."""
        world = self.relaxation.world
        tick_of = self.relaxation.edges_s / world.dt_s
        edges = np.round(tick_of).astype(int)
        period_of = np.searchsorted(edges, np.arange(world.ticks), side="right") - 1
        integral = self._integral(self._heat_of(shares)[:, period_of])
        budgets: list[tuple[Array, Array, float]] = []
        for arm in range(len(world.arms)):
            above = shares[self.relaxation.columns.above[arm]]
            total = np.concatenate([np.zeros((1, JOINTS)), integral[arm, :, WINDING].cumsum(axis=0)])
            for length_s in WINDOWS_S:
                for first, last, joint in self._worst(total, above, edges, length_s):
                    budgets.append(self._budget(arm, joint, first, last))
        return budgets

    def _heat_of(self, shares: Array) -> Array:
        """Mean heat of a solution, W, [arm, period, node]."""
        relaxation, pieces = self.relaxation, self.relaxation.pieces
        heat_j = np.zeros((len(relaxation.world.arms), relaxation.periods, self._surplus_w.shape[1]))
        share = shares[: len(pieces)]
        used = np.flatnonzero(share > 0)
        joules = (share[used] * pieces.cycles_s[used])[:, None] * self._surplus_w[used]
        np.add.at(heat_j, (pieces.arm[used], pieces.period[used]), joules)
        heat_w = heat_j / np.diff(relaxation.edges_s)[:, None] + relaxation.base_w[:, None]
        lost = shares[relaxation.columns.lost] / np.diff(relaxation.edges_s)
        return heat_w - lost[..., None] * relaxation.base_w[:, None]

    @cached_property
    def _surplus_w(self) -> Array:
        """Heat of the cycle of each piece beyond the smallest heat, W, [piece, node]."""
        relaxation, pieces = self.relaxation, self.relaxation.pieces
        surplus_w = relaxation.plan_heat_w(pieces.arm, pieces.plan) - relaxation.base_w[pieces.arm]
        return np.maximum(surplus_w, 0.0)

    def _worst(self, total: Array, above_s: Array, edges: Array, length_s: float) -> list[tuple[int, int, int]]:
        """Windows (first and last period) and motors of an arm that pass their limit by most.

        Args:
            total: Integral of the temperatures until each tick, K·s, [tick + 1, joint].
        """
        relaxation, dt_s = self.relaxation, self.relaxation.world.dt_s
        warning_c = relaxation.world.tables.warning_c
        count = max(1, round(length_s / float(relaxation.edges_s[1])))
        first = np.arange(0, max(1, relaxation.periods - count + 1), max(1, count // 2))
        last = np.minimum(first + count, relaxation.periods)
        seconds = (edges[last] - edges[first]) * dt_s
        until = np.append(0.0, above_s.cumsum())
        allowed = warning_c * seconds + (self.highest_c - warning_c) * (until[last] - until[first])
        excess_k = (total[edges[last]] - total[edges[first]] - allowed[:, None]) / seconds[:, None]
        joint = excess_k.argmax(axis=1)
        most = excess_k[np.arange(len(first)), joint]
        chosen = [n for n in np.argsort(-most)[:MOST_PER_ARM] if most[n] > VIOLATED_K]
        return [(int(first[n]), int(last[n]), int(joint[n])) for n in chosen]

    def _budget(self, arm: int, joint: int, first: int, last: int) -> tuple[Array, Array, float]:
        """The budget of a motor in a window of periods: columns, their values, and the bound."""
        relaxation, world, pieces = self.relaxation, self.relaxation.world, self.relaxation.pieces
        edges_s, warning_c = relaxation.edges_s, world.tables.warning_c
        low, high = self._effect(arm, joint, float(edges_s[first]), float(edges_s[last]))
        own = np.flatnonzero((pieces.arm == arm) & (pieces.period < last + 1))
        joules = pieces.cycles_s[own, None] * self._surplus_w[own]
        effect = (joules * low[pieces.period[own]]).sum(axis=1)
        lost = -(high @ relaxation.base_w[arm])
        window = slice(first, last)
        above = np.full(last - first, warning_c - self.highest_c)
        ticks = np.round(edges_s[[first, last]] / world.dt_s).astype(int)
        base = float(self.base_integral[arm, ticks[0] : ticks[1], joint].sum())
        bound = warning_c * float(edges_s[last] - edges_s[first]) - base
        columns = np.concatenate([own, relaxation.columns.lost[arm], relaxation.columns.above[arm][window]])
        scale = float(edges_s[last] - edges_s[first])
        return columns, np.concatenate([effect, lost, above]) / scale, bound / scale

    def _effect(self, arm: int, joint: int, first_s: float, last_s: float) -> tuple[Array, Array]:
        """Smallest and largest integral of a motor's temperature over a window per joule in each node at any moment of
        each period and nearby, K·s/J, both [period, node]."""
        relaxation, world = self.relaxation, self.relaxation.world
        thermal = world.thermal
        step_s = world.dt_s / GRID
        time_s = np.arange(world.ticks * GRID + 1) * step_s
        rates, modes, root = thermal.rates[arm], thermal.modes[arm], np.sqrt(thermal.capacity[arm])
        begin_s, end_s = np.maximum(first_s - time_s, 0.0), np.maximum(last_s - time_s, 0.0)
        decay = (np.exp(-np.outer(begin_s, rates)) - np.exp(-np.outer(end_s, rates))) / rates
        effect = np.maximum((decay * (modes[joint] / root[joint])) @ (modes / root[:, None]).T, 0.0)
        # Backward in time no node's effect falls faster than it loses heat: a bound between the points.
        between = np.exp(-np.diag(thermal.laplacian[arm]) / thermal.capacity[arm] * step_s)
        approach_s = float(relaxation.times_s[:, 0].max())
        reach = int(np.ceil((max(approach_s, relaxation.tail_s)) / step_s)) + 1
        size = 2 * reach + 1
        low = minimum_filter1d(effect, size, axis=0, mode="nearest") * between
        high = maximum_filter1d(effect, size, axis=0, mode="nearest") / between
        at = np.round(relaxation.edges_s / step_s).astype(int)
        parts = list(pairwise(at.tolist()))
        return (
            np.stack([low[one : other + 1].min(axis=0) for one, other in parts]),
            np.stack([high[one : other + 1].max(axis=0) for one, other in parts]),
        )


ROUNDS = 3
"""Most times that heat budgets are added."""


LEAST_GAIN = 1e-3
"""No more budgets are added once they lower the bound by less than this share."""
MOST_COLUMNS = 12_000
"""Programs with more columns, of some 40 arms, keep the bound with parts of jobs: whole ones take minutes."""
GAP = 5e-4
"""The branch and bound ends once bound and solution differ by this share."""
ROUNDING = 1e-6
"""Share added to a bound that a solver computed in floating point."""


@dataclass(frozen=True, eq=False)
class UpperBound:
    """An upper bound and how it was found."""

    reward: float
    """No policy has more."""
    linear: float
    """The bound with parts of jobs, without heat."""
    budgets: int
    """Number of heat budgets used."""


def upper_bound(relaxation: Relaxation, *, heat: bool = True, nodes: int = 2000) -> UpperBound:
    """The upper bound of a relaxation: with whole jobs, and with the heat budgets that its solution in parts passes.

    Args:
        nodes: Most nodes of the branch and bound; what it has proved by then counts. 0: the linear program alone.
    """
    rows, bounds = relaxation.rows
    linear, shares = _solve(relaxation, rows, bounds)
    value, count, budget = linear, 0, HeatBudget(relaxation)
    for _ in range(ROUNDS if heat and nodes else 0):
        violated = budget.violated(shares)
        if not violated:
            break
        table = _Rows(relaxation.columns.total)
        relaxation.add_losses(table, budget.longest_loss_s)
        for columns, values, bound in violated:
            table.add_row(columns, values, bound)
        more, limits = table.matrix()
        rows, bounds = csr_array(vstack([rows, more])), np.concatenate([bounds, limits])
        count += len(violated)
        better, shares = _solve(relaxation, rows, bounds)
        gain, value = value - better, min(value, better)
        if gain < LEAST_GAIN * abs(value):
            break
    if nodes:
        value = min(value, _whole(relaxation, rows, bounds, nodes))
    return UpperBound(value + relaxation.constant, linear + relaxation.constant, count)


def _solve(relaxation: Relaxation, rows: csr_array, bounds: Array) -> tuple[float, Array]:
    """Bound with parts of jobs by the dual prices of the rows, and the solution, [column].

    Any prices >= 0 give a valid bound, so rounding errors of the solver make it looser and never wrong
    (Neumaier & Shcherbina, Mathematical Programming 99, 2004).
    """
    worth, most = relaxation.worth, relaxation.most
    result = linprog(-worth, rows, bounds, bounds=np.stack([np.zeros(len(most)), most], axis=1), method="highs")
    if not result.success:
        raise ValueError(f"The relaxation of the shift could not be solved: {result.message}")
    prices = np.maximum(-result.ineqlin.marginals, 0.0)
    surplus = np.maximum(worth - rows.T @ prices, 0.0)
    return float(prices @ bounds + surplus @ most), result.x


def _whole(relaxation: Relaxation, rows: csr_array, bounds: Array, nodes: int) -> float:
    """Bound with whole jobs; inf if branch and bound proved none, or if the program is too large."""
    if relaxation.columns.total > MOST_COLUMNS:
        return np.inf
    whole = np.zeros(relaxation.columns.total)
    whole[relaxation.columns.jobs] = 1
    result = milp(
        -relaxation.worth,
        constraints=LinearConstraint(rows, -np.inf, bounds),  # pyright: ignore[reportArgumentType]
        bounds=Bounds(0.0, relaxation.most),  # pyright: ignore[reportArgumentType]  # SciPy's stubs allow no arrays
        integrality=whole,
        options={"node_limit": nodes, "mip_rel_gap": GAP},
    )
    if result.mip_dual_bound is None:
        return np.inf
    return -result.mip_dual_bound + ROUNDING * (1.0 + abs(result.mip_dual_bound))
