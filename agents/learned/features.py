"""Network inputs from observation vectors: scaled, and arranged as sets of slots and peers."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from fleet.observation import Layout

OWN, SLOT, PEER, PAIR = 14, 12, 5, 3
"""Number of features of the arm itself, of a slot, of a peer, and of a peer's score of a slot."""


class Sets(NamedTuple):
    """Inputs of the network; leading axes [...] are free."""

    own: Tensor
    """[..., OWN]."""
    slot: Tensor
    """[..., slot, SLOT]; the first feature is 1 where the slot holds a job."""
    peer: Tensor
    """[..., peer, PEER]."""
    pair: Tensor
    """[..., peer, slot, PAIR]."""


def sets_of(layout: Layout, vectors: Tensor) -> Sets:
    """Features of vectors float32 [..., size]; the same for any number and order of arms and slots."""
    as_array: Any = vectors  # tensors are sliced and reshaped like arrays
    o: Any = layout.read(as_array, as_array[..., :0])  # an Observation of tensors
    own = [o.clock, o.idle, o.working, o.faulted, _minutes(o.busy_s), o.last_award, o.headroom_k / 20.0]
    slot = [
        o.offered,
        o.feasible,
        o.known,
        o.difficulty,
        o.p_saturation,
        _minutes(o.duration_s),
        _minutes(o.slack_s),
        _minutes(o.age_s),
        o.payload_kg / 4.0,
        o.value / 4.0,
        o.returns,
        o.value / (o.duration_s / 60.0).clamp(min=0.5),
    ]
    fresh = torch.exp(-o.peer_age_s / 60.0)
    peer = [o.peer_heard, fresh, o.peer_working, o.peer_faulted, o.peer_headroom_k / 20.0]
    harder = o.peer_known * o.known[..., None, :] * (o.peer_difficulty - o.difficulty[..., None, :])
    pair = [o.peer_known, o.peer_difficulty, harder]
    own, slot, peer, pair = (torch.stack(features, dim=-1) for features in (own, slot, peer, pair))
    return Sets(torch.cat([own, (o.temp_c - 50.0) / 20.0], dim=-1), slot, peer, pair)


def _minutes(seconds: Tensor) -> Tensor:
    """Signed times in minutes, logarithmic beyond one."""
    return torch.sign(seconds) * torch.log1p(seconds.abs() / 60.0)
