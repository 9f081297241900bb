"""The beginning of a shift in a row of the engine."""

import numpy as np

from fleet.engine.crossings import hottest
from fleet.engine.state import WAITING
from fleet.engine.tables import Simulation
from fleet.jit import kernel, nonnegative
from fleet.job import MOST_FAULTS
from fleet.robot import JOINTS
from fleet.telemetry import IDLE
from fleet.thermal import NODES

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
    """
    t, d, s, o = sim.tables, sim.jobs, sim.state, sim.offers
    arms, room, waits = nonnegative(s.mode.shape[1]), nonnegative(d.kind.shape[1]), nonnegative(d.after.shape[2])
    own = nonnegative(after.shape[1])
    for n in range(len(rows)):
        e, at, count = nonnegative(rows[n]), first[n], first[n + 1] - first[n]
        d.fleet[e], d.ambient_offset_k[e], d.noise_key[e], d.number[e] = (
            fleet[n],
            ambient_offset_k[n],
            noise_key[n],
            count,
        )
        o.alarm[e] = False
        s.tick[e], o.unfinished[e], o.given_up[e], o.head[e] = 0, count, 0, 0
        for j in range(count):
            i = at + j
            d.kind[e, j], d.repetitions[e, j], d.expires[e, j] = kind[i], repetitions[i], expires[i]
            d.release_s[e, j], d.due_s[e, j], s.queued_s[e, j] = release_s[i], due_s[i], release_s[i]
            place = j
            while place > 0 and release_s[at + o.queue[e, place - 1]] > release_s[i]:
                o.queue[e, place] = o.queue[e, place - 1]
                place -= 1
            o.queue[e, place] = j
        for j in range(count, room):
            d.kind[e, j], d.repetitions[e, j], d.expires[e, j] = 0, 1, False
            d.release_s[e, j] = d.due_s[e, j] = s.queued_s[e, j] = np.inf
        for j in range(room):
            s.status[e, j], s.cycles[e, j], s.returns[e, j], s.finished_s[e, j] = WAITING, 0, 0, np.nan
            for w in range(MOST_FAULTS - 1):
                s.failed_arm[e, j, w] = -1
            for w in range(waits):
                d.after[e, j, w] = after[at + j, w] if j < count and w < own else -1
        for a in range(arms):
            s.mode[e, a], s.job[e, a], s.plan[e, a] = IDLE, -1, -1
            s.clear_at_s[e, a] = s.moved_at_s[e, a] = np.inf
            o.current_kind[e, a], o.pending[e, a] = t.feasible.shape[1], False
            s.todo[e, a] = s.last_award[e, a] = s.faults[e, a] = s.illegal[e, a] = 0
            s.progress_s[e, a] = s.above_warning_s[e, a] = s.busy_s[e, a] = s.lost_s[e, a] = s.energy_j[e, a] = 0.0
            for node in range(NODES):
                s.temp_c[e, a, node] = t.start_c[fleet[n], a, node] + ambient_offset_k[n]
            for k in range(JOINTS):
                s.housing_c[e, a, k] = t.start_housing_c[fleet[n], a, k] + ambient_offset_k[n]
            s.peak_c[e, a] = hottest(s.temp_c[e, a])
