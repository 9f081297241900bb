"""The exchange without a bus: for training and sweeps, and to judge a policy under delay, loss or a sparse graph."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import networkx as nx
import numpy as np

from fleet.bus.exchange import Array, Condition, Heard, Scores, Words, assemble, check, check_order, checked_arms
from fleet.errors import BusError, nearest


@dataclass(frozen=True, eq=False)
class _Spoken:
    """The words of one tick on their way."""

    due_s: float
    conditions: list[Condition]
    scores: list[Scores]
    reaches: Array
    """bool, [receiver, sender]: not lost on the way."""


class MemoryExchange:
    """Hands words over in memory, after a delay, along the edges of a graph, some of them lost.

    Every word is lost on its own with probability `loss`. A lost word is not said again: its receiver keeps the last
    one it had. Times are those of the words; the exchange has no clock.
    """

    def __init__(
        self,
        arms: Sequence[str],
        *,
        graph: nx.Graph | None = None,
        delay_s: float = 0.0,
        loss: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            graph: Who hears whom: an edge lets both ends hear each other, a directed one its head hear its tail.
                Every arm hears every other without it; an arm that is no node of it is alone.
            delay_s: How long every word takes, simulation seconds.
            loss: Probability that a word is lost, [0, 1]; needs an `rng`.
        """
        self.arms = checked_arms(arms)
        if not 0 <= delay_s < float("inf"):
            raise ValueError(f"delay_s must be finite and >= 0 (got {delay_s}).")
        if not 0 <= loss <= 1:
            raise ValueError(f"loss must be a probability (got {loss}).")
        if loss and rng is None:
            raise ValueError("A lossy exchange needs an rng to draw from.")
        self.delivered = 0
        self.malformed = 0
        self.late = 0
        self._delay_s = delay_s
        self._loss = loss
        self._rng = rng
        self._hears = _hearing(self.arms, graph)
        self._closed = False
        self._forget()

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """A new episode: forget what was heard and what is on its way; losses are drawn from `rng` from now on."""
        self._forget()
        if rng is not None:
            self._rng = rng

    def share(self, words: Words) -> Heard:
        """Say the words of one tick, and return what every arm knows thereafter.

        Raises:
            ValueError: the words do not fit the arms, or hold numbers that cannot be said.
            BusError: the exchange is closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        check(words, self.arms)
        check_order(words.time_s, self._now_s)
        self._now_s = now_s = float(words.time_s)
        spoken = self._speak(words)
        self._on_the_way.append(spoken)
        # A hair of slack: 0.1 + 0.2 must not come a tick after 0.3.
        while self._on_the_way and self._on_the_way[0].due_s <= now_s + 1e-9 * max(1.0, abs(now_s)):
            self._hear(self._on_the_way.popleft())
        for arm, (condition, scores) in enumerate(zip(spoken.conditions, spoken.scores, strict=True)):
            self._conditions[arm][arm] = condition
            self._scores[arm][arm] = scores
        return assemble(now_s, words.jobs, self._conditions, self._scores)

    def close(self) -> None:
        """Let go of everything; twice is fine."""
        self._closed = True
        self._forget()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _forget(self) -> None:
        arms = len(self.arms)
        self._now_s = -float("inf")
        self._on_the_way: deque[_Spoken] = deque()
        self._conditions: list[list[Condition | None]] = [[None] * arms for _ in range(arms)]
        self._scores: list[list[Scores | None]] = [[None] * arms for _ in range(arms)]

    def _speak(self, words: Words) -> _Spoken:
        # Copies: the caller may fill the same arrays again at the next tick.
        difficulty, p_saturation = np.array(words.difficulty, dtype=float), np.array(words.p_saturation, dtype=float)
        time_s = float(words.time_s)
        conditions = [
            Condition(time_s, mode, headroom)
            for mode, headroom in zip(words.mode.tolist(), words.headroom_k.tolist(), strict=True)
        ]
        scores = [Scores(time_s, words.jobs, d, p) for d, p in zip(difficulty, p_saturation, strict=True)]
        reaches = self._hears
        if self._loss:
            assert self._rng is not None
            reaches = reaches & (self._rng.random(reaches.shape) >= self._loss)
        return _Spoken(time_s + self._delay_s, conditions, scores, reaches)

    def _hear(self, spoken: _Spoken) -> None:
        came = int(spoken.reaches.sum())
        self.delivered += came
        self.late += int(self._hears.sum()) - came
        for receiver, sender in np.argwhere(spoken.reaches).tolist():
            self._conditions[receiver][sender] = spoken.conditions[sender]
            self._scores[receiver][sender] = spoken.scores[sender]


def _hearing(arms: tuple[str, ...], graph: nx.Graph | None) -> Array:
    """bool, [receiver, sender], never of oneself."""
    if graph is None:
        return ~np.eye(len(arms), dtype=bool)
    strangers = [node for node in graph if node not in arms]
    if strangers:
        raise ValueError(f"No arm '{strangers[0]}' to be a node of the graph{nearest(str(strangers[0]), arms)}")
    hears = np.zeros((len(arms), len(arms)), dtype=bool)
    place = {arm: index for index, arm in enumerate(arms)}
    for tail, head in graph.edges():
        hears[place[head], place[tail]] = True
        if not graph.is_directed():
            hears[place[tail], place[head]] = True
    np.fill_diagonal(hears, False)
    return hears
