"""Alarms as HTTP requests to other programs: signed, repeated until they are accepted, and never waited for.

The body is the message `Alarm` as JSON. `X-Thermofleet-Signature` is `t=TIME,v1=HEX`: the hex digest of HMAC-SHA256
over `TIME.BODY` with the secret; TIME is in Unix seconds, so that a receiver can refuse what is old.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import itertools
import logging
import os
import ssl
import time
from collections import deque
from collections.abc import Iterable
from urllib.parse import urlsplit

from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import Alarm
from fleet.errors import FleetError, printable
from fleet.live.monitor.health import Finding
from fleet.live.monitor.snapshot import MAX_ALARMS

_LOG = logging.getLogger(__name__)

SECRET = "THERMOFLEET_WEBHOOK_SECRET"
"""Environment variable of the secret."""
MIN_SECRET = 16
MOST_WAITING = 2 * MAX_ALARMS
"""Alarms that wait for one target; the next one drops the oldest. At its start a gateway sends all that it knows."""
REPLY_S = 5.0
"""Real seconds for a whole request."""
RETRY_S = (1.0, 5.0, 30.0, 120.0)
"""Real seconds before each repetition; the last one is repeated while the target is down."""
TOO_EARLY = (408, 425, 429)
"""Of the statuses from 400 to 499 those that a repetition may change; with another one the alarm is dropped for this
target after the repetitions of `RETRY_S`, so that it does not hold up the next ones."""


class Webhook:
    """One target: `run` sends what `send` has queued; both on the event loop.

    Attributes:
        problem: Why the target has accepted no alarm since, after a repetition; "" if the last one was accepted.
    """

    def __init__(self, url: str, secret: str) -> None:
        """Prepare.

        Raises:
            FleetError: no secret, no URL of HTTP, or plain HTTP beyond loopback.
        """
        if len(secret) < MIN_SECRET:
            raise FleetError(f"--webhook needs a secret to sign with: set {SECRET} to {MIN_SECRET} or more characters.")
        try:
            parts = urlsplit(url)
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise FleetError(f"--webhook: {error} (got '{printable(url)}').") from error
        wrong = parts.scheme not in ("http", "https") or not host or "@" in parts.netloc or port == 0
        if wrong or any(char.isspace() for char in url):
            raise FleetError(f"--webhook must be a URL such as http://127.0.0.1:9000/alarms (got '{printable(url)}').")
        if parts.scheme == "http" and not _is_loopback(host):
            raise FleetError(f"--webhook beyond this machine must be https:// (got '{printable(url)}').")
        self._port = port or (443 if parts.scheme == "https" else 80)
        self.problem, self._secret, self._host = "", secret.encode(), host
        self._named = f"[{host}]" if ":" in host else host
        self._target = f"{self._named}:{self._port}"
        self._tls = ssl.create_default_context() if parts.scheme == "https" else None
        self._path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._waiting: deque[bytes] = deque(maxlen=MOST_WAITING)
        self._woken = asyncio.Event()

    def send(self, alarm: Alarm) -> None:
        """Queue an alarm."""
        if len(self._waiting) == MOST_WAITING:
            _LOG.warning("The webhook at %s is %d alarms behind; the oldest is dropped.", self._target, MOST_WAITING)
        self._waiting.append(encode(alarm))
        self._woken.set()

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            self._woken.clear()
            if not self._waiting:
                await self._woken.wait()
                continue
            body = self._waiting.popleft()
            for attempt in itertools.count():
                problem, final = await self._attempt(body)
                if not problem or attempt:  # one attempt may fail
                    self.problem = problem
                if not problem:
                    break
                if final and attempt >= len(RETRY_S):
                    _LOG.error("The webhook at %s refuses an alarm (%s): it is dropped there.", self._target, problem)
                    break
                await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])

    def findings(self) -> tuple[Finding, ...]:
        """A warning while the target accepts nothing; without the path of the URL, which may be secret."""
        if not (problem := self.problem):
            return ()
        what = f"The webhook at {self._target} accepts no alarms: {problem}."
        return (Finding("warning", what, "webhook", self._target),)

    async def _attempt(self, body: bytes) -> tuple[str, bool]:
        """Send one request; return why it was not accepted, or "", and whether the target judged this alarm."""
        try:
            async with asyncio.timeout(REPLY_S):
                status = await self._post(body)
        except TimeoutError:
            return f"no reply within {REPLY_S:g} s", False
        except (OSError, ValueError) as error:
            return str(error) or type(error).__name__, False
        return "" if 200 <= status < 300 else f"status {status}", 400 <= status < 500 and status not in TOO_EARLY

    async def _post(self, body: bytes) -> int:
        """Status of the reply, whose body is not read: it may have any size."""
        at = str(int(time.time()))
        signature = hmac.new(self._secret, at.encode() + b"." + body, hashlib.sha256).hexdigest()
        head = (
            f"POST {self._path} HTTP/1.1\r\nHost: {self._target}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(body)}\r\nX-Thermofleet-Signature: t={at},v1={signature}\r\n"
            "Connection: close\r\n\r\n"
        )
        reader, writer = await asyncio.open_connection(self._host, self._port, ssl=self._tls)
        try:
            writer.write(head.encode() + body)
            await writer.drain()
            return int((await reader.readline()).split(maxsplit=2)[1])
        except IndexError as error:
            raise ValueError("no reply of HTTP") from error
        finally:
            writer.transport.abort()


def webhooks_of(urls: Iterable[str]) -> list[Webhook]:
    """Return the targets of these URLs, with the secret of the environment. Raises FleetError as `Webhook`."""
    return [Webhook(url, os.environ.get(SECRET, "")) for url in urls]


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
