"""What arms of a simulated shift broadcast at each step, through a channel that may delay and lose messages.

`Exchange` delivers; `fleet.bus.exchange.zenoh.ZenohExchange` also publishes the messages on the bus. Delay and loss
depend on the channel, the time and the random generator of the episode, never on the content: a seed delays and loses
the same broadcasts under every policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fleet.bus.exchange.channel import PERFECT, Channel
from fleet.errors import BusError

Array = np.ndarray

UNHEARD = -1
"""Mode of an arm without a received broadcast."""


@dataclass(frozen=True, eq=False)
class Broadcast:
    """Broadcasts of every arm at one step."""

    time_s: float
    mode: Array
    """int, [arm]: 0 idle, 1 working, 2 faulted."""
    temp_c: Array
    """Measured motor temperatures, [arm, joint]."""
    headroom_k: Array
    """Warning limit minus hottest motor, [arm]."""
    busy_s: Array
    """Time until home with the current job done, [arm]."""
    jobs: tuple[str, ...]
    """Names of the open jobs, [slot]; "" for an empty slot, which is not broadcast."""
    difficulty: Array
    """[arm, slot], NaN where the arm has no score or cannot do the job."""
    duration_s: Array
    """Time that each plan for the job takes, [arm, slot, plan], NaN where the arm has none."""
    peak_c: Array
    """Predicted peak, °C, [arm, slot, plan], NaN where unknown."""
    p_saturation: Array
    """[arm, slot, plan], NaN where unknown."""
    twin: tuple[str, ...]
    """Twin version per arm."""


@dataclass(frozen=True, eq=False)
class PeerView:
    """Last broadcast that every arm has of every arm after a step, [receiver, sender, ...]; its own at once."""

    mode: Array
    """int, [receiver, sender]; UNHEARD if nothing was received."""
    headroom_k: Array
    """[receiver, sender], NaN if nothing was received."""
    busy_s: Array
    """[receiver, sender], NaN if nothing was received."""
    difficulty: Array
    """[receiver, sender, slot] for the present slots (matched by job name), NaN where not broadcast."""
    duration_s: Array
    """[receiver, sender, slot, plan], NaN where not broadcast; likewise the next two."""
    peak_c: Array
    p_saturation: Array
    age_s: Array
    """[receiver, sender]: simulation seconds since that broadcast; inf if nothing was received."""


class Exchange:
    """Shares broadcasts in memory through a channel, on the time of the broadcasts.

    A lost broadcast is not sent again: its receiver keeps the last one. A broadcast that arrives after a later one is
    ignored.

    Attributes:
        arms: Names of the arms.
        delivered: Broadcasts delivered to a peer, over all episodes; one per receiver and sender.
        late: Broadcasts that were lost on the channel, over all episodes.
    """

    def __init__(self, arms: Sequence[str], channel: Channel = PERFECT) -> None:
        """Prepare an exchange between `arms`.

        Raises:
            ValueError: no arm, an empty name, a name twice, or the channel names an unknown arm.
        """
        self.arms = tuple(arms)
        if not self.arms or not all(self.arms) or len(set(self.arms)) != len(self.arms):
            raise ValueError(f"An exchange needs arms with different, non-empty names (got {self.arms}).")
        self.delivered = self.late = 0
        self._channel, self._linked = channel, channel.links(self.arms)
        self._cuts = [(p.from_s, p.to_s, p.cuts(self.arms)) for p in channel.partitions]
        self._rng: np.random.Generator | None = None
        self._closed = False
        self.begin()

    @property
    def perfect(self) -> bool:
        """Whether every arm receives every broadcast at once."""
        return self._channel.perfect

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """Begin an episode without messages received or in transit; `rng` is for channels with loss or jitter."""
        self._rng = rng or self._rng
        self._now_s, self._tick = -np.inf, -1
        self._newest = np.full(self._linked.shape, -1)
        self._sent: dict[int, Broadcast] = {}
        """Last broadcasts received by an arm, and those in transit, by tick."""
        self._due_s: dict[int, Array] = {}
        """When the broadcasts of each tick in transit arrive, [receiver, sender]; inf for one that is lost, or has
        arrived."""

    def share(self, broadcast: Broadcast) -> PeerView:
        """Broadcast one step, and return the view of every arm after it.

        Raises:
            ValueError: it is older than the last broadcast; or the channel has loss or jitter, and there is no rng.
            BusError: the exchange is closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        if broadcast.time_s < self._now_s:
            sent_s, last_s = f"{broadcast.time_s:g} s", f"{self._now_s:g} s"
            raise ValueError(f"Broadcast of {sent_s} after that of {last_s}; begin() starts a new episode.")
        self._now_s = broadcast.time_s
        received = self._carry(self._now_s)
        self._sent[self._tick] = broadcast
        kept = self._due_s.keys() | set(np.unique(received).tolist())
        self._sent = {tick: sent for tick, sent in self._sent.items() if tick in kept}
        return _view(broadcast, received, self._sent)

    def close(self) -> None:
        """Release all resources; may be called twice."""
        self._closed = True
        self.begin()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _carry(self, now_s: float) -> Array:
        """Send the broadcasts of the next tick, and deliver everything that is due by now.

        Returns:
            Tick of the last broadcast that each arm has of each arm, [receiver, sender]; −1 for none. An arm has its
            own at once.
        """
        self._tick += 1
        self._due_s[self._tick] = self._send(now_s)
        # Tolerance: 0.1 + 0.2 must not arrive a step after 0.3.
        until_s = now_s + 1e-9 * max(1.0, abs(now_s))
        for tick, due_s in self._due_s.items():
            due = due_s <= until_s
            due_s[due] = np.inf
            self.delivered += int(due.sum())
            self._newest[due] = np.maximum(self._newest[due], tick)
        self._due_s = {tick: due_s for tick, due_s in self._due_s.items() if np.isfinite(due_s).any()}
        received = self._newest.copy()
        np.fill_diagonal(received, self._tick)
        return received

    def _send(self, now_s: float) -> Array:
        """When each broadcast of this tick arrives, [receiver, sender]; inf for lost ones."""
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
        self.late += int(self._linked.sum()) - int(np.isfinite(due_s).sum())
        return due_s


_OF_ARMS = ("mode", "headroom_k", "busy_s")
_OF_JOBS = ("difficulty", "duration_s", "peak_c", "p_saturation")
"""Fields that a broadcast and a view have alike: [arm] and [arm, slot, ...]."""


def _view(now: Broadcast, received: Array, sent: dict[int, Broadcast]) -> PeerView:
    """The view of every arm, from the tick of the last broadcast that it has of each arm, [receiver, sender]."""
    shape = received.shape
    view = PeerView(
        mode=np.full(shape, UNHEARD),
        headroom_k=np.full(shape, np.nan),
        busy_s=np.full(shape, np.nan),
        **{name: np.full((*shape, *getattr(now, name).shape[1:]), np.nan) for name in _OF_JOBS},
        age_s=np.full(shape, np.inf),
    )
    for tick in np.unique(received[received >= 0]).tolist():
        then = sent[tick]
        receivers, senders = np.nonzero(received == tick)
        columns = {job: column for column, job in enumerate(then.jobs) if job}
        present = [slot for slot, job in enumerate(now.jobs) if job in columns]
        old = [columns[now.jobs[slot]] for slot in present]
        for name in _OF_ARMS:
            getattr(view, name)[receivers, senders] = getattr(then, name)[senders]
        view.age_s[receivers, senders] = now.time_s - then.time_s
        at = receivers[:, None], senders[:, None], present
        for name in _OF_JOBS:
            getattr(view, name)[at] = getattr(then, name)[senders[:, None], old]
    return view
