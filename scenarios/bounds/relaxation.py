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
- What remains of heat: `scenarios.bounds.heat_budget`. What is left out: slots, the number of visits, and the
  order within a period.
"""

from dataclasses import dataclass
from functools import cached_property

import networkx as nx
import numpy as np
from scipy.sparse import csr_array

from fleet.engine.reward import RewardWeights
from fleet.engine.state import World
from fleet.motor import magnet_factor
from fleet.thermal import node_heat

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


@dataclass(frozen=True, eq=False)
class Relaxation:
    """The relaxation of env 0 of a world.

    Columns: the pieces, whether each job is done, the faults of each arm, then per arm and period the seconds lost to
    faults and the seconds above the warning limit.

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
    def periods(self) -> int:
        """Number of periods."""
        return len(self.edges_s) - 1

    @cached_property
    def tail_s(self) -> float:
        """Longest retreat and one interval: what a visit may last beyond its last cycle."""
        return float(self.world.plans.times_s[:, 2].max()) + self.world.dt_s

    @cached_property
    def base_w(self) -> Array:
        """Smallest heat of a powered arm, resting or at work, W, [arm, node]."""
        world = self.world
        base = self._heat_w(np.arange(len(world.arms)), world.rest.current_sq, world.rest.friction_w)
        for arm in range(len(world.arms)):
            rows = np.unique(world.offers.plan[0, arm])
            for phase in range(3):
                plans = rows[rows >= 0]
                of_plans = self.plan_heat_w(np.full(len(plans), arm), plans, phase)
                base[arm] = np.minimum(base[arm], of_plans.min(axis=0, initial=np.inf))
        return base

    def plan_heat_w(self, arm: Array, plan: Array, phase: int = 1) -> Array:
        """Smallest heat in a phase of plans (the cycle) of arms, W, [n, node], at the lowest temperatures."""
        plans = self.world.plans
        return self._heat_w(arm, plans.current_sq[plan, phase], plans.friction_w[plan, phase])

    def _heat_w(self, arm: Array, current_sq: Array, friction_w: Array) -> Array:
        motors = self.world.motors
        coldest_c = min(float(self.world.start_c.min()), float(self.world.ambient_c.min()))
        # The coldest magnets are the strongest: their torque constant falls with the temperature.
        assert motors.alpha_kt_per_k <= 0 <= motors.alpha_cu_per_k
        resistance = motors.copper_w_per_a2[arm] * (1.0 + motors.alpha_cu_per_k * (coldest_c - motors.reference_c))
        warm_sq = current_sq / magnet_factor(coldest_c, motors) ** 2
        return node_heat(resistance * warm_sq, friction_w + motors.idle_w[arm])

    @cached_property
    def release_s(self) -> Array:
        """When an arm can begin each job at the earliest, [job]; inf for one that cannot be done within the shift."""
        world, jobs = self.world, self.world.jobs
        begin_s = np.ceil(jobs.release_s[0, : self.jobs] / world.dt_s - ROUNDING_S) * world.dt_s
        plan = world.offers.plan[0, :, : self.jobs]
        times_s = world.plans.times_s[plan]
        whole_s = times_s[..., 0] + jobs.repetitions[0, : self.jobs, None] * times_s[..., 1]
        shortest_s = np.where(plan >= 0, whole_s, np.inf).min(axis=(0, 2))
        for _ in range(self.jobs):
            done_s = np.append(begin_s + shortest_s, -np.inf)  # the last one for "no job before"
            later_s = np.maximum(begin_s, done_s[jobs.after[0, : self.jobs]].max(axis=1))
            if np.array_equal(later_s, begin_s):
                break
            begin_s = later_s
        return np.where(begin_s + shortest_s <= world.horizon_s + ROUNDING_S, begin_s, np.inf)

    @property
    def jobs(self) -> int:
        """Number of jobs."""
        return int(self.world.jobs.exists[0].sum())

    @cached_property
    def pieces(self) -> Pieces:
        """All pieces that jobs of a positive worth can have."""
        columns = [piece for job in range(self.jobs) for piece in self._pieces_of(job)]
        if not columns:
            columns = [np.empty((8, 0))]
        arm, job, plan, period, *rest = np.concatenate(columns, axis=1)
        return Pieces(*(column.astype(int) for column in (arm, job, plan, period)), *rest)

    def _pieces_of(self, job: int) -> list[Array]:
        world, edges_s, dt_s = self.world, self.edges_s, self.world.dt_s
        offered = world.offers.plan[0, :, job]
        rows, begin_s, times_s = offered[offered >= 0], self.release_s[job], world.plans.times_s
        if not len(rows) or begin_s >= edges_s[-1]:
            return []
        count = int(world.jobs.repetitions[0, job])
        cycles = np.arange(1, count + 1)
        tail_s = times_s[rows, 2].max() + dt_s
        due_s, value = world.jobs.due_s[0, job], world.jobs.value[0, job]
        step_s = count * max(float(times_s[rows, 1].min()), ROUNDING_S)
        start_s = np.maximum(edges_s[:-1], begin_s)
        steps = np.where(start_s >= due_s + tail_s, np.floor((start_s - due_s - tail_s) / step_s) + 1.0, 0.0)
        worth = value * (self.weights.finished_value + self.weights.tardiness / 60.0 * step_s * steps)
        # A job of a positive worth has no share in a period that is more than a step below zero.
        least = value * self.weights.tardiness / 60.0 * step_s
        possible = (edges_s[1:] > begin_s) & (worth >= least - 1e-9)
        if world.jobs.expires[0, job]:
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
    def _blocks(self) -> list[int]:
        """Where jobs, faults, lost seconds, seconds above the warning limit begin, and the number of columns."""
        arms, cells = len(self.world.arms), len(self.world.arms) * self.periods
        return np.cumsum([len(self.pieces), self.jobs, arms, cells, cells]).tolist()

    def job_columns(self) -> Array:
        """Columns that say whether a job is done, 0 or 1, int [job]."""
        return self._blocks[0] + np.arange(self.jobs)

    def fault_columns(self) -> Array:
        """Columns of the faults, int [arm]."""
        return self._blocks[1] + np.arange(len(self.world.arms))

    def lost_columns(self, arm: int) -> Array:
        """Columns of the seconds that an arm loses to faults, int [period]."""
        return self._blocks[2] + arm * self.periods + np.arange(self.periods)

    def above_columns(self, arm: int) -> Array:
        """Columns of the seconds of an arm above the warning limit, int [period]."""
        return self._blocks[3] + arm * self.periods + np.arange(self.periods)

    @property
    def columns(self) -> int:
        """Number of columns."""
        return self._blocks[4]

    @cached_property
    def worth(self) -> Array:
        """Worth per unit of each column, [column]."""
        worth, weights, arms = np.zeros(self.columns), self.weights, len(self.world.arms)
        worth[: len(self.pieces)] = self.pieces.worth
        worth[self.fault_columns()] = weights.faults
        for arm in range(arms):
            worth[self.lost_columns(arm)] = -weights.energy / 3600.0 * self.base_w[arm].sum()
            worth[self.above_columns(arm)] = weights.above_warning / 60.0
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
        jobs, released_s = self.world.jobs, 0.0
        first = (jobs.after[0, : self.jobs] < 0).all(axis=1)
        if first.any():
            released_s = float(jobs.release_s[0, : self.jobs][first].max())
        end_s = min(released_s, self.world.horizon_s)
        return self.weights.energy / 3600.0 * float(self.base_w.sum()) * end_s

    @cached_property
    def cliques(self) -> list[set[int]]:
        """Sets of plans of which only one can be executed at a time."""
        world, pieces = self.world, self.pieces
        stations: dict[int, set[int]] = {}
        arm_of: dict[int, int] = {}
        for plan, arm, job in np.unique(np.stack([pieces.plan, pieces.arm, pieces.job]), axis=1).T.tolist():
            arm_of[plan] = arm
            needed = {s for s in world.jobs.stations[0, job].tolist() if s >= 0}
            stations[plan] = stations.get(plan, needed) & needed
        graph: nx.Graph[int] = nx.Graph()
        graph.add_nodes_from(arm_of)
        volume = world.plans.volume
        graph.add_edges_from(
            (p, q)
            for p in arm_of
            for q in arm_of
            if p < q and (arm_of[p] == arm_of[q] or stations[p] & stations[q] or world.conflicts[volume[p], volume[q]])
        )
        found = []
        for clique in nx.find_cliques(graph):
            found.append(set(clique))
            if len(found) > MOST_CLIQUES:
                by_arm = [{p for p in arm_of if arm_of[p] == arm} for arm in set(arm_of.values())]
                used = set().union(*stations.values())
                return by_arm + [{p for p in arm_of if station in stations[p]} for station in used]
        return found

    @cached_property
    def rows(self) -> tuple[csr_array, Array]:
        """The rows A x <= b without heat budgets: A, sparse [row, column], and b, [row]."""
        pieces, count, arms = self.pieces, len(self.pieces), len(self.world.arms)
        table = _Rows(self.columns)
        room_s = np.diff(self.edges_s)
        room_s[-1] += self.tail_s
        for clique in self.cliques:
            inside = np.flatnonzero(np.isin(pieces.plan, list(clique)))
            involved = np.unique(pieces.arm[inside])
            faults = self.fault_columns()[involved]
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
                np.concatenate([np.arange(count), self.job_columns()]),
                np.concatenate([np.full(count, sign), np.full(self.jobs, -sign)]),
                np.zeros(self.jobs),
            )
        before = self.world.jobs.after[0, : self.jobs]
        waits = [(job, int(other)) for job in range(self.jobs) for other in before[job] if other >= 0]
        for job, other in waits:
            table.add(np.zeros(2, int), self.job_columns()[[job, other]], np.array([1.0, -1.0]), np.zeros(1))
        for arm in range(arms):
            lost = self.lost_columns(arm)
            columns = np.append(lost, self.fault_columns()[arm])
            values = np.append(np.ones(len(lost)), -self.world.horizon_s)
            table.add(np.zeros(len(columns), int), columns, values, np.zeros(1))
        return table.matrix()


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

    def matrix(self) -> tuple[csr_array, Array]:
        """All rows and their right sides."""
        row, column, value = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        return csr_array((value, (row, column)), shape=(self._count, self._columns)), np.concatenate(self._bounds)
