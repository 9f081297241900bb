"""Metrics of one shift: jobs, faults, energy, and the effects of heat on windings, tool points and surfaces."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, State
from fleet.engine.world import World
from fleet.events import Event
from fleet.heat.effects import arrhenius_rate, life_used, most_drift_m, seconds_above, segment_temperatures, surface_c
from fleet.heat.thermal import HOUSING, WINDING


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of one shift; times count from its start."""

    jobs: int
    """Number of jobs released before the horizon."""
    finished: int
    value: float
    """Value of the finished jobs."""
    value_offered: float
    given_up: int
    """Number of abandoned jobs: arms faulted in them too often, or a predecessor was abandoned or expired."""
    expired: int
    """Number of jobs that still waited at their hard due date."""
    on_time: int
    """Number of jobs finished by their due date."""
    tardiness_min: float
    """Sum over finished jobs of max(0, finish − due)."""
    mean_wait_s: float
    """Time from release to the first award, mean over the awarded jobs."""
    makespan_s: float
    """Time at which the last job was finished."""
    jobs_per_hour: float
    faults: int
    moved_home: int
    """Number of times a person moved a faulted arm home."""
    contacts: int | None
    """Contacts of arms and payloads with other arms, the floor or fixtures; None if the plant does not detect them."""
    above_warning_min: float
    """Sum over arms of the time with a motor above the warning limit."""
    peak_c: dict[str, float]
    """Highest motor temperature of each arm."""
    availability: float
    """Share of the arms' time not lost to faults."""
    utilisation: float
    """Share of the arms' time spent on jobs."""
    energy_wh: float
    """Energy turned to heat in the motors of all arms."""
    heat_gini: float
    """Gini coefficient of the arms' shares of that energy: 0 if equal, near 1 if one arm has all."""
    insulation_ppb: dict[str, float]
    """Billionths of the rated life used by the most aged winding of each arm; see `fleet.heat.effects`."""
    tool_drift_mm: dict[str, float]
    """Largest displacement by heat of the tool point of each arm, stretched, since the start of the shift; see
    `fleet.heat.effects`."""
    hot_surface_min: float
    """Sum over arms of the time with a surface above the burn threshold of the scenario's `people.contact_s`."""
    surface_c: dict[str, float]
    """Highest temperature of an accessible surface of each arm; see `fleet.heat.effects`."""
    messages: int
    """Number of messages delivered to peers."""
    lost_claims: int
    illegal_actions: int


def gini(shares: np.ndarray) -> float:
    """Gini coefficient of non-negative shares, [item] → [0, 1).

    Source: mean absolute difference over twice the mean (Sen, On Economic Inequality, 1973).
    """
    shares = np.asarray(shares, dtype=float)
    if not shares.size:
        raise ValueError("The Gini coefficient needs at least one share.")
    if np.any(shares < 0):
        raise ValueError(f"Shares must be >= 0 (got {shares}).")
    mean = shares.mean()
    if mean == 0:
        return 0.0
    return float(np.abs(shares[:, None] - shares[None, :]).mean() / (2 * mean))


Array = np.ndarray


class HeatUse:
    """Sums over the recorded temperatures of a shift, with any leading axes.

    Args:
        temp_c: Temperatures at the start, °C, [..., arm, node], at which the tool points are calibrated.
        burn_c: Temperature above which a surface is too hot to touch.
    """

    def __init__(self, temp_c: Array, burn_c: float) -> None:
        temp_c = temp_c.astype(float)
        self._burn_c, self._surface_c = burn_c, surface_c(temp_c)
        self.surface_c = self._surface_c.copy()
        """Hottest surface of each arm so far, °C, [..., arm]."""
        self._hot_s = np.zeros_like(self._surface_c)
        self._start_c = segment_temperatures(temp_c[..., HOUSING])
        self._rate = arrhenius_rate(temp_c[..., WINDING])
        self._used = np.zeros_like(self._rate)
        self._drift_m = np.zeros(self._rate.shape[:-1])

    def add(self, temp_c: Array, dt_s: float) -> None:
        """Add steps one after the other.

        Args:
            temp_c: Temperatures at their ends, °C, [step, ..., arm, node].
            dt_s: Length of each, s.
        """
        temp_c = temp_c.astype(float)  # sums over a shift need more digits than a temperature
        rate = np.concatenate([self._rate[None], arrhenius_rate(temp_c[..., WINDING])])
        self._used += life_used(rate[:-1], rate[1:], dt_s).sum(axis=0)
        rise_k = segment_temperatures(temp_c[..., HOUSING]) - self._start_c
        np.maximum(self._drift_m, most_drift_m(rise_k).max(axis=0), out=self._drift_m)
        each_c = np.concatenate([self._surface_c[None], surface_c(temp_c)])
        self._hot_s += seconds_above(each_c[:-1], each_c[1:], self._burn_c, dt_s).sum(axis=0)
        np.maximum(self.surface_c, each_c.max(axis=0), out=self.surface_c)
        self._rate, self._surface_c = rate[-1], each_c[-1]

    @property
    def insulation_ppb(self) -> Array:
        """Billionths of the rated life used by the most aged winding of each arm, [..., arm]."""
        return 1e9 * self._used.max(axis=-1)

    @property
    def tool_drift_mm(self) -> Array:
        """Largest drift of the tool point of the stretched arm, mm, [..., arm]."""
        return 1e3 * self._drift_m

    @property
    def hot_surface_min(self) -> Array:
        """Time with a surface above the burn threshold, min, [..., arm]."""
        return self._hot_s / 60.0


def metrics_of(
    world: World,
    state: State,
    heat: HeatUse,
    events: Sequence[Event],
    messages: int,
    *,
    finds_contacts: bool = False,
) -> Metrics:
    """Metrics of env 0 at the time of `state`.

    Args:
        heat: Of the whole shift, [arm].
        finds_contacts: Whether the plant detects contacts.
    """
    time_s = float(state.tick[0] * world.dt_s)
    shift = world.shifts[0]
    jobs, release_s, due_s = slice(len(shift.kind)), shift.release_s, shift.due_s
    value = world.tables.value[0, shift.kind]
    finished_s = state.finished_s[0, jobs][state.status[0, jobs] == DONE]
    late_s = np.maximum(finished_s - due_s[state.status[0, jobs] == DONE], 0.0)
    released = release_s <= time_s
    release = dict(zip(shift.names, release_s.tolist(), strict=True))
    first_award: dict[str, float] = {}
    for event in events:
        if event.kind == "award":
            first_award.setdefault(event.job, event.time_s)
    waits = [at_s - release[job] for job, at_s in first_award.items()]
    return Metrics(
        **common_figures(state, 0, value, due_s, world.dt_s),
        jobs=int(released.sum()),
        given_up=int((state.status[0, jobs] == GIVEN_UP).sum()),
        expired=int((state.status[0, jobs] == EXPIRED).sum()),
        moved_home=sum(event.kind == "moved" for event in events),
        value_offered=float(value[released].sum()),
        tardiness_min=float(late_s.sum() / 60.0),
        mean_wait_s=math.fsum(waits) / len(waits) if waits else 0.0,
        makespan_s=float(finished_s.max(initial=0.0)),
        jobs_per_hour=float(len(finished_s) / (time_s / 3600.0)) if time_s else 0.0,
        peak_c=dict(zip(world.arms, state.peak_c[0].tolist(), strict=True)),
        utilisation=float(state.busy_s[0].sum() / (time_s * len(world.arms))) if time_s else 0.0,
        energy_wh=float(state.energy_j[0].sum() / 3600.0),
        heat_gini=gini(state.energy_j[0]),
        insulation_ppb=dict(zip(world.arms, heat.insulation_ppb.tolist(), strict=True)),
        tool_drift_mm=dict(zip(world.arms, heat.tool_drift_mm.tolist(), strict=True)),
        hot_surface_min=float(heat.hot_surface_min.sum()),
        surface_c=dict(zip(world.arms, heat.surface_c.tolist(), strict=True)),
        messages=messages,
        contacts=sum(event.kind == "contact" for event in events) if finds_contacts else None,
        lost_claims=sum(event.kind == "lost" for event in events),
        illegal_actions=int(state.illegal[0].sum()),
    )


def common_figures(state: State, env: int, value: Array, due_s: Array, dt_s: float) -> dict[str, Any]:
    """Figures shared by the metrics of a run and of a comparison, by name (Any: numbers).

    Args:
        value, due_s: Of each job of this env, [job].
    """
    done = state.status[env, : len(value)] == DONE
    time_s, lost_s = float(state.tick[env] * dt_s), state.lost_s[env]
    return {
        "finished": int(done.sum()),
        "value": float(value[done].sum()),
        "on_time": int((state.finished_s[env, : len(value)][done] <= due_s[done]).sum()),
        "faults": int(state.faults[env].sum()),
        "above_warning_min": float(state.above_warning_s[env].sum() / 60.0),
        "availability": float(1.0 - lost_s.sum() / (time_s * len(lost_s))) if time_s else 1.0,
    }
