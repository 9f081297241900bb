"""From the end of a shift to its metrics."""

import math
from collections.abc import Sequence

import numpy as np

from fleet.engine.state import DONE, State, World
from fleet.events import Event
from fleet.metrics import Metrics, gini


def metrics_of(world: World, state: State, events: Sequence[Event], messages: int) -> Metrics:
    """Metrics of env 0 at the moment of `state`."""
    time_s = float(state.tick[0] * world.dt_s)
    table = world.jobs
    released = table.exists[0] & (table.release_s[0] <= time_s)
    done = (state.status[0] == DONE) & table.exists[0]
    late_s = np.maximum(state.finished_s[0][done] - table.due_s[0][done], 0.0)
    release = dict(zip(table.names[0], table.release_s[0].tolist(), strict=False))
    first_award: dict[str, float] = {}
    for event in events:
        if event.kind == "award":
            first_award.setdefault(event.job, event.time_s)
    waits = [at - release[job] for job, at in first_award.items()]
    arm_time_s = time_s * len(world.arms)
    return Metrics(
        jobs=int(released.sum()),
        finished=int(done.sum()),
        value=float(table.value[0][done].sum()),
        value_offered=float(table.value[0][released].sum()),
        on_time=int((late_s == 0).sum()),
        tardiness_min=float(late_s.sum() / 60.0),
        mean_wait_s=math.fsum(waits) / len(waits) if waits else 0.0,
        makespan_s=float(state.finished_s[0][done].max(initial=0.0)),
        jobs_per_hour=float(done.sum() / (time_s / 3600.0)) if time_s else 0.0,
        faults=int(state.faults[0].sum()),
        above_warning_min=float(state.above_warning_s[0].sum() / 60.0),
        peak_c=dict(zip(world.arms, state.peak_c[0].tolist(), strict=True)),
        availability=float(1.0 - state.lost_s[0].sum() / arm_time_s) if time_s else 1.0,
        utilisation=float(state.busy_s[0].sum() / arm_time_s) if time_s else 0.0,
        energy_wh=float(state.energy_j[0].sum() / 3600.0),
        heat_gini=gini(state.energy_j[0]),
        messages=messages,
        lost_claims=sum(event.kind == "lost" for event in events),
        illegal_actions=int(state.illegal[0].sum()),
    )
