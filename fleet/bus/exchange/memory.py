"""The exchange without a bus: for training, for sweeps, and for tests of a policy on a channel that is not perfect."""

from collections.abc import Sequence
from typing import Self

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.bus.exchange.delivery import Delivery
from fleet.bus.exchange.protocol import (
    Broadcast,
    Condition,
    PeerView,
    Scores,
    assemble,
    check,
    check_order,
    checked_arms,
)
from fleet.errors import BusError
from fleet.telemetry import MODES


class MemoryExchange:
    """Shares broadcasts in memory through a channel, on the time of the broadcasts."""

    def __init__(
        self, arms: Sequence[str], channel: Channel = PERFECT, *, rng: np.random.Generator | None = None
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            rng: For a channel with loss or jitter, until `begin` brings another.

        Raises:
            ValueError: the channel names an arm that is not there.
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
        """Whether every arm receives every broadcast at once."""
        return self._delivery is None

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """Begin an episode without messages received or in transit; `rng` is for channels with loss or jitter."""
        self._now_s = -float("inf")
        if self._delivery is not None:
            self._delivery.begin(rng)

    def share(self, broadcast: Broadcast) -> PeerView:
        """Broadcast one step, and return what every arm knows after it.

        Raises:
            ValueError: the broadcast does not fit the arms or holds infinite numbers; or the channel has loss or
                jitter, and there is no rng.
            BusError: the exchange is closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        check(broadcast, self.arms)
        check_order(broadcast.time_s, self._now_s)
        self._now_s = now_s = float(broadcast.time_s)
        conditions, scores = _contents_of(broadcast)
        arms = len(self.arms)
        to_all, all_scores = [conditions] * arms, [scores] * arms
        if self._delivery is None:
            self.delivered += arms * (arms - 1)
            return assemble(now_s, broadcast.jobs, to_all, all_scores)
        self._delivery.carry(now_s, to_all, all_scores)
        self.delivered, self.late = self._delivery.delivered, self._delivery.late
        return assemble(now_s, broadcast.jobs, self._delivery.conditions, self._delivery.scores)

    def close(self) -> None:
        """Release all resources; may be called twice."""
        self._closed = True
        self.begin()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _contents_of(broadcast: Broadcast) -> tuple[list[Condition], list[Scores]]:
    """Contents of a broadcast, [arm]; copies, as the caller may reuse its arrays at the next step."""
    difficulty, p_saturation = (
        np.array(broadcast.difficulty, dtype=float),
        np.array(broadcast.p_saturation, dtype=float),
    )
    time_s = float(broadcast.time_s)
    conditions = [
        Condition(time_s, MODES[mode], headroom_k, busy_s)
        for mode, headroom_k, busy_s in zip(
            broadcast.mode.tolist(), broadcast.headroom_k.tolist(), broadcast.busy_s.tolist(), strict=True
        )
    ]
    return conditions, [Scores(time_s, broadcast.jobs, d, p) for d, p in zip(difficulty, p_saturation, strict=True)]
