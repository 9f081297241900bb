"""From the end of a shift to its metrics."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fleet.engine.state import DONE, EXPIRED, GIVEN_UP, State, World
from fleet.events import Event
from scenarios.run.heat_use import HeatUse
from scenarios.run.metrics import Metrics, gini

Array = np.ndarray


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
        finds_contacts: Whether the plant looks for contacts.
    """
    time_s = float(state.tick[0] * world.dt_s)
    jobs = slice(int(world.jobs.exists[0].sum()))
    release_s, due_s, value = (column[0, jobs] for column in (world.jobs.release_s, world.jobs.due_s, world.jobs.value))
    finished_s = state.finished_s[0, jobs][state.status[0, jobs] == DONE]
    late_s = np.maximum(finished_s - due_s[state.status[0, jobs] == DONE], 0.0)
    released = release_s <= time_s
    release = dict(zip(world.jobs.names[0], release_s.tolist(), strict=True))
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
    """The figures that metrics of a run and of a comparison share, by name (Any: numbers).

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
