"""From observation vectors to the inputs of a network: scaled, and laid out as sets of slots and peers."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from fleet.observation import Layout

OWN, SLOT, PEER, PAIR = 14, 12, 5, 3
"""Features of an arm itself, of a slot, of a peer, and of a peer's word on a slot."""


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
    """Read vectors float32 [..., size].

    Nothing depends on the number of arms or slots, nor on their order.
    """
    alike: Any = vectors  # a tensor is cut and shaped as an array is
    o: Any = layout.read(alike, alike[..., :0])  # an Observation of tensors
    own = torch.stack(
        [o.clock, o.idle, o.working, o.faulted, _minutes(o.busy_s), o.last_award, o.headroom_k / 20.0], dim=-1
    )
    own = torch.cat([own, (o.temp_c - 50.0) / 20.0], dim=-1)
    slot = torch.stack(
        [
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
        ],
        dim=-1,
    )
    peer = torch.stack(
        [
            o.peer_heard,
            torch.exp(-o.peer_age_s / 60.0),
            o.peer_working,
            o.peer_faulted,
            o.peer_headroom_k / 20.0,
        ],
        dim=-1,
    )
    harder = o.peer_known * o.known[..., None, :] * (o.peer_difficulty - o.difficulty[..., None, :])
    pair = torch.stack([o.peer_known, o.peer_difficulty, harder], dim=-1)
    return Sets(own, slot, peer, pair)


def _minutes(seconds: Tensor) -> Tensor:
    """Times of any length on one scale: logarithmic beyond a minute."""
    return torch.sign(seconds) * torch.log1p(seconds.abs() / 60.0)
