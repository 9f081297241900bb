"""The shared network: one actor for every arm of every fleet, and the critics that train it.

Deep sets (Zaheer et al., NeurIPS 2017): small shared networks encode options and peers, and their outputs are pooled.
So the logits are equivariant in the options, and invariant to the order and number of peers.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from agents.learned.config import NetworkSize
from agents.learned.features import OPTION, OWN, PAIR, PEER, sets_of
from fleet.observation import Layout

BIASES = (-3.0, -6.0)
"""Initial biases of the logits of waiting and giving back, so that an untrained actor claims jobs and ends them."""


class Actor(nn.Module):
    """Logits over waiting, the options, and giving the job back."""

    def __init__(self, size: NetworkSize | None = None) -> None:
        super().__init__()
        size = size or NetworkSize()
        self.own = _mlp([OWN, size.arm, size.arm])
        self.pair = _mlp([PAIR + PEER + OPTION, size.pair, size.pair])
        self.option = _mlp([OPTION + 2 * size.pair + size.arm, size.option, size.option])
        self.claim = _mlp([2 * size.option + size.arm, size.option, 1], last=False)
        self.other = _mlp([size.option + size.arm, size.option, len(BIASES)], last=False)
        self._pair = size.pair
        with torch.no_grad():
            _last_linear(self.other).bias.copy_(torch.tensor(BIASES))

    def forward(self, layout: Layout, vectors: Tensor) -> Tensor:
        """Logits before the mask, [row, action], of vectors [row, size]."""
        own_in, option_in, peer_in, pair_in = sets_of(layout, vectors)
        options, peers = option_in.shape[-2], peer_in.shape[-2]
        own = self.own(own_in)
        if peers:
            of_peer = peer_in[..., :, None, :].expand(*pair_in.shape[:-1], PEER)
            of_option = option_in[..., None, :, :].expand(*pair_in.shape[:-1], OPTION)
            pairs = self.pair(torch.cat([pair_in, of_peer, of_option], dim=-1))
            pooled = torch.cat([pairs.mean(dim=-3), pairs.amax(dim=-3)], dim=-1)
        else:
            pooled = option_in.new_zeros(*option_in.shape[:-1], 2 * self._pair)
        mine = own[..., None, :].expand(*option_in.shape[:-1], own.shape[-1])
        option = self.option(torch.cat([option_in, pooled, mine], dim=-1))
        offered = option_in[..., :1]
        queue = (offered * option).sum(dim=-2) / offered.sum(dim=-2).clamp(min=1.0)
        waiting = queue[..., None, :].expand(*queue.shape[:-1], options, queue.shape[-1])
        claim = self.claim(torch.cat([option, waiting, mine], dim=-1))[..., 0]
        other = self.other(torch.cat([queue, own], dim=-1))
        return torch.cat([other[..., :1], claim, other[..., 1:]], dim=-1)


class Critic(nn.Module):
    """Value of the state from the observations of all arms (MAPPO), or of each arm alone (IPPO)."""

    def __init__(self, size: NetworkSize | None = None, *, central: bool = True) -> None:
        super().__init__()
        size = size or NetworkSize()
        self.central = central
        self.own = _mlp([OWN, size.arm, size.arm])
        self.option = _mlp([OPTION, size.pair, size.pair])
        self.worth = _mlp([2 * size.arm + 2 * size.pair, size.arm, 1], last=False)

    def forward(self, layout: Layout, vectors: Tensor) -> Tensor:
        """Values [..., arm] of vectors [..., arm, size]; a central critic gives all arms the same."""
        sets = sets_of(layout, vectors)
        own = self.own(sets.own)
        offered = sets.option[..., :1]
        option = offered * self.option(sets.option)
        queue = torch.cat([option.sum(dim=-2) / 8.0, option.amax(dim=-2)], dim=-1)
        if not self.central:
            return self.worth(torch.cat([own, torch.zeros_like(own), queue], dim=-1))[..., 0]
        state = torch.cat([own.mean(dim=-2), own.amax(dim=-2), queue.mean(dim=-2)], dim=-1)
        return self.worth(state).expand(*vectors.shape[:-1])


def masked(logits: Tensor, mask: Tensor) -> Tensor:
    """Logits with the lowest finite value for illegal actions, so that their probability is zero."""
    return logits.masked_fill(~mask.bool(), torch.finfo(logits.dtype).min)


def _last_linear(layers: nn.Sequential) -> nn.Linear:
    return [layer for layer in layers if isinstance(layer, nn.Linear)][-1]


def _mlp(widths: Sequence[int], *, last: bool = True) -> nn.Sequential:
    """Linear layers with SiLU between them, and after the last one if `last`."""
    layers: list[nn.Module] = []
    for i, (before, after) in enumerate(pairwise(widths)):
        layers.append(nn.Linear(before, after))
        if last or i < len(widths) - 2:
            layers.append(nn.SiLU())
    return nn.Sequential(*layers)
