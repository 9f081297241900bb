"""Thermal job allocation, version 0: arms claim jobs, heat up, and must not fault.

A PettingZoo `ParallelEnv` as a thin view of the one engine `fleet.sim.kernel`. Agents are the arms, fixed for the
whole episode. Every decision interval each answers Discrete(slots + 1): 0 waits or goes on and is always legal, k
claims the job in slot k. Two claims for one job or station: the lower shared difficulty wins, then the lower index.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import parallel_to_aec, wrappers

from fleet.bus.exchange import Exchange, Heard
from fleet.bus.memory import MemoryExchange
from fleet.env.observation import Layout, Observation, observe, say
from fleet.env.reward import TERMS, RewardWeights, terms
from fleet.events import Event
from fleet.sim import claims
from fleet.sim.kernel import Plant, Step, step
from fleet.sim.state import DONE, State, World, initial
from fleet.telemetry import MODES
from fleet.thermal import WINDING

Array = np.ndarray

VERSION = "allocation_v0"


@dataclass(frozen=True, eq=False)
class Episode:
    """One shift, ready to run."""

    world: World
    plant: Plant
    twins: tuple[str, ...]
    """Version of each arm's difficulty model."""
    rng: np.random.Generator
    """For sensor noise."""


EpisodeFactory = Callable[[np.random.SeedSequence], Episode]
"""Makes the episode of a seed; the fleet must be the same for every seed."""


class AllocationEnv(ParallelEnv[str, Any, Any]):
    """The environment itself; `parallel_env` is its public door.

    Args:
        make_episode: Makes the shift of a seed.
        exchange: Carries what arms tell each other; perfect and immediate if not given. The env closes it.
        weights: Of the reward terms.
        max_cycles: Ends the episode earlier than the shift's horizon, in decision intervals.
        keep_events: Collect an event log in `events`.
        watch: Called with every `Step` of the kernel, for recording.
        render_mode: "ansi" for a table of the fleet as text, or None.
    """

    metadata = {"name": VERSION, "render_modes": ["ansi"], "is_parallelizable": True}  # noqa: RUF012  # PettingZoo's

    def __init__(
        self,
        make_episode: EpisodeFactory,
        *,
        exchange: Exchange | None = None,
        weights: RewardWeights | None = None,
        max_cycles: int | None = None,
        keep_events: bool = False,
        watch: Callable[[Step], None] | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "ansi"):
            raise ValueError(f"render_mode must be None or 'ansi' (got {render_mode!r}).")
        if max_cycles is not None and max_cycles < 1:
            raise ValueError(f"max_cycles must be >= 1 (got {max_cycles}).")
        self.render_mode = render_mode
        self.events: list[Event] = []
        self._make_episode = make_episode
        self._weights = weights or RewardWeights()
        self._max_cycles = max_cycles
        self._keep_events = keep_events
        self._watch = watch
        self._seeds = np.random.SeedSequence()
        self._episode = make_episode(np.random.SeedSequence(0))
        world = self._episode.world
        self.possible_agents = list(world.arms)
        self.agents: list[str] = []
        self._exchange = exchange or MemoryExchange(world.arms)
        self._spoken_before = 0
        self.layout = Layout(len(world.arms), world.slots)
        low, high = self.layout.bounds
        self.observation_spaces = {
            arm: spaces.Dict(
                {
                    "observation": spaces.Box(low, high, dtype=np.float32),
                    "action_mask": spaces.Box(0, 1, (world.slots + 1,), dtype=np.int8),
                }
            )
            for arm in world.arms
        }
        self.action_spaces = {arm: spaces.Discrete(world.slots + 1) for arm in world.arms}
        self.state_space = spaces.Box(np.tile(low, len(world.arms)), np.tile(high, len(world.arms)), dtype=np.float32)
        self._state: State | None = None

    @property
    def world(self) -> World:
        """The world of the present episode (the simulator's truth: not for policies)."""
        return self._episode.world

    @property
    def episode(self) -> Episode:
        """The present episode."""
        return self._episode

    @property
    def truth(self) -> State:
        """The simulator's state (not for policies)."""
        if self._state is None:
            raise RuntimeError("There is no state yet: call reset() first.")
        return self._state

    @property
    def messages(self) -> int:
        """Words that reached a peer in this episode."""
        return self._exchange.delivered - self._spoken_before

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Space of an agent's observation; the same object on every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Space of an agent's action; the same object on every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, dict[str, Array]], dict[str, dict[str, float]]]:
        """Begin a new shift: observations and infos by agent. Without a seed, the next one of the last seed's row."""
        if seed is not None:
            self._seeds = np.random.SeedSequence(seed)
            entropy = np.random.SeedSequence(seed)
        else:
            entropy = self._seeds.spawn(1)[0]
        self._episode = self._make_episode(entropy)
        self._exchange.begin(self._episode.rng.spawn(1)[0])
        self._spoken_before = self._exchange.delivered
        self._state = initial(self.world)
        self.agents = list(self.possible_agents)
        self.events = []
        self._perceive()
        zero = dict.fromkeys(TERMS, 0.0)
        return self._observations(), {arm: self._info(a, zero) for a, arm in enumerate(self.world.arms)}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, dict[str, Array]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, float]],
    ]:
        """One decision interval; a missing or illegal action is a wait."""
        before = self.truth
        if not self.agents:
            raise RuntimeError("The episode is over: call reset() before step().")
        unknown = set(actions) - set(self.possible_agents)
        if unknown:
            raise ValueError(
                f"No agent '{sorted(unknown)[0]}' in this fleet. Agents: {', '.join(self.possible_agents)}."
            )
        chosen = np.array([[_integer(arm, actions.get(arm, 0)) for arm in self.world.arms]])
        log = self.events if self._keep_events else None
        done = step(self.world, before, chosen, self._shared_scores()[None], self._episode.plant, log, self._board)
        if self._watch is not None:
            self._watch(done)
        self._state = done.state
        self._perceive()
        parts = {name: float(value[0]) for name, value in terms(self.world, before, done.state, self._weights).items()}
        reward = sum(parts.values())
        jobs = self.world.jobs.exists[0]
        # A shift without any job is stood through to its end.
        finished = bool(jobs.any() and (done.state.status[0][jobs] == DONE).all())
        last_tick = min(self.world.ticks, self._max_cycles or self.world.ticks)
        over = not finished and bool(done.state.tick[0] >= last_tick)
        arms = self.world.arms
        infos = {arm: self._info(a, parts) for a, arm in enumerate(arms)}
        if finished or over:
            self.agents = []
        return (
            self._observations(),
            dict.fromkeys(arms, reward),
            dict.fromkeys(arms, finished),
            dict.fromkeys(arms, over),
            infos,
        )

    def state(self) -> Array:
        """What all arms know together: their vectors one after the other, float32."""
        return self._perceived()[0].reshape(-1).copy()

    def knowledge(self) -> dict[str, Observation]:
        """The present observation of every arm by name, as policies read it."""
        vectors, masks = (values.copy() for values in self._perceived())
        return {arm: self.layout.read(vectors[a], masks[a]) for a, arm in enumerate(self.world.arms)}

    def render(self) -> str | None:
        """The fleet as a table of text in mode "ansi"."""
        if self.render_mode is None:
            return None
        state, world = self.truth, self.world
        rows = [f"t = {state.tick[0] * world.dt_s:7.0f} s"]
        for a, arm in enumerate(world.arms):
            job = state.job[0, a]
            name = world.jobs.names[0][job] if job >= 0 else "-"
            temps = " ".join(f"{t:5.1f}" for t in state.temp_c[0, a, WINDING])
            rows.append(f"{arm:>10}  {MODES[state.mode[0, a]]:<8} {name:<20} {temps}")
        return "\n".join(rows)

    def close(self) -> None:
        """Close the exchange."""
        self._exchange.close()

    def _perceive(self) -> None:
        """Read the sensors, tell the peers, hear them, and lay it all out."""
        world, state = self.world, self.truth
        self._board = claims.board(world, state)
        on_offer, mask = self._board.on_offer, self._board.mask
        true_c = state.temp_c[..., WINDING]
        measured = true_c + world.motors.sensor_noise_k * self._episode.rng.standard_normal(true_c.shape)
        words = say(world, state, on_offer, measured, self._episode.twins)
        self._heard: Heard = self._exchange.share(words)
        observation = observe(world, state, on_offer, mask, measured, self._heard)
        self._vectors = self.layout.pack(observation)

    def _shared_scores(self) -> Array:
        """Difficulty by which claims are settled, [arm, slot]: each arm's own word, as it told it."""
        arm = np.arange(len(self.world.arms))
        return self._heard.difficulty[arm, arm]

    def _perceived(self) -> tuple[Array, Array]:
        """Vectors float32 [arm, size] and masks int8 [arm, slot + 1] of this moment."""
        if self._state is None:
            raise RuntimeError("Nobody knows anything yet: call reset() first.")
        return self._vectors[0], self._board.mask[0].astype(np.int8)

    def _observations(self) -> dict[str, dict[str, Array]]:
        vectors, masks = self._perceived()
        return {
            arm: {"observation": vectors[a].copy(), "action_mask": masks[a].copy()}
            for a, arm in enumerate(self.world.arms)
        }

    def _info(self, a: int, parts: dict[str, float]) -> dict[str, float]:
        state = self.truth
        info = {
            "faults": float(state.faults[0, a]),
            "illegal": float(state.illegal[0, a]),
            "peak_c": float(state.peak_c[0, a]),
            "above_warning_s": float(state.above_warning_s[0, a]),
            "jobs_done": float((state.status[0] == DONE).sum()),
        }
        return info | {f"reward_{name}": value for name, value in parts.items()}


def _integer(arm: str, action: Any) -> int:
    value = np.asarray(action)
    if value.size != 1 or not np.issubdtype(value.dtype, np.integer):
        raise ValueError(f"The action of '{arm}' must be one integer (got {action!r}).")
    return int(value.reshape(()))


def parallel_env(make_episode: EpisodeFactory, **options: Any) -> AllocationEnv:
    """The `ParallelEnv`; options as in `AllocationEnv`."""
    return AllocationEnv(make_episode, **options)


def raw_env(make_episode: EpisodeFactory, **options: Any) -> AECEnv[str, Any, Any]:
    """The same as an `AECEnv`, without wrappers."""
    return parallel_to_aec(parallel_env(make_episode, **options))


def env(make_episode: EpisodeFactory, **options: Any) -> AECEnv[str, Any, Any]:
    """The same as an `AECEnv`, with PettingZoo's order check."""
    return wrappers.OrderEnforcingWrapper(raw_env(make_episode, **options))
