"""A trained policy: the shared actor as a `Policy`, saved as safetensors and JSON."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from agents.learned.config import NetworkSize
from agents.learned.features import has_choice
from agents.learned.network import Actor, masked
from agents.policy import WAIT, plans_of
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.observation import Layout, Observation

FORMAT = 5
"""Increase it when the network or its inputs change."""
WEIGHTS, CARD = "policy.safetensors", "policy.json"


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

    def choose(self, observation: Observation, place: int) -> int:
        """An action of one arm; WAIT where there is no choice."""
        return self.act({"": observation})[""]

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The actions of all arms, from one call of the network."""
        actions = dict.fromkeys(observations, WAIT)
        choosing = [arm for arm, seen in observations.items() if has_choice(seen.action_mask, seen.headroom_k)]
        if not choosing:
            return actions
        first = observations[choosing[0]]
        layout = Layout(len(first.peer_heard) + 1, len(first.offered), plans=plans_of(first))
        vectors = torch.from_numpy(np.stack([layout.pack(observations[arm]) for arm in choosing]))
        mask = torch.from_numpy(np.stack([observations[arm].action_mask for arm in choosing]))
        with torch.inference_mode():
            logits = masked(self._actor(layout, vectors), mask).numpy()
        return actions | dict(zip(choosing, draw(logits, self._rng).tolist(), strict=True))


def draw(logits: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A sample from softmax(logits) by Gumbel's trick, logits [..., action] to int [...]."""
    return (logits + rng.gumbel(size=logits.shape)).argmax(axis=-1)


def save_policy(actor: Actor, size: NetworkSize, folder: Path, **details: object) -> None:
    """Write an actor into a folder, made if need be; each file is written atomically.

    Args:
        details: Additional JSON values of the card: scenario, algorithm, steps.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / WEIGHTS) as draft:
        # save_file would make the file unreadable for group and others.
        draft.write_bytes(save({name: value.contiguous() for name, value in actor.state_dict().items()}))
    card = {"format": FORMAT, "size": asdict(size), **details}
    with atomic_path(folder / CARD) as draft:
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def load_policy(folder: Path) -> LearnedPolicy:
    """The policy that `save_policy` wrote.

    Raises:
        CheckpointError: a file is missing, damaged or of another format.
    """
    try:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
        if card["format"] != FORMAT:
            raise CheckpointError(
                f"{folder / CARD}: format {card['format']} is not {FORMAT}: its network takes other observations. "
                "Train the policy again."
            )
        size = NetworkSize(**card["size"])
    except FileNotFoundError as error:
        raise CheckpointError(f"There is no trained policy in '{folder}': no {CARD}.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / CARD}: not the card of a policy ({error}).") from error
    actor = Actor(size)
    try:
        actor.load_state_dict(load_file(folder / WEIGHTS))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise CheckpointError(f"{folder / WEIGHTS}: {error}") from error
    return LearnedPolicy(actor)
