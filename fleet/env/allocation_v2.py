"""Thermal job allocation, version 2: a PettingZoo `ParallelEnv` on the engine `fleet.engine.step`.

Agents are the arms, fixed for the whole episode. Actions are Discrete(slots · plans + 2): 0 waits or continues and is
always legal, 1 + slot · plans + plan claims the job in a slot by one of the arm's plans for it, and the last action
returns the current job after its cycle. Of two claims for one job, station or space the lower difficulty wins, then the
lower index.

It is one row of a batch (`fleet.env.vector`), with a plant that moves the arms, events and a watcher.
"""

from copy import copy, deepcopy
from typing import Any, Literal, get_args

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import parallel_to_aec_wrapper

from fleet.bus.exchange.memory import Exchange
from fleet.engine.batch import RewardWeights, Shift
from fleet.engine.shift import Episode as Episode
from fleet.engine.shift import EpisodeFactory as EpisodeFactory
from fleet.engine.shift import Watch, events_of, record_of
from fleet.engine.state import State
from fleet.engine.step import FINISHED, OUTCOME, TICK, TOTAL
from fleet.engine.world import World
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.env.render.renderer import Renderer
from fleet.env.render.scene import CellMap
from fleet.env.validation import (
    Decisions,
    actions_of,
    agent_of,
    at_least_one,
    check_choice,
    check_reset_options,
    seed_of,
)
from fleet.env.vector import AHEAD_S, REWARDS, BatchEnv, Library, arm_spaces
from fleet.events import Event
from fleet.heat.thermal import WINDING
from fleet.observation import Observation
from fleet.telemetry import MODES


def spaces_like(first: tuple[spaces.Dict, spaces.Discrete]) -> tuple[spaces.Dict, spaces.Discrete]:
    """Copies of spaces with their own random generator; they share the bounds, which are large with many arms."""
    observation, action = first
    return spaces.Dict({name: copy(space) for name, space in observation.items()}), copy(action)


Array = np.ndarray

VERSION = "allocation_v2"
MaskPlace = Literal["obs", "info", "both"]
RENDER_MODES = ("ansi", "rgb_array", "human")
FRAMES_PER_S = 10
"""Frame rate of a rendered episode, decision intervals per second."""


class AllocationEnv(ParallelEnv[str, Any, Any]):
    """The environment; `parallel_env` makes it.

    Args:
        make_episode: Makes the episode of a seed.
        exchange: Carries the messages between arms; perfect and immediate if not given. The env closes it.
        weights: Of the reward terms.
        max_cycles: Ends the episode earlier than the shift's horizon, in decision intervals.
        keep_events: Collect an event log in `events`.
        watch: Called with the `StepRecord` of every step, for recording.
        render_mode: "rgb_array" for a picture from above, "human" for a window that shows it, "ansi" for a table of
            the fleet as text, or None.
        cell: Where arms and stations stand, for pictures; arms in a row if not given.
        mask_in: Where the mask of legal actions is: in the observation, in the info, or both. In the info alone, the
            observation is the vector by itself.
        near: The peers each arm has in its vector; see `fleet.observation.Layout`.
        decisions: Length of a step: one decision "interval", or until an arm may claim a job or one at work passes its
            warning limit ("events").
        scaled, ahead_s, bids: As in `fleet.env.vector.BatchEnv`.
    """

    metadata = {  # noqa: RUF012  # PettingZoo's
        "name": VERSION,
        "render_modes": list(RENDER_MODES),
        "render_fps": FRAMES_PER_S,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        make_episode: EpisodeFactory,
        *,
        exchange: Exchange | None = None,
        weights: RewardWeights | None = None,
        max_cycles: int | None = None,
        keep_events: bool = False,
        watch: Watch | None = None,
        render_mode: str | None = None,
        cell: CellMap | None = None,
        mask_in: MaskPlace = "obs",
        near: tuple[tuple[int, ...], ...] | None = None,
        decisions: Decisions = "interval",
        scaled: bool = True,
        ahead_s: float = AHEAD_S,
        bids: bool = False,
    ) -> None:
        check_choice("render_mode", render_mode, (None, *RENDER_MODES))
        check_choice("mask_in", mask_in, get_args(MaskPlace))
        check_choice("decisions", decisions, get_args(Decisions))
        self.render_mode = render_mode
        self.events: list[Event] = []
        self._make_episode = make_episode
        self._keep_events = keep_events
        self._watch = watch
        self._renderer = Renderer(cell)
        self._mask_in = mask_in
        self._until_choice = decisions == "events"
        self._seeds = np.random.SeedSequence()
        self._draw(np.random.SeedSequence(0))
        arms, ticks = self.world.arms, self.world.ticks
        self._last_tick = ticks if max_cycles is None else min(ticks, at_least_one("max_cycles", max_cycles))
        self.possible_agents = list(arms)
        self.agents: list[str] = []
        self._exchange = exchange or Exchange(arms)
        self._near = near
        self._options: dict[str, Any] = {
            "weights": weights,
            "exchanges": None if self._exchange.perfect else [self._exchange],
            "scaled": scaled,
            "ahead_s": ahead_s,
            "bids": bids,
            "keep_events": keep_events,
            "trace": watch is not None or (keep_events and not self._episode.plant.follows_plans),
        }
        self.batch = self._one_row()
        """The batch of one env, with the true state (not for policies); another one if a reset brings another fleet."""
        self.layout = self.batch.layout
        first = arm_spaces(self.layout)
        self.observation_spaces: dict[str, spaces.Space[Any]] = {}
        self.action_spaces: dict[str, spaces.Space[Any]] = {}
        for arm in arms:
            observation, self.action_spaces[arm] = spaces_like(first)
            self.observation_spaces[arm] = observation["observation"] if mask_in == "info" else observation
        low, high = self.layout.bounds
        self.state_space = spaces.Box(np.tile(low, len(arms)), np.tile(high, len(arms)), dtype=np.float32)
        self._started, self._tick = False, 0
        self._delivered_before = 0

    def __copy__(self) -> "AllocationEnv":
        return deepcopy(self)

    def _draw(self, seed: np.random.SeedSequence) -> Shift:
        self._episode = self._make_episode(seed)
        return self._episode.shift

    def _one_row(self) -> BatchEnv:
        world = self.world
        library = Library(world.arms, world.slots, world.tables, self._draw, self._near, self._episode.twins)
        return BatchEnv(library, 1, autoreset=False, **self._options)

    @property
    def world(self) -> World:
        """World of the current episode (true state: not for policies)."""
        return self._episode.world

    @property
    def episode(self) -> Episode:
        """The current episode."""
        return self._episode

    @property
    def truth(self) -> State:
        """A copy of the true state (not for policies)."""
        return self._begun("looking at its state").engine.state.copy(jobs=slice(self.world.jobs))

    @property
    def tick(self) -> int:
        """Elapsed decision intervals of this episode."""
        self._begun("counting steps")
        return self._tick

    @property
    def messages(self) -> int:
        """Number of messages delivered to peers in this episode."""
        self._begun("counting messages")
        if not self._exchange.perfect:
            return self._exchange.delivered - self._delivered_before
        return self.layout.arms * (self.layout.arms - 1) * (self.tick + 1)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Space of an agent's observation; the same object on every call."""
        return self.observation_spaces[agent_of(self.possible_agents, agent)]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Space of an agent's action; the same object on every call."""
        return self.action_spaces[agent_of(self.possible_agents, agent)]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Start a new episode; return observations and infos by agent. Without a seed: the next child of the last seed.

        Raises:
            ValueError: a seed that is no integer from 0 to 2**32 - 1, or an option.
        """
        check_reset_options(options)
        if seed is not None:
            self._seeds, entropy = seed_of(seed), seed_of(seed)
        else:
            entropy = self._seeds.spawn(1)[0]
        shift = self._draw(entropy)
        if self.world.tables is not self.batch.engine.tables:  # another fleet
            self.batch = self._one_row()
        self._delivered_before = self._exchange.delivered
        self.batch.begin(_FIRST, [shift], [self._episode.sensors])
        self.agents, self.events = list(self.possible_agents), []
        self._started, self._tick = True, 0
        observations, masks = self._observations()
        return observations, self._infos(np.zeros(OUTCOME), masks, 0.0)

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One step; a missing or illegal action is a wait.

        Raises:
            RuntimeError: before reset, or after the end.
            ValueError: no dictionary, an action that is no integer, or one of an agent that is not there.
        """
        before = self._tick
        outcome, finished, over = self.advance(actions)
        observations, masks = self._observations()
        infos = self._infos(outcome, masks, (self._tick - before) * self.batch.engine.tables.dt_s)
        reward, arms = float(outcome[TOTAL]), self.possible_agents
        return (
            observations,
            dict.fromkeys(arms, reward),
            dict.fromkeys(arms, finished),
            dict.fromkeys(arms, over),
            infos,
        )

    def advance(self, actions: dict[str, Any]) -> tuple[Array, bool, bool]:
        """As `step`, without observations, for callers that read `knowledge` when they need it.

        Returns the outcome, as `fleet.engine.batch.Engine.step`, and whether all jobs are done and whether the time is
        over.
        """
        batch = self._begun("step()")
        if not self.agents:
            raise RuntimeError("The episode is over: call reset() before step().")
        chosen = actions_of(self.possible_agents, actions)
        outcome, last_tick = self._advance(batch, chosen[None]), self._last_tick
        while self._until_choice and not outcome[FINISHED] and outcome[TICK] < last_tick and not batch.engine.choice[0]:
            more = self._advance(batch, None)
            more[: TOTAL + 1] += outcome[: TOTAL + 1]
            outcome = more
        self._tick, finished = int(outcome[TICK]), bool(outcome[FINISHED])
        over = not finished and self._tick >= last_tick
        if finished or over:
            self.agents = []
        return outcome, finished, over

    def _advance(self, batch: BatchEnv, actions: Array | None) -> Array:
        """One decision interval; return its outcome."""
        episode, engine = self._episode, batch.engine
        outcome = engine.step(actions, batch.parts, drive=episode.drive)[0]
        batch.deliver(_FIRST)
        if self._keep_events:
            self.events += events_of(episode.world, engine.state, engine.events)
            if not episode.plant.follows_plans:
                self.events += episode.plant.contacts(episode.world, record_of(engine))
        if self._watch is not None:
            self._watch(record_of(engine))
        return outcome

    def state(self) -> Array:
        """Vectors of all arms, concatenated, float32."""
        return self.layout.join(*self._begun("state()").parts).reshape(-1)

    @property
    def may_claim(self) -> bool:
        """Whether an arm may claim a job now."""
        return bool(self._begun("may_claim").engine.mask[0, :, 1:-1].any())

    def knowledge(self) -> dict[str, Observation]:
        """Current observation of every arm by name, as policies read it."""
        batch = self._begun("knowledge()")
        shared, own = batch.parts
        return self.layout.read_each(self.possible_agents, shared[0], own[0], batch.engine.mask[0])

    def lookahead(self, simulator: CellSimulator) -> Lookahead:
        """A simulator of the cell in the current episode, for policies that plan."""
        return self._begun("looking ahead").lookahead(simulator, 0)

    def render(self) -> Array | str | None:
        """The fleet as a picture, uint8 [height, width, 3], in mode "rgb_array", as a table of text in mode "ansi", or
        shown in a window in mode "human" (which returns nothing, as does no mode)."""
        if self.render_mode is None:
            return None
        self._begun("render()")
        if self.render_mode == "ansi":
            return _table(self.world, self.truth)
        frame = self._renderer.frame(self.world, self.truth)
        if self.render_mode == "rgb_array":
            return frame
        self._renderer.show(frame)
        return None

    def close(self) -> None:
        """Close the exchange, and the window if there is one."""
        self._exchange.close()
        self._renderer.close()

    def _begun(self, what: str) -> BatchEnv:
        if not self._started:
            raise RuntimeError(f"No episode has started: call reset() before {what}.")
        return self.batch

    def _observations(self) -> tuple[dict[str, Any], Array]:
        """Observations by agent, and the masks [arm, option + 2]; all in arrays of their own."""
        shared, own = self.batch.parts
        vectors, masks = self.layout.join(shared[0], own[0]), self.batch.engine.mask[0].copy()
        if self._mask_in == "info":
            return dict(zip(self.possible_agents, vectors, strict=True)), masks
        each = zip(self.possible_agents, vectors, masks, strict=True)
        return {arm: {"observation": vector, "action_mask": mask} for arm, vector, mask in each}, masks

    def _infos(self, outcome: Array, masks: Array, elapsed_s: float) -> dict[str, dict[str, Any]]:
        *rewards, _, _, jobs_done, _ = outcome.tolist()
        of_all = {"jobs_done": jobs_done, "elapsed_s": elapsed_s, **dict(zip(REWARDS, rewards, strict=True))}
        infos = dict[str, dict[str, Any]]()
        for arm, of_arm in zip(self.possible_agents, self.batch.engine.infos[0].tolist(), strict=True):
            infos[arm] = info = of_all.copy()
            info["faults"], info["illegal"], info["peak_c"], info["above_warning_s"] = of_arm
        if self._mask_in != "obs":
            for a, info in enumerate(infos.values()):
                info["action_mask"] = masks[a].copy()
        return infos


_FIRST = np.zeros(1, dtype=int)


def _table(world: World, state: State) -> str:
    rows = [f"t = {state.tick[0] * world.dt_s:7.0f} s"]
    for a, arm in enumerate(world.arms):
        job = state.job[0, a]
        name = world.shifts[0].names[job] if job >= 0 else "-"
        temps = " ".join(f"{t:5.1f}" for t in state.temp_c[0, a, WINDING])
        rows.append(f"{arm:>10}  {MODES[state.mode[0, a]]:<8} {name:<20} {temps}")
    return "\n".join(rows)


def parallel_env(make_episode: EpisodeFactory, **options: Any) -> AllocationEnv:  # passed on
    """The `ParallelEnv`, with the options of `AllocationEnv`."""
    return AllocationEnv(make_episode, **options)


class InTurns(parallel_to_aec_wrapper[str, Any, Any]):
    """The same for agents that act in turn; the step follows the action of the last agent."""

    def step(self, action: Any) -> None:  # as PettingZoo has it
        """Action of one agent.

        Raises:
            ValueError: no integer; refused before anybody else is asked. After the end, anything but None.
        """
        agent = self.agent_selection
        if not (self.terminations[agent] or self.truncations[agent]):
            actions_of([agent], {agent: action})
        elif action is not None:
            raise ValueError(
                f"The episode is over for '{agent}': step(None), or reset() for the next one (got {action!r})."
            )
        super().step(action)


def raw_env(make_episode: EpisodeFactory, **options: Any) -> AECEnv[str, Any, Any]:  # passed on
    """The same as an `AECEnv`, without wrappers."""
    return InTurns(parallel_env(make_episode, **options))


def env(make_episode: EpisodeFactory, **options: Any) -> AECEnv[str, Any, Any]:  # passed on
    """The same as an `AECEnv`, with PettingZoo's order check."""
    return wrappers.OrderEnforcingWrapper(raw_env(make_episode, **options))
