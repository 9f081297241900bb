"""Network inputs from observation vectors: scaled, and arranged as sets of options and peers."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from fleet.observation import Layout

OWN, OPTION, PEER, PAIR = 14, 13, 5, 3
"""Number of features of the arm itself, of an option, of a peer, and of a peer's score of an option."""


class Sets(NamedTuple):
    """Inputs of the network; leading axes [...] are free."""

    own: Tensor
    """[..., OWN]."""
    option: Tensor
    """[..., option, OPTION]; the first feature is 1 where the slot holds a job."""
    peer: Tensor
    """[..., peer, PEER]."""
    pair: Tensor
    """[..., peer, option, PAIR]."""


def sets_of(layout: Layout, vectors: Tensor) -> Sets:
    """Features of vectors float32 [..., size]; the same for any number and order of arms and slots."""
    as_array: Any = vectors  # tensors are sliced and reshaped like arrays
    o: Any = layout.read(as_array, as_array[..., :0])  # an Observation of tensors
    own = [o.clock, o.idle, o.working, o.faulted, _minutes(o.busy_s), o.last_award, o.headroom_k / 20.0]
    offered, age_s, payload_kg, value, returns, station_free, peer_known, peer_difficulty = (
        each.repeat_interleave(layout.plans, dim=-1)
        for each in (
            o.offered, o.age_s, o.payload_kg, o.value, o.returns, o.station_free, o.peer_known, o.peer_difficulty
        )
    )  # fmt: skip
    option = [
        offered,
        o.feasible,
        o.known,
        o.difficulty,
        o.p_saturation,
        _minutes(o.duration_s),
        _minutes(o.slack_s),
        _minutes(age_s),
        payload_kg / 4.0,
        value / 4.0,
        returns,
        value / (o.duration_s / 60.0).clamp(min=0.5),
        station_free * o.space_free,
    ]
    fresh = torch.exp(-o.peer_age_s / 60.0)
    peer = [o.peer_heard, fresh, o.peer_working, o.peer_faulted, o.peer_headroom_k / 20.0]
    harder = peer_known * o.known[..., None, :] * (peer_difficulty - o.difficulty[..., None, :])
    pair = [peer_known, peer_difficulty, harder]
    own, option, peer, pair = (torch.stack(features, dim=-1) for features in (own, option, peer, pair))
    return Sets(torch.cat([own, (o.temp_c - 50.0) / 20.0], dim=-1), option, peer, pair)


def _minutes(seconds: Tensor) -> Tensor:
    """Signed times in minutes, logarithmic beyond one."""
    return torch.sign(seconds) * torch.log1p(seconds.abs() / 60.0)
