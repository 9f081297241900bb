"""`thermofleet gateway`: the bus over HTTP and server-sent events, for those who do not speak Zenoh."""

import asyncio
import ipaddress
import logging
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from fleet.errors import FleetError
from scenarios.live_options import ENDPOINT, EndpointOption, FleetOption, the_fleet
from scenarios.terminal import Interrupted

if TYPE_CHECKING:
    import uvicorn
    from starlette.applications import Starlette

    from scenarios.gateway_app import Readers

TOKEN = "THERMOFLEET_TOKEN"
SHORTEST = 16
_LOG = logging.getLogger(__name__)


def gateway_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    port: Annotated[int, typer.Option(help="TCP port of the gateway; 0 is any free one.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen on; beyond loopback only with a token.")] = "127.0.0.1",
    token: Annotated[
        str, typer.Option(envvar=TOKEN, help="Only who shows it gets in; others on this machine can see an option.")
    ] = "",
) -> None:
    """Offer the fleet over HTTP until Ctrl-C or SIGTERM."""
    try:
        import starlette
        import uvicorn
    except ImportError as error:
        raise FleetError(f"The gateway needs the extra: pip install 'thermofleet[gateway]' ({error.name}).") from error
    del starlette, uvicorn
    check(host, port, token)
    if asyncio.run(serve(endpoint, the_fleet(fleet, endpoint), host, port, token)) == signal.SIGINT:
        raise Interrupted("The gateway was interrupted.")


def check(host: str, port: int, token: str) -> None:
    """Refuse what would let strangers in.

    Raises:
        FleetError: says what is missing.
    """
    if not 0 <= port <= 65535:
        raise FleetError(f"--port must be 0 to 65535 (got {port}).")
    if token and (len(token) < SHORTEST or not token.isascii() or not token.isprintable()):
        raise FleetError(f"A token needs {SHORTEST} or more printable ASCII characters (got {len(token)}).")
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise FleetError(f"--host must be an IP address, as 127.0.0.1 or ::1 (got '{host}').") from error
    if local:
        return
    if not token:
        raise FleetError(
            f"--host {host} is not this machine alone: whoever reaches it could hand in jobs. Set {TOKEN} (or --token) "
            f"to {SHORTEST} or more random characters, or stay on 127.0.0.1."
        )
    _LOG.warning("Listening on %s: who has the token gets in, and HTTP is not encrypted; put TLS in front.", host)


def listening(host: str, port: int, stuck_s: float) -> socket.socket:
    """A socket on which the system itself drops connections whose reader takes nothing for so long.

    Raises:
        FleetError: the address is not ours, or the port is in use.
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


def server_of(app: "Starlette", readers: "Readers") -> "uvicorn.Server":
    """A server that leaves signals to its caller, and ends the streams when it is to end."""
    import uvicorn

    class Server(uvicorn.Server):
        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield  # uvicorn would raise SIGTERM again at the end

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            readers.close()  # streams would go on for ever
            await super().shutdown(sockets)

    return Server(
        uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            limit_concurrency=256,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=2,
        )
    )


async def serve(endpoint: str, fleet: str, host: str, port: int, token: str) -> int:
    """Serve until a signal asks for an end; which one."""
    from fleet.bus.link import Link
    from fleet.live.gateway import Gateway
    from scenarios.gateway_app import STUCK_S, Readers, application

    readers, came = Readers(), [0]
    with listening(host, port, STUCK_S) as bound, Link(endpoint, fleet) as link:
        async with Gateway(link, readers.tell) as gateway:
            server = server_of(application(gateway, readers, token=token), readers)

            def stop(number: int) -> None:
                came[0], server.should_exit = number, True

            for number in (signal.SIGINT, signal.SIGTERM):
                asyncio.get_running_loop().add_signal_handler(number, stop, number)
            where = bound.getsockname()
            shown = f"[{where[0]}]" if ":" in where[0] else where[0]
            typer.echo(f"ready gateway http://{shown}:{where[1]}/v1 {os.getpid()}")
            await server.serve(sockets=[bound])
    return came[0]
