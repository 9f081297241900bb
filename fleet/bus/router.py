"""The router of a fleet, and the transport settings that every session on the bus shares.

Loopback only: nothing on this bus proves who it is, so nothing outside this machine may reach it.
"""

import ipaddress
import json
import logging
import re
from collections.abc import Mapping
from typing import Any, Self

import zenoh

from fleet.errors import BusError

_LOG = logging.getLogger(__name__)

LEASE_MS = 2000
"""After this long without a sign of life a session counts as gone."""
_ATTEMPTS = 3
_ENDPOINT = re.compile(r"tcp/(?:\[(?P<v6>[0-9A-Fa-f:.]+)\]|(?P<host>[^:\[\]/?#]+)):(?P<port>\d{1,5})")

_TRANSPORT: Mapping[str, Any] = {
    # A router would otherwise wait half a second for others to be found.
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {
        "shared_memory": {"enabled": False},
        "link": {
            "tx": {
                "lease": LEASE_MS,
                "queue": {
                    "size": {"data": 16},
                    # Microseconds. A burst of a whole fleet on a busy machine is no reason to drop; a stuck peer is.
                    "congestion_control": {
                        "drop": {"wait_before_drop": 20_000},
                        "block": {"wait_before_close": 1_000_000},
                    },
                },
            }
        },
    },
}


def loopback(endpoint: str) -> str:
    """The endpoint, when it is `tcp/<address>:<port>` on this machine's loopback.

    Raises:
        BusError: anything else, with the reason.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 <= int(match["port"]) <= 65535:
        raise BusError(
            f"'{endpoint}' is no endpoint of this bus. Expected tcp/<address>:<port>, as tcp/127.0.0.1:7447."
        )
    host = match["v6"] or match["host"]
    if host == "localhost":
        return endpoint
    try:
        address = ipaddress.ip_address(host)
    except ValueError as error:
        raise BusError(
            f"Endpoint '{endpoint}': the name '{host}' may lead anywhere. Allowed: 127.0.0.1, [::1], localhost."
        ) from error
    if not address.is_loopback:
        raise BusError(
            f"Endpoint '{endpoint}' is not on loopback. The bus has no authentication, so whoever reaches it could "
            "speak for any arm; it stays on 127.0.0.1, [::1] or localhost."
        )
    return endpoint


def open_client(endpoint: str, *, timeout_s: float) -> zenoh.Session:
    """A client session on the router at `endpoint`.

    Raises:
        BusError: the endpoint is not on loopback, or no router answered within `timeout_s`.
    """
    connect = {
        "endpoints": [loopback(endpoint)],
        "timeout_ms": max(1, round(1000 * timeout_s)),
        "retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
    }
    try:
        return zenoh.open(_config({"mode": "client", "connect": connect}))
    except zenoh.ZError as error:
        raise BusError(f"No router answered at {endpoint} within {timeout_s} s ({_first(error)}).") from error


class Router:
    """A router in this process: what the sessions of one fleet meet at.

    `with Router() as router:` listens on a free port of 127.0.0.1 until the end of the block.
    """

    def __init__(self, port: int = 0) -> None:
        """Prepare a router.

        Args:
            port: TCP port on 127.0.0.1; 0 lets the system choose a free one.
        """
        if not 0 <= port <= 65535:
            raise ValueError(f"A port is 0..65535 (got {port}).")
        self._port = port
        self._session: zenoh.Session | None = None
        self._endpoint: str | None = None

    @property
    def endpoint(self) -> str:
        """Where sessions connect, for example `tcp/127.0.0.1:7447`.

        Raises:
            BusError: the router is not open.
        """
        if self._endpoint is None:
            raise BusError("The router is not open.")
        return self._endpoint

    def open(self) -> Self:
        """Listen.

        Raises:
            BusError: the port is taken, or the system gives none.
        """
        if self._session is not None:
            return self
        config = {
            "mode": "router",
            "listen": {"endpoints": [f"tcp/127.0.0.1:{self._port}"]},
            # The router's own description is the one place that tells which port the system chose.
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        }
        problem = BusError("The router did not open.")
        # Only a port that the system chooses can be free at the second attempt.
        for attempt in range(1, 1 + (1 if self._port else _ATTEMPTS)):
            try:
                session = zenoh.open(_config(config))
            except zenoh.ZError as error:
                where = f"port {self._port} of 127.0.0.1; is it in use?" if self._port else "a free port of 127.0.0.1."
                problem = BusError(f"The router could not listen on {where} ({_first(error)})")
                problem.__cause__ = error
                continue
            try:
                self._endpoint = _where(session)
            except BusError as error:
                problem = error
                session.close()
                continue
            self._session = session
            _LOG.debug("Router at %s (attempt %d).", self._endpoint, attempt)
            return self
        raise problem

    def close(self) -> None:
        """Stop listening and drop every link; twice is fine.

        Raises:
            BusError: the router could not be closed in order.
        """
        session, self._session, self._endpoint = self._session, None, None
        if session is None:
            return
        try:
            session.close()
        except zenoh.ZError as error:
            raise BusError(f"The router did not close in order ({_first(error)}).") from error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()


def _config(own: Mapping[str, Any]) -> zenoh.Config:
    return zenoh.Config.from_json5(json.dumps({**_TRANSPORT, **own}))


def _where(session: zenoh.Session) -> str:
    """The endpoint that a router session listens on, from its own description."""
    for reply in session.get(f"@/{session.zid()}/router", timeout=5.0):
        if reply.ok is not None:
            locators = json.loads(reply.ok.payload.to_bytes())["locators"]
            if len(locators) == 1:
                return loopback(locators[0])
    raise BusError("The router opened, but does not tell on which port it listens.")


def _first(error: zenoh.ZError) -> str:
    """What Zenoh says, without the places in its source that it names."""
    return re.split(r" at /|\.? \[", str(error))[0]
