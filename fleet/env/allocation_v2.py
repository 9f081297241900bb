"""Thermal job allocation, version 2: a PettingZoo `ParallelEnv` on the engine `fleet.engine.step`.

Agents are the arms, fixed for the whole episode. Actions are Discrete(slots · plans + 2): 0 waits or continues and is
always legal, 1 + slot · plans + plan claims the job in a slot by one of the arm's plans for it, and the last action
returns the current job after its cycle. Of two claims for one job, station or space the lower difficulty wins, then the
lower index.

Seeds, counts and actions of callers are checked here for the batch and the adapters too.
"""

from copy import copy
from typing import Any, Literal, get_args

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import parallel_to_aec_wrapper

from fleet.bus.exchange.memory import Exchange
from fleet.engine.batch import TERMS, RewardWeights
from fleet.engine.shift import Episode as Episode
from fleet.engine.shift import EpisodeFactory as EpisodeFactory
from fleet.engine.shift import ShiftRunner, Watch
from fleet.engine.state import State, World
from fleet.engine.step import FINISHED, OUTCOME, TICK, TOTAL
from fleet.env.lookahead import CellSimulator, Lookahead
from fleet.env.render.renderer import Renderer
from fleet.env.render.scene import CellMap
from fleet.env.validation import Decisions, actions_of, agent_of, at_least_one, check_choice, seed_of, switch
from fleet.events import Event
from fleet.heat.thermal import WINDING
from fleet.observation import Layout, Observation
from fleet.telemetry import MODES


def arm_spaces(layout: Layout) -> tuple[spaces.Dict, spaces.Discrete]:
    """Observation and action space of one arm."""
    low, high = layout.bounds
    observation = spaces.Dict(
        {
            "observation": spaces.Box(low, high, dtype=np.float32),
            "action_mask": spaces.Box(0, 1, (layout.actions,), dtype=np.int8),
        }
    )
    return observation, spaces.Discrete(layout.actions)


def spaces_like(first: tuple[spaces.Dict, spaces.Discrete]) -> tuple[spaces.Dict, spaces.Discrete]:
    """Copies of spaces with their own random generator; they share the bounds, which are large with many arms."""
    observation, action = first
    return spaces.Dict({name: copy(space) for name, space in observation.items()}), copy(action)


Array = np.ndarray

VERSION = "allocation_v2"
AHEAD_S = 0.0
"""Options are given to free arms; see `Layout.ahead_s`."""
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
        scaled: Vectors hold values of order 1 (`Field.scale`); otherwise they have the units of the fields.
        ahead_s: Options of arms that are home later than this are 0: they cannot claim soon. inf for those of all.
        bids: Vectors hold the bids of members; see `fleet.observation.Layout`.
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
        self._weights = weights or RewardWeights()
        self._max_cycles = None if max_cycles is None else at_least_one("max_cycles", max_cycles)
        self._keep_events = keep_events
        self._watch = watch
        self._renderer = Renderer(cell)
        self._mask_in = mask_in
        self._until_choice = decisions == "events"
        self._seeds = np.random.SeedSequence()
        self._episode = make_episode(np.random.SeedSequence(0))
        world = self._episode.world
        self.possible_agents = list(world.arms)
        self.agents: list[str] = []
        self._exchange = exchange or Exchange(world.arms)
        self.layout = Layout(
            len(world.arms),
            world.slots,
            near,
            world.plans_per_job,
            scaled=scaled,
            delivered=not self._exchange.perfect,
            ahead_s=ahead_s,
            bids=switch("bids", bids),
        )
        first = arm_spaces(self.layout)
        self.observation_spaces: dict[str, spaces.Space[Any]] = {}
        self.action_spaces: dict[str, spaces.Space[Any]] = {}
        for arm in world.arms:
            observation, self.action_spaces[arm] = spaces_like(first)
            self.observation_spaces[arm] = observation["observation"] if mask_in == "info" else observation
        low, high = self.layout.bounds
        self.state_space = spaces.Box(np.tile(low, len(world.arms)), np.tile(high, len(world.arms)), dtype=np.float32)
        self._shift: ShiftRunner | None = None
        self._tick = 0

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
        return self._begun("looking at its state").state.copy()

    @property
    def tick(self) -> int:
        """Elapsed decision intervals of this episode."""
        self._begun("counting steps")
        return self._tick

    @property
    def messages(self) -> int:
        """Number of messages delivered to peers in this episode."""
        return self._begun("counting messages").messages

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
            ValueError: a seed that is no integer >= 0.
        """
        if seed is not None:
            self._seeds, entropy = seed_of(seed), seed_of(seed)
        else:
            entropy = self._seeds.spawn(1)[0]
        self._episode = self._make_episode(entropy)
        self.agents = list(self.possible_agents)
        self.events = []
        self._shift = ShiftRunner(
            self._episode,
            self._weights,
            exchange=self._exchange,
            keep_events=self._keep_events,
            watch=self._watch,
            layout=self.layout,
        )
        self.events, self._tick = self._shift.events, 0
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
        infos = self._infos(outcome, masks, (self._tick - before) * self.world.dt_s)
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
        shift = self._begun("step()")
        if not self.agents:
            raise RuntimeError("The episode is over: call reset() before step().")
        chosen = actions_of(self.possible_agents, actions)
        last_tick = min(self.world.ticks, self._max_cycles or self.world.ticks)
        outcome = shift.step(chosen)
        while self._until_choice and not outcome[FINISHED] and outcome[TICK] < last_tick and not shift.choice:
            more = shift.step(None)
            more[: TOTAL + 1] += outcome[: TOTAL + 1]
            outcome = more
        self._tick = int(outcome[TICK])
        finished = bool(outcome[FINISHED])
        over = not finished and self._tick >= last_tick
        if finished or over:
            self.agents = []
        return outcome, finished, over

    def state(self) -> Array:
        """Vectors of all arms, concatenated, float32."""
        return self.layout.join(*self._begun("state()").parts).reshape(-1)

    @property
    def may_claim(self) -> bool:
        """Whether an arm may claim a job now."""
        return bool(self._begun("may_claim").mask[:, 1:-1].any())

    def knowledge(self) -> dict[str, Observation]:
        """Current observation of every arm by name, as policies read it."""
        shift = self._begun("knowledge()")
        shared, own = shift.parts
        return self.layout.read_each(self.possible_agents, shared.copy(), own.copy(), shift.mask.copy())

    def lookahead(self, simulator: CellSimulator) -> Lookahead:
        """A simulator of the cell in the current episode, for policies that plan."""
        return Lookahead(simulator, self._begun("looking ahead").engine)

    def render(self) -> Array | str | None:
        """The fleet as a picture, uint8 [height, width, 3], in mode "rgb_array", as a table of text in mode "ansi", or
        shown in a window in mode "human" (which returns nothing, as does no mode)."""
        if self.render_mode is None:
            return None
        shift, world = self._begun("render()"), self.world
        if self.render_mode == "ansi":
            return _table(world, shift.state)
        frame = self._renderer.frame(world, shift.state)
        if self.render_mode == "rgb_array":
            return frame
        self._renderer.show(frame)
        return None

    def close(self) -> None:
        """Close the exchange, and the window if there is one."""
        self._exchange.close()
        self._renderer.close()

    def _begun(self, what: str) -> ShiftRunner:
        if self._shift is None:
            raise RuntimeError(f"No episode has started: call reset() before {what}.")
        return self._shift

    def _observations(self) -> tuple[dict[str, Any], Array]:
        """Observations by agent, and the masks [arm, option + 2]; all in arrays of their own."""
        shift = self._begun("observing")
        vectors, masks = self.layout.join(*shift.parts), shift.mask.copy()
        arms = self.possible_agents
        if self._mask_in == "info":
            return {arm: vectors[a] for a, arm in enumerate(arms)}, masks
        return {arm: {"observation": vectors[a], "action_mask": masks[a]} for a, arm in enumerate(arms)}, masks

    def _infos(self, outcome: Array, masks: Array, elapsed_s: float) -> dict[str, dict[str, Any]]:
        *rewards, _, _, jobs_done, _ = outcome.tolist()
        of_all = {"jobs_done": jobs_done, "elapsed_s": elapsed_s, **dict(zip(_REWARDS, rewards, strict=True))}
        infos: dict[str, dict[str, Any]] = {
            arm: {"faults": faults, "illegal": illegal, "peak_c": peak_c, "above_warning_s": above_s, **of_all}
            for arm, (faults, illegal, peak_c, above_s) in zip(
                self.possible_agents, self._begun("infos").infos, strict=True
            )
        }
        if self._mask_in != "obs":
            for a, info in enumerate(infos.values()):
                info["action_mask"] = masks[a].copy()
        return infos


_REWARDS = tuple(f"reward_{name}" for name in TERMS)


def _table(world: World, state: State) -> str:
    rows = [f"t = {state.tick[0] * world.dt_s:7.0f} s"]
    for a, arm in enumerate(world.arms):
        job = state.job[0, a]
        name = world.jobs.names[0][job] if job >= 0 else "-"
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
