"""A seat at the bus: one session, what the arms that share it say with, and what they have heard.

As a rule every arm has a seat of its own. Where many share one, what they say reaches each other through Zenoh all the
same, as to everybody else, and what is heard is heard by all of them.
"""

import math
import time
from collections.abc import Sequence
from typing import Any

import zenoh
from zenoh import ext as advanced

from fleet.bus import keys
from fleet.bus.exchange import Condition, Scores
from fleet.bus.inbox import Inbox, LastWords
from fleet.bus.messages import DifficultyWord, Info, State, encode, encoding
from fleet.bus.wording import Reader, condition_of, scores_of

HEARTBEAT_S = 1.0
"""How soon after the last word its number is repeated, so that a lost last word is noticed."""
SILENT_AFTER = 3
"""Ticks that a peer may miss in a row before nobody waits for it until it is heard again."""
_LOOK_AGAIN_S = 0.002
_BACKLOG = 1024
"""Samples that one session keeps until they are read, for each topic; the oldest go first. A fleet that behaves needs
a few per arm, the rest is patience with strangers."""


class Seat:
    """One session, and the arms on it.

    Attributes:
        seated: Places in the fleet of the arms that share it.
        present: Arms whose liveliness token is seen here.
    """

    def __init__(
        self, session: zenoh.Session, fleet: str, arms: tuple[str, ...], seated: Sequence[int], reader: Reader
    ) -> None:
        """Declare all that these arms say and hear."""
        self.seated = tuple(seated)
        self._reader = reader
        # An arm alone knows its own words without the bus.
        origin = zenoh.Locality.REMOTE if len(self.seated) == 1 else zenoh.Locality.ANY
        self._limit = max(_BACKLOG, 16 * len(arms))
        self._inbox = Inbox(self._limit)
        self.present: set[int] = set()
        self._awaited: set[int] = set()
        """Those of them that were there when the tick began, and have not been away since."""
        self.conditions = LastWords[Condition](len(arms))
        self.scores = LastWords[Scores](len(arms))
        self.misses = [0] * len(arms)
        """Ticks in a row in which a peer was not heard."""

        self._ring = session.declare_subscriber(
            keys.of_every_arm(fleet, "state"),
            zenoh.handlers.RingChannel(self._limit),
            allowed_origin=origin,
        )
        # On the receiving thread itself: a thread of Python's between would only hand on.
        hear: Any = zenoh.handlers.Callback(self._inbox.hear, indirect=False)
        self._difficulties = advanced.declare_advanced_subscriber(
            session,
            keys.of_every_arm(fleet, "difficulty"),
            hear,
            allowed_origin=origin,
            history=advanced.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=advanced.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._tokens = session.liveliness().declare_subscriber(keys.of_every_arm(fleet, "alive"), hear, history=True)
        self._voices = [_Voice(session, fleet, arms[index], origin) for index in self.seated]

    def begin(self, tick: int, now_s: float) -> None:
        """Read what came since `tick`, the last one, and settle whom to wait for: words on a broken link never come."""
        self.drain(tick, now_s)
        self._awaited = {sender for sender in self.present if self.misses[sender] < SILENT_AFTER}

    def say(self, tick: int, words: Sequence[tuple[State, DifficultyWord]]) -> None:
        """Publish what the arms here say of one tick, [arm of the fleet], and who says it when that has changed."""
        for index, voice in zip(self.seated, self._voices, strict=True):
            state, difficulty = words[index]
            if len(self.seated) == 1:
                self.conditions.keep(index, tick, condition_of(state))
                self.scores.keep(index, tick, scores_of(difficulty))
            voice.say(state, difficulty)

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


class _Voice:
    """What one arm says with."""

    def __init__(self, session: zenoh.Session, fleet: str, arm: str, destination: zenoh.Locality) -> None:
        self._arm = arm
        self._said_info: Info | None = None
        self._state = session.declare_publisher(
            keys.of_arm(fleet, arm, "state"),
            encoding=encoding(State),
            congestion_control=zenoh.CongestionControl.DROP,
            allowed_destination=destination,
        )
        self._difficulty = _remembering(session, keys.of_arm(fleet, arm, "difficulty"), DifficultyWord, destination)
        self._info = _remembering(session, keys.of_arm(fleet, arm, "info"), Info, destination)
        # Declared last: whoever sees the token knows that the router has the rest.
        self._token = session.liveliness().declare_token(keys.of_arm(fleet, arm, "alive"))

    def say(self, state: State, difficulty: DifficultyWord) -> None:
        """Publish the words of one tick."""
        info = Info(arm=self._arm, joints=len(state.temp_c), twin=difficulty.twin)
        if info != self._said_info:
            self._info.put(encode(info))
            self._said_info = info
        self._state.put(encode(state))
        self._difficulty.put(encode(difficulty))


def _remembering(
    session: zenoh.Session, key: str, kind: type[DifficultyWord] | type[Info], destination: zenoh.Locality
) -> advanced.AdvancedPublisher:
    """A publisher whose last word a late joiner gets, and whose lost words are noticed and said again."""
    return advanced.declare_advanced_publisher(
        session,
        key,
        encoding=encoding(kind),
        congestion_control=zenoh.CongestionControl.DROP,
        allowed_destination=destination,
        cache=advanced.CacheConfig(max_samples=1 if kind is Info else 4),
        sample_miss_detection=advanced.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        publisher_detection=True,
    )
