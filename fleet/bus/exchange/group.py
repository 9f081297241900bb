"""Arms that share one client of the bus: what they publish, and what they have received, in a simulated shift."""

import math
import time
from collections.abc import Sequence
from typing import Generic, TypeVar

from fleet.bus.client.client import BusClient
from fleet.bus.exchange.protocol import Array, Broadcast, Condition, Scores
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.telemetry import MODES

Content = TypeVar("Content", Condition, Scores)

SILENT_AFTER = 3
"""Steps in a row that a peer may miss; then nobody waits for it until something of it arrives again."""


def messages_of(broadcast: Broadcast, arms: tuple[str, ...], tick: int) -> list[tuple[State, DifficultyScores]]:
    """The messages of one step, [arm]; empty slots are left out."""
    slots = [slot for slot, job in enumerate(broadcast.jobs) if job]
    jobs = tuple(broadcast.jobs[slot] for slot in slots)
    time_s = float(broadcast.time_s)
    columns = zip(
        arms,
        broadcast.mode.tolist(),
        broadcast.temp_c.tolist(),
        broadcast.headroom_k.tolist(),
        broadcast.twin,
        _nullable(broadcast.difficulty[:, slots]),
        _nullable(broadcast.p_saturation[:, slots]),
        strict=True,
    )
    return [
        (
            State(arm, tick, time_s, MODES[mode], tuple(temp_c), headroom_k),
            DifficultyScores(arm, tick, time_s, twin, jobs, difficulty, p_saturation),
        )
        for arm, mode, temp_c, headroom_k, twin, difficulty, p_saturation in columns
    ]


class _Latest(Generic[Content]):
    """The newest content of one topic from each sender."""

    def __init__(self, arms: int) -> None:
        self.forget(-1, arms)

    def forget(self, tick: int, arms: int) -> None:
        """Know nothing, and accept nothing of `tick` or before."""
        self.ticks = [tick] * arms
        self.last: list[Content | None] = [None] * arms

    def keep(self, sender: int, tick: int, content: Content) -> bool:
        """Keep the content if it is newer than what is known of the sender; whether it was."""
        if tick <= self.ticks[sender]:
            return False
        self.ticks[sender], self.last[sender] = tick, content
        return True

    def of(self, tick: int) -> list[Content | None]:
        """The contents of a step, [sender]."""
        return [content if ours == tick else None for ours, content in zip(self.ticks, self.last, strict=True)]


class Contents:
    """What an exchange keeps of messages; equal messages that several clients received share one content."""

    def __init__(self) -> None:
        self._states: dict[str, tuple[State, Condition]] = {}
        self._scores: dict[str, tuple[DifficultyScores, Scores]] = {}

    def condition(self, state: State) -> Condition:
        known = self._states.get(state.arm)
        if known is None or known[0] != state:
            known = state, Condition(state.time_s, MODES.index(state.mode), state.headroom_k)
            self._states[state.arm] = known
        return known[1]

    def scores(self, message: DifficultyScores) -> Scores:
        known = self._scores.get(message.arm)
        if known is None or known[0] != message:
            numbers = _numbers(message.difficulty), _numbers(message.p_saturation)
            known = message, Scores(message.time_s, message.jobs, *numbers)
            self._scores[message.arm] = known
        return known[1]


class Group:
    """The arms that share one client, and what they have received; as a rule one arm.

    Attributes:
        members: Indices of these arms in the fleet.
    """

    def __init__(self, client: BusClient, arms: tuple[str, ...], members: Sequence[int], contents: Contents) -> None:
        """Declare everything that these arms publish and subscribe to."""
        self.client, self.members = client, tuple(members)
        self._index = {arm: index for index, arm in enumerate(arms)}
        self._contents = contents
        self._tick, self._now_s = -1, -math.inf
        self._present: set[int] = set()
        self._awaited: set[int] = set()
        """Present when the step began, and not gone since."""
        self.conditions = _Latest[Condition](len(arms))
        self.scores = _Latest[Scores](len(arms))
        self._misses = [0] * len(arms)
        """Steps in a row in which a peer was not received."""
        # An arm alone knows its own messages without the bus.
        own, fleet = len(self.members) > 1, client.fleet
        client.subscribe(keys.of_every_arm(fleet, "state"), State, self._receive, own=own)
        client.subscribe(keys.of_every_arm(fleet, "difficulty"), DifficultyScores, self._receive, history=True, own=own)
        client.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)
        self._publishers = [_Publishers(client, arms[index]) for index in self.members]

    def begin_step(self, tick: int, now_s: float) -> None:
        """Handle what arrived since `tick`, the last one, and decide whom to wait for in the next step."""
        self._tick, self._now_s = tick, now_s
        self.client.serve()
        self._awaited = {sender for sender in self._present if self._misses[sender] < SILENT_AFTER}

    def publish(self, tick: int, now_s: float, messages: Sequence[tuple[State, DifficultyScores]]) -> None:
        """Publish the messages of these arms of one step, given those of the fleet, [arm]."""
        self._tick, self._now_s = tick, now_s
        for index, publishers in zip(self.members, self._publishers, strict=True):
            state, difficulty = messages[index]
            if len(self.members) == 1:
                self.conditions.keep(index, tick, self._contents.condition(state))
                self.scores.keep(index, tick, self._contents.scores(difficulty))
            publishers.publish(state, difficulty)

    def forget(self, tick: int) -> None:
        """A new episode after `tick`: nothing is known, and what was published until then is ignored."""
        self.conditions.forget(tick, len(self._misses))
        self.scores.forget(tick, len(self._misses))

    def await_peers(self, deadline_s: float) -> list[int]:
        """Wait for the token of every arm; returns the arms whose token did not appear before the deadline."""
        while (missing := len(self._misses) - len(self._present)) and time.monotonic() < deadline_s:
            self.client.serve(deadline_s, at_least=missing)
        return [index for index in range(len(self._misses)) if index not in self._present]

    def await_messages(self, deadline_s: float) -> list[int]:
        """Wait for the messages of this step; returns the peers that were not received, for whatever reason."""
        while missing := self._missing():
            if not self.client.serve(deadline_s, at_least=missing) and time.monotonic() >= deadline_s:
                break
        missed = []
        for sender, tick in enumerate(map(min, self.scores.ticks, self.conditions.ticks)):
            self._misses[sender] = self._misses[sender] + 1 if tick < self._tick else 0
            if tick < self._tick:
                missed.append(sender)
        return missed

    def _missing(self) -> int:
        """Messages of this step that are still awaited."""
        return sum(
            ticks[sender] < self._tick
            for ticks in (self.conditions.ticks, self.scores.ticks)
            for sender in self._awaited
        )

    def _receive(self, arm: str, message: State | DifficultyScores) -> None:
        sender = self._index.get(arm)
        if sender is None:  # an arm of the fleet that this exchange does not simulate
            return
        tick, time_s = message.tick, message.time_s
        if tick > self._tick or time_s > self._now_s or (tick == self._tick and time_s != self._now_s):
            self.client.reject(
                f"{type(message).__name__} of '{arm}' is of step {tick} at {time_s} s, but it is step {self._tick} at "
                f"{self._now_s} s."
            )
        elif (
            self.conditions.keep(sender, tick, self._contents.condition(message))
            if isinstance(message, State)
            else self.scores.keep(sender, tick, self._contents.scores(message))
        ):
            # A silent peer that is received again gets one more chance to be in time.
            self._misses[sender] = min(self._misses[sender], SILENT_AFTER - 1)

    def _token(self, arm: str, there: bool) -> None:
        sender = self._index.get(arm)
        if sender is None:
            return
        if there:
            self._present.add(sender)
        else:
            self._present.discard(sender)
            self._awaited.discard(sender)


class _Publishers:
    """What one arm publishes with."""

    def __init__(self, client: BusClient, arm: str) -> None:
        self._arm = arm
        self._last_info: Info | None = None
        self._state = client.publisher(keys.of_arm(client.fleet, arm, "state"), State)
        self._difficulty = client.publisher(keys.of_arm(client.fleet, arm, "difficulty"), DifficultyScores)
        self._info = client.publisher(keys.of_arm(client.fleet, arm, "info"), Info)
        # Declared last: who sees the token knows that the router has the rest.
        client.declare_token(keys.of_arm(client.fleet, arm, "alive"))

    def publish(self, state: State, difficulty: DifficultyScores) -> None:
        """Publish the messages of one step, and the arm's constants when they have changed."""
        info = Info(arm=self._arm, joints=len(state.temp_c), twin=difficulty.twin)
        if info != self._last_info:
            self._info(info)
            self._last_info = info
        self._state(state)
        self._difficulty(difficulty)


def _nullable(values: Array) -> list[tuple[float | None, ...]]:
    """Rows of an array [arm, job], with None for NaN."""
    return [tuple(None if math.isnan(value) else float(value) for value in row) for row in values.tolist()]


def _numbers(values: tuple[float | None, ...]) -> list[float]:
    return [math.nan if value is None else value for value in values]
