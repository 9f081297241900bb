"""The bus over HTTP and server-sent events, and a page for browsers, as a process."""

import asyncio
import ipaddress
import logging
import os
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from fleet.bus.client.client import BusClient
from fleet.env.render.heat import heat_scale
from fleet.errors import FleetError
from fleet.live.monitor.async_bridge import AsyncBridge
from scenarios.cli.options import the_fleet
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import Interrupted, echo
from scenarios.live.http_app import MIN_TOKEN, STUCK_S, Readers, Role, application, check_token, read_tokens
from scenarios.live.http_page import LivePage
from scenarios.schema import Scenario

TOKEN = "THERMOFLEET_TOKEN"
MAX_CONNECTIONS, MAX_WAITING, HEADER_S = 1000, 128, 5.0
"""Connections at a time; those that have sent no complete request yet, of which one more ends the oldest; and real
seconds after which such a connection ends."""
_LOG = logging.getLogger(__name__)


def scene_of(scenario: Scenario) -> dict[str, Any]:  # values of JSON
    """The cell of a scenario as the page draws it."""
    from fleet.physics.cell_model import cell_model  # loads MuJoCo

    limits, robots = scenario.limits, [arm.robot() for arm in scenario.arms]
    heat = heat_scale(limits.warning_c, limits.error_c)
    return {**cell_model(robots, scenario.places, scenario.fixtures), "heat": heat}


def run_gateway(
    endpoint: str, fleet: str, port: int, host: str, token: str, tokens: Path | None, page: LivePage | None = None
) -> None:
    """Serve until a signal arrives; the arguments are the options of `thermofleet bus gateway`."""
    roles = read_tokens(tokens) if tokens else {}
    if token:
        roles[check_token(token)] = "operator"
    check(host, endpoint, bool(roles))
    name = the_fleet(fleet, endpoint)
    with listen(host, port, STUCK_S) as bound:
        with until_stopped() as stop:
            link = BusClient(endpoint, name, stopped=stop.is_set).open()
        with link:
            number = asyncio.run(serve(link, bound, roles, page))
    if number == signal.SIGINT:
        raise Interrupted("The gateway was interrupted.")


def check(host: str, endpoint: str, has_tokens: bool) -> None:
    """Refuse to pass on requests without a token of those that could not send them to the router themselves.

    Raises:
        FleetError: an option is wrong or missing.
    """
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise FleetError(f"--host must be an IP address, as 127.0.0.1 or ::1 (got '{host}').") from error
    if not has_tokens and endpoint.startswith("tls/"):
        raise FleetError(
            f"The router needs certificates, and without a token every user of this machine could use yours. Set "
            f"{TOKEN} (or --token) to {MIN_TOKEN} or more random characters, or give --tokens."
        )
    if local:
        return
    if not has_tokens:
        raise FleetError(
            f"--host {host} is reachable from other machines, which could submit jobs. Set {TOKEN} (or --token) to "
            f"{MIN_TOKEN} or more random characters, or use 127.0.0.1."
        )
    _LOG.warning("Listening on %s: HTTP is not encrypted and shows the token; put TLS in front.", host)


def listen(host: str, port: int, stuck_s: float) -> socket.socket:
    """Socket on which the system drops connections whose reader takes nothing for `stuck_s`.

    Raises:
        FleetError: the address is not of this machine, or the port is in use.
    """
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * stuck_s))
    try:
        bound.bind((host, port))
        bound.listen()
    except OSError as error:
        bound.close()
        raise FleetError(f"The gateway cannot listen on {host}:{port}: {os.strerror(error.errno or 0)}.") from error
    return bound


class Server(uvicorn.Server):
    """Server that leaves signals to its caller, and ends the event streams when it stops."""

    def __init__(self, app: Starlette, readers: Readers) -> None:
        config = uvicorn.Config(
            app,
            http=_protocol(),
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            limit_concurrency=MAX_CONNECTIONS,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=2,
        )
        super().__init__(config)
        self._readers = readers

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Do nothing: uvicorn would raise SIGTERM again when it stops."""
        yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the event streams, which have no end of their own, and shut down."""
        self._readers.close()
        await super().shutdown(sockets)


def _protocol() -> type[H11Protocol]:
    """HTTP of one server, which does not let connections wait without a complete request."""
    waiting: dict[H11Protocol, Callable[[], None]] = {}

    class Protocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            waiting[self] = self._end_waiting
            if len(waiting) > MAX_WAITING:
                next(iter(waiting.values()))()
            self.loop.call_later(HEADER_S, self._end_waiting)

        def handle_events(self) -> None:
            super().handle_events()
            if self.cycle is not None:
                waiting.pop(self, None)

        def connection_lost(self, exc: Exception | None) -> None:
            waiting.pop(self, None)
            super().connection_lost(exc)

        def _end_waiting(self) -> None:
            if self in waiting:
                del waiting[self]
                self.transport.close()

    return Protocol


async def serve(link: BusClient, bound: socket.socket, tokens: Mapping[str, Role], page: LivePage | None = None) -> int:
    """Serve until a signal arrives; return its number."""
    readers, received = Readers(), [0]
    async with AsyncBridge(link, readers.put) as bridge:
        server = Server(application(bridge, readers, tokens=tokens, page=page), readers)

        def stop(number: int) -> None:
            received[0], server.should_exit = number, True

        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop, number)
        address, bound_port, *_ = bound.getsockname()
        shown = f"[{address}]" if ":" in address else address
        kind, path = ("gateway", "/v4") if page is None else ("page", "/")
        echo(f"ready {kind} http://{shown}:{bound_port}{path} {os.getpid()}")
        await server.serve(sockets=[bound])
    return received[0]
