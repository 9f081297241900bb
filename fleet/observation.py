"""The observation of an arm: named fields, and their layout in one vector.

An arm observes its own sensors, its own predictions for the open jobs, and its peers' messages with their age. The
observation contains no true state of the simulation.
"""

from collections import namedtuple
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np

from fleet.robot import JOINTS

Array = np.ndarray
Axis = Literal["joint", "slot", "option", "peer"]

LONG_S = 1e5
"""Times are clipped to this, s: a little over a day."""
MOST_SLOTS = 256


@dataclass(frozen=True)
class Field:
    """One named part of the observation vector."""

    axes: tuple[Axis, ...]
    unit: str
    low: float
    high: float
    text: str
    name: str = ""
    """Set from the attribute of `Observation`."""


_JOINT: tuple[Axis, ...] = ("joint",)
_SLOT: tuple[Axis, ...] = ("slot",)
_OPTION: tuple[Axis, ...] = ("option",)
_PEER: tuple[Axis, ...] = ("peer",)
_PEER_SLOT: tuple[Axis, ...] = ("peer", "slot")


@dataclass(frozen=True, eq=False)
class Observation:
    """Observations of arms, with any leading axes [...]. Each `Field` gives axes, unit, lowest and highest value.

    An option is one plan for the job of one slot: option = slot · plans + plan. Action 0 waits or continues the current
    job, action option + 1 claims the option, and the last action gives the current job back after the present cycle.
    The first plan of a job is the fastest.
    """

    clock: Annotated[Array, Field((), "1", 0, 1, "share of the episode that has passed")]
    left_s: Annotated[Array, Field((), "s", 0, LONG_S, "time until the end of the episode; 100000 live without end")]
    idle: Annotated[Array, Field((), "1", 0, 1, "1 when this arm is free")]
    working: Annotated[Array, Field((), "1", 0, 1, "1 when it works or goes home")]
    faulted: Annotated[Array, Field((), "1", 0, 1, "1 from a fault until it recovers")]
    busy_s: Annotated[Array, Field((), "s", 0, LONG_S, "time until it is home, with the current job done")]
    last_award: Annotated[Array, Field((), "1", -1, 1, "last claim: 1 won, -1 lost, 0 none made")]
    temp_c: Annotated[Array, Field(_JOINT, "°C", -60, 200, "own motor temperatures as measured")]
    housing_c: Annotated[Array, Field(_JOINT, "°C", -60, 200, "own estimate of the housing temperatures")]
    ambient_c: Annotated[Array, Field((), "°C", -60, 200, "ambient temperature at this arm")]
    headroom_k: Annotated[Array, Field((), "K", -150, 150, "warning limit minus hottest motor")]
    error_headroom_k: Annotated[Array, Field((), "K", -150, 150, "error limit minus hottest motor")]
    job_value: Annotated[Array, Field((), "1", 0, 1e6, "value of the current job, 0 without one")]
    job_cycles: Annotated[Array, Field((), "1", 0, 1e5, "unfinished cycles of the current job")]
    job_peak_c: Annotated[Array, Field((), "°C", -60, 300, "predicted peak in the rest of that job, 0 if unknown")]
    job_p: Annotated[Array, Field((), "1", 0, 1, "P(saturation) in the rest of that job, 0 without one")]
    offered: Annotated[Array, Field(_SLOT, "1", 0, 1, "1 when the slot holds a job")]
    station_free: Annotated[Array, Field(_SLOT, "1", 0, 1, "1 when no arm occupies its stations")]
    too_heavy: Annotated[Array, Field(_SLOT, "1", 0, 1, "1 when the load exceeds this arm's rating")]
    feasible: Annotated[Array, Field(_OPTION, "1", 0, 1, "1 when this arm has such a plan")]
    space_free: Annotated[Array, Field(_OPTION, "1", 0, 1, "1 when no other arm takes space that excludes the plan")]
    known: Annotated[Array, Field(_OPTION, "1", 0, 1, "1 when this arm has a difficulty for the plan")]
    difficulty: Annotated[Array, Field(_OPTION, "1", 0, JOINTS, "own thermal difficulty d of the plan, 0 if unknown")]
    peak_c: Annotated[Array, Field(_OPTION, "°C", -60, 300, "predicted peak: hottest motor in the plan, 0 if unknown")]
    p_saturation: Annotated[Array, Field(_OPTION, "1", 0, 1, "P(saturation) of the plan, 0.5 if unknown")]
    duration_s: Annotated[Array, Field(_OPTION, "s", 0, LONG_S, "time this arm needs for the rest of the job")]
    slack_s: Annotated[Array, Field(_OPTION, "s", -LONG_S, LONG_S, "due date minus now minus duration")]
    age_s: Annotated[Array, Field(_SLOT, "s", 0, LONG_S, "time since its release or return to the queue")]
    payload_kg: Annotated[Array, Field(_SLOT, "kg", 0, 100, "carried mass")]
    value: Annotated[Array, Field(_SLOT, "1", 0, 1e6, "value of finishing it")]
    returns: Annotated[Array, Field(_SLOT, "1", 0, 1e3, "number of faults that returned it")]
    expires: Annotated[Array, Field(_SLOT, "1", 0, 1, "1 when it expires if it still waits at its due date")]
    peer_heard: Annotated[Array, Field(_PEER, "1", 0, 1, "1 when a message of the peer has arrived")]
    peer_age_s: Annotated[Array, Field(_PEER, "s", 0, LONG_S, "age of the peer's last message")]
    peer_working: Annotated[Array, Field(_PEER, "1", 0, 1, "1 when the peer was working then")]
    peer_faulted: Annotated[Array, Field(_PEER, "1", 0, 1, "1 when the peer was faulted then")]
    peer_headroom_k: Annotated[Array, Field(_PEER, "K", -150, 150, "headroom the peer shared, 0 if none")]
    peer_busy_s: Annotated[Array, Field(_PEER, "s", 0, LONG_S, "time until the peer is home as it shared, 0 if free")]
    peer_known: Annotated[Array, Field(_PEER_SLOT, "1", 0, 1, "1 when the peer shared a difficulty for the slot's job")]
    peer_difficulty: Annotated[
        Array, Field(_PEER_SLOT, "1", 0, JOINTS, "least d of its plans the peer shared, 0 if none")
    ]
    peer_blocks: Annotated[
        Array, Field(_PEER_SLOT, "1", 0, 1, "1 when space that the peer takes excludes this arm's fastest plan")
    ]
    action_mask: Array
    """Legal actions, int8 [..., option + 2]."""


def _fields() -> Iterator[Field]:
    for name, kind in get_type_hints(Observation, include_extras=True).items():
        for field in getattr(kind, "__metadata__", ()):
            yield replace(field, name=name)


FIELDS: tuple[Field, ...] = tuple(_fields())
"""The layout: the order of this tuple is the order in the vector."""
_BY_NAME = {field.name: field for field in FIELDS}
Offsets = namedtuple("Offsets", [field.name for field in FIELDS])  # pyright: ignore[reportUntypedNamedTuple]
"""First column of each field in the vector, by name."""


@dataclass(frozen=True)
class Layout:
    """Position of each field in the vector, for a number of arms, slots and plans."""

    arms: int
    slots: int
    near: tuple[tuple[int, ...], ...] | None = None
    """Indices of the peers in each arm's vector, in order; None: all other arms in the order of the fleet."""
    plans: int = 1
    """Plans for the job of a slot."""

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

    @property
    def actions(self) -> int:
        """Number of actions: wait, one for each option, and give back."""
        return 2 + self.slots * self.plans

    def shape(self, field: Field) -> tuple[int, ...]:
        """Lengths of the axes of a field."""
        sizes = {"joint": JOINTS, "slot": self.slots, "option": self.slots * self.plans, "peer": self.peers}
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
        """First column of each field in the vector."""
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
        """An observation as vectors, float32 [..., size], clipped to `bounds`."""
        out = np.empty((*np.shape(observation.clock), self.size), np.float32)
        self.write(out, {field.name: np.asarray(getattr(observation, field.name)) for field in FIELDS})
        return out

    def write(self, vectors: Array, fields: Mapping[str, Array]) -> None:
        """Write fields, [..., *shape], into vectors [..., size], clipped to `bounds`."""
        for name, values in fields.items():
            (span, shape), field = self._spans[name], _BY_NAME[name]
            lead = values.shape[: values.ndim - len(shape)]
            flat, out = np.reshape(values, (*lead, -1)), vectors[..., span]
            if values.dtype == bool:
                out[...] = flat
            else:
                np.clip(flat, field.low, field.high, out=out, casting="same_kind")

    def read(self, vector: Array, action_mask: Array) -> Observation:
        """The observation of vectors [..., size]; its arrays are views of them."""
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

    def read_each(self, arms: Sequence[str], vectors: Array, action_masks: Array) -> dict[str, Observation]:
        """The observation of each arm by name, from vectors [arm, size] and masks [arm, option + 2], for policies.

        Its arrays are views; values without an axis are NumPy scalars. Cheaper than `read` for one arm after another.
        """
        fields = vars(self.read(vectors, action_masks)).values()
        return {arm: Observation(*each) for arm, *each in zip(arms, *fields, strict=True)}


@cache
def all_peers(arms: int) -> Array:
    """Indices of the peers of each arm, int [arm, peer]."""
    return np.array([[s for s in range(arms) if s != r] for r in range(arms)], dtype=int).reshape(arms, arms - 1)
