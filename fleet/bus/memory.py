"""The exchange without a bus: for training and sweeps, and to judge a policy on a channel that is not perfect."""

from collections.abc import Sequence
from typing import Self

import numpy as np

from fleet.bus.channel import PERFECT, Channel
from fleet.bus.delivery import Delivery
from fleet.bus.exchange import Condition, Heard, Scores, Words, assemble, check, check_order, checked_arms
from fleet.errors import BusError


class MemoryExchange:
    """Hands words over in memory, as a channel lets them. Times are those of the words; the exchange has no clock."""

    def __init__(
        self, arms: Sequence[str], channel: Channel = PERFECT, *, rng: np.random.Generator | None = None
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            rng: For a channel with loss or jitter, until `begin` brings another.

        Raises:
            ValueError: the channel speaks of an arm that is not there.
        """
        self.arms = checked_arms(arms)
        self.delivered = 0
        self.malformed = 0
        self.late = 0
        self._delivery = None if channel.perfect else Delivery(self.arms, channel, rng)
        self._now_s = -float("inf")
        self._closed = False

    @property
    def perfect(self) -> bool:
        """Whether every arm hears every other at once, always."""
        return self._delivery is None

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """A new episode: forget what was heard and what is on its way; chance comes from `rng` from now on."""
        self._now_s = -float("inf")
        if self._delivery is not None:
            self._delivery.begin(rng)

    def share(self, words: Words) -> Heard:
        """Say the words of one tick, and return what every arm knows thereafter.

        Raises:
            ValueError: the words do not fit the arms, or hold numbers that cannot be said; or the channel draws by
                chance, and there is no rng.
            BusError: the exchange is closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        check(words, self.arms)
        check_order(words.time_s, self._now_s)
        self._now_s = now_s = float(words.time_s)
        conditions, scores = _spoken(words)
        arms = len(self.arms)
        to_all, all_scores = [conditions] * arms, [scores] * arms
        if self._delivery is None:
            self.delivered += arms * (arms - 1)
            return assemble(now_s, words.jobs, to_all, all_scores)
        self._delivery.carry(now_s, to_all, all_scores)
        self.delivered, self.late = self._delivery.delivered, self._delivery.late
        return assemble(now_s, words.jobs, self._delivery.conditions, self._delivery.scores)

    def close(self) -> None:
        """Let go of everything; twice is fine."""
        self._closed = True
        self.begin()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _spoken(words: Words) -> tuple[list[Condition], list[Scores]]:
    """What every arm says, [arm]; copies, as the caller may fill the same arrays again at the next tick."""
    difficulty, p_saturation = np.array(words.difficulty, dtype=float), np.array(words.p_saturation, dtype=float)
    time_s = float(words.time_s)
    conditions = [
        Condition(time_s, mode, headroom)
        for mode, headroom in zip(words.mode.tolist(), words.headroom_k.tolist(), strict=True)
    ]
    return conditions, [Scores(time_s, words.jobs, d, p) for d, p in zip(difficulty, p_saturation, strict=True)]
