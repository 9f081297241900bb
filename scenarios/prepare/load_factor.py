"""Thermal and time load of a shift, and the regime of a scenario.

Job j on arm a for t_aj seconds raises the steady motor temperatures above idle. The share of the headroom up to the
warning limit that the hottest motor uses, times t_aj, is the thermal arm time h_aj of the job. Three loads follow, each
over the shift of length T; 1 is the capacity of the fleet:

- time: the least λ for which all jobs can be shared out (in parts) with no arm busy for longer than λ·T,
  min λ, Σ_a x_aj = 1, Σ_j t_aj x_aj ≤ λ·T, x ≥ 0, a linear program; T without the breaks and failures of the arm;
- thermal, the thermal load factor: the same with h_aj, among the assignments that the arms have time for
  (Σ_j t_aj x_aj ≤ T, or the time load's λ·T if larger): the load of the best assignment;
- blind: the load of the hottest arm when every job is split equally among the arms that can do it.

Above 1.2 for the best assignment, or in time, the shift is hopeless. From a blind load of 0.6 on, heat decides if the
best assignment has less than 0.9 of it. Otherwise time decides from a time load of 0.6 on. All loads are averages over
the shift: motors may pass the limit for a while at a low load, or nowhere where heat decides.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, vstack

from fleet.engine.tables import drive_of
from fleet.engine.world import World
from fleet.heat.thermal import NODES, WINDING, drive_heat

Array = np.ndarray


LITTLE, ALIKE = 0.6, 0.9
"""Load from which heat or time may decide; share of the equal split's load from which the best one heats alike."""


@dataclass(frozen=True)
class LoadFactor:
    """Loads of env 0 of a world; 1 is the capacity of the fleet."""

    thermal: float
    blind: float
    time: float
    able: float
    """Share of the arms that can do a job, mean over the jobs."""

    @property
    def regime(self) -> str:
        """The regime: hopeless, heat decides, time decides or nothing decides."""
        if max(self.thermal, self.time) > 1.2:
            return "hopeless"
        if self.blind >= LITTLE and self.thermal < ALIKE * self.blind:
            return "heat decides"
        return "time decides" if self.time >= LITTLE else "nothing decides"


def load_factor(world: World) -> LoadFactor:
    """Thermal, blind and time load of the jobs of env 0."""
    shift, work = world.shifts[0], world.tables.work["plan"][0]  # [kind, arm, plan]
    jobs = np.flatnonzero((work[shift.kind] >= 0).any(axis=(1, 2)))
    plan = work[shift.kind[jobs], :, 0].T
    possible = plan >= 0
    if not possible.any():
        return LoadFactor(0.0, 0.0, 0.0, 0.0)
    times = world.tables.plans["times_s"][plan]
    length_s = times[..., 0] + shift.repetitions[jobs] * times[..., 1] + times[..., 2]
    length_s = np.where(possible, length_s, 0.0)
    heat = _heat_share(world, plan) * length_s / world.horizon_s
    busy = length_s / np.maximum(_present_s(world), world.dt_s)[:, None]
    time = _least(busy, possible)
    blind = (heat * possible / possible.sum(axis=0)).sum(axis=1).max()
    thermal, able = _least(heat, possible, busy, max(1.0, time)), float(possible.mean())
    return LoadFactor(thermal=thermal, blind=float(blind), time=time, able=able)


def _present_s(world: World) -> Array:
    """Length of the shift without breaks and failures, s, [arm]."""
    present = np.ones((len(world.arms), world.ticks), bool)
    for each in world.shifts[0].absences:
        present[each["arm"], each["begin"] : each["end"]] = False
    return present.sum(axis=1) * world.dt_s


def _heat_share(world: World, plan: Array) -> Array:
    """Share of the room up to the warning limit that the cycle of each plan uses in steady state, [arm, job]."""
    tables = world.tables
    at_limit = np.full((len(world.arms), NODES), tables.warning_c)
    ambient_c = tables.ambient_c[0].mean(axis=0) + world.shifts[0].ambient_offset_k

    def steady_c(current_sq: Array, friction_w: Array) -> Array:
        """Motor temperatures [arm, joint] for the losses at the limit: linear, so shares of time add up."""
        heat_w = drive_heat(at_limit, current_sq, friction_w, world.motors)
        return world.thermal.steady(heat_w, ambient_c)[..., WINDING]

    rest_c = steady_c(*drive_of(tables.start[0]))
    room_k = np.maximum(tables.warning_c - rest_c, 1.0)  # an arm that idles at the limit has none left
    shares = np.empty(plan.shape)
    for j, rows in enumerate(np.maximum(plan.T, 0)):
        current_sq, friction_w = drive_of(tables.plans[rows])
        hot_c = steady_c(current_sq[:, 1], friction_w[:, 1])
        shares[:, j] = np.maximum((hot_c - rest_c) / room_k, 0.0).max(axis=-1)
    return shares


def _least(load: Array, possible: Array, busy: Array | None = None, most: float = np.inf) -> float:
    """Least largest load of an arm when every job is shared out, [arm, job], while no arm's `busy` passes `most`.

    Jobs that are equal for every arm are one job with a count; only possible pairs are variables.
    """
    columns = np.stack([possible, load * possible, (load if busy is None else busy) * possible])
    (alike, loads, busies), count = np.unique(columns, axis=2, return_counts=True)
    arms, kinds = alike.shape
    arm, kind = np.nonzero(alike)
    pairs = np.arange(len(arm))
    # Variables: how much of each kind goes to each arm that can do it, and the largest load.
    shape = (arms, len(pairs) + 1)
    own = csr_array((loads[arm, kind], (arm, pairs)), shape=shape) - csr_array(
        (np.ones(arms), (np.arange(arms), np.full(arms, len(pairs)))), shape=shape
    )
    time = csr_array((busies[arm, kind], (arm, pairs)), shape=shape)
    limited = busy is not None
    result = linprog(
        np.append(np.zeros(len(pairs)), 1.0),
        vstack([own, time]) if limited else own,
        np.append(np.zeros(arms), np.full(arms, most * (1.0 + 1e-9)) if limited else []),
        csr_array((np.ones(len(pairs)), (kind, pairs)), shape=(kinds, len(pairs) + 1)),
        count,
        method="highs",
    )
    if not result.success:
        raise ValueError(f"The load of the shift could not be computed: {result.message}")
    return float(result.x[-1])
