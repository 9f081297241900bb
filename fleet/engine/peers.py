"""What arms tell each other over an exchange, and how it enters their observations."""

from collections.abc import Sequence

import numpy as np

from fleet.bus.exchange.protocol import Broadcast, Exchange, PeerView
from fleet.engine.batch import Engine
from fleet.observation import LONG_S, Layout
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray


def deliver(
    exchange: Exchange, engine: Engine, vectors: Array, names: Sequence[str], twins: tuple[str, ...], env: int = 0
) -> None:
    """Broadcast what the arms of an env know now, and replace their peers' fields by what was delivered.

    Args:
        vectors: Of the env, float32 [arm, size].
        names: Of its jobs, [job].
        twins: Version of each arm's difficulty model.
    """
    view = exchange.share(broadcast(engine, vectors, names, twins, env))
    write_peers(engine.layout, view, vectors)


def broadcast(engine: Engine, vectors: Array, names: Sequence[str], twins: tuple[str, ...], env: int = 0) -> Broadcast:
    """What the arms of an env broadcast at this moment; arguments as in `deliver`."""
    known, slots = engine.layout.read(vectors, engine.mask[env]), engine.offers.slot_job[env]
    tables, fleet = engine.tables, engine.jobs.fleet[env]
    kinds = np.where(slots >= 0, engine.jobs.kind[env, slots], 0)
    filled = slots[:, None] >= 0
    work = {name: tables.work[name][fleet][:, kinds] for name in ("difficulty", "p_saturation", "risk", "peak")}
    unknown = (work["risk"] < 0) & (work["peak"] < 0) & np.isnan(work["p_saturation"])  # [arm, slot, plan]
    p_saturation = known.p_saturation.reshape(unknown.shape)
    return Broadcast(
        time_s=float(engine.state.tick[env] * tables.dt_s),
        mode=engine.state.mode[env].copy(),
        busy_s=known.busy_s.astype(float),
        temp_c=known.temp_c.astype(float),
        headroom_k=known.headroom_k.astype(float),
        jobs=tuple(names[j] if j >= 0 else "" for j in map(int, slots)),
        difficulty=np.fmin.reduce(np.where(filled, work["difficulty"], np.nan), axis=-1),
        p_saturation=np.fmin.reduce(np.where(filled & ~unknown, p_saturation, np.nan), axis=-1),
        twin=twins,
    )


def write_peers(layout: Layout, view: PeerView, vectors: Array) -> None:
    """Put what each arm received of its peers into the vectors [arm, size]."""
    rows = np.arange(layout.arms)[:, None]

    def received(values: Array) -> Array:
        return values[rows, layout.who]  # [arm, peer, ...]

    age_s, mode = received(view.age_s), received(view.mode)
    headroom_k, busy_s, difficulty = received(view.headroom_k), received(view.busy_s), received(view.difficulty)
    never, unknown = np.isinf(age_s), np.isnan(difficulty)
    difficulty[unknown] = 0.0
    fields = {
        "peer_heard": ~never,
        "peer_age_s": np.where(never, LONG_S, age_s),
        "peer_working": ~never & (mode == WORKING),
        "peer_faulted": ~never & (mode == FAULTED),
        "peer_busy_s": np.where(np.isnan(busy_s), 0.0, busy_s),
        "peer_headroom_k": np.where(np.isnan(headroom_k), 0.0, headroom_k),
        "peer_known": ~unknown,
        "peer_difficulty": difficulty,
    }
    layout.write(vectors, fields)
