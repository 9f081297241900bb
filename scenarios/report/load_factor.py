"""Thermal and time load of a shift, and the regime of a scenario.

Job j on arm a for t_aj seconds raises the steady motor temperatures above idle. The share of the headroom up to the
warning limit that the hottest motor uses, times t_aj, is the thermal arm time h_aj of the job. Three loads follow, each
over the shift of length T; 1 is the capacity of the fleet:

- time: the least λ for which all jobs can be shared out (in parts) with no arm busy for longer than λ·T,
  min λ, Σ_a x_aj = 1, Σ_j t_aj x_aj ≤ λ·T, x ≥ 0, a linear program;
- thermal, the thermal load factor: the same with h_aj, among the assignments that the arms have time for
  (Σ_j t_aj x_aj ≤ T, or the time load's λ·T if larger): the load of the best assignment;
- blind: the load of the hottest arm when every job is split equally among the arms that can do it.

Above 1.2 for the best assignment no policy keeps the fleet below the limit. Below 0.6 for the blind one every policy
does. In between the choice of arm decides.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from fleet.engine.state import World
from fleet.thermal import WINDING, drive_heat

Array = np.ndarray


@dataclass(frozen=True)
class LoadFactor:
    """Loads of env 0 of a world; 1 is the capacity of the fleet."""

    thermal: float
    blind: float
    time: float

    @property
    def regime(self) -> str:
        """The regime: hopeless, heat decides or relaxed."""
        if max(self.thermal, self.time) > 1.2:
            return "hopeless"
        return "relaxed" if self.blind < 0.6 else "heat decides"


def load_factor(world: World) -> LoadFactor:
    """Thermal, blind and time load of the jobs of env 0."""
    jobs = np.flatnonzero(world.jobs.exists[0] & (world.offers.plan[0] >= 0).any(axis=0))
    plan = world.offers.plan[0][:, jobs]
    possible = plan >= 0
    if not possible.any():
        return LoadFactor(0.0, 0.0, 0.0)
    times = world.plans.times_s[plan]
    length_s = times[..., 0] + world.jobs.repetitions[0, jobs] * times[..., 1] + times[..., 2]
    busy = np.where(possible, length_s, 0.0) / world.horizon_s
    heat = _heat_share(world, plan) * busy
    time = _least(busy, possible)
    blind = (heat * possible / possible.sum(axis=0)).sum(axis=1).max()
    return LoadFactor(thermal=_least(heat, possible, busy, max(1.0, time)), blind=float(blind), time=time)


def _heat_share(world: World, plan: Array) -> Array:
    """Share of the room up to the warning limit that the cycle of each plan would use when settled, [arm, job]."""
    limit = world.limits.warning_c
    at_limit = np.full(world.start_c.shape, limit)
    air = world.ambient_c.mean(axis=0)
    rest = _settled(world, at_limit, world.rest.current_sq, world.rest.friction_w, air)
    room = np.maximum(limit - rest, 1.0)  # an arm that idles at the limit has none left
    out = np.empty(plan.shape)
    for j in range(plan.shape[1]):
        rows = np.maximum(plan[:, j], 0)
        sq, friction = world.plans.current_sq[rows, 1], world.plans.friction_w[rows, 1]
        hot = _settled(world, at_limit, sq, friction, air)
        out[:, j] = np.maximum((hot - rest) / room, 0.0).max(axis=-1)
    return out


def _settled(world: World, temp_c: Array, current_sq: Array, friction_w: Array, air_c: Array) -> Array:
    """Settled motor temperatures for the losses at `temp_c`, [arm, joint]: linear, so shares of time add up."""
    return world.thermal.steady(drive_heat(temp_c, current_sq, friction_w, world.motors), air_c)[..., WINDING]


def _least(load: Array, possible: Array, busy: Array | None = None, most: float = np.inf) -> float:
    """Least largest load of an arm when every job is shared out, [arm, job], while no arm's `busy` passes `most`."""
    arms, jobs = load.shape
    cost = np.append(np.zeros(arms * jobs), 1.0)
    whole = np.hstack([np.tile(np.eye(jobs), arms), np.zeros((jobs, 1))])
    per_arm = [np.hstack([_block(load), np.full((arms, 1), -1.0)])]
    bound = [np.zeros(arms)]
    if busy is not None:
        per_arm.append(np.hstack([_block(busy), np.zeros((arms, 1))]))
        bound.append(np.full(arms, most * (1.0 + 1e-9)))
    upper = np.append(np.where(possible.ravel(), 1.0, 0.0), np.inf)
    found = linprog(
        cost,
        np.vstack(per_arm),
        np.concatenate(bound),
        whole,
        np.ones(jobs),
        bounds=np.column_stack([np.zeros(len(cost)), upper]),
    )
    if not found.success:
        raise ValueError(f"The load of the shift could not be computed: {found.message}")
    return float(found.x[-1])


def _block(values: Array) -> Array:
    """[arm, arm · job] with row a holding the values of arm a in its own columns, for [arm, job]."""
    arms, jobs = values.shape
    out = np.zeros((arms, arms, jobs))
    out[np.arange(arms), np.arange(arms)] = values
    return out.reshape(arms, arms * jobs)
