"""What an arm knows when it decides: named fields, one layout, packed and read in one place.

An arm knows its own sensors, its own scores for the jobs on offer, and what its peers told it, with the age of
what they said. Nothing of the simulator's truth is in here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np

from fleet.bus.exchange import Heard, Words
from fleet.robot import JOINTS
from fleet.sim.claims import per_slot
from fleet.sim.state import Offers, State, World
from fleet.telemetry import FAULTED, IDLE, WORKING

Array = np.ndarray
Axis = Literal["joint", "slot", "peer"]

LONG_S = 1e5
"""Times are clipped here, s: a little over a day."""


@dataclass(frozen=True)
class Field:
    """One named stretch of the observation vector."""

    name: str
    axes: tuple[Axis, ...]
    unit: str
    low: float
    high: float
    text: str


FIELDS: tuple[Field, ...] = (
    Field("clock", (), "1", 0, 1, "share of the shift that has passed"),
    Field("idle", (), "1", 0, 1, "1 when this arm is free"),
    Field("working", (), "1", 0, 1, "1 when it has a job in hand"),
    Field("faulted", (), "1", 0, 1, "1 when it is lost to heat"),
    Field("busy_s", (), "s", 0, LONG_S, "time until the job in hand is done and the arm at home"),
    Field("last_award", (), "1", -1, 1, "1 last claim won, -1 lost, 0 none made"),
    Field("temp_c", ("joint",), "°C", -60, 200, "own motor temperatures as measured"),
    Field("headroom_k", (), "K", -150, 150, "warning limit minus hottest motor"),
    Field("offered", ("slot",), "1", 0, 1, "1 when the slot holds a job"),
    Field("feasible", ("slot",), "1", 0, 1, "1 when this arm could do it at all"),
    Field("known", ("slot",), "1", 0, 1, "1 when this arm has a difficulty for it"),
    Field("difficulty", ("slot",), "1", 0, JOINTS, "own thermal difficulty d of its best plan, 0 where not known"),
    Field("p_saturation", ("slot",), "1", 0, 1, "probability to pass the warning limit from now, 0.5 if not known"),
    Field("duration_s", ("slot",), "s", 0, LONG_S, "how long this arm would take for what is left of it"),
    Field("slack_s", ("slot",), "s", -LONG_S, LONG_S, "due date minus now minus duration"),
    Field("age_s", ("slot",), "s", 0, LONG_S, "time since it was released or came back"),
    Field("payload_kg", ("slot",), "kg", 0, 100, "carried mass"),
    Field("value", ("slot",), "1", 0, 1e6, "worth of finishing it"),
    Field("returns", ("slot",), "1", 0, 1e3, "how often a fault sent it back"),
    Field("peer_heard", ("peer",), "1", 0, 1, "1 when the peer ever said something"),
    Field("peer_age_s", ("peer",), "s", 0, LONG_S, "age of the peer's last word"),
    Field("peer_working", ("peer",), "1", 0, 1, "1 when the peer said it was at work"),
    Field("peer_faulted", ("peer",), "1", 0, 1, "1 when the peer said it was lost to heat"),
    Field("peer_headroom_k", ("peer",), "K", -150, 150, "headroom the peer told, 0 where never heard"),
    Field("peer_known", ("peer", "slot"), "1", 0, 1, "1 when the peer told a difficulty for the slot's job"),
    Field("peer_difficulty", ("peer", "slot"), "1", 0, JOINTS, "difficulty the peer told, 0 where it told none"),
)
"""The layout: the order of this tuple is the order in the vector."""


@dataclass(frozen=True, eq=False)
class Observation:
    """An arm's knowledge by name; leading axes [...] are free. See `FIELDS` for units and meaning."""

    clock: Array
    idle: Array
    working: Array
    faulted: Array
    busy_s: Array
    last_award: Array
    temp_c: Array
    headroom_k: Array
    offered: Array
    feasible: Array
    known: Array
    difficulty: Array
    p_saturation: Array
    duration_s: Array
    slack_s: Array
    age_s: Array
    payload_kg: Array
    value: Array
    returns: Array
    peer_heard: Array
    peer_age_s: Array
    peer_working: Array
    peer_faulted: Array
    peer_headroom_k: Array
    peer_known: Array
    peer_difficulty: Array
    action_mask: Array
    """Legal actions, int8 [..., slot + 1]."""


@dataclass(frozen=True)
class Layout:
    """Where each field lies in the vector of a fleet of so many arms and slots."""

    arms: int
    slots: int
    near: tuple[tuple[int, ...], ...] | None = None
    """The peers that each arm has in its vector, in that order; all others in the fleet's order if not given."""

    @cached_property
    def who(self) -> Array:
        """The peers of each arm, int [arm, peer]."""
        if self.near is None:
            return _peers(self.arms)
        return np.array(self.near, dtype=int).reshape(self.arms, -1)

    @property
    def peers(self) -> int:
        """How many peers an arm has in its vector."""
        return self.arms - 1 if self.near is None else len(self.near[0])

    def shape(self, field: Field) -> tuple[int, ...]:
        """Axes of a field as numbers."""
        sizes = {"joint": JOINTS, "slot": self.slots, "peer": self.peers}
        return tuple(sizes[axis] for axis in field.axes)

    @cached_property
    def _spans(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        spans: dict[str, tuple[slice, tuple[int, ...]]] = {}
        begin = 0
        for field in FIELDS:
            shape = self.shape(field)
            end = begin + int(np.prod(shape))
            spans[field.name] = (slice(begin, end), shape)
            begin = end
        return spans

    @property
    def starts(self) -> tuple[int, ...]:
        """Where each of `FIELDS` begins."""
        return tuple(self._spans[field.name][0].start for field in FIELDS)

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return max(span.stop for span, _ in self._spans.values())

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value of each element, float32 [size]."""
        low, high = np.empty(self.size, np.float32), np.empty(self.size, np.float32)
        for field in FIELDS:
            span, _ = self._spans[field.name]
            low[span], high[span] = field.low, field.high
        return low, high

    def pack(self, observation: Observation) -> Array:
        """The observation as vectors, float32 [..., size], clipped into `bounds`."""
        lead = np.shape(observation.clock)
        out = np.empty((*lead, self.size), np.float32)
        for field in FIELDS:
            span, _ = self._spans[field.name]
            out[..., span] = np.reshape(getattr(observation, field.name), (*lead, -1))
        return np.clip(out, *self.bounds, out=out)

    def read(self, vector: Array, action_mask: Array) -> Observation:
        """The inverse of `pack`; arrays are views of the vector."""
        if vector.shape[-1] != self.size:
            raise ValueError(
                f"An observation of {self.slots} slots and {self.peers} peer(s) has {self.size} elements, "
                f"got {vector.shape[-1]}."
            )
        lead = vector.shape[:-1]
        named: dict[str, Any] = {
            name: vector[..., span].reshape((*lead, *shape)) for name, (span, shape) in self._spans.items()
        }
        return Observation(**named, action_mask=action_mask)


def say(world: World, state: State, on_offer: Array, measured_c: Array, twins: tuple[str, ...]) -> Words:
    """What the arms of env 0 tell each other at this moment.

    Args:
        on_offer: Jobs on offer, int [env, slot].
        measured_c: Motor temperatures as read, [env, arm, joint].
    """
    names = world.jobs.names[0]
    return Words(
        time_s=float(state.tick[0] * world.dt_s),
        mode=state.mode[0],
        temp_c=measured_c[0],
        headroom_k=world.limits.warning_c - measured_c[0].max(axis=-1),
        jobs=tuple(names[j] if j >= 0 else "" for j in on_offer[0].tolist()),
        difficulty=scored(world.offers.difficulty, on_offer)[0],
        p_saturation=saturation(world.offers, on_offer, measured_c)[0],
        twin=twins,
    )


def scored(values: Array, on_offer: Array) -> Array:
    """[env, arm, slot] of a score per [env, arm, job]; NaN in empty slots."""
    return np.where((on_offer >= 0)[:, None, :], per_slot(values, on_offer), np.nan)


def saturation(offers: Offers, on_offer: Array, measured_c: Array) -> Array:
    """Probability of each arm, as warm as it measures, to pass the warning limit in each job on offer.

    It is that of the whole job, also where a fault sent the job back with cycles done: then it errs to the safe side.

    Returns:
        [env, arm, slot]; NaN in empty slots and where the arm cannot say.
    """
    p = scored(offers.p_saturation, on_offer)
    if offers.risks is not None:
        row = np.where((on_offer >= 0)[:, None, :], per_slot(offers.risk, on_offer), -1)
        env, arm, slot = np.nonzero(row >= 0)
        p[env, arm, slot] = offers.risks[row[env, arm, slot]].at(measured_c[env, arm])
    return p


def remaining_s(world: World, state: State, on_offer: Array) -> Array:
    """How long each arm would take for what is left of each job on offer, s, [env, arm, slot]; 0 where it cannot."""
    env = np.arange(world.envs)[:, None]
    plan = per_slot(world.offers.plan, on_offer)
    times = world.plans.times_s[plan]
    cycles = (world.jobs.repetitions - state.cycles)[env, on_offer][:, None, :]
    total = times[..., 0] + cycles * times[..., 1] + times[..., 2]
    return np.where((plan >= 0) & (on_offer >= 0)[:, None, :], total, 0.0)


def observe(
    world: World,
    state: State,
    on_offer: Array,
    mask: Array,
    measured_c: Array,
    heard: Mapping[str, Array] | Heard,
    who: Array | None = None,
) -> Observation:
    """What every arm knows now, leading axes [env, arm].

    Args:
        heard: What each arm received, arrays [env, receiver, sender, ...].
        who: The peers of each arm, int [arm, peer]; all others if not given.
    """
    told = heard if isinstance(heard, Mapping) else {k: np.asarray(v)[None] for k, v in vars(heard).items()}
    envs, arms = state.mode.shape
    env = np.arange(envs)[:, None]
    time_s = (state.tick * world.dt_s)[:, None]
    filled = on_offer >= 0

    def slot(values: Array) -> Array:
        picked = np.where(filled, values[env, on_offer], 0.0)
        return np.broadcast_to(picked[:, None, :], (envs, arms, world.slots))

    own = scored(world.offers.difficulty, on_offer)
    risk = saturation(world.offers, on_offer, measured_c)
    duration = remaining_s(world, state, on_offer)
    peers = _peers(arms) if who is None else who
    peer = {name: _others(values, peers) for name, values in told.items() if name != "p_saturation"}
    total = world.plans.times_s[world.offers.plan[env, np.arange(arms), state.job]]
    left = total[..., 0] + state.todo * total[..., 1] + total[..., 2] - state.progress_s
    never, known, peer_known = np.isinf(peer["age_s"]), ~np.isnan(own), ~np.isnan(peer["difficulty"])
    return Observation(
        clock=np.broadcast_to(time_s / world.horizon_s, (envs, arms)),
        idle=state.mode == IDLE,
        working=state.mode == WORKING,
        faulted=state.mode == FAULTED,
        busy_s=np.where(state.mode == WORKING, left, 0.0),
        last_award=state.last_award,
        temp_c=measured_c,
        headroom_k=world.limits.warning_c - measured_c.max(axis=-1),
        offered=slot(np.ones_like(world.jobs.value)),
        feasible=duration > 0,
        known=known,
        difficulty=np.where(known, own, 0.0),
        p_saturation=np.where(np.isnan(risk), 0.5, risk),
        duration_s=duration,
        slack_s=np.where(filled[:, None, :], slot(world.jobs.due_s) - time_s[..., None] - duration, 0.0),
        age_s=np.where(filled[:, None, :], time_s[..., None] - slot(state.queued_s), 0.0),
        payload_kg=slot(world.jobs.payload_kg),
        value=slot(world.jobs.value),
        returns=slot(state.returns),
        peer_heard=~never,
        peer_age_s=np.where(never, LONG_S, peer["age_s"]),
        peer_working=~never & (peer["mode"] == WORKING),
        peer_faulted=~never & (peer["mode"] == FAULTED),
        peer_headroom_k=np.where(np.isnan(peer["headroom_k"]), 0.0, peer["headroom_k"]),
        peer_known=peer_known,
        peer_difficulty=np.where(peer_known, peer["difficulty"], 0.0),
        action_mask=mask.astype(np.int8),
    )


def _others(values: Array, peers: Array) -> Array:
    """[env, receiver, peer, ...] of [env, receiver, sender, ...]."""
    return values[:, np.arange(len(peers))[:, None], peers]


@cache
def _peers(arms: int) -> Array:
    """Indices of the peers of each arm, int [arm, peer]."""
    return np.array([[s for s in range(arms) if s != r] for r in range(arms)], dtype=int).reshape(arms, arms - 1)
