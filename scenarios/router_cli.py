"""`thermofleet router`: the router of a fleet as a process of its own."""

from pathlib import Path
from typing import Annotated

import typer

from fleet.errors import FleetError
from scenarios.load import load
from scenarios.stopping import until_stopped

PORT = 7447
STATE_HZ = 100.0


def router_command(
    port: Annotated[int, typer.Option(help="TCP port; 0 is any free one.")] = PORT,
    host: Annotated[str, typer.Option(help="Address to listen on; beyond loopback only with --tls.")] = "127.0.0.1",
    tls: Annotated[
        Path | None,
        typer.Option(help="Folder that thermofleet keys made: mutual TLS, and each may do what its role needs."),
    ] = None,
    name: Annotated[str, typer.Option(help="--tls: whose certificate the router shows.")] = "router",
    scenario: Annotated[
        str | None, typer.Option(help="--tls: refuse to start unless every arm of this scenario has a certificate.")
    ] = None,
    state_hz: Annotated[
        float, typer.Option(help="Telemetry words a second let through from each session; 0 is any number.")
    ] = STATE_HZ,
) -> None:
    """Run the router of a fleet until Ctrl-C or SIGTERM; its endpoint is printed when it listens."""
    from fleet.bus.limits import Limits
    from fleet.bus.router import Router
    from fleet.bus.security import Tls

    if not 0 <= port <= 65535:
        raise FleetError(f"--port must be 0 to 65535 (got {port}).")
    if not 0 <= state_hz < 1e6:
        raise FleetError(f"--state-hz must be 0 or more (got {state_hz:g}).")
    if scenario is not None:
        _check_roster(tls, scenario)
    limits = Limits(state_hz=state_hz or None)
    with until_stopped() as stop, Router(port, host=host, tls=Tls(tls, name) if tls else None, limits=limits) as router:
        typer.echo(router.endpoint)  # flushed: a supervisor reads this line
        stop.wait()
        stop.leave("The router was interrupted; whoever was connected tries again by itself.")


def _check_roster(folder: Path | None, scenario: str) -> None:
    from fleet.bus.roster import read_roster

    if folder is None:
        raise FleetError("--scenario goes with --tls: without it nobody has a certificate.")
    chosen, roster = load(scenario), read_roster(folder)
    if roster.fleet != chosen.name:
        raise FleetError(f"The keys in '{folder}' are of the fleet '{roster.fleet}', not of '{chosen.name}'.")
    missing = [arm.name for arm in chosen.arms if arm.name not in roster.of_role("arm")]
    if missing:
        raise FleetError(
            f"No certificate in '{folder}' for {', '.join(missing)}; thermofleet keys {folder} --add {missing[0]}:arm "
            "makes one."
        )
