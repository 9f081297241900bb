"""One that listens to a whole fleet, takes no part in it, and keeps the overview up to date."""

import logging
import time
from collections.abc import Callable
from functools import partial

import msgspec

from fleet.bus import keys
from fleet.bus.answers import Answers
from fleet.bus.contract import PUBLISHED
from fleet.bus.link import Link
from fleet.bus.trade import Status, StatusRequest
from fleet.errors import BusError
from fleet.live.overview import Overview, Role

_LOG = logging.getLogger(__name__)

ASK_EVERY_S = 5.0
"""Real seconds between two questions where the jobs stand: for what was said before we listened."""
Heard = Callable[[str, str, msgspec.Struct], None]
"""Told the topic, the name in the key and the word."""


class Onlooker:
    """`Onlooker(link).serve(until_s)` in a loop keeps `overview` up to date."""

    def __init__(
        self,
        link: Link,
        *,
        heard: Heard = lambda topic, name, word: None,
        came: Callable[[Role, str, bool], None] = lambda role, name, there: None,
    ) -> None:
        """Listen to all that is published in the fleet of an open line.

        Args:
            heard: Called with every word, after the overview has it.
            came: Called with who came or went.
        """
        self.overview = Overview(link.fleet)
        self._link, self._heard, self._came = link, heard, came
        self._ask_s = time.monotonic()
        for channel in PUBLISHED:
            one = str(keys.Key(link.fleet, channel.role, "x", channel.topic))
            everyone = one.replace(f"/{channel.role}/x/", f"/{channel.role}/*/")
            link.listen(everyone, channel.word, self._hear(channel.topic), remembered=channel.kept)
        link.watch(keys.of_every_arm(link.fleet, "alive"), self._token("arm"))
        link.watch(keys.of_every_auction(link.fleet, "alive"), self._token("auction"))

    def serve(self, until_s: float) -> None:
        """Hear what comes until the real second `until_s`; now and then ask where the jobs stand."""
        if time.monotonic() >= self._ask_s:
            asked_s = time.monotonic()
            self._ask_s = asked_s + ASK_EVERY_S
            key = keys.of_jobs(self._link.fleet, "status")
            try:
                told = partial(self._told, asked_s)
                self._link.ask(key, StatusRequest(), Status, told, timeout_s=ASK_EVERY_S)
            except BusError as error:
                _LOG.warning("%s", error)
        while time.monotonic() < until_s:
            self._link.serve(until_s)

    def _hear(self, topic: str) -> Callable[[str, msgspec.Struct], None]:
        def hear(name: str, word: msgspec.Struct) -> None:
            self.overview.hear(name, word, time.monotonic())
            self._heard(topic, name, word)

        return hear

    def _token(self, role: Role) -> Callable[[str, bool], None]:
        def came(name: str, there: bool) -> None:
            if self.overview.token(role, name, there):
                self._came(role, name, there)

        return came

    def _told(self, asked_s: float, answers: Answers[Status]) -> None:
        told = list(answers.words.values())
        for status in told:
            self.overview.told(status, time.monotonic())
        if not answers.refused:
            self.overview.forget_all_but(told, asked_s)
