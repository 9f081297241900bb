"""How much heat a shift asks of its fleet: the regime a scenario is in.

Thermal load factor: offered heat over the heat the fleet can carry at the warning limit, under the best assignment.
Doing job j on arm a for t_aj seconds would lift some motor's settled temperature over its idle one; the share of the
room up to the warning limit that the hottest motor uses, times t_aj, is the arm time h_aj the job takes thermally. The
factor λ is the least for which all jobs can be shared out (in parts) with no arm above λ times the shift:
min λ, Σ_a x_aj = 1, Σ_j h_aj x_aj ≤ λ·T, x ≥ 0, a linear program. Below 0.6 a shift is relaxed; at 0.8–1.1 policies
differ; above 1.2 no policy keeps the fleet below the limit. With t_aj in place of h_aj it is the load in time.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from fleet.sim.state import World
from fleet.thermal import WINDING, drive_heat

Array = np.ndarray


@dataclass(frozen=True)
class LoadFactor:
    """Load of env 0 of a world: 1 is what the best assignment can just carry."""

    thermal: float
    time: float

    @property
    def regime(self) -> str:
        """In a word."""
        if max(self.thermal, self.time) > 1.2:
            return "hopeless"
        return "relaxed" if self.thermal < 0.6 else "heat decides"


def load_factor(world: World) -> LoadFactor:
    """Thermal and time load of the jobs of env 0."""
    jobs = np.flatnonzero(world.jobs.exists[0] & (world.offers.plan[0] >= 0).any(axis=0))
    plan = world.offers.plan[0][:, jobs]
    times = world.plans.times_s[plan]
    time_s = times[..., 0] + world.jobs.repetitions[0, jobs] * times[..., 1] + times[..., 2]
    share = _heat_share(world, plan)
    possible = plan >= 0
    return LoadFactor(
        thermal=_best_split(np.where(possible, share * time_s, np.inf), world.horizon_s),
        time=_best_split(np.where(possible, time_s, np.inf), world.horizon_s),
    )


def _heat_share(world: World, plan: Array) -> Array:
    """Share of the room up to the warning limit that the cycle of each plan would use when settled, [arm, job]."""
    limit = world.limits.warning_c
    at_limit = np.full(world.start_c.shape, limit)
    air = world.ambient_c.mean(axis=0)
    rest = _settled(world, at_limit, world.rest.current_sq, world.rest.friction_w, air)
    room = np.maximum(limit - rest, 0.1)
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


def _best_split(hours: Array, horizon_s: float) -> float:
    """Least largest load of an arm over the horizon when every job is shared out, [arm, job]; inf is impossible."""
    arms, jobs = hours.shape
    if jobs == 0:
        return 0.0
    possible = np.isfinite(hours)
    cost = np.zeros(arms * jobs + 1)
    cost[-1] = 1.0
    whole = np.hstack([np.tile(np.eye(jobs), arms), np.zeros((jobs, 1))])
    load = np.zeros((arms, arms * jobs + 1))
    for a in range(arms):
        load[a, a * jobs : (a + 1) * jobs] = np.where(possible[a], hours[a], 0.0) / horizon_s
        load[a, -1] = -1.0
    upper = np.append(np.where(possible.ravel(), 1.0, 0.0), np.inf)
    found = linprog(
        cost, load, np.zeros(arms), whole, np.ones(jobs), bounds=np.column_stack([np.zeros(len(cost)), upper])
    )
    if not found.success:
        raise ValueError(f"The load of the shift could not be computed: {found.message}")
    return float(found.x[-1])
