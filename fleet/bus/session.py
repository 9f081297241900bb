"""The exchange over Zenoh: one client session per arm, which knows of its peers only what it received itself.

A tick is two words per arm: `state` (telemetry: dropped under congestion, read through a ring) and `difficulty` (an
advanced publisher with cache and recovery, so that a gap is filled and a late joiner gets the last word). Both travel
the same link in this order, so whoever has the difficulty of a peer has its state, and waiting on one wakes for both.
`info` is said when it changes; a liveliness token says that an arm is there at all.

Zenoh's receiving threads only put samples into queues; every word is read on the thread that calls `share`.
"""

import logging
import math
import time
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
import zenoh
from zenoh import ext as advanced

from fleet.bus import keys
from fleet.bus.channel import PERFECT, Channel
from fleet.bus.delivery import Delivery
from fleet.bus.exchange import Condition, Heard, Scores, Words, assemble, check, check_order, checked_arms
from fleet.bus.inbox import Inbox, LastWords
from fleet.bus.messages import DifficultyWord, Info, State, encode, encoding
from fleet.bus.router import Router, open_client, reachable
from fleet.bus.security import Tls
from fleet.bus.wording import Reader, condition_of, scores_of, spoken
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

HEARTBEAT_S = 1.0
"""How soon after the last word its number is repeated, so that a lost last word is noticed."""
SILENT_AFTER = 3
"""Ticks that a peer may miss in a row before nobody waits for it until it is heard again."""
_LOOK_AGAIN_S = 0.002
_BACKLOG = 1024
"""Samples that one session keeps until they are read, for each topic; the oldest go first. A fleet that behaves needs
a few per arm, the rest is patience with strangers."""

_OPEN_TIMEOUT_S = 20.0


class _Client:
    """One arm on the bus: its session, what it says with, and what it has heard."""

    def __init__(self, session: zenoh.Session, fleet: str, arms: tuple[str, ...], index: int, reader: Reader) -> None:
        self._arm = arms[index]
        self._index = index
        self._reader = reader
        self._limit = max(_BACKLOG, 16 * len(arms))
        self._inbox = Inbox(self._limit)
        self.present: set[int] = set()
        """Arms whose liveliness token this arm sees."""
        self._awaited: set[int] = set()
        """Those of them that were there when the tick began, and have not been away since."""
        self.conditions = LastWords[Condition](len(arms))
        self.scores = LastWords[Scores](len(arms))
        self.misses = [0] * len(arms)
        """Ticks in a row in which a peer was not heard."""

        # Declared last is the token: whoever sees it knows that the router has the rest.
        self._ring = session.declare_subscriber(
            keys.of_every_arm(fleet, "state"),
            zenoh.handlers.RingChannel(self._limit),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        # On the receiving thread itself: a thread of Python's between would only hand on.
        hear: Any = zenoh.handlers.Callback(self._inbox.hear, indirect=False)
        self._difficulties = advanced.declare_advanced_subscriber(
            session,
            keys.of_every_arm(fleet, "difficulty"),
            hear,
            allowed_origin=zenoh.Locality.REMOTE,
            history=advanced.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=advanced.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._tokens = session.liveliness().declare_subscriber(keys.of_every_arm(fleet, "alive"), hear, history=True)
        self._state = session.declare_publisher(
            keys.of_arm(fleet, self._arm, "state"),
            encoding=encoding(State),
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        self._difficulty = _remembering_publisher(session, keys.of_arm(fleet, self._arm, "difficulty"), DifficultyWord)
        self._info = _remembering_publisher(session, keys.of_arm(fleet, self._arm, "info"), Info)
        self._said_info: Info | None = None
        self._token = session.liveliness().declare_token(keys.of_arm(fleet, self._arm, "alive"))

    def begin(self, tick: int, now_s: float) -> None:
        """Read what came since `tick`, the last one, and settle whom to wait for: words on a broken link never come."""
        self.drain(tick, now_s)
        self._awaited = {sender for sender in self.present if self.misses[sender] < SILENT_AFTER}

    def say(self, state: State, difficulty: DifficultyWord) -> None:
        """Publish the words of one tick, and who says them when that has changed."""
        info = Info(arm=self._arm, joints=len(state.temp_c), twin=difficulty.twin)
        if info != self._said_info:
            self._info.put(encode(info))
            self._said_info = info
        self._state.put(encode(state))
        self._difficulty.put(encode(difficulty))

    def know_own(self, tick: int, condition: Condition, scores: Scores) -> None:
        """An arm knows its own word without the bus."""
        self.conditions.keep(self._index, tick, condition)
        self.scores.keep(self._index, tick, scores)

    def forget(self, tick: int) -> None:
        """A new episode after `tick`: nothing is known, and what was said until then comes too late."""
        self.conditions.forget(tick)
        self.scores.forget(tick)

    def await_peers(self, arms: int, deadline_s: float) -> bool:
        """Whether every arm's token was seen before the deadline."""
        in_time = True
        while len(self.present) < arms and in_time:
            in_time = time.monotonic() < deadline_s
            self._inbox.wait(arms - len(self.present), deadline_s)
            self.drain(tick=-1, now_s=-math.inf)
        return len(self.present) == arms

    def drain(self, tick: int, now_s: float) -> None:
        """Read all that has come, without waiting."""
        for sample in self._inbox.take():
            self._take(sample, tick, now_s)
        for _ in range(self._limit):
            sample = self._ring.try_recv()
            if sample is None:
                break
            self._take(sample, tick, now_s)

    def listen(self, tick: int, now_s: float, deadline_s: float) -> list[int]:
        """Wait for the words of this tick; returns the peers that were not heard, for whatever reason."""
        in_time = True
        while in_time and (missing := self._missing(self.scores.ticks, tick)):
            in_time = time.monotonic() < deadline_s
            self._inbox.wait(len(missing), deadline_s)
            self.drain(tick, now_s)
        # As a rule not reached: a state travels ahead of its difficulty.
        while in_time and self._missing(self.conditions.ticks, tick):
            in_time = time.monotonic() < deadline_s
            self._inbox.wait(1, min(deadline_s, time.monotonic() + _LOOK_AGAIN_S))
            self.drain(tick, now_s)
        unheard = []
        for sender, heard in enumerate(map(min, self.scores.ticks, self.conditions.ticks)):
            self.misses[sender] = self.misses[sender] + 1 if heard < tick else 0
            if heard < tick:
                unheard.append(sender)
        return unheard

    def _missing(self, ticks: list[int], tick: int) -> list[int]:
        """Peers whose word of this tick is still awaited."""
        return [sender for sender, heard in enumerate(ticks) if heard < tick and sender in self._awaited]

    def _take(self, sample: zenoh.Sample, tick: int, now_s: float) -> None:
        """Read a sample and keep what is new."""
        key = str(sample.key_expr)
        place = self._reader.places.get(key)
        if place is None:
            self._reader.strange(key)
            return
        topic, sender = place
        if topic == "alive":
            if sample.kind == zenoh.SampleKind.PUT:
                self.present.add(sender)
            else:
                self.present.discard(sender)
                self._awaited.discard(sender)
            return
        read = self._reader.read(topic, sender, sample.payload.to_bytes(), str(sample.encoding))
        if read is None:
            return
        said_tick, word = read
        if said_tick > tick or word.time_s > now_s or (said_tick == tick and word.time_s != now_s):
            reason = f"speaks of tick {said_tick} at {word.time_s} s, but it is tick {tick} at {now_s} s"
            self._reader.refuse(key, reason)
        elif (
            self.conditions.keep(sender, said_tick, word)
            if isinstance(word, Condition)
            else self.scores.keep(sender, said_tick, word)
        ):
            # A silent peer that is heard again gets one more chance to be in time.
            self.misses[sender] = min(self.misses[sender], SILENT_AFTER - 1)


class ZenohExchange:
    """Hands words over through Zenoh: a router, and one client session per arm, all in this process.

    Nothing is opened before the first `share` or the `with` block. One thread at a time may use an exchange.

    A channel that is not perfect works at the receivers: the bus carries every word to every arm, and each holds back
    what the channel delays and drops what it loses, so that the fleet knows the same as with a `MemoryExchange`.
    """

    def __init__(
        self,
        arms: Sequence[str],
        fleet: str,
        endpoint: str | None = None,
        *,
        channel: Channel = PERFECT,
        tls: Path | None = None,
        timeout_s: float = 2.0,
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            fleet: Name of the fleet, part of every key.
            endpoint: Of a router on loopback, as `tcp/127.0.0.1:7447`; None for a router of its own on a free port.
            tls: Folder with a certificate of every arm (and of `router`, for a router of its own); the endpoint then
                begins with `tls/`, and may be anywhere.
            timeout_s: How long `share` waits for words that do not come.

        Raises:
            BusError: the endpoint is not on loopback.
            ValueError: the channel speaks of an arm that is not there.
        """
        self.arms = checked_arms(arms)
        if not 0 < timeout_s < math.inf:
            raise ValueError(f"timeout_s must be finite and > 0 (got {timeout_s}).")
        self.delivered = 0
        self.malformed = 0
        self.late = 0
        self._fleet = fleet
        self._tls = {arm: None if tls is None else Tls(tls, arm) for arm in self.arms}
        self._own_tls = None if tls is None else Tls(tls, "router")
        self._endpoint = None if endpoint is None else reachable(endpoint, self._tls[self.arms[0]])
        self._timeout_s = timeout_s
        self._reader = Reader(fleet, self.arms)
        self._delivery = None if channel.perfect else Delivery(self.arms, channel)
        self._clients: list[_Client] = []
        self._tick = -1
        self._now_s = -math.inf
        self._unheard: set[tuple[int, int]] = set()
        self._closed = False
        self._resources = ExitStack()
        # A process that ends without closing its sessions would hang.
        self._at_exit = weakref.finalize(self, self._resources.close)

    @property
    def endpoint(self) -> str | None:
        """Where the router listens; None before the exchange is open."""
        return self._endpoint

    def open(self) -> Self:
        """Start the router when none was given, connect every arm, and wait until all see each other.

        Raises:
            BusError: no router, an arm of this name is already there, the arms do not find each other, or closed.
        """
        if self._closed:
            raise BusError("This exchange is closed.")
        if self._clients:
            return self
        try:
            if self._endpoint is None:
                self._endpoint = self._resources.enter_context(Router(tls=self._own_tls)).endpoint
            sessions: list[zenoh.Session] = []
            for arm in self.arms:
                sessions.append(open_client(self._endpoint, timeout_s=self._timeout_s, tls=self._tls[arm]))
                self._resources.callback(sessions[-1].close)
            self._refuse_namesakes(sessions[0])
            self._clients = [
                _Client(session, self._fleet, self.arms, index, self._reader) for index, session in enumerate(sessions)
            ]
            deadline_s = time.monotonic() + _OPEN_TIMEOUT_S
            for arm, client in zip(self.arms, self._clients, strict=True):
                if not client.await_peers(len(self.arms), deadline_s):
                    unseen = ", ".join(self.arms[i] for i in range(len(self.arms)) if i not in client.present)
                    raise BusError(f"Arm '{arm}' did not see {unseen} on the bus within {_OPEN_TIMEOUT_S} s.")
        except zenoh.ZError as error:
            self._give_up()
            raise BusError(f"The bus at {self._endpoint} could not be opened: {error}") from error
        except BaseException:
            self._give_up()
            raise
        return self

    def begin(self, rng: np.random.Generator | None = None) -> None:
        """A new episode: forget what was heard; chance, where the channel has any, comes from `rng` from now on."""
        if self._delivery is not None:
            self._delivery.begin(rng)
        for client in self._clients:
            client.begin(self._tick, self._now_s)  # what waits to be read is of the last episode
            client.forget(self._tick)
        self._now_s = -math.inf

    def share(self, words: Words) -> Heard:
        """Say the words of one tick, and return what every arm knows thereafter.

        Waits until every arm has heard every peer that is present, at most `timeout_s`. A word that did not come in
        time leaves the last one known, with its age, and is counted in `late`.

        Raises:
            ValueError: the words do not fit the arms, or hold numbers that cannot be said; or the channel draws by
                chance, and there is no rng.
            BusError: the bus could not be opened, was lost, or is closed.
        """
        check(words, self.arms)
        check_order(words.time_s, self._now_s)
        self.open()
        for client in self._clients:
            client.begin(self._tick, self._now_s)
        self._tick += 1
        self._now_s = float(words.time_s)
        self._reader.forget()
        try:
            for client, (state, difficulty) in zip(self._clients, spoken(words, self.arms, self._tick), strict=True):
                client.know_own(self._tick, condition_of(state), scores_of(difficulty))
                client.say(state, difficulty)
        except zenoh.ZError as error:
            raise BusError(f"The bus at {self._endpoint} was lost: {error}") from error
        deadline_s = time.monotonic() + self._timeout_s
        unheard = {
            (receiver, sender)
            for receiver, client in enumerate(self._clients)
            for sender in client.listen(self._tick, self._now_s, deadline_s)
        }
        self._count(unheard)
        self.malformed = self._reader.malformed
        if self._delivery is None:
            conditions = [client.conditions.words for client in self._clients]
            scores = [client.scores.words for client in self._clients]
            return assemble(self._now_s, words.jobs, conditions, scores)
        # A word that the bus itself brings a tick late is lost: the channel asks for the words of this tick.
        conditions = [client.conditions.of(self._tick) for client in self._clients]
        scores = [client.scores.of(self._tick) for client in self._clients]
        self._delivery.carry(self._now_s, conditions, scores)
        self.delivered, self.late = self._delivery.delivered, self._delivery.late
        return assemble(self._now_s, words.jobs, self._delivery.conditions, self._delivery.scores)

    def close(self) -> None:
        """Disconnect every arm and stop the router; twice is fine.

        Raises:
            BusError: something did not close in order; everything else is closed all the same.
        """
        self._closed = True
        self._clients = []
        try:
            self._resources.close()
        except (zenoh.ZError, BusError) as error:
            raise BusError(f"The exchange did not close in order: {error}") from error
        finally:
            self._at_exit.detach()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
        else:
            self._give_up()

    def _give_up(self) -> None:
        """Close while another exception is on its way, which must not be hidden."""
        try:
            self.close()
        except BusError:
            _LOG.exception("While closing after another error:")

    def _refuse_namesakes(self, session: zenoh.Session) -> None:
        wanted = {keys.of_arm(self._fleet, arm, "alive"): arm for arm in self.arms}
        replies = session.liveliness().get(keys.of_every_arm(self._fleet, "alive"), timeout=self._timeout_s)
        taken = sorted(wanted[str(r.ok.key_expr)] for r in replies if r.ok and str(r.ok.key_expr) in wanted)
        if taken:
            raise BusError(f"Fleet '{self._fleet}' already has {', '.join(taken)} on the bus at {self._endpoint}.")

    def _count(self, unheard: set[tuple[int, int]]) -> None:
        pairs = len(self.arms) * (len(self.arms) - 1)
        self.late += len(unheard)
        self.delivered += pairs - len(unheard)
        fresh = sorted(unheard - self._unheard)
        if fresh:
            named = ", ".join(f"{self.arms[sender]} by {self.arms[receiver]}" for receiver, sender in fresh[:8])
            more = f" and {len(fresh) - 8} more" if len(fresh) > 8 else ""
            _LOG.warning("Not heard at %s s (and not before heard again): %s%s.", self._now_s, named, more)
        self._unheard = unheard


def _remembering_publisher(
    session: zenoh.Session, key: str, kind: type[DifficultyWord] | type[Info]
) -> advanced.AdvancedPublisher:
    """A publisher whose last word a late joiner gets, and whose lost words are noticed and said again."""
    return advanced.declare_advanced_publisher(
        session,
        key,
        encoding=encoding(kind),
        congestion_control=zenoh.CongestionControl.DROP,
        allowed_destination=zenoh.Locality.REMOTE,
        cache=advanced.CacheConfig(max_samples=1 if kind is Info else 4),
        sample_miss_detection=advanced.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        publisher_detection=True,
    )
