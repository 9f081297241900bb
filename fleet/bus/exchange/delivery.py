"""Applies a channel to broadcasts: delays them, drops some, and keeps what every arm has received.

Both exchanges use it. Delay and loss depend on the channel, the time and the episode's random generator, never on the
content or the exchange. So a seed delays and loses the same broadcasts in memory and over Zenoh.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.protocol import AllConditions, AllScores, Array, Condition, Scores
from fleet.bus.protocol.messages import DifficultyScores, State


@dataclass(frozen=True, eq=False)
class _Batch:
    """The broadcasts of one step in transit."""

    tick: int
    due_s: Array
    """[receiver, sender]; inf for a broadcast that is lost, or has arrived."""
    conditions: AllConditions
    scores: AllScores


class Delivery:
    """The broadcasts that every arm has received through a channel, in one episode after the other.

    A lost broadcast is not sent again: its receiver keeps the last one. A broadcast that arrives after a later one is
    ignored. The time is that of the broadcasts.
    """

    def __init__(self, arms: Sequence[str], channel: Channel, rng: np.random.Generator | None = None) -> None:
        """Prepare a delivery without anything in transit.

        Args:
            rng: For loss and jitter, until `begin` brings another.

        Raises:
            ValueError: the channel names an arm that is not there.
        """
        self.delivered = 0
        """Broadcasts delivered to a peer, over all episodes."""
        self.late = 0
        """Broadcasts that were lost, or that the bus itself did not deliver in their step, over all episodes."""
        self._channel = channel
        self._linked = channel.links(arms)
        self._links = int(self._linked.sum())
        self._cuts = [(p.from_s, p.to_s, p.cuts(arms)) for p in channel.partitions]
        self._arms = len(arms)
        self._rng = rng
        self.begin(rng)

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """Begin an episode without broadcasts received or in transit; `rng` is for loss and jitter."""
        self._rng = rng or self._rng
        self.conditions: list[list[Condition | State | None]] = [[None] * self._arms for _ in range(self._arms)]
        """Last content received, [receiver][sender]."""
        self.scores: list[list[Scores | DifficultyScores | None]] = [[None] * self._arms for _ in range(self._arms)]
        self._tick = -1
        self._newest = np.full((self._arms, self._arms), -1)
        self._in_transit: list[_Batch] = []

    def carry(self, now_s: float, conditions: AllConditions, scores: AllScores) -> None:
        """Send the broadcasts of one step, and put everything that is due by now into `conditions` and `scores`.

        Args:
            conditions: As each receiver would have them without delay, [receiver][sender]; scores likewise.

        Raises:
            ValueError: the channel has loss or jitter, and no `rng` was given.
        """
        self._tick += 1
        self._in_transit.append(_Batch(self._tick, self._due_s(now_s), conditions, scores))
        # Tolerance: 0.1 + 0.2 must not arrive a step after 0.3.
        until_s = now_s + 1e-9 * max(1.0, abs(now_s))
        for batch in self._in_transit:
            self._deliver(batch, batch.due_s <= until_s)
        self._in_transit = [batch for batch in self._in_transit if np.isfinite(batch.due_s).any()]
        for arm in range(self._arms):
            self.conditions[arm][arm] = conditions[arm][arm]
            self.scores[arm][arm] = scores[arm][arm]

    def _due_s(self, now_s: float) -> Array:
        """When each broadcast of this step arrives, [receiver, sender]; inf for lost ones."""
        channel, shape = self._channel, self._linked.shape
        due_s = np.where(self._linked, now_s + channel.delay_s, np.inf)
        if channel.by_chance:
            if self._rng is None:
                raise ValueError("A channel with loss or jitter needs an rng; pass one to begin().")
            # Always draws both, so that a change of jitter does not change which broadcasts are lost.
            lost, longer = self._rng.random((2, *shape))
            due_s += channel.jitter_s * longer
            due_s[lost < channel.loss] = np.inf
        for from_s, to_s, cut in self._cuts:
            if now_s < to_s:
                due_s[cut & (due_s >= from_s)] = np.inf
        self.late += self._links - int(np.isfinite(due_s).sum())
        return due_s

    def _deliver(self, batch: _Batch, due: Array) -> None:
        """Deliver the due broadcasts of a batch: count all, keep those newer than the last."""
        news = due & (self._newest < batch.tick)
        batch.due_s[due] = np.inf
        for receiver in np.flatnonzero(due.any(axis=1)).tolist():
            conditions, scores = batch.conditions[receiver], batch.scores[receiver]
            senders = np.flatnonzero(due[receiver]).tolist()
            missing = [s for s in senders if conditions[s] is None or scores[s] is None]
            self.delivered += len(senders) - len(missing)
            self.late += len(missing)
            news[receiver, missing] = False
            for sender in np.flatnonzero(news[receiver]).tolist():
                self.conditions[receiver][sender] = conditions[sender]
                self.scores[receiver][sender] = scores[sender]
        self._newest[news] = batch.tick
