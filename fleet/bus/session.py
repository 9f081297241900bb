"""The exchange over Zenoh: every arm knows of its peers only what came over the bus.

A few arms each have a client session of their own (`fleet.bus.seat`), many share some: what n sessions hear of n arms
grows with n², and with it the time to find each other and the memory.

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
from typing import Self

import numpy as np
import zenoh

from fleet.bus import keys
from fleet.bus.channel import PERFECT, Channel
from fleet.bus.delivery import Delivery
from fleet.bus.exchange import Heard, Word, Words, assemble, check, check_order, checked_arms
from fleet.bus.router import Router, open_client, reachable
from fleet.bus.seat import Seat
from fleet.bus.security import Tls
from fleet.bus.wording import Reader, spoken
from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

MOST_SEATS, SHARED_SEATS = 8, 4
"""So many arms have a session each; more of them share so many sessions."""
MOST_NAMED = 8
"""Arms that a complaint names."""
_OPEN_TIMEOUT_S = 20.0


def seats_of(arms: int) -> int:
    """Sessions on which so many arms meet, unless each has to show a certificate of its own."""
    return arms if arms <= MOST_SEATS else SHARED_SEATS


class ZenohExchange:
    """Hands words over through Zenoh: a router, and the client sessions of the arms, all in this process.

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
        sessions: int | None = None,
    ) -> None:
        """Prepare an exchange between `arms`.

        Args:
            fleet: Name of the fleet, part of every key.
            endpoint: Of a router on loopback, as `tcp/127.0.0.1:7447`; None for a router of its own on a free port.
            tls: Folder with a certificate of every arm (and of `router`, for a router of its own); the endpoint then
                begins with `tls/`, and may be anywhere.
            timeout_s: How long `share` waits for words that do not come.
            sessions: That the arms share, at most; None for `seats_of` them. With `tls` every arm has its own.

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
        if sessions is not None and sessions < 1:
            raise ValueError(f"sessions must be >= 1 (got {sessions}).")
        arms_in_all = len(self.arms)
        self._seated = arms_in_all if tls is not None else min(sessions or seats_of(arms_in_all), arms_in_all)
        self._fleet = fleet
        self._tls = {arm: None if tls is None else Tls(tls, arm) for arm in self.arms}
        self._own_tls = None if tls is None else Tls(tls, "router")
        self._endpoint = None if endpoint is None else reachable(endpoint, self._tls[self.arms[0]])
        self._timeout_s = timeout_s
        self._reader = Reader(fleet, self.arms)
        self._delivery = None if channel.perfect else Delivery(self.arms, channel)
        self._seats: list[Seat] = []
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
        if self._seats:
            return self
        try:
            if self._endpoint is None:
                self._endpoint = self._resources.enter_context(Router(tls=self._own_tls)).endpoint
            sessions: list[zenoh.Session] = []
            for arm in self.arms[: self._seated]:
                sessions.append(open_client(self._endpoint, timeout_s=self._timeout_s, tls=self._tls[arm]))
                self._resources.callback(sessions[-1].close)
            self._refuse_namesakes(sessions[0])
            everybody = range(len(self.arms))
            self._seats = [
                Seat(session, self._fleet, self.arms, everybody[i :: len(sessions)], self._reader)
                for i, session in enumerate(sessions)
            ]
            deadline_s = time.monotonic() + _OPEN_TIMEOUT_S
            for seat in self._seats:
                if not seat.await_peers(len(self.arms), deadline_s):
                    missing = [self.arms[i] for i in everybody if i not in seat.present]
                    more = f" and {len(missing) - MOST_NAMED} more" if len(missing) > MOST_NAMED else ""
                    unseen = ", ".join(missing[:MOST_NAMED]) + more
                    arm = self.arms[seat.seated[0]]
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
        for seat in self._seats:
            seat.begin(self._tick, self._now_s)  # what waits to be read is of the last episode
            seat.forget(self._tick)
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
        for seat in self._seats:
            seat.begin(self._tick, self._now_s)
        self._tick += 1
        self._now_s = float(words.time_s)
        self._reader.forget()
        try:
            said = spoken(words, self.arms, self._tick)
            for seat in self._seats:
                seat.say(self._tick, said)
        except zenoh.ZError as error:
            raise BusError(f"The bus at {self._endpoint} was lost: {error}") from error
        deadline_s = time.monotonic() + self._timeout_s
        unheard = {
            (receiver, sender)
            for seat in self._seats
            for sender in seat.listen(self._tick, self._now_s, deadline_s)
            for receiver in seat.seated
            if receiver != sender
        }
        self._count(unheard)
        self.malformed = self._reader.malformed
        if self._delivery is None:
            conditions = self._of_every_arm([seat.conditions.words for seat in self._seats])
            scores = self._of_every_arm([seat.scores.words for seat in self._seats])
            return assemble(self._now_s, words.jobs, conditions, scores)
        # A word that the bus itself brings a tick late is lost: the channel asks for the words of this tick.
        conditions = self._of_every_arm([seat.conditions.of(self._tick) for seat in self._seats])
        scores = self._of_every_arm([seat.scores.of(self._tick) for seat in self._seats])
        self._delivery.carry(self._now_s, conditions, scores)
        self.delivered, self.late = self._delivery.delivered, self._delivery.late
        return assemble(self._now_s, words.jobs, self._delivery.conditions, self._delivery.scores)

    def close(self) -> None:
        """Disconnect every arm and stop the router; twice is fine.

        Raises:
            BusError: something did not close in order; everything else is closed all the same.
        """
        self._closed = True
        self._seats = []
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

    def _of_every_arm(self, heard: list[list[Word | None]]) -> list[list[Word | None]]:
        """[receiver][sender], from what was heard at every seat."""
        return [heard[i % len(heard)] for i in range(len(self.arms))]

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
            named = ", ".join(f"{self.arms[s]} by {self.arms[r]}" for r, s in fresh[:MOST_NAMED])
            more = f" and {len(fresh) - MOST_NAMED} more" if len(fresh) > MOST_NAMED else ""
            _LOG.warning("Not heard at %s s (and not before heard again): %s%s.", self._now_s, named, more)
        self._unheard = unheard
