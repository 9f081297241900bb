"""MAPPO and IPPO with TorchRL: proximal policy optimisation of one actor that all arms share.

Clipped surrogate (Schulman et al., arXiv 1707.06347) with generalised advantages (arXiv 1506.02438); the critic sees
the whole fleet (MAPPO, Yu et al., NeurIPS 2022) or one arm (IPPO, de Witt et al., arXiv 2011.09533). The actor trains
only on steps at which an arm has a choice.

Steps may differ in length, so the process is a semi-Markov one: discounts go by the time that a step took (Bradtke &
Duff, NeurIPS 1994; Sutton, Precup & Singh, Artificial Intelligence 1999).

Warm start of a training: the actor imitates a rule before it learns by reinforcement.
"""

import pickle
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.modules import MaskedCategorical, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from agents.learned.config import PpoConfig
from agents.learned.policy import Actor, Critic, draw, has_choice, masked
from agents.policy import WAIT
from fleet.errors import CheckpointError
from fleet.fields import MAX_SEED
from fleet.files import atomic_path
from fleet.observation import Layout

SEEN, MASK, ACTION, LIKELIHOOD = ("arms", "observation"), ("arms", "action_mask"), ("arms", "action"), "log_prob"
CERTAIN = 1e3
"""A logit beside zeros."""
_STATE = ("actor", "critic", "optimizer")
EnvFactory = Callable[[int, int], EnvBase]
"""From a number of envs and a seed to a batched environment with the keys of `fleet.env.adapters.torchrl`."""


@dataclass(frozen=True)
class Iteration:
    """Statistics of one iteration."""

    number: int
    """From 1."""
    env_steps: int
    """In all iterations."""
    hours: float
    """Simulated time, summed over the envs."""
    reward: float
    """Mean per simulated hour of an env, not scaled."""
    choices: int
    """Number of steps at which an arm had a choice."""
    entropy: float
    """Of the action distribution at those choices, nat."""
    clipped: float
    """Share of choices with a clipped likelihood ratio."""
    value_loss: float


def use_threads(count: int) -> None:
    """Set the number of torch threads of this process."""
    torch.set_num_threads(count)


def choices(layout: Layout, vectors: Tensor, mask: Any) -> Tensor:
    """Whether each arm has a choice, bool [...], of vectors [..., size] and masks [..., action]."""
    as_array: Any = vectors
    return has_choice(mask, layout.read(as_array, as_array[..., :0]).headroom_k)


class Chooser(nn.Module):
    """Logits of every arm; an arm without a choice waits."""

    def __init__(self, actor: Actor, layout: Layout) -> None:
        super().__init__()
        self.actor, self.layout = actor, layout

    def forward(self, vectors: Tensor, mask: Tensor) -> Tensor:
        """[..., action] of vectors [..., size] and masks."""
        choice = choices(self.layout, vectors, mask)
        logits = vectors.new_zeros(mask.shape)
        logits[..., WAIT] = CERTAIN
        if bool(choice.any()):
            logits[choice] = self.actor(self.layout, vectors[choice])
        return logits


def advantages(
    elapsed_s: Tensor,
    reward: Tensor,
    values: Tensor,
    next_values: Tensor,
    done: Tensor,
    *,
    discount_s: float,
    trace_s: float,
) -> tuple[Tensor, Tensor]:
    """Generalised advantages and value targets of steps of unequal length, each [env, time, arm] like the arguments.

    δ = r + γ v' - v, A = δ + γ λ A' with γ = exp(-elapsed_s / discount_s) and λ = exp(-elapsed_s / trace_s); v' and A'
    are 0 after the last step of an episode. The reward of a step counts as of its start.

    Source: arXiv 1506.02438, eq. 16; γ by time as in Sutton, Precup & Singh, Artificial Intelligence 112, 1999, sec. 3.
    """
    gamma, lmbda = torch.exp(-elapsed_s / discount_s), torch.exp(-elapsed_s / trace_s)
    # Annotated float, but calculates with tensors; the vectorised form would need memory for time².
    estimate: Any = generalized_advantage_estimate
    return estimate(gamma, lmbda, values, next_values, reward, done, done)


class TrainingCell:
    """One environment of a training, with what learns in it; all of them share actor and critic."""

    def __init__(self, make_env: EnvFactory, layout: Layout, actor: Actor, config: PpoConfig) -> None:
        self.make_env, self.layout = make_env, layout
        chooser = TensorDictModule(Chooser(actor, layout), in_keys=[SEEN, MASK], out_keys=[("arms", "logits")])
        keys: Any = {"logits": ("arms", "logits"), "mask": MASK}  # TorchRL accepts a dict, its annotation does not
        self.policy = ProbabilisticActor(
            chooser,
            in_keys=keys,
            out_keys=[ACTION],
            distribution_class=MaskedCategorical,
            return_log_prob=True,
            log_prob_key=("arms", LIKELIHOOD),
        )
        self.loss = ClipPPOLoss(
            self.policy, None, clip_epsilon=config.clip, entropy_coeff=config.entropy, critic_coeff=None
        )
        self.loss.set_keys(action=ACTION, sample_log_prob=("arms", LIKELIHOOD), advantage="advantage")

    def collect(self, config: PpoConfig, seed: int) -> Collector:
        """Endless rollouts of an iteration each."""
        return Collector(
            self.make_env(config.envs, seed),
            self.policy,
            frames_per_batch=config.envs * config.length,
            total_frames=-1,
            use_buffers=False,
            auto_register_policy_transforms=False,
        )


class Trainer:
    """Trains an actor and a critic.

    Args:
        cells: Environments with their layouts; iterations take them in turns.
    """

    def __init__(self, cells: Sequence[tuple[EnvFactory, Layout]], config: PpoConfig) -> None:
        self.config = config
        self.done = 0
        """Number of finished iterations."""
        torch.manual_seed(self._seed_of(0))
        self.actor, self.critic = Actor(config.size), Critic(config.size, central=config.algorithm == "mappo")
        self._cells = [TrainingCell(make_env, layout, self.actor, config) for make_env, layout in cells]
        self._parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self._parameters, lr=config.learning_rate, eps=1e-5)

    @property
    def env_steps(self) -> int:
        """Env steps in all finished iterations."""
        return self.done * self.config.envs * self.config.length

    def iterate(self) -> Iterator[Iteration]:
        """Endless iterations of collecting and learning; random draws depend on the number of finished iterations."""
        torch.manual_seed(self._seed_of(1))
        self._order = np.random.default_rng(self._seed_of(2))
        seed = self._seed_of(3)
        with ExitStack() as stack:
            collectors: dict[int, Iterator[TensorDictBase]] = {}
            while True:
                turn = self.done % len(self._cells)
                if turn not in collectors:
                    collector = self._cells[turn].collect(self.config, (seed + turn) % (MAX_SEED + 1))
                    stack.callback(collector.shutdown)
                    collectors[turn] = iter(collector)
                yield self._learn(next(collectors[turn]), self._cells[turn])

    def _seed_of(self, purpose: int) -> int:
        """Seed of the initial weights (0), the actions (1), the minibatches (2) and the episodes (3)."""
        seed = np.random.SeedSequence([self.config.seed, purpose, self.done])
        return int(seed.generate_state(1)[0])

    def _learn(self, rollout: TensorDictBase, cell: TrainingCell) -> Iteration:
        config = self.config
        advantage, target = self._advantages(rollout, cell.layout)
        seen: Any = rollout[SEEN]  # a tensor; the stub allows any entry
        choice = choices(cell.layout, seen, rollout[MASK])
        at_choices = advantage[choice]
        advantage = (advantage - at_choices.mean()) / (at_choices.std() + 1e-6)
        count = int(choice.sum())
        kept = (SEEN, MASK, ACTION, ("arms", LIKELIHOOD))
        chosen = TensorDict({key: rollout[key][choice] for key in kept}, batch_size=[count])
        chosen["advantage"] = advantage[choice][..., None]
        vectors, target = seen.flatten(0, 1), target.flatten(0, 1)
        batches = max(1, -(-count // config.minibatch))
        statistics: list[tuple[float, float, float]] = []
        for _ in range(config.epochs):
            rows = np.array_split(self._order.permutation(count), batches)
            moments = np.array_split(self._order.permutation(len(vectors))[: len(vectors) // config.epochs], batches)
            for row, moment in zip(rows, moments, strict=True):
                at = torch.from_numpy(moment)
                statistics.append(self._step(cell, chosen[torch.from_numpy(row)], vectors[at], target[at]))
        self.done += 1
        entropy, clipped, value_loss = np.mean(statistics, axis=0).tolist()
        hours = float(rollout["next", "arms", "elapsed_s"][:, :, 0].double().sum()) / 3600.0
        reward = float(rollout["next", "arms", "reward"][:, :, 0].double().sum()) / hours
        return Iteration(self.done, self.env_steps, hours, reward, count, entropy, clipped, value_loss)

    def _step(
        self, cell: TrainingCell, choices: TensorDictBase, vectors: Tensor, target: Tensor
    ) -> tuple[float, float, float]:
        """One step of the optimiser; entropy, clipped share and value loss."""
        losses: Any = cell.loss(choices)  # a TensorDict of tensors
        value_loss = nn.functional.smooth_l1_loss(self.critic(cell.layout, vectors), target)
        loss = losses["loss_objective"] + losses["loss_entropy"] + value_loss
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._parameters, self.config.max_gradient)
        self.optimizer.step()
        return float(losses["entropy"]), float(losses["clip_fraction"]), float(value_loss.detach())

    @torch.no_grad()
    def _advantages(self, rollout: TensorDictBase, layout: Layout) -> tuple[Tensor, Tensor]:
        """Advantages and value targets, [env, time, arm].

        The horizon terminates an episode too, because the clock is in the observation.
        """
        values = self.critic(layout, rollout[SEEN])
        next_seen: Any = rollout["next", *SEEN]  # a tensor; the stub allows any entry
        next_values = torch.cat([values[:, 1:], self.critic(layout, next_seen[:, -1:])], dim=1)  # ignored at ends
        done = rollout["next", "done"].expand(*values.shape)
        reward = rollout["next", "arms", "reward"][..., 0] * self.config.reward_scale
        elapsed_s = rollout["next", "arms", "elapsed_s"][..., 0]
        return advantages(
            elapsed_s, reward, values, next_values, done, discount_s=self.config.discount_s, trace_s=self.config.trace_s
        )

    def act(self, layout: Layout, vectors: np.ndarray, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Actions of the present actor, int [...], at vectors float32 [..., size] and masks."""
        legal = torch.from_numpy(mask)
        with torch.inference_mode():
            logits = Chooser(self.actor, layout)(torch.from_numpy(vectors), legal)
            return draw(masked(logits, legal).numpy(), rng)

    def save(self, path: Path, **numbers: float) -> None:
        """Write the state of the training and some numbers atomically."""
        state = {name: getattr(self, name).state_dict() for name in _STATE} | {"done": self.done}
        with atomic_path(path) as draft:
            torch.save({"trainer": state, **numbers}, draft)

    def load(self, path: Path) -> dict[str, Any]:
        """Restore what `save` wrote, and return the numbers; environments begin new episodes.

        Raises:
            CheckpointError: the file is damaged, or of another network.
        """
        if not zipfile.is_zipfile(path):
            raise CheckpointError(f"{path}: the training cannot be resumed, because the file is damaged.")
        try:
            saved = torch.load(path, weights_only=True)
            state = saved.pop("trainer")
            for name in _STATE:
                getattr(self, name).load_state_dict(state[name])
            self.done = state["done"]
        except (RuntimeError, KeyError, ValueError, EOFError, pickle.UnpicklingError) as error:
            raise CheckpointError(f"{path}: the training cannot be resumed ({error}).") from error
        return saved


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
