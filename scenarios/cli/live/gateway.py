"""`thermofleet gateway`: the bus over HTTP and server-sent events, for clients without Zenoh."""

import asyncio
import ipaddress
import logging
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
import uvicorn
from starlette.applications import Starlette

from fleet.bus.client.client import BusClient
from fleet.errors import FleetError
from fleet.live.monitor.async_bridge import AsyncBridge
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, number, the_fleet
from scenarios.cli.terminal import Interrupted
from scenarios.live.http_app import STUCK_S, Readers, application

TOKEN = "THERMOFLEET_TOKEN"
MIN_TOKEN = 16
_LOG = logging.getLogger(__name__)


def gateway_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    port: Annotated[int, number("TCP port of the gateway; 0 takes a free one.", 0, 65535)] = 8080,
    host: Annotated[str, typer.Option(help="Listening address; beyond loopback only with a token.")] = "127.0.0.1",
    token: Annotated[
        str,
        typer.Option(
            envvar=TOKEN, help="Bearer token of requests. Prefer the variable: other users can read command lines."
        ),
    ] = "",
) -> None:
    """Serve the fleet over HTTP until Ctrl-C or SIGTERM."""
    check(host, token)
    if asyncio.run(serve(endpoint, the_fleet(fleet, endpoint), host, port, token)) == signal.SIGINT:
        raise Interrupted("The gateway was interrupted.")


def check(host: str, token: str) -> None:
    """Refuse an address that others can reach without a token.

    Raises:
        FleetError: an option is wrong or missing.
    """
    if token and (len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable()):
        raise FleetError(f"A token needs {MIN_TOKEN} or more printable ASCII characters (got {len(token)}).")
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise FleetError(f"--host must be an IP address, as 127.0.0.1 or ::1 (got '{host}').") from error
    if local:
        return
    if not token:
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
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            limit_concurrency=256,
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


async def serve(endpoint: str, fleet: str, host: str, port: int, token: str) -> int:
    """Serve until a signal arrives; return its number."""
    readers, received = Readers(), [0]
    with listen(host, port, STUCK_S) as bound, BusClient(endpoint, fleet) as link:
        async with AsyncBridge(link, readers.put) as bridge:
            server = Server(application(bridge, readers, token=token), readers)

            def stop(number: int) -> None:
                received[0], server.should_exit = number, True

            for number in (signal.SIGINT, signal.SIGTERM):
                asyncio.get_running_loop().add_signal_handler(number, stop, number)
            address, bound_port, *_ = bound.getsockname()
            shown = f"[{address}]" if ":" in address else address
            typer.echo(f"ready gateway http://{shown}:{bound_port}/v4 {os.getpid()}")
            await server.serve(sockets=[bound])
    return received[0]
