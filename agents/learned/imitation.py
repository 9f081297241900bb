"""Warm start of a training: the actor imitates a rule before it learns by reinforcement."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import nn

from agents.learned.features import has_choice
from agents.learned.network import Actor, masked
from fleet.observation import Layout

Array = np.ndarray


def imitate(
    actor: Actor,
    layout: Layout,
    batches: Iterable[tuple[Array, Array, Array]],
    rng: np.random.Generator,
    *,
    epochs: int = 4,
    minibatch: int = 512,
    learning_rate: float = 2e-3,
) -> list[float]:
    """Learn the actions of a rule by cross-entropy.

    Args:
        batches: Vectors float32 [row, size], masks [row, action] and actions int [row]; rows without a choice are
            ignored.

    Returns:
        Mean cross-entropy of each batch in its last epoch, nat.
    """
    optimizer = torch.optim.Adam(actor.parameters(), lr=learning_rate)
    batch_means: list[float] = []
    for vectors, masks, actions in batches:
        choice = has_choice(masks, layout.read(vectors, masks).headroom_k)
        if not choice.any():
            continue
        seen, legal, chosen = (torch.from_numpy(np.ascontiguousarray(a[choice])) for a in (vectors, masks, actions))
        losses: list[float] = []
        for _ in range(epochs):
            losses = []
            for rows in np.array_split(rng.permutation(len(seen)), -(-len(seen) // minibatch)):
                at = torch.from_numpy(rows)
                loss = nn.functional.cross_entropy(masked(actor(layout, seen[at]), legal[at]), chosen[at].long())
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(float(loss.detach()))
        batch_means.append(float(np.mean(losses)))
    return batch_means
