"""A trained policy of all arms and fleets: its inputs, its network with the critics that train it, and its files.

Deep sets (Zaheer et al., NeurIPS 2017): small shared networks encode options and peers, and their outputs are pooled.
So the logits are equivariant in the options, and invariant to the order and number of peers.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from agents.learned.config import NetworkSize
from agents.policy import WAIT, plans_of
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.json_file import read_card, write_card
from fleet.observation import Layout, Observation

OWN, OPTION, PEER, PAIR = 27, 15, 5, 3
"""Number of features of the arm itself, of an option, of an arm of the fleet, and of its score of an option."""


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
    feasible, offered = o.duration_s > 0, o.group > 0
    known = feasible & (o.difficulty >= 0)
    own = [
        _minutes(o.left_s),
        1 - o.working - o.faulted,
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
    offered, age_s, due_in_s, payload_kg, value, returns, expires, station_free, blocked, shared_d = (
        each.repeat_interleave(layout.plans, dim=-1)
        for each in (
            offered.float(), o.age_s, o.due_in_s, o.payload_kg, o.value, o.returns, o.expires, o.station_free,
            o.blocked, o.fleet_difficulty,
        )
    )  # fmt: skip
    difficulty, shared = o.difficulty.clamp(min=0.0), (shared_d >= 0).float() * offered[..., None, :]
    option = [
        offered,
        feasible.float(),
        known.float(),
        difficulty,
        _degrees(o.peak_c),
        o.p_saturation,
        _minutes(o.duration_s),
        _minutes(torch.where(feasible, due_in_s - o.duration_s, 0.0)),
        _minutes(age_s),
        payload_kg / 4.0,
        value / 4.0,
        returns,
        expires,
        value / (o.duration_s / 60.0).clamp(min=0.5),
        station_free * (1 - blocked),
    ]
    fresh = torch.exp(-o.fleet_age_s / 60.0)
    peer = [fresh, o.fleet_working, o.fleet_faulted, o.fleet_headroom_k / 20.0, _minutes(o.fleet_busy_s)]
    harder = shared * known.float()[..., None, :] * (shared_d - difficulty[..., None, :])
    pair = [shared, shared_d.clamp(min=0.0), harder]
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


FORMAT = 6
"""Increase it when the network or its inputs change."""
WEIGHTS, CARD = "policy.safetensors", "policy.json"
LARGEST_WEIGHT = 1e6
"""Magnitude; those of a trained network are below 10."""


class LearnedPolicy:
    """Every arm samples its action from the actor's probabilities, as in training. Scope arm: it reads one observation.

    The most probable action would be worse: arms with equal observations would all claim the same job, and an arm that
    waits with a high probability would wait forever.

    Args:
        actor: A trained actor; it serves fleets of any size.
    """

    scope: ClassVar = "arm"

    def __init__(self, actor: Actor) -> None:
        self._actor = actor.eval()
        self._rng = np.random.default_rng(0)

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._rng = rng

    def choose(self, observation: Observation, arm_index: int) -> int:
        """An action of one arm; WAIT where there is no choice."""
        return self.act({"": observation})[""]

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The actions of all arms, from one call of the network."""
        actions = dict.fromkeys(observations, WAIT)
        choosing = [arm for arm, seen in observations.items() if has_choice(seen.action_mask, seen.headroom_k)]
        if not choosing:
            return actions
        first = observations[choosing[0]]
        layout = Layout(len(first.fleet_age_s), len(first.group), plans=plans_of(first))
        vectors = torch.from_numpy(np.stack([layout.pack(observations[arm]) for arm in choosing]))
        mask = torch.from_numpy(np.stack([observations[arm].action_mask for arm in choosing]))
        with torch.inference_mode():
            logits = masked(self._actor(layout, vectors), mask).numpy()
        return actions | dict(zip(choosing, draw(logits, self._rng).tolist(), strict=True))


def draw(logits: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A sample from softmax(logits) by Gumbel's trick, logits [..., action] to int [...]."""
    return (logits + rng.gumbel(size=logits.shape)).argmax(axis=-1)


class PolicyCard(msgspec.Struct):
    """What `load_policy` reads of the card."""

    format: int
    size: NetworkSize


def save_policy(actor: Actor, size: NetworkSize, folder: Path, **details: object) -> None:
    """Write an actor into a folder, made if need be; each file is written atomically.

    Args:
        details: Additional JSON values of the card: scenario, algorithm, steps.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / WEIGHTS) as draft:
        # save_file would make the file unreadable for group and others.
        draft.write_bytes(save({name: value.contiguous() for name, value in actor.state_dict().items()}))
    write_card({"format": FORMAT, "size": size, **details}, folder / CARD)


def load_policy(folder: Path) -> LearnedPolicy:
    """The policy that `save_policy` wrote.

    Raises:
        CheckpointError: a file is missing, damaged or of another format.
    """
    actor = Actor(read_card(folder / CARD, PolicyCard, format_=FORMAT, what="trained policy").size)
    try:
        weights = load_file(folder / WEIGHTS)
        actor.load_state_dict(weights)
    except (OSError, SafetensorError, RuntimeError) as error:
        reason = " ".join(str(error).split())  # torch's has a line for each tensor
        raise CheckpointError(f"{folder / WEIGHTS}: {reason}") from error
    if not all(bool((value.abs() <= LARGEST_WEIGHT).all()) for value in weights.values()):
        raise CheckpointError(
            f"{folder / WEIGHTS}: a weight is not finite, or beyond ±{LARGEST_WEIGHT:g}: the training diverged, or the "
            "file is damaged. Train again, perhaps with a lower --lr."
        )
    return LearnedPolicy(actor)
