"""Network inputs from observation vectors: scaled, and arranged as sets of options and peers."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from fleet.observation import Layout

OWN, OPTION, PEER, PAIR = 28, 15, 6, 4
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
    own = [
        o.clock,
        _minutes(o.left_s),
        o.idle,
        o.working,
        o.faulted,
        _minutes(o.busy_s),
        o.last_award,
        o.headroom_k / 20.0,
        o.error_headroom_k / 20.0,
        o.job_value / 4.0,
        torch.log1p(o.job_cycles),
        _degrees(o.job_peak_c),
        o.job_p,
        (o.ambient_c - 25.0) / 10.0,
    ]
    offered, age_s, payload_kg, value, returns, expires, station_free, peer_known, peer_difficulty, peer_blocks = (
        each.repeat_interleave(layout.plans, dim=-1)
        for each in (
            o.offered, o.age_s, o.payload_kg, o.value, o.returns, o.expires, o.station_free,
            o.peer_known, o.peer_difficulty, o.peer_blocks,
        )
    )  # fmt: skip
    option = [
        offered,
        o.feasible,
        o.known,
        o.difficulty,
        _degrees(o.peak_c),
        o.p_saturation,
        _minutes(o.duration_s),
        _minutes(o.slack_s),
        _minutes(age_s),
        payload_kg / 4.0,
        value / 4.0,
        returns,
        expires,
        value / (o.duration_s / 60.0).clamp(min=0.5),
        station_free * o.space_free,
    ]
    fresh = torch.exp(-o.peer_age_s / 60.0)
    peer = [o.peer_heard, fresh, o.peer_working, o.peer_faulted, o.peer_headroom_k / 20.0, _minutes(o.peer_busy_s)]
    harder = peer_known * o.known[..., None, :] * (peer_difficulty - o.difficulty[..., None, :])
    pair = [peer_known, peer_difficulty, harder, peer_blocks]
    own, option, peer, pair = (torch.stack(features, dim=-1) for features in (own, option, peer, pair))
    return Sets(torch.cat([own, _degrees(o.temp_c), _degrees(o.housing_c)], dim=-1), option, peer, pair)


def has_choice(mask: Any, headroom_k: Any) -> Any:
    """Whether arms choose, bool [...], by masks [..., action] and headroom [...]; arrays or tensors alike.

    An arm may claim a job, or it may give its job back and is above its warning limit. So most arms at work have no
    choice, and whether one has does not depend on how long a step is. All legal actions of an arm that chooses are
    choices.
    """
    return mask[..., 1:-1].any(-1) | ((mask[..., -1] > 0) & (headroom_k <= 0.0))


def _degrees(temp_c: Tensor) -> Tensor:
    return (temp_c - 50.0) / 20.0


def _minutes(seconds: Tensor) -> Tensor:
    """Signed times in minutes, logarithmic beyond one."""
    return torch.sign(seconds) * torch.log1p(seconds.abs() / 60.0)
