"""The observation of an arm, version 2: named fields, and their layout in vectors.

An arm observes its own sensors, its own predictions for the open jobs, and what the arms of its fleet share, with its
age. The observation contains no true state of the simulation.

The vector of an arm has two parts: what all arms of a fleet know alike (the jobs in the slots, and what the arms share)
comes once for each env, and what one arm knows of itself once for each arm. Where messages take time, or each arm has
peers of its own, what the arms share belongs to the second part; the order of the vector is the same.
"""

from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Annotated, Literal, get_type_hints

import numpy as np

from fleet.robot import JOINTS

Array = np.ndarray
Axis = Literal["joint", "slot", "option", "member"]
Part = Literal["jobs", "fleet", "own"]

VERSION = 2
LONG_S = 1e5
"""Times are clipped to this, s: a little over a day."""
MOST_SLOTS = 256


@dataclass(frozen=True)
class Field:
    """One named part of the observation vector."""

    part: Part
    axes: tuple[Axis, ...]
    unit: str
    low: float
    high: float
    scale: float
    """The scaled vector holds values divided by this: a power of two, so that nothing is rounded."""
    text: str
    name: str = ""
    """Set from the attribute of `Observation`."""


_JOINT: tuple[Axis, ...] = ("joint",)
_SLOT: tuple[Axis, ...] = ("slot",)
_OPTION: tuple[Axis, ...] = ("option",)
_MEMBER: tuple[Axis, ...] = ("member",)
_MEMBER_SLOT: tuple[Axis, ...] = ("member", "slot")
_BID: tuple[Axis, ...] = ("member", "option")


@dataclass(frozen=True, eq=False)
class Observation:
    """Observations of arms, with any leading axes [...]. Each `Field` gives axes, unit, lowest and highest value.

    An option is one plan for the job of one slot: option = slot · plans + plan. Action 0 waits or continues the current
    job, action option + 1 claims the option, and the last action gives the current job back after the present cycle.
    The first plan of a job is the fastest. Fields of empty slots and of options without a plan are 0.

    A member is an arm of the fleet, this one included, or only the peers that the layout gives this arm. The bids of
    members, [member, option], are part of layouts with `bids`; in others they have no member.
    """

    left_s: Annotated[
        Array, Field("jobs", (), "s", 0, LONG_S, 4096, "time until the end of the episode; 100000 without end")
    ]
    group: Annotated[
        Array,
        Field(
            "jobs",
            _SLOT,
            "1",
            0,
            MOST_SLOTS,
            16,
            "0 if empty; jobs with one number share a station with the first of it",
        ),
    ]
    station_free: Annotated[Array, Field("jobs", _SLOT, "1", 0, 1, 1, "1 when no arm occupies its stations")]
    age_s: Annotated[Array, Field("jobs", _SLOT, "s", 0, LONG_S, 1024, "time since its release or return to the queue")]
    due_in_s: Annotated[Array, Field("jobs", _SLOT, "s", -LONG_S, LONG_S, 1024, "due date minus now")]
    payload_kg: Annotated[Array, Field("jobs", _SLOT, "kg", 0, 100, 4, "carried mass")]
    value: Annotated[Array, Field("jobs", _SLOT, "1", 0, 1e6, 4, "value of finishing it")]
    returns: Annotated[Array, Field("jobs", _SLOT, "1", 0, 1e3, 1, "number of faults that returned it")]
    expires: Annotated[Array, Field("jobs", _SLOT, "1", 0, 1, 1, "1 when it expires if it still waits at its due date")]
    fleet_age_s: Annotated[
        Array, Field("fleet", _MEMBER, "s", 0, LONG_S, 64, "age of the member's last message; 100000 without any")
    ]
    fleet_working: Annotated[Array, Field("fleet", _MEMBER, "1", 0, 1, 1, "1 when the member was working then")]
    fleet_faulted: Annotated[
        Array, Field("fleet", _MEMBER, "1", 0, 1, 1, "1 when the member was faulted or had a break then")
    ]
    fleet_busy_s: Annotated[
        Array, Field("fleet", _MEMBER, "s", 0, LONG_S, 1024, "time until the member is home, as it shared; 0 if free")
    ]
    fleet_headroom_k: Annotated[
        Array, Field("fleet", _MEMBER, "K", -150, 150, 32, "warning limit minus its hottest motor, 0 if not shared")
    ]
    fleet_difficulty: Annotated[
        Array, Field("fleet", _MEMBER_SLOT, "1", -1, JOINTS, 1, "least d of its plans for the job, -1 if not shared")
    ]
    fleet_duration_s: Annotated[
        Array, Field("fleet", _BID, "s", 0, LONG_S, 1024, "time the member needs, 0: no plan, or not shared")
    ]
    fleet_peak_c: Annotated[
        Array, Field("fleet", _BID, "°C", -60, 300, 64, "predicted peak of the member's plan, 0 if unknown")
    ]
    fleet_p_saturation: Annotated[
        Array, Field("fleet", _BID, "1", 0, 1, 1, "P(saturation) of the member's plan, 0.5 if unknown")
    ]
    working: Annotated[Array, Field("own", (), "1", 0, 1, 1, "1 when this arm works or goes home")]
    faulted: Annotated[Array, Field("own", (), "1", 0, 1, 1, "1 from a fault until it recovers")]
    busy_s: Annotated[Array, Field("own", (), "s", 0, LONG_S, 1024, "time until it is home, with the current job done")]
    last_award: Annotated[Array, Field("own", (), "1", -1, 1, 1, "last claim: 1 won, -1 lost, 0 none made")]
    break_in_s: Annotated[
        Array, Field("own", (), "s", 0, LONG_S, 16384, "time until its next break, 0 during one; 100000 without any")
    ]
    temp_c: Annotated[Array, Field("own", _JOINT, "°C", -60, 200, 64, "own motor temperatures as measured")]
    housing_c: Annotated[Array, Field("own", _JOINT, "°C", -60, 200, 64, "own estimate of the housing temperatures")]
    ambient_c: Annotated[Array, Field("own", (), "°C", -60, 200, 64, "ambient temperature at this arm")]
    headroom_k: Annotated[Array, Field("own", (), "K", -150, 150, 32, "warning limit minus hottest motor")]
    error_headroom_k: Annotated[Array, Field("own", (), "K", -150, 150, 32, "error limit minus hottest motor")]
    job_value: Annotated[Array, Field("own", (), "1", 0, 1e6, 4, "value of the current job, 0 without one")]
    job_cycles: Annotated[Array, Field("own", (), "1", 0, 1e5, 16, "unfinished cycles of the current job")]
    job_peak_c: Annotated[
        Array, Field("own", (), "°C", -60, 300, 64, "predicted peak in the rest of that job, 0 if unknown")
    ]
    job_p: Annotated[Array, Field("own", (), "1", 0, 1, 1, "P(saturation) in the rest of that job, 0 without one")]
    duration_s: Annotated[
        Array, Field("own", _OPTION, "s", 0, LONG_S, 1024, "time this arm needs for the rest of the job, 0: no plan")
    ]
    difficulty: Annotated[
        Array, Field("own", _OPTION, "1", -1, JOINTS, 1, "own difficulty d of the plan, -1 if unknown")
    ]
    peak_c: Annotated[
        Array, Field("own", _OPTION, "°C", -60, 300, 64, "predicted peak: hottest motor in the plan, 0 if unknown")
    ]
    p_saturation: Annotated[Array, Field("own", _OPTION, "1", 0, 1, 1, "P(saturation) of the plan, 0.5 if unknown")]
    blocked: Annotated[
        Array, Field("own", _SLOT, "1", 0, 1, 1, "1 when another arm takes space that this arm's fastest plan needs")
    ]
    peers: Array
    """Members that are not this arm, int [..., peer]."""
    action_mask: Array
    """Legal actions, int8 [..., option + 2]."""

    @property
    def idle(self) -> Array:
        """1 when this arm is free, [...]."""
        return 1 - self.working - self.faulted

    @property
    def offered(self) -> Array:
        """Whether a slot holds a job, bool [..., slot]."""
        return self.group > 0

    @property
    def feasible(self) -> Array:
        """Whether this arm has such a plan, bool [..., option]."""
        return self.duration_s > 0

    @property
    def known(self) -> Array:
        """Whether this arm has a difficulty for the plan, bool [..., option]."""
        return (self.duration_s > 0) & (self.difficulty >= 0)

    @property
    def slack_s(self) -> Array:
        """Due date minus now minus duration, [..., option]; 0 without a plan."""
        plans = self.duration_s.shape[-1] // self.due_in_s.shape[-1]
        return np.where(self.feasible, np.repeat(self.due_in_s, plans, axis=-1) - self.duration_s, np.float32(0.0))

    @property
    def peer_age_s(self) -> Array:
        """Age of each peer's last message, [..., peer]; 100000 without any."""
        return self._of_peers(self.fleet_age_s)

    @property
    def peer_heard(self) -> Array:
        """Whether a message of the peer has arrived, bool [..., peer]."""
        return self.peer_age_s < LONG_S

    @property
    def peer_working(self) -> Array:
        """1 when the peer was working then, [..., peer]."""
        return self._of_peers(self.fleet_working)

    @property
    def peer_faulted(self) -> Array:
        """1 when the peer was faulted or had a break then, [..., peer]."""
        return self._of_peers(self.fleet_faulted)

    @property
    def peer_busy_s(self) -> Array:
        """Time until the peer is home as it shared, 0 if free, [..., peer]."""
        return self._of_peers(self.fleet_busy_s)

    @property
    def peer_headroom_k(self) -> Array:
        """Headroom that the peer shared, 0 if none, [..., peer]."""
        return self._of_peers(self.fleet_headroom_k)

    @property
    def peer_difficulty(self) -> Array:
        """Least d of its plans for a slot's job that the peer shared, −1 if none, [..., peer, slot]."""
        return self._rows_of_peers(self.fleet_difficulty)

    @property
    def peer_duration_s(self) -> Array:
        """Time the peer needs by each plan, 0 without one, or if not shared, [..., peer, option]."""
        return self._bids_of_peers(self.fleet_duration_s)

    @property
    def peer_peak_c(self) -> Array:
        """Predicted peak of each plan of the peer, 0 if unknown, [..., peer, option]."""
        return self._bids_of_peers(self.fleet_peak_c)

    @property
    def peer_p_saturation(self) -> Array:
        """P(saturation) of each plan of the peer, 0.5 if unknown, [..., peer, option]."""
        return self._bids_of_peers(self.fleet_p_saturation)

    @property
    def peer_known(self) -> Array:
        """Whether the peer shared a difficulty for the slot's job, bool [..., peer, slot]."""
        return self.offered[..., None, :] & (self.peer_difficulty >= 0)

    def _of_peers(self, values: Array) -> Array:
        return np.take_along_axis(values, self.peers, axis=-1)

    def _rows_of_peers(self, values: Array) -> Array:
        return np.take_along_axis(values, self.peers[..., None], axis=-2)

    def _bids_of_peers(self, values: Array) -> Array:
        if self.peers.shape[-1] and not values.shape[-2]:
            raise ValueError("This observation has no bids of members: make the environment with bids=True.")
        return self._rows_of_peers(values)


class LazyObservation(Observation):
    """Observations whose fields are read when they are first used: few policies use more than ten.

    Args:
        read: Returns a field by its name; not needed if all of them are given.
        fields: Fields by name, instead of those of `read`.
    """

    def __init__(self, read: Callable[[str], Array] | None = None, **fields: Array) -> None:
        vars(self).update(fields, _read=read)

    def __getattr__(self, name: str) -> Array:
        """The field, kept for the next use."""
        if name.startswith("_"):
            raise AttributeError(name)
        read: Callable[[str], Array] = vars(self)["_read"]
        return vars(self).setdefault(name, read(name))


def _fields() -> Iterator[Field]:
    for name, kind in get_type_hints(Observation, include_extras=True).items():
        for field in getattr(kind, "__metadata__", ()):
            yield replace(field, name=name)


FIELDS: tuple[Field, ...] = tuple(_fields())
"""The layout: the order of this tuple is the order in the vector."""
_BY_NAME = {field.name: field for field in FIELDS}


Offsets = namedtuple("Offsets", [field.name for field in FIELDS])  # pyright: ignore[reportUntypedNamedTuple]
"""A number of each field, by name."""
BIDS = {"fleet_duration_s": "duration_s", "fleet_peak_c": "peak_c", "fleet_p_saturation": "p_saturation"}
"""Fields of the bids of members, each with the one that the member has itself, which has the same unit and scale."""
assert all(_BY_NAME[bid].scale == _BY_NAME[own].scale for bid, own in BIDS.items())


@dataclass(frozen=True)
class Layout:
    """Position of each field in the vector, for a number of arms, slots and plans."""

    arms: int
    slots: int
    near: tuple[tuple[int, ...], ...] | None = None
    """Indices of the members in each arm's vector, in order: its peers. None: all arms in the order of the fleet."""
    plans: int = 1
    """Plans for the job of a slot."""
    scaled: bool = False
    """Whether vectors hold values divided by the scales of the fields, of order 1, or in the units of the fields."""
    delivered: bool = False
    """Whether messages between arms take time or get lost, so that each arm knows its members otherwise."""
    ahead_s: float = np.inf
    """Options are given to arms that are home within this time; the options of others are 0."""
    bids: bool = False
    """Whether members share the predictions of their plans for the open jobs."""

    @cached_property
    def members(self) -> Array:
        """The members of each arm, int [arm, member]."""
        if self.near is None:
            return np.tile(np.arange(self.arms), (self.arms, 1))
        return np.array(self.near, dtype=int).reshape(self.arms, -1)

    @cached_property
    def peers(self) -> Array:
        """Members of each arm that are not the arm itself, as numbers of members, int [arm, peer]."""
        if self.near is None:
            return all_peers(self.arms)
        return np.tile(np.arange(len(self.near[0])), (self.arms, 1))

    @property
    def is_shared(self) -> bool:
        """Whether what the arms share is the same for all of them."""
        return self.near is None and not self.delivered

    @property
    def actions(self) -> int:
        """Number of actions: wait, one for each option, and give back."""
        return 2 + self.slots * self.plans

    def shape(self, field: Field) -> tuple[int, ...]:
        """Lengths of the axes of a field."""
        sizes = {
            "joint": JOINTS,
            "slot": self.slots,
            "option": self.slots * self.plans,
            "member": self.members.shape[1] if self.bids or field.axes != _BID else 0,
        }
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

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return max(span.stop for span, _ in self._spans.values())

    @cached_property
    def shared(self) -> int:
        """Length of the first part of the vector, which all arms of an env have alike."""
        return min(self._spans[f.name][0].start for f in FIELDS if not self._in_shared(f))

    def _in_shared(self, field: Field) -> bool:
        return field.part == "jobs" or (field.part == "fleet" and self.is_shared)

    @property
    def offsets(self) -> "Offsets":
        """First column of each field in its part of the vector."""
        starts = (self._spans[f.name][0].start - (0 if self._in_shared(f) else self.shared) for f in FIELDS)
        return Offsets(*starts)

    @cached_property
    def scales(self) -> Array:
        """What the vector's elements are multiplied with to have the units of the fields, float32 [size]."""
        scales = np.ones(self.size, np.float32)
        if self.scaled:
            for field in FIELDS:
                scales[self._spans[field.name][0]] = field.scale
        return scales

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest value of each element, float32 [size]."""
        low, high = np.empty(self.size, np.float32), np.empty(self.size, np.float32)
        for field in FIELDS:
            span, _ = self._spans[field.name]
            low[span], high[span] = field.low, field.high
        return low / self.scales, high / self.scales

    def pack(self, observation: Observation) -> Array:
        """An observation as vectors, float32 [..., size], clipped to `bounds`."""
        out = np.empty((*np.shape(observation.left_s), self.size), np.float32)
        names = (field.name for field in FIELDS if self.bids or field.name not in BIDS)
        self.write(out, {name: np.asarray(getattr(observation, name)) for name in names})
        return out

    def write(self, vectors: Array, fields: Mapping[str, Array]) -> None:
        """Write fields, [..., *shape], into vectors [..., size], or into their last columns, clipped to `bounds`."""
        skipped = self.size - vectors.shape[-1]
        for name, values in fields.items():
            (span, shape), field = self._spans[name], _BY_NAME[name]
            lead = values.shape[: values.ndim - len(shape)]
            out = vectors[..., span.start - skipped : span.stop - skipped]
            np.clip(np.reshape(values, (*lead, -1)), field.low, field.high, out=out, casting="unsafe")
            if self.scaled:
                out /= field.scale

    def join(self, shared: Array, own: Array) -> Array:
        """The vectors of all arms, float32 [..., arm, size], of both parts, [..., shared] and [..., arm, own]."""
        out = np.empty((*own.shape[:-1], self.size), np.float32)
        out[..., : self.shared], out[..., self.shared :] = shared[..., None, :], own
        return out

    def read(self, vector: Array, action_mask: Array) -> Observation:
        """The observation of vectors [..., arm, size] of all arms, or of some, [..., size] without any peer.

        Its arrays are views, unless the vectors are scaled; of one vector, values without an axis are NumPy scalars.
        """
        if vector.shape[-1] != self.size:
            raise ValueError(
                f"An observation of {self.slots} slots and {self.members.shape[1]} member(s) has {self.size} elements, "
                f"got {vector.shape[-1]}."
            )
        return self._lazy(vector[..., : self.shared], vector[..., self.shared :], action_mask)

    def read_parts(self, shared: Array, own: Array, action_mask: Array) -> Observation:
        """The observation of both parts of vectors, [..., shared] and [..., arm, own]; see `read`."""
        one_each = np.broadcast_to(shared[..., None, :], (*own.shape[:-1], self.shared))
        return self._lazy(one_each, own, action_mask)

    def read_each(self, arms: Sequence[str], shared: Array, own: Array, action_masks: Array) -> dict[str, Observation]:
        """The observation of each arm by name, from [shared], [arm, own] and masks [arm, option + 2]; see `read`.

        Each has arrays of its own: an arm that writes into them changes nothing that another one observes.
        """
        each = zip(arms, own, action_masks, self.peers, strict=True)
        return {
            arm: self._lazy(shared.copy(), mine.copy(), mask.copy(), peers.copy()) for arm, mine, mask, peers in each
        }

    def _lazy(self, shared: Array, own: Array, action_mask: Array, peers: Array | None = None) -> Observation:
        """The observation of both parts, which have the same leading axes."""
        lead = own.shape[:-1]
        if peers is None:
            all_arms = len(lead) > 0 and lead[-1] == self.arms
            peers = (
                np.broadcast_to(self.peers, (*lead[:-1], *self.peers.shape)) if all_arms else np.zeros((*lead, 0), int)
            )
        return LazyObservation(partial(self._field, shared, own), peers=peers, action_mask=action_mask)

    def _field(self, shared: Array, own: Array, name: str) -> Array:
        if name not in self._spans:
            raise AttributeError(f"An observation has no field '{name}'.")
        (span, shape), cut = self._spans[name], self.shared
        part, first = (shared, span.start) if span.stop <= cut else (own, span.start - cut)
        if not shape:
            values = part[first] if part.ndim == 1 else part[..., first]
        else:
            values = part[..., first : first + span.stop - span.start].reshape((*part.shape[:-1], *shape))
        return values * _BY_NAME[name].scale if self.scaled else values


@cache
def all_peers(arms: int) -> Array:
    """Indices of the peers of each arm, int [arm, peer]."""
    return np.array([[s for s in range(arms) if s != r] for r in range(arms)], dtype=int).reshape(arms, arms - 1)
