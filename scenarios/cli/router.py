"""`thermofleet router`."""

from pathlib import Path
from typing import Annotated

import typer

from fleet.bus.protocol.registry import CHANNEL
from fleet.errors import FleetError
from scenarios.cli.options import check_name, number
from scenarios.cli.signals import until_stopped
from scenarios.cli.terminal import echo
from scenarios.load import load

PORT = 7447


def router_command(
    port: Annotated[int, number("TCP port; 0 is any free one.", 0, 65535)] = PORT,
    host: Annotated[str, typer.Option(help="Address to listen on; beyond loopback only with --tls.")] = "127.0.0.1",
    tls: Annotated[
        Path | None,
        typer.Option(help="Folder that `thermofleet keys` made: mutual TLS, and access by role."),
    ] = None,
    name: Annotated[
        str, typer.Option(help="--tls: participant whose certificate the router presents.", callback=check_name)
    ] = "router",
    connect: Annotated[
        list[str] | None,
        typer.Option(help="--tls: another router of the fleet, tls/HOST:PORT, to link with; may be given repeatedly."),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="--tls: refuse to start unless every arm of this scenario has a certificate.")
    ] = None,
    state_hz: Annotated[
        float, number("Telemetry messages forwarded per second and session; 0 is unlimited.", 0, 1_000_000)
    ] = CHANNEL["arm", "state"].limit_hz or 0.0,
) -> None:
    """Run the Zenoh router of a fleet until Ctrl-C or SIGTERM; it prints its endpoint once it listens."""
    from fleet.bus.client.rate_limits import Limits
    from fleet.bus.client.router import Router
    from fleet.bus.security.tls import Tls

    if scenario is not None:
        check_roster(tls, scenario)
    limits = Limits(state_hz=state_hz or None)
    router = Router(port, host=host, tls=Tls(tls, name) if tls else None, limits=limits, connect=connect or ())
    with until_stopped() as stop, router:
        echo(router.endpoint)  # flushed: a supervisor reads this line
        stop.wait()
        stop.leave("The router was interrupted; its clients keep trying to reconnect.")


def check_roster(folder: Path | None, scenario: str) -> None:
    """Check that a folder of keys has a certificate for every arm of a scenario.

    Raises:
        FleetError: it has not, or it is not a folder of keys of this scenario.
    """
    from fleet.bus.security.access_control import read_roster

    if folder is None:
        raise FleetError("--scenario needs --tls: without TLS there are no certificates to check.")
    chosen, roster = load(scenario), read_roster(folder)
    if roster.fleet != chosen.name:
        raise FleetError(f"The keys in '{folder}' are for the fleet '{roster.fleet}', not for '{chosen.name}'.")
    missing = [arm.name for arm in chosen.arms if arm.name not in roster.of_role("arm")]
    if missing:
        raise FleetError(
            f"No certificate in '{folder}' for {', '.join(missing)}; make one with: thermofleet keys {folder} --add "
            f"{missing[0]}:arm."
        )
