"""Heat budgets: rows of the relaxation that keep the mean temperature of a motor within its limits.

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
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.sparse import csr_array

from fleet.robot import JOINTS
from fleet.thermal import HOUSING, WINDING, advance
from scenarios.bounds.relaxation import Relaxation

Array = np.ndarray

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
    def base_c(self) -> tuple[Array, Array]:
        """Temperatures with the smallest heat at every tick, [arm, tick + 1, node], and their integrals over every
        interval, K·s, [arm, tick, node]."""
        world = self.relaxation.world
        heat_w = np.repeat(self.relaxation.base_w[:, None], world.ticks, axis=1)
        return self._simulated(heat_w)

    def _simulated(self, heat_w: Array) -> tuple[Array, Array]:
        """Temperatures and integrals as in `base_c` with this heat, W, [arm, tick, node]."""
        world, thermal = self.relaxation.world, self.relaxation.world.thermal
        temp_c = np.empty((heat_w.shape[0], world.ticks + 1, heat_w.shape[2]))
        temp_c[:, 0] = world.start_c
        for tick in range(world.ticks):
            temp_c[:, tick + 1] = advance(
                temp_c[:, tick], heat_w[:, tick], world.ambient_c[tick], world.phi, world.gamma, thermal.to_ambient
            )
        load_w = heat_w + thermal.to_ambient[:, None] * world.ambient_c.T[..., None]
        stored_j = thermal.capacity[:, None] * np.diff(temp_c, axis=1)
        integral = np.linalg.solve(thermal.laplacian[:, None], (world.dt_s * load_w - stored_j)[..., None])[..., 0]
        return temp_c, integral

    @cached_property
    def highest_c(self) -> float:
        """A temperature that no motor exceeds."""
        world = self.relaxation.world
        friction_w = np.concatenate([world.plans.friction_w.reshape(-1, JOINTS), world.rest.friction_w]).max(axis=0)
        housing_w = np.zeros_like(world.start_c)
        housing_w[:, HOUSING] = friction_w + world.motors.idle_w
        settled_c = world.thermal.steady(housing_w, np.full(len(world.arms), world.ambient_c.max()))
        return float(max(world.limits.error_c, settled_c.max(), world.start_c.max(), world.ambient_c.max()))

    @cached_property
    def longest_loss_s(self) -> float:
        """Longest time that one fault can cost an arm."""
        world, limits = self.relaxation.world, self.relaxation.world.limits
        temp_c = np.full_like(world.start_c, self.highest_c)
        brakes_w = np.zeros_like(temp_c)
        if not limits.power_off_on_fault:
            brakes_w[:, HOUSING] = world.motors.idle_w
        air_c = world.ambient_c.max(axis=0)
        for tick in range(world.ticks):
            if temp_c[:, WINDING].max() < limits.restart_c:
                return min(world.horizon_s, (tick + 1) * world.dt_s + limits.clear_s)
            temp_c = advance(temp_c, brakes_w, air_c, world.phi, world.gamma, world.thermal.to_ambient)
        return world.horizon_s

    def losses(self) -> tuple[csr_array, Array]:
        """Rows that limit the time that faults cost an arm."""
        relaxation, arms = self.relaxation, len(self.relaxation.world.arms)
        columns = np.concatenate(
            [[*relaxation.lost_columns(arm), relaxation.fault_columns()[arm]] for arm in range(arms)]
        )
        values = np.tile(np.append(np.ones(relaxation.periods), -self.longest_loss_s), arms)
        row = np.repeat(np.arange(arms), relaxation.periods + 1)
        return csr_array((values, (row, columns)), shape=(arms, relaxation.columns)), np.zeros(arms)

    def violated(self, shares: Array) -> tuple[csr_array, Array]:
        """Budgets that a solution [column] violates most, as rows A x <= b: A, sparse [row, column], and b, [row]."""
        world = self.relaxation.world
        tick_of = self.relaxation.edges_s / world.dt_s
        edges = np.round(tick_of).astype(int)
        period_of = np.searchsorted(edges, np.arange(world.ticks), side="right") - 1
        _, integral = self._simulated(self._heat_of(shares)[:, period_of])
        found: list[tuple[Array, Array, float]] = []
        for arm in range(len(world.arms)):
            above = shares[self.relaxation.above_columns(arm)]
            total = np.concatenate([np.zeros((1, JOINTS)), integral[arm, :, WINDING].cumsum(axis=0)])
            for length_s in WINDOWS_S:
                for first, last, joint in self._worst(total, above, edges, length_s):
                    found.append(self._budget(arm, joint, first, last))
        if not found:
            return csr_array((0, self.relaxation.columns)), np.zeros(0)
        lengths = [len(columns) for columns, _, _ in found]
        row = np.repeat(np.arange(len(found)), lengths)
        columns, values = (np.concatenate([each[i] for each in found]) for i in range(2))
        matrix = csr_array((values, (row, columns)), shape=(len(found), self.relaxation.columns))
        return matrix, np.array([bound for _, _, bound in found])

    def _heat_of(self, shares: Array) -> Array:
        """Mean heat of a solution, W, [arm, period, node]."""
        relaxation, pieces = self.relaxation, self.relaxation.pieces
        heat_j = np.zeros((len(relaxation.world.arms), relaxation.periods, self._surplus_w.shape[1]))
        share = shares[: len(pieces)]
        used = np.flatnonzero(share > 0)
        joules = (share[used] * pieces.cycles_s[used])[:, None] * self._surplus_w[used]
        np.add.at(heat_j, (pieces.arm[used], pieces.period[used]), joules)
        heat_w = heat_j / np.diff(relaxation.edges_s)[:, None] + relaxation.base_w[:, None]
        for arm in range(len(heat_w)):
            lost = shares[relaxation.lost_columns(arm)] / np.diff(relaxation.edges_s)
            heat_w[arm] -= lost[:, None] * relaxation.base_w[arm]
        return heat_w

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
        warning_c = relaxation.world.limits.warning_c
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
        edges_s, warning_c = relaxation.edges_s, world.limits.warning_c
        low, high = self._effect(arm, joint, float(edges_s[first]), float(edges_s[last]))
        own = np.flatnonzero((pieces.arm == arm) & (pieces.period < last + 1))
        joules = pieces.cycles_s[own, None] * self._surplus_w[own]
        effect = (joules * low[pieces.period[own]]).sum(axis=1)
        lost = -(high @ relaxation.base_w[arm])
        window = slice(first, last)
        above = np.full(last - first, warning_c - self.highest_c)
        ticks = np.round(edges_s[[first, last]] / world.dt_s).astype(int)
        base = float(self.base_c[1][arm, ticks[0] : ticks[1], joint].sum())
        bound = warning_c * float(edges_s[last] - edges_s[first]) - base
        columns = np.concatenate([own, relaxation.lost_columns(arm), relaxation.above_columns(arm)[window]])
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
        plans = world.plans.times_s
        reach = int(np.ceil((max(float(plans[:, 0].max()), relaxation.tail_s)) / step_s)) + 1
        size = 2 * reach + 1
        low = minimum_filter1d(effect, size, axis=0, mode="nearest") * between
        high = maximum_filter1d(effect, size, axis=0, mode="nearest") / between
        at = np.round(relaxation.edges_s / step_s).astype(int)
        parts = list(pairwise(at.tolist()))
        return (
            np.stack([low[one : other + 1].min(axis=0) for one, other in parts]),
            np.stack([high[one : other + 1].max(axis=0) for one, other in parts]),
        )
