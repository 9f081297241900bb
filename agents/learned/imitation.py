"""A warm start: an actor learns what a rule does before it learns what is better."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import nn

from agents.learned.network import Actor, masked
from fleet.observation import Layout

Array = np.ndarray


def imitate(
    actor: Actor,
    layout: Layout,
    shown: Iterable[tuple[Array, Array, Array]],
    rng: np.random.Generator,
    *,
    epochs: int = 4,
    minibatch: int = 512,
    learning_rate: float = 2e-3,
) -> list[float]:
    """Learn from what a rule chose, by cross-entropy.

    Args:
        shown: Batches of vectors float32 [row, size], masks [row, slot + 1] and actions int [row]; rows in which there
            was no choice are left out.

    Returns:
        Mean cross-entropy of each batch in its last epoch, nat.
    """
    optimizer = torch.optim.Adam(actor.parameters(), lr=learning_rate)
    told: list[float] = []
    for vectors, masks, actions in shown:
        choice = masks.sum(axis=-1) > 1
        if not choice.any():
            continue
        seen, legal, done = (torch.from_numpy(np.ascontiguousarray(part[choice])) for part in (vectors, masks, actions))
        losses: list[float] = []
        for _ in range(epochs):
            order = rng.permutation(len(seen))
            losses = []
            for rows in np.array_split(order, -(-len(order) // minibatch)):
                at = torch.from_numpy(rows)
                loss = nn.functional.cross_entropy(masked(actor(layout, seen[at]), legal[at]), done[at].long())
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(float(loss.detach()))
        told.append(float(np.mean(losses)))
    return told
