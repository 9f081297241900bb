"""What an arm knows when it decides: named fields in one layout.

An arm knows its own sensors, its own scores for the open jobs, and what its peers shared, with its age. Nothing of the
simulator's truth is in here.
"""

from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np

from fleet.robot import JOINTS

Array = np.ndarray
Axis = Literal["joint", "slot", "peer"]

LONG_S = 1e5
"""Times are clipped to this, s: a little over a day."""


@dataclass(frozen=True)
class Field:
    """One named part of the observation vector."""

    name: str
    axes: tuple[Axis, ...]
    unit: str
    low: float
    high: float
    text: str


FIELDS: tuple[Field, ...] = (
    Field("clock", (), "1", 0, 1, "share of the shift that has passed"),
    Field("idle", (), "1", 0, 1, "1 when this arm is free"),
    Field("working", (), "1", 0, 1, "1 when it has a current job"),
    Field("faulted", (), "1", 0, 1, "1 when it is faulted by heat"),
    Field("busy_s", (), "s", 0, LONG_S, "time until the current job is done and the arm at home"),
    Field("last_award", (), "1", -1, 1, "1 last claim won, -1 lost, 0 none made"),
    Field("temp_c", ("joint",), "°C", -60, 200, "own motor temperatures as measured"),
    Field("headroom_k", (), "K", -150, 150, "warning limit minus hottest motor"),
    Field("offered", ("slot",), "1", 0, 1, "1 when the slot holds a job"),
    Field("feasible", ("slot",), "1", 0, 1, "1 when this arm could do it at all"),
    Field("known", ("slot",), "1", 0, 1, "1 when this arm has a difficulty for it"),
    Field("difficulty", ("slot",), "1", 0, JOINTS, "own thermal difficulty d of its plan, 0 where not known"),
    Field("p_saturation", ("slot",), "1", 0, 1, "probability to pass the warning limit from now, 0.5 if not known"),
    Field("duration_s", ("slot",), "s", 0, LONG_S, "how long this arm would take for what is left of it"),
    Field("slack_s", ("slot",), "s", -LONG_S, LONG_S, "due date minus now minus duration"),
    Field("age_s", ("slot",), "s", 0, LONG_S, "time since it was released or came back"),
    Field("payload_kg", ("slot",), "kg", 0, 100, "carried mass"),
    Field("value", ("slot",), "1", 0, 1e6, "worth of finishing it"),
    Field("returns", ("slot",), "1", 0, 1e3, "how often a fault sent it back"),
    Field("peer_heard", ("peer",), "1", 0, 1, "1 when a message of the peer ever arrived"),
    Field("peer_age_s", ("peer",), "s", 0, LONG_S, "age of the peer's last message"),
    Field("peer_working", ("peer",), "1", 0, 1, "1 when the peer was at work then"),
    Field("peer_faulted", ("peer",), "1", 0, 1, "1 when the peer was faulted then"),
    Field("peer_headroom_k", ("peer",), "K", -150, 150, "headroom the peer shared, 0 where nothing arrived"),
    Field("peer_known", ("peer", "slot"), "1", 0, 1, "1 when the peer shared a difficulty for the slot's job"),
    Field("peer_difficulty", ("peer", "slot"), "1", 0, JOINTS, "difficulty the peer shared, 0 where it shared none"),
)
"""The layout: the order of this tuple is the order in the vector."""


Offsets = namedtuple("Offsets", [field.name for field in FIELDS])  # pyright: ignore[reportUntypedNamedTuple]
"""Where each field begins in the vector, by name."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What arms know, by name; leading axes [...] are free. See `FIELDS` for units and meaning."""

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
    """Where each field lies in the vector, for a number of arms and slots."""

    arms: int
    slots: int
    near: tuple[tuple[int, ...], ...] | None = None
    """The peers in each arm's vector, in that order; all others in the fleet's order if not given."""

    @cached_property
    def who(self) -> Array:
        """The peers of each arm, int [arm, peer]."""
        if self.near is None:
            return all_peers(self.arms)
        return np.array(self.near, dtype=int).reshape(self.arms, -1)

    @property
    def peers(self) -> int:
        """Number of peers in an arm's vector."""
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
    def offsets(self) -> "Offsets":
        """Where each field begins in the vector."""
        return Offsets(*(self._spans[field.name][0].start for field in FIELDS))

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
        """An observation as vectors, float32 [..., size], clipped into `bounds`."""
        out = np.empty((*np.shape(observation.clock), self.size), np.float32)
        self.write(out, {field.name: np.asarray(getattr(observation, field.name)) for field in FIELDS})
        return out

    def write(self, vectors: Array, fields: Mapping[str, Array]) -> None:
        """Put some fields, [..., *shape], into vectors [..., size], clipped into `bounds`."""
        low, high = self.bounds
        for name, values in fields.items():
            span, shape = self._spans[name]
            lead = values.shape[: values.ndim - len(shape)]
            vectors[..., span] = np.clip(np.reshape(values, (*lead, -1)), low[span], high[span])

    def read(self, vector: Array, action_mask: Array) -> Observation:
        """Vectors as fields by name; arrays are views of the vector."""
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


@cache
def all_peers(arms: int) -> Array:
    """Indices of the peers of each arm, int [arm, peer]."""
    return np.array([[s for s in range(arms) if s != r] for r in range(arms)], dtype=int).reshape(arms, arms - 1)
