"""The exchange of a simulated shift that is also on the bus: others can watch the shift, record it, or take part in it.

At each step an arm publishes its `state` and then its `difficulty`. It publishes `info` when it changes, and a
liveliness token shows that the arm is present. Arms know of their peers what an `Exchange` delivers, so the result
of a shift depends neither on the load of the machine nor on others on the bus.
"""

import logging
import math
import os
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NoReturn, Self

import numpy as np
import zenoh

from fleet.bus.client import BusClient
from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.bus.exchange.memory import Broadcast, Exchange, PeerView
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.router import Router, reachable
from fleet.errors import BusError
from fleet.telemetry import MODES

_LOG = logging.getLogger(__name__)

Array = np.ndarray


class ZenohExchange(Exchange):
    """An `Exchange` that publishes the messages of each step, through a router and a client in this process.

    Nothing is opened before the first `share` or the `with` block. One thread at a time may use an exchange. The bus
    carries every message, also those that the channel loses or delays.
    """

    def __init__(
        self,
        arms: Sequence[str],
        fleet: str,
        endpoint: str | None = None,
        *,
        channel: Channel = PERFECT,
        timeout_s: float = 2.0,
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            fleet: Name of the fleet, part of every key.
            endpoint: Of a router on loopback, as `tcp/127.0.0.1:7447`; None to start one on a free port.
            timeout_s: How long a router may take to reply, real seconds.

        Raises:
            BusError: the endpoint is not on loopback.
            ValueError: the channel names an arm that is not there.
        """
        super().__init__(arms, channel)
        if not 0 < timeout_s < math.inf:
            raise ValueError(f"timeout_s must be finite and > 0 (got {timeout_s}).")
        keys.chunk(fleet)
        self._fleet, self._timeout_s = fleet, timeout_s
        self._endpoint = None if endpoint is None else reachable(endpoint)
        self._publishers: list[_ArmPublishers] = []
        self._process = os.getpid()
        self._published = 0
        """Steps, over all episodes."""
        self._resources = ExitStack()

    def __getstate__(self) -> NoReturn:
        """Refuse to be copied or pickled.

        Raises:
            TypeError: always: its connections belong to it.
        """
        raise TypeError(
            "An exchange over Zenoh can be neither copied nor pickled: its connections belong to it. Make another "
            "environment, or use bus='memory'."
        )

    @property
    def perfect(self) -> bool:
        """Never: each step is published, too."""
        return False

    @property
    def endpoint(self) -> str | None:
        """Where the router listens; None before the exchange is open."""
        return self._endpoint

    def open(self) -> Self:
        """Start a router if no endpoint was given, and show every arm on the bus.

        Raises:
            BusError: no router, an arm of this name is already present, or closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        if self._publishers:
            return self
        with ExitStack() as stack:
            endpoint = self._endpoint or stack.enter_context(Router()).endpoint
            client = stack.enter_context(BusClient(endpoint, self._fleet, timeout_s=self._timeout_s))
            of_arms = keys.of_every_arm(self._fleet, "alive")
            present = client.tokens(of_arms)
            if taken := sorted(present & set(self.arms)):
                raise BusError(f"Fleet '{self._fleet}' already has {', '.join(taken)} on the bus at {endpoint}.")
            try:
                self._publishers = [_ArmPublishers(client, arm) for arm in self.arms]
            except zenoh.ZError as error:
                raise BusError(f"The bus at {endpoint} could not be opened: {error}") from error
            client.tokens(of_arms)  # replied in order: the router has the tokens, and the next to ask gets them
            self._endpoint, self._resources = endpoint, stack.pop_all()
        return self

    def share(self, broadcast: Broadcast) -> PeerView:
        """Publish the broadcast of one step, and return the view of every arm after it.

        Raises:
            ValueError: as an `Exchange`.
            BusError: the bus could not be opened, was lost, or is closed.
        """
        if self._process != os.getpid():
            raise BusError(
                f"This exchange belongs to process {self._process}: a forked process has none of its connections. Make "
                "the environment in the process that steps it, or use bus='memory'."
            )
        view = super().share(broadcast)
        self.open()
        messages = messages_of(broadcast, self.arms, self._published)
        self._published += 1
        try:
            for publishers, (state, difficulty) in zip(self._publishers, messages, strict=True):
                publishers.publish(state, difficulty)
        except zenoh.ZError as error:
            raise BusError(f"The bus at {self._endpoint} was lost: {error}") from error
        return view

    def close(self) -> None:
        """Disconnect the arms and stop the router; may be called twice.

        Raises:
            BusError: the client or the router did not close cleanly; the other is closed.
        """
        super().close()
        self._publishers = []
        try:
            self._resources.close()
        except (zenoh.ZError, BusError) as error:
            raise BusError(f"The exchange did not close cleanly: {error}") from error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        try:
            self.close()
        except BusError:
            if exc[0] is None:
                raise
            _LOG.exception("While closing after another error:")


class _ArmPublishers:
    """Publishers and token of one arm."""

    def __init__(self, client: BusClient, arm: str) -> None:
        self._constants: tuple[int, str] | None = None
        self._state = client.publisher(keys.of_arm(client.fleet, arm, "state"), State)
        self._difficulty = client.publisher(keys.of_arm(client.fleet, arm, "difficulty"), DifficultyScores)
        self._info = client.publisher(keys.of_arm(client.fleet, arm, "info"), Info)
        # Declared last: a participant that sees the token can be sure that the router has the publishers.
        client.declare_token(keys.of_arm(client.fleet, arm, "alive"))

    def publish(self, state: State, difficulty: DifficultyScores) -> None:
        """Publish the messages of one step, and the arm's constants when they have changed."""
        constants = len(state.temp_c), difficulty.twin
        if constants != self._constants:
            self._info(Info(state.arm, *constants))
            self._constants = constants
        self._state(state)
        self._difficulty(difficulty)


def messages_of(broadcast: Broadcast, arms: tuple[str, ...], tick: int) -> list[tuple[State, DifficultyScores]]:
    """The messages of one step, [arm]; empty slots are left out."""
    slots, time_s = [slot for slot, job in enumerate(broadcast.jobs) if job], float(broadcast.time_s)
    jobs, p_saturation = tuple(broadcast.jobs[slot] for slot in slots), broadcast.p_saturation[:, slots]
    duration_s, peak_c = broadcast.duration_s[:, slots], broadcast.peak_c[:, slots]
    lacks_peak = np.any(~np.isnan(duration_s) & np.isnan(peak_c), axis=(1, 2)).tolist()
    difficulty, least_p = _nullable(broadcast.difficulty[:, slots], 4), _nullable(np.fmin.reduce(p_saturation, -1), 3)
    bid_s, bid_c, bid_p = _nullable(duration_s, 1), _nullable(peak_c, 1), _nullable(p_saturation, 3)
    mode, temp_c = broadcast.mode.tolist(), broadcast.temp_c.tolist()
    headroom_k, busy_s = broadcast.headroom_k.tolist(), broadcast.busy_s.tolist()
    return [
        (
            State(arm, tick, time_s, MODES[mode[a]], tuple(temp_c[a]), headroom_k[a], busy_s=busy_s[a]),
            DifficultyScores(
                *(arm, tick, time_s, broadcast.twin[a], jobs, difficulty[a], least_p[a]),
                bid_duration_s=bid_s[a],
                bid_peak_c=bid_c[a],
                bid_p_saturation=bid_p[a] if lacks_peak[a] else (),
            ),
        )
        for a, arm in enumerate(arms)
    ]


def _nullable(values: Array, digits: int) -> list[tuple[float | None, ...]]:
    """Rows of an array [arm, ...], rounded, with None for NaN."""
    values = values.reshape(len(values), -1)
    nullable = values.round(digits).astype(object)
    nullable[np.isnan(values)] = None
    return [tuple(row) for row in nullable.tolist()]
