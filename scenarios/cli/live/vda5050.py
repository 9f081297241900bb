"""`thermofleet vda5050`: take orders of a plant's master control."""

import os
import time
from typing import Annotated

import typer

from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, number, the_fleet
from scenarios.cli.signals import until_stopped
from scenarios.extras import require_extra

TURN_S = 0.25
"""Real seconds between two checks for a stop request."""


def vda5050_command(
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
    broker: Annotated[str, typer.Option(help="Host of the MQTT broker.")] = "localhost",
    mqtt_port: Annotated[int, number("Port of the MQTT broker.", 1, 65535)] = 1883,
    serial: Annotated[str, typer.Option(help="serialNumber of the station. Default: the name of the fleet.")] = "",
    manufacturer: Annotated[str, typer.Option(help="manufacturer of the station.")] = "thermofleet",
    user: Annotated[str, typer.Option(help="User at the broker; the password is in MQTT_PASSWORD.")] = "",
    mqtt_tls: Annotated[bool, typer.Option("--mqtt-tls", help="TLS, with the certificates of the system.")] = False,
) -> None:
    """Show a fleet as one stationary vehicle of VDA 5050 that takes orders over MQTT, until Ctrl-C or SIGTERM."""
    require_extra("vda5050")
    from fleet.bus.client.client import BusClient
    from fleet.vda5050.mqtt import StationLink

    name = the_fleet(fleet, endpoint)
    with (
        until_stopped() as stop,
        BusClient(endpoint, name, stopped=stop.is_set) as link,
        StationLink(
            link,
            broker,
            mqtt_port,
            serial=serial or name,
            manufacturer=manufacturer,
            user=user,
            password=os.environ.get("MQTT_PASSWORD", ""),
            tls=mqtt_tls,
        ) as station,
    ):
        typer.echo(f"ready {station.prefix} {os.getpid()}")
        while not stop.is_set():
            station.serve(time.monotonic() + TURN_S)
        stop.leave("The station is offline; submitted jobs go on.")
