"""The arrays that the compiled kernel reads and writes, by name.

A *lot* is one fleet as it is built: envs of one lot have the same arms. A *kind* is one sort of job: its work and how
often it is repeated. Every array lies in one piece and belongs to the tuple alone, so that one compilation fits all.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from fleet.difficulty import Risk
from fleet.robot import JOINTS
from fleet.sim.state import State, World

Array = np.ndarray

LANES, WIDE = 8, 16
"""Joints and nodes are padded to so many, which a processor takes at once."""
assert JOINTS == LANES - 1
RISK = 5
"""Place of the row of the risk tables in `Tables.word`."""


class Tables(NamedTuple):
    """All that does not change from shift to shift; see `World` for the meaning."""

    dt_s: float
    ticks: int
    warning_c: float
    error_c: float
    restart_c: float
    clear_s: float
    power_off: bool
    alpha_cu: float
    alpha_kt: float
    reference_c: float
    ambient_c: Array
    """[lot, tick, arm]."""
    step: Array
    """One step of the heat, [lot, arm, from, to node]: from the temperatures (the transposed phi), then from the loads
    (gamma); its rows padded with zeros to `WIDE`."""
    to_ambient: Array
    """[lot, arm, node]."""
    root: Array
    """Square root of the capacities, [lot, arm, node]."""
    rates: Array
    """[lot, arm, mode]."""
    modes: Array
    """[lot, arm, node, mode]."""
    noise_k: Array
    """[lot, arm, joint padded to `LANES`]."""
    motor: Array
    """Of each joint its copper loss in W/A², idle heat in W, and squared current and friction heat at rest, [lot, arm,
    4, joint padded to `LANES`]."""
    start_c: Array
    """[lot, arm, node]."""
    times_s: Array
    """[plan, phase]."""
    drive: Array
    """Mean squared current and mean friction heat, [plan, phase, 2, joint padded to `LANES`]."""
    plan: Array
    """Row of the plan tables, −1 for none, int [lot, arm, kind]."""
    difficulty: Array
    """[lot, arm, kind], NaN where not known."""
    word: Array
    """What an arm says of a kind of job, [lot, arm, kind, padded to `LANES`]: seconds on the way there and back,
    seconds a cycle (zero of what it cannot do), 1 if it knows a difficulty, the difficulty or 0, P(saturation) or 0.5,
    and the row of the risk tables that knows better, −1 for none."""
    score: Array
    """Weights of the motor temperatures, and then the offset (−inf where there is no such piece), [risk, piece,
    `LANES`]."""
    curve: Array
    """[risk, knot, 2]; no knot at all where no risk has any."""
    able: Array
    """Whether an arm can do a kind of job at all, bool [lot, kind, arm]."""
    places: Array
    """Stations of a kind of job, a bit each, uint64 [lot, kind, word]; the last kind is no job, and needs none."""
    payload_kg: Array
    """[lot, kind]."""
    value: Array
    """[lot, kind]."""


class Drawn(NamedTuple):
    """What was drawn for the shift of each env."""

    lot: Array
    """int [env]."""
    air_k: Array
    """By how much its air is warmer than the lot's, [env]."""
    key: Array
    """Of its sensor noise, uint64 [env]."""
    jobs: Array
    """Jobs of the shift, int [env]; they are the first of their row."""
    kind: Array
    """int [env, job]."""
    release_s: Array
    due_s: Array
    repetitions: Array
    """int [env, job]."""
    after: Array
    """int [env, job, n], −1 for none."""


class Rows(NamedTuple):
    """The arrays of a `State`, in its order, to be written in place."""

    tick: Array
    temp_c: Array
    mode: Array
    job: Array
    progress_s: Array
    todo: Array
    clear_at_s: Array
    last_award: Array
    faults: Array
    illegal: Array
    peak_c: Array
    above_warning_s: Array
    busy_s: Array
    lost_s: Array
    energy_j: Array
    status: Array
    queued_s: Array
    cycles: Array
    returns: Array
    finished_s: Array


class Offer(NamedTuple):
    """What hangs out to be claimed, see `claims.Board`, and what is worked at: known from the rest, but dear to ask."""

    on_offer: Array
    """int [env, slot]."""
    mask: Array
    """int8 [env, arm, slot + 1]."""
    open: Array
    """Jobs not done, int [env]."""
    queue: Array
    """Jobs that wait, released or not, by the time they came, int32 [env, job]; they fill a row up to its last job."""
    head: Array
    """Where in its row the queue begins, int [env]."""
    hand: Array
    """Kind of the job that an arm has in hand, int [env, arm]; one more than there are if none."""
    owed: Array
    """Whether that job is still to be finished, bool [env, arm]; else the arm is on its way home."""


def state_of(rows: Rows, first: int, last: int) -> State:
    """A state of some envs, in arrays of its own."""
    return State(**{name: values[first:last].copy() for name, values in rows._asdict().items()})


def tables_of(world: World) -> tuple[Tables, Drawn]:
    """A world as tables: each env is a lot of its own, and each job a kind."""
    envs, jobs = world.envs, world.jobs
    count = jobs.exists.sum(axis=1)
    if not np.array_equal(jobs.exists, np.arange(jobs.exists.shape[1]) < count[:, None]):
        raise ValueError("The jobs of an env must be the first of its row.")

    def lots(values: Array) -> Array:
        return np.repeat(values[None], envs, axis=0)

    limits, motors, offers = world.limits, world.motors, world.offers
    score, curve = risk_tables(offers.risks)
    tables = Tables(
        dt_s=float(world.dt_s),
        ticks=int(world.ticks),
        warning_c=float(limits.warning_c),
        error_c=float(limits.error_c),
        restart_c=float(limits.restart_c),
        clear_s=float(limits.clear_s),
        power_off=bool(limits.power_off_on_fault),
        alpha_cu=float(motors.alpha_cu_per_k),
        alpha_kt=float(motors.alpha_kt_per_k),
        reference_c=float(motors.reference_c),
        ambient_c=lots(world.ambient_c),
        step=lots(_padded(np.concatenate([world.phi, world.gamma], axis=-1).swapaxes(-1, -2), 2, WIDE, 0.0)),
        to_ambient=lots(world.thermal.to_ambient),
        root=lots(np.sqrt(world.thermal.capacity)),
        rates=lots(world.thermal.rates),
        modes=lots(world.thermal.modes),
        motor=lots(_laned(motors.copper_w_per_a2, motors.idle_w, world.rest.current_sq, world.rest.friction_w)),
        noise_k=lots(_padded(motors.sensor_noise_k, -1, LANES, 0.0)),
        start_c=lots(world.start_c),
        times_s=world.plans.times_s,
        drive=_laned(world.plans.current_sq, world.plans.friction_w),
        plan=offers.plan,
        difficulty=offers.difficulty,
        word=_words(world),
        score=score,
        curve=curve,
        able=(offers.plan >= 0).swapaxes(-1, -2),
        places=_places(jobs.stations, len(world.stations)),
        payload_kg=jobs.payload_kg,
        value=jobs.value,
    )
    drawn = Drawn(
        lot=np.arange(envs),
        air_k=np.zeros(envs),
        key=np.zeros(envs, np.uint64),
        jobs=count,
        kind=np.repeat(np.arange(jobs.exists.shape[1])[None], envs, axis=0),
        release_s=jobs.release_s,
        due_s=jobs.due_s,
        repetitions=jobs.repetitions,
        after=jobs.after,
    )
    return owned(tables), owned(drawn)


def _laned(*values: Array) -> Array:
    """Values [..., joint] side by side, [..., value, joint padded to `LANES`]."""
    return _padded(np.stack(values, axis=-2), -1, LANES, 0.0)


def _places(stations: Array, count: int) -> Array:
    """Bits of stations, int [lot, kind, n], −1 for none."""
    lots, kinds, most = stations.shape
    bits = np.zeros((lots, kinds + 1, max(1, -(-count // 64))), np.uint64)
    for n in range(most):
        lot, kind = np.nonzero(stations[..., n] >= 0)
        station = stations[lot, kind, n]
        bits[lot, kind, station // 64] |= np.uint64(1) << (station % 64).astype(np.uint64)
    return bits


def _words(world: World) -> Array:
    offers, can = world.offers, world.offers.plan >= 0
    times_s = np.where(can[..., None], world.plans.times_s[offers.plan], 0.0)
    known, p_known = ~np.isnan(offers.difficulty), ~np.isnan(offers.p_saturation)
    return np.stack(
        [
            times_s[..., 0] + times_s[..., 2],
            times_s[..., 1],
            known,
            np.where(known, offers.difficulty, 0.0),
            np.where(p_known, offers.p_saturation, 0.5),
            offers.risk,
            *[np.zeros(offers.plan.shape)] * (LANES - 1 - RISK),
        ],
        axis=-1,
    )


def risk_tables(risks: Risk | None) -> tuple[Array, Array]:
    """Scores and curves of stacked risks, with empty axes for what is not there."""
    if risks is None:
        return np.empty((0, 1, LANES)), np.empty((0, 0, 2))
    curve = np.empty((len(risks.offset), 0, 2)) if risks.curve is None else risks.curve
    return np.concatenate([risks.weight, risks.offset[..., None]], axis=-1), curve


Arrays = TypeVar("Arrays", Tables, Drawn)


def owned(arrays: Arrays) -> Arrays:
    """The same with every array in one piece, writeable and its own."""
    return arrays._replace(
        **{name: np.array(v, order="C") for name, v in arrays._asdict().items() if isinstance(v, np.ndarray)}
    )


def stacked(fleets: Sequence[Tables]) -> Tables:
    """The tables of several fleets as lots of one.

    Raises:
        ValueError: they differ in what they share: the length of a step or a shift, limits, arms, or kinds of jobs.
    """
    first = fleets[0]
    for other in fleets[1:]:
        for name in _SHARED:
            if getattr(other, name) != getattr(first, name):
                raise ValueError(
                    f"Fleets of one batch must agree in {name} ({getattr(first, name)}, {getattr(other, name)})."
                )
        for name in ("ambient_c", "plan"):
            if getattr(other, name).shape != getattr(first, name).shape:
                raise ValueError(f"Fleets of one batch must have as many arms and kinds of jobs as the first ({name}).")
    rows = np.cumsum([0, *(len(each.times_s) for each in fleets)])
    risks = np.cumsum([0, *(len(each.score) for each in fleets)])
    pieces = max(each.score.shape[1] for each in fleets)
    knots = max(each.curve.shape[1] for each in fleets)
    words = max(each.places.shape[2] for each in fleets)

    def shifted(each: Iterable[Array], by: Array) -> Array:
        return np.concatenate([np.where(v >= 0, v + n, -1) for v, n in zip(each, by, strict=False)])

    def with_pieces(score: Array) -> Array:
        more = np.zeros((len(score), pieces - score.shape[1], LANES))
        more[..., -1] = -np.inf
        return np.concatenate([score, more], axis=1)

    joined = {name: np.concatenate([getattr(each, name) for each in fleets]) for name in _JOINED}
    joined["word"][..., RISK] = shifted((t.word[..., RISK] for t in fleets), risks)
    return owned(
        first._replace(
            **joined,
            plan=shifted((t.plan for t in fleets), rows),
            score=np.concatenate([with_pieces(t.score) for t in fleets]),
            curve=np.concatenate([_longer(t.curve, knots) for t in fleets]),
            places=np.concatenate([_padded(t.places, 2, words, 0) for t in fleets]),
        )
    )


_SHARED = ("dt_s", "ticks", "warning_c", "error_c", "restart_c", "clear_s", "power_off", "alpha_cu", "alpha_kt",
           "reference_c")  # fmt: skip
_JOINED = ("ambient_c", "step", "to_ambient", "root", "rates", "modes", "motor", "noise_k",
           "start_c", "times_s", "drive", "difficulty", "able",
           "word", "payload_kg", "value")  # fmt: skip


def _padded(values: Array, axis: int, size: int, fill: float) -> Array:
    width = [(0, 0)] * values.ndim
    width[axis] = (0, size - values.shape[axis])
    return np.pad(values, width, constant_values=fill)


def _longer(curve: Array, knots: int) -> Array:
    """Curves [risk, knot, 2] with more knots: constant beyond the last; NaN where there is none at all."""
    more = knots - curve.shape[1]
    if not more or not len(curve):
        return np.zeros((len(curve), knots, 2)) if not len(curve) else curve
    if not curve.shape[1]:
        return np.full((len(curve), knots, 2), np.nan)
    beyond = np.repeat(curve[:, -1:], more, axis=1)
    beyond[..., 0] = np.where(np.isnan(curve[:, :1, 0]), np.nan, np.inf)
    return np.concatenate([curve, beyond], axis=1)
