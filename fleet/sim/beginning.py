"""How a shift begins in a row of the compiled kernel."""

import numpy as np

from fleet.sim.boiling import hottest
from fleet.sim.jit import entry, natural
from fleet.sim.state import WAITING
from fleet.sim.tables import Drawn, Offer, Rows, Tables
from fleet.telemetry import IDLE
from fleet.thermal import NODES

Array = np.ndarray


@entry
def begin(
    t: Tables,
    d: Drawn,
    s: Rows,
    o: Offer,
    rows: Array,
    lot: Array,
    air_k: Array,
    key: Array,
    first: Array,
    kind: Array,
    release_s: Array,
    due_s: Array,
    repetitions: Array,
    after: Array,
) -> None:
    """Put new shifts into some envs.

    Args:
        rows: Which envs, int [row].
        lot: Which fleet, int [row].
        air_k: By how much its air is warmer than the lot's, [row].
        key: Of its sensor noise, uint64 [row].
        first: Where its jobs begin in the arrays below, and where they end, int [row + 1].
        kind, release_s, due_s, repetitions, after: The jobs of all these shifts, [job], [job, n].
    """
    arms, room, waits = natural(s.mode.shape[1]), natural(d.kind.shape[1]), natural(d.after.shape[2])
    own = natural(after.shape[1])
    for n in range(len(rows)):
        e, at, count = natural(rows[n]), first[n], first[n + 1] - first[n]
        d.lot[e], d.air_k[e], d.key[e], d.jobs[e] = lot[n], air_k[n], key[n], count
        s.tick[e], o.open[e], o.head[e] = 0, count, 0
        for j in range(count):
            i = at + j
            d.kind[e, j], d.repetitions[e, j] = kind[i], repetitions[i]
            d.release_s[e, j], d.due_s[e, j], s.queued_s[e, j] = release_s[i], due_s[i], release_s[i]
            place = j
            while place > 0 and release_s[at + o.queue[e, place - 1]] > release_s[i]:
                o.queue[e, place] = o.queue[e, place - 1]
                place -= 1
            o.queue[e, place] = j
        for j in range(count, room):
            d.kind[e, j], d.repetitions[e, j] = 0, 1
            d.release_s[e, j] = d.due_s[e, j] = s.queued_s[e, j] = np.inf
        for j in range(room):
            s.status[e, j], s.cycles[e, j], s.returns[e, j], s.finished_s[e, j] = WAITING, 0, 0, np.nan
            for w in range(waits):
                d.after[e, j, w] = after[at + j, w] if j < count and w < own else -1
        for a in range(arms):
            s.mode[e, a], s.job[e, a], s.clear_at_s[e, a] = IDLE, -1, np.inf
            o.hand[e, a], o.owed[e, a] = t.able.shape[1], False
            s.todo[e, a] = s.last_award[e, a] = s.faults[e, a] = s.illegal[e, a] = 0
            s.progress_s[e, a] = s.above_warning_s[e, a] = s.busy_s[e, a] = s.lost_s[e, a] = s.energy_j[e, a] = 0.0
            for node in range(NODES):
                s.temp_c[e, a, node] = t.start_c[lot[n], a, node] + air_k[n]
            s.peak_c[e, a] = hottest(s.temp_c[e, a])
