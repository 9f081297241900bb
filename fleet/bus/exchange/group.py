"""Arms of a simulated shift that share clients: their publications and the messages they received."""

import math
import time
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from fleet.bus.client.client import BusClient
from fleet.bus.exchange.protocol import Array, Broadcast
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.telemetry import MODES

Message = TypeVar("Message", State, DifficultyScores)

_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.0002, 0.002
"""Pauses between two checks for new messages. Waking for every message costs more: it takes the GIL from publishers."""
SILENT_AFTER = 3
"""A peer that missed this many steps in a row is not waited for until one of its messages arrives."""


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
        broadcast.busy_s.tolist(),
        broadcast.twin,
        _nullable(broadcast.difficulty[:, slots]),
        _nullable(broadcast.p_saturation[:, slots]),
        strict=True,
    )
    return [
        (
            State(arm, tick, time_s, MODES[mode], tuple(temp_c), headroom_k, busy_s=busy_s),
            DifficultyScores(arm, tick, time_s, twin, jobs, difficulty, p_saturation),
        )
        for arm, mode, temp_c, headroom_k, busy_s, twin, difficulty, p_saturation in columns
    ]


class _Latest(Generic[Message]):
    """The newest message of one topic from each sender."""

    def __init__(self, arms: int) -> None:
        self.forget(-1, arms)

    def forget(self, tick: int, arms: int) -> None:
        """Remove all messages, and accept none of `tick` or before."""
        self.ticks = [tick] * arms
        self.last: list[Message | None] = [None] * arms

    def keep(self, sender: int, message: Message) -> bool:
        """Keep the message if it is newer than the last one of its sender, and return whether it is."""
        if message.tick <= self.ticks[sender]:
            return False
        self.ticks[sender], self.last[sender] = message.tick, message
        return True

    def of(self, tick: int) -> list[Message | None]:
        """The messages of a step, [sender]."""
        return [message if ours == tick else None for ours, message in zip(self.ticks, self.last, strict=True)]


class Group:
    """The arms that share clients, and the messages they received; in small fleets one arm.

    Attributes:
        members: Indices of these arms in the fleet.
        reader: The client that receives.
    """

    def __init__(self, client: BusClient, reader: BusClient, arms: tuple[str, ...], members: Sequence[int]) -> None:
        """Declare the publishers and tokens of these arms with `client`, their subscribers with `reader`.

        Several arms need two clients, so that what they receive of each other passes the router, too.
        """
        self.reader, self.members = reader, tuple(members)
        self._index = {arm: index for index, arm in enumerate(arms)}
        self._tick, self._now_s = -1, -math.inf
        self._present: set[int] = set()
        self._awaited: set[int] = set()
        """Present since the step began."""
        self.conditions = _Latest[State](len(arms))
        self.scores = _Latest[DifficultyScores](len(arms))
        self._misses = [0] * len(arms)
        """Steps in a row in which a peer was not received."""
        fleet = client.fleet
        # A single arm has its own messages without the bus.
        states, scores = keys.of_every_arm(fleet, "state"), keys.of_every_arm(fleet, "difficulty")
        reader.subscribe(states, State, self._receive, own=False, wake=False)
        reader.subscribe(scores, DifficultyScores, self._receive, history=True, own=False, wake=False)
        reader.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)
        self._publishers = [_Publishers(client, arms[index]) for index in self.members]

    def begin_step(self, tick: int, now_s: float) -> None:
        """Handle the messages that arrived since the last step, `tick`, and choose the peers to wait for."""
        self._tick, self._now_s = tick, now_s
        self.reader.serve()
        self._awaited = {sender for sender in self._present if self._misses[sender] < SILENT_AFTER}

    def publish(self, tick: int, now_s: float, messages: Sequence[tuple[State, DifficultyScores]]) -> None:
        """Publish these arms' messages of one step, given those of the whole fleet, [arm]."""
        self._tick, self._now_s = tick, now_s
        for index, publishers in zip(self.members, self._publishers, strict=True):
            state, difficulty = messages[index]
            if len(self.members) == 1:
                self.conditions.keep(index, state)
                self.scores.keep(index, difficulty)
            publishers.publish(state, difficulty)

    def forget(self, tick: int) -> None:
        """Begin a new episode after `tick`: remove all messages, and ignore those published until then."""
        self.conditions.forget(tick, len(self._misses))
        self.scores.forget(tick, len(self._misses))

    def await_peers(self, deadline_s: float) -> list[int]:
        """Wait for the token of every arm, and return the arms without one at the deadline."""
        while (missing := len(self._misses) - len(self._present)) and time.monotonic() < deadline_s:
            self.reader.serve(deadline_s, at_least=missing)
        return [index for index in range(len(self._misses)) if index not in self._present]

    def await_messages(self, deadline_s: float) -> list[int]:
        """Wait for the messages of this step, and return the peers of which one is missing."""
        pause_s, late = _SHORTEST_PAUSE_S, False
        self.reader.serve()
        while self._missing() and not late:
            late = time.monotonic() >= deadline_s  # what has arrived by then is handled once more
            self.reader.serve(min(deadline_s, time.monotonic() + pause_s))
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        missed = []
        for sender, tick in enumerate(map(min, self.scores.ticks, self.conditions.ticks)):
            self._misses[sender] = self._misses[sender] + 1 if tick < self._tick else 0
            if tick < self._tick:
                missed.append(sender)
        return missed

    def _missing(self) -> bool:
        """Whether a message of this step is awaited."""
        ticks = self.conditions.ticks, self.scores.ticks
        return any(of[sender] < self._tick for of in ticks for sender in self._awaited)

    def _receive(self, arm: str, message: State | DifficultyScores) -> None:
        sender = self._index.get(arm)
        if sender is None:  # an arm of the fleet that this exchange does not simulate
            return
        tick, time_s = message.tick, message.time_s
        if tick > self._tick or time_s > self._now_s or (tick == self._tick and time_s != self._now_s):
            self.reader.reject(
                f"{type(message).__name__} of '{arm}' is of step {tick} at {time_s} s, but it is step {self._tick} at "
                f"{self._now_s} s."
            )
        elif self.conditions.keep(sender, message) if isinstance(message, State) else self.scores.keep(sender, message):
            # A silent peer that is received again gets one more chance to be in time.
            self._misses[sender] = min(self._misses[sender], SILENT_AFTER - 1)

    def _token(self, arm: str, present: bool) -> None:
        sender = self._index.get(arm)
        if sender is None:
            return
        if present:
            self._present.add(sender)
        else:
            self._present.discard(sender)
            self._awaited.discard(sender)


class _Publishers:
    """Publishers and token of one arm."""

    def __init__(self, client: BusClient, arm: str) -> None:
        self._constants: tuple[int, str] | None = None
        self._state = client.publisher(keys.of_arm(client.fleet, arm, "state"), State)
        self._difficulty = client.publisher(keys.of_arm(client.fleet, arm, "difficulty"), DifficultyScores)
        self._info = client.publisher(keys.of_arm(client.fleet, arm, "info"), Info)
        # Declared last: whoever sees the token can be sure that the router has the publishers.
        client.declare_token(keys.of_arm(client.fleet, arm, "alive"))

    def publish(self, state: State, difficulty: DifficultyScores) -> None:
        """Publish the messages of one step, and the arm's constants when they have changed."""
        constants = len(state.temp_c), difficulty.twin
        if constants != self._constants:
            self._info(Info(state.arm, *constants))
            self._constants = constants
        self._state(state)
        self._difficulty(difficulty)


def _nullable(values: Array) -> list[tuple[float | None, ...]]:
    """Rows of an array [arm, job], with None for NaN."""
    nullable = values.astype(object)
    nullable[np.isnan(values)] = None
    return [tuple(row) for row in nullable.tolist()]
