"""MAPPO and IPPO through TorchRL: proximal policy optimisation of one actor that all arms share.

Clipped surrogate (Schulman et al., arXiv 1707.06347) with generalised advantages (arXiv 1506.02438); a critic of the
whole fleet (MAPPO, Yu et al., NeurIPS 2022) or of each arm by itself (IPPO, de Witt et al., arXiv 2011.09533). Only
moments at which an arm has a choice train the actor: an arm at work can only go on.
"""

import pickle
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from agents.learned.network import Actor, Critic, NetworkSize, masked
from agents.learned.policy import draw
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.observation import Layout

Algorithm = Literal["mappo", "ippo"]
SEEN, MASK, ACTION, LIKELIHOOD = ("arms", "observation"), ("arms", "action_mask"), ("arms", "action"), "log_prob"
EnvFactory = Callable[[int, int], EnvBase]
"""Makes a native batched environment of so many envs from a seed; keys as in `fleet.env.adapters.torchrl`."""


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """How it is trained."""

    algorithm: Algorithm = "mappo"
    size: NetworkSize = field(default_factory=NetworkSize)
    envs: int = 64
    steps: int = 128
    """Decision intervals of every env in an iteration."""
    epochs: int = 4
    """Over the choices; the critic sees every moment once."""
    minibatch: int = 512
    """Choices of arms in a step of the actor."""
    learning_rate: float = 3e-4
    gamma: float = 0.99
    lmbda: float = 0.98
    """Near 1: the value of the job in hand is not in the observation, so it is the reward itself that must arrive."""
    clip: float = 0.2
    entropy: float = 0.002
    """Weight of the entropy bonus."""
    max_gradient: float = 0.5
    reward_scale: float = 0.1
    warm_start: str = ""
    """Rule that the actor imitates first; empty for none."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.algorithm not in get_args(Algorithm):
            raise ValueError(f"algorithm must be one of {', '.join(get_args(Algorithm))} (got {self.algorithm!r}).")
        for name in ("envs", "steps", "epochs", "minibatch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1 (got {getattr(self, name)}).")
        for name in ("learning_rate", "clip", "max_gradient", "reward_scale"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be > 0 (got {getattr(self, name)}).")
        for name in ("gamma", "lmbda"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in (0, 1] (got {getattr(self, name)}).")


@dataclass(frozen=True)
class Iteration:
    """What one iteration saw and did."""

    number: int
    """From 1."""
    env_steps: int
    """So far."""
    reward: float
    """Mean reward per env step, not scaled."""
    choices: int
    """Moments at which an arm had a choice."""
    entropy: float
    """Of those choices, nat."""
    clipped: float
    """Share of choices whose likelihood ratio was clipped."""
    value_loss: float


def use_threads(count: int) -> None:
    """Threads of the networks' arithmetic, for the whole process."""
    torch.set_num_threads(count)


class Chooser(nn.Module):
    """Logits of every arm; the network is asked only where there is a choice."""

    def __init__(self, actor: Actor, layout: Layout) -> None:
        super().__init__()
        self.actor, self.layout = actor, layout

    def forward(self, vectors: Tensor, mask: Tensor) -> Tensor:
        """[..., slot + 1] of vectors [..., size] and masks."""
        choice = mask.sum(dim=-1) > 1
        logits = vectors.new_zeros(mask.shape)
        if bool(choice.any()):
            logits[choice] = self.actor(self.layout, vectors[choice])
        return logits


class Trainer:
    """Trains an actor; `iterate` goes on for ever, iteration by iteration."""

    def __init__(self, make_env: EnvFactory, layout: Layout, config: PpoConfig) -> None:
        self.config, self.layout = config, layout
        self.done = 0
        """Iterations."""
        torch.manual_seed(self._seed_of(0))
        self.actor, self.critic = Actor(config.size), Critic(config.size, central=config.algorithm == "mappo")
        chooser = TensorDictModule(Chooser(self.actor, layout), in_keys=[SEEN, MASK], out_keys=[("arms", "logits")])
        keys: Any = {"logits": ("arms", "logits"), "mask": MASK}  # a dict is taken, and not in the annotation
        self.policy = ProbabilisticActor(
            chooser,
            in_keys=keys,
            out_keys=[ACTION],
            distribution_class=MaskedCategorical,
            return_log_prob=True,
            log_prob_key=("arms", LIKELIHOOD),
        )
        self._loss = ClipPPOLoss(
            self.policy, None, clip_epsilon=config.clip, entropy_coeff=config.entropy, critic_coeff=None
        )
        self._loss.set_keys(action=ACTION, sample_log_prob=("arms", LIKELIHOOD), advantage="advantage")
        networks = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(networks, lr=config.learning_rate, eps=1e-5)
        self._make_env = make_env

    @property
    def env_steps(self) -> int:
        """So far."""
        return self.done * self.config.envs * self.config.steps

    def iterate(self) -> Iterator[Iteration]:
        """Collect, learn, tell; for ever. What follows is drawn by the number of iterations done."""
        frames = self.config.envs * self.config.steps
        torch.manual_seed(self._seed_of(1))
        self._order = np.random.default_rng(self._seed_of(2))
        collector = Collector(
            self._make_env(self.config.envs, self._seed_of(3)),
            self.policy,
            frames_per_batch=frames,
            total_frames=-1,
            use_buffers=False,
            auto_register_policy_transforms=False,
        )
        try:
            for seen in collector:
                yield self._learn(seen)
        finally:
            collector.shutdown()

    def _seed_of(self, purpose: int) -> int:
        """For the network's start, its choices, the order of learning, and the shifts."""
        seed = np.random.SeedSequence([self.config.seed, purpose, self.done])
        return int(seed.generate_state(1)[0])

    def _learn(self, seen: TensorDictBase) -> Iteration:
        config = self.config
        advantage, target = self._advantages(seen)
        choice = seen[MASK].sum(dim=-1) > 1
        raw = advantage[choice]
        advantage = (advantage - raw.mean()) / (raw.std() + 1e-6)
        count = int(choice.sum())
        chosen = TensorDict(
            {
                SEEN: seen[SEEN][choice],
                MASK: seen[MASK][choice],
                ACTION: seen[ACTION][choice],
                ("arms", LIKELIHOOD): seen["arms", LIKELIHOOD][choice],
                "advantage": advantage[choice][..., None],
            },
            batch_size=[count],
        )
        everything: Any = seen[SEEN]  # a tensor; the stub allows any entry
        vectors, target = everything.flatten(0, 1), target.flatten(0, 1)
        batches = max(1, -(-count // config.minibatch))
        told: list[tuple[float, float, float]] = []
        for _ in range(config.epochs):
            rows = np.array_split(self._order.permutation(count), batches)
            moments = np.array_split(self._order.permutation(len(vectors))[: len(vectors) // config.epochs], batches)
            for row, moment in zip(rows, moments, strict=True):
                at = torch.from_numpy(moment)
                told.append(self._step(chosen, torch.from_numpy(row), vectors[at], target[at]))
        self.done += 1
        entropy, clipped, value_loss = np.mean(told, axis=0).tolist()
        reward = float(seen["next", "arms", "reward"].mean())
        return Iteration(self.done, self.env_steps, reward, count, entropy, clipped, value_loss)

    def _step(
        self, chosen: TensorDictBase, rows: Tensor, vectors: Tensor, target: Tensor
    ) -> tuple[float, float, float]:
        losses: Any = self._loss(chosen[rows])  # a TensorDict of tensors
        value_loss = nn.functional.smooth_l1_loss(self.critic(self.layout, vectors), target)
        loss = losses["loss_objective"] + losses["loss_entropy"] + value_loss
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_([*self.actor.parameters(), *self.critic.parameters()], self.config.max_gradient)
        self.optimizer.step()
        return float(losses["entropy"]), float(losses["clip_fraction"]), float(value_loss.detach())

    @torch.no_grad()
    def _advantages(self, seen: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Advantages and value targets, [env, time, arm].

        A shift's end, also that at the horizon, is an end: the clock is in the observation.
        """
        values = self.critic(self.layout, seen[SEEN])
        afterwards: Any = seen["next", *SEEN]  # a tensor; the stub allows any entry
        last = self.critic(self.layout, afterwards[:, -1:])
        following = torch.cat([values[:, 1:], last], dim=1)  # what comes after an end does not count
        done = seen["next", "done"].expand(*values.shape)
        reward = seen["next", "arms", "reward"][..., 0] * self.config.reward_scale
        return vec_generalized_advantage_estimate(
            self.config.gamma, self.config.lmbda, values, following, reward, done, done
        )

    def act(self, vectors: np.ndarray, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draws of the actor as it is now, int [...], at vectors float32 [..., size] and masks."""
        legal = torch.from_numpy(mask)
        with torch.inference_mode():
            logits = Chooser(self.actor, self.layout)(torch.from_numpy(vectors), legal)
            return draw(masked(logits, legal).numpy(), rng)

    def save(self, path: Path, **told: float) -> None:
        """Write all that goes on when training is resumed, and some numbers; the file appears whole or not at all."""
        with atomic_path(path) as draft:
            torch.save({"trainer": self.state(), **told}, draft)

    def load(self, path: Path) -> dict[str, Any]:
        """Go on from what `save` wrote; returns the numbers.

        Raises:
            CheckpointError: the file is damaged, or of another network.
        """
        if not zipfile.is_zipfile(path):
            raise CheckpointError(f"{path}: no training to go on from: the file is damaged.")
        try:
            kept = torch.load(path, weights_only=True)
            self.resume(kept.pop("trainer"))
        except (RuntimeError, KeyError, ValueError, EOFError, pickle.UnpicklingError) as error:
            raise CheckpointError(f"{path}: no training to go on from ({error}).") from error
        return kept

    def state(self) -> dict[str, Any]:
        """All that goes on when training is resumed."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "done": self.done,
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from what `state` told. Environments begin new shifts."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.done = state["done"]
