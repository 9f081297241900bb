"""What a channel does to the words of a fleet: holds them back, loses some, and knows what every arm has by now.

Both exchanges hand what was said to a `Delivery` and show what it lets through. What becomes of a word depends on
the channel, the time and the chance of the episode, never on what it says or who carries it, so the same seed loses
and delays the same words in memory and over Zenoh.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.bus.channel import Channel
from fleet.bus.exchange import Array, Condition, Scores

Conditions = Sequence[Sequence[Condition | None]]
"""[receiver][sender]; None for a word that did not come."""
Said = Sequence[Sequence[Scores | None]]


@dataclass(frozen=True, eq=False)
class _Batch:
    """The words of one tick on their way."""

    tick: int
    due_s: Array
    """[receiver, sender]; inf for a word that does not come, or came already."""
    conditions: Conditions
    scores: Said


class Delivery:
    """The words that every arm has of every other, under a channel; one episode after the other.

    A word that is lost is not said again: its receiver keeps the last one it had. A word that overtakes another stays:
    what comes later, but was said earlier, is not news. Times are those of the words; there is no clock.
    """

    def __init__(self, arms: Sequence[str], channel: Channel, rng: np.random.Generator | None = None) -> None:
        """Nothing is on its way yet.

        Args:
            rng: For loss and jitter, until `begin` brings another.

        Raises:
            ValueError: the channel speaks of an arm that is not there.
        """
        self.delivered = 0
        """Words that reached a peer, over all episodes."""
        self.late = 0
        """Words that are lost, or that the bus itself did not bring in their tick, over all episodes."""
        self._channel = channel
        self._hears = channel.hears(arms)
        self._links = int(self._hears.sum())
        self._cuts = [(p.from_s, p.to_s, p.cuts(arms)) for p in channel.partitions]
        self._arms = len(arms)
        self._rng = rng
        self.begin(rng)

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """A new episode: forget what was heard and what is on its way; chance comes from `rng` from now on."""
        self._rng = rng or self._rng
        self.conditions: list[list[Condition | None]] = [[None] * self._arms for _ in range(self._arms)]
        """The last that each arm has of each, [receiver][sender]."""
        self.scores: list[list[Scores | None]] = [[None] * self._arms for _ in range(self._arms)]
        self._tick = -1
        self._known = np.full((self._arms, self._arms), -1)
        self._under_way: list[_Batch] = []

    def carry(self, now_s: float, conditions: Conditions, scores: Said) -> None:
        """Take the words of one tick, and hand over all that is due by now into `conditions` and `scores`.

        Args:
            conditions: What was said as each receiver would have it at once, [receiver][sender]; the same for scores.

        Raises:
            ValueError: the channel draws by chance, and no `rng` was given.
        """
        self._tick += 1
        self._under_way.append(_Batch(self._tick, self._due_s(now_s), conditions, scores))
        # A hair of slack: 0.1 + 0.2 must not come a tick after 0.3.
        until_s = now_s + 1e-9 * max(1.0, abs(now_s))
        for batch in self._under_way:
            self._hand_over(batch, batch.due_s <= until_s)
        self._under_way = [batch for batch in self._under_way if np.isfinite(batch.due_s).any()]
        for arm in range(self._arms):
            self.conditions[arm][arm] = conditions[arm][arm]
            self.scores[arm][arm] = scores[arm][arm]

    def _due_s(self, now_s: float) -> Array:
        """When each word of now arrives, [receiver, sender]; inf for those that do not."""
        channel, shape = self._channel, self._hears.shape
        due_s = np.where(self._hears, now_s + channel.delay_s, np.inf)
        if channel.by_chance:
            if self._rng is None:
                raise ValueError("A channel with loss or jitter needs an rng to draw from: begin(rng) gives it one.")
            # Both are drawn always, so that more jitter does not lose other words.
            lost, longer = self._rng.random((2, *shape))
            due_s += channel.jitter_s * longer
            due_s[lost < channel.loss] = np.inf
        for from_s, to_s, cut in self._cuts:
            if now_s < to_s:
                due_s[cut & (due_s >= from_s)] = np.inf
        self.late += self._links - int(np.isfinite(due_s).sum())
        return due_s

    def _hand_over(self, batch: _Batch, due: Array) -> None:
        """Of a batch, what is due now; all that comes counts, but only what is newer is kept."""
        news = due & (self._known < batch.tick)
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
        self._known[news] = batch.tick
