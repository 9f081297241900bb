"""`thermofleet clear`: free the space of an absent arm."""

import getpass
from typing import Annotated

import typer

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.operator import Cleared, ClearRequest
from fleet.errors import BusError, FleetError
from scenarios.cli.options import ENDPOINT, EndpointOption, FleetOption, check_name, the_fleet
from scenarios.cli.terminal import echo

MOST_CHARACTERS = 128
"""Longest name of a person."""
REPLY_S = 5.0
"""Real seconds to wait for a reply."""


def clear_command(
    arm: Annotated[str, typer.Argument(help="Name of the arm.", callback=check_name)],
    by: Annotated[str, typer.Option(help="Who requests it, for the journal. Default: the name of the user.")] = "",
    endpoint: EndpointOption = ENDPOINT,
    fleet: FleetOption = "",
) -> None:
    """Free the space that an absent arm takes, so that other arms can use it.

    First stop the process of the arm, and make sure that the arm is at home
    or removed, and switched off. Start the process again only when the arm is
    at home. The request is refused for an arm that is present, because its own
    quotes report its space.
    """
    check_person(by)
    with BusClient(endpoint, the_fleet(fleet, endpoint)) as link:
        request = ClearRequest(arm, by or user_name())
        replies = link.query_and_wait(keys.of_jobs(link.fleet, "clear"), request, Cleared, timeout_s=REPLY_S)
        name = link.fleet
    for reason in replies.refusals:
        where = " by all arms" if replies.messages else ""
        raise BusError(f"The space of '{arm}' was not freed{where}: {reason}")
    if not replies.messages:
        raise BusError(
            f"Neither an auctioneer nor an arm of fleet '{name}' replied within {REPLY_S:g} s. With TLS, use a "
            "certificate of the role operator."
        )
    echo(f"{arm}: its space is free until the arm reports its space again.")


def check_person(by: str) -> None:
    """Check the name of the person who requests something.

    Raises:
        FleetError: it is too long.
    """
    if len(by) > MOST_CHARACTERS:
        raise FleetError(f"--by must have at most {MOST_CHARACTERS} characters (got {len(by)}).")


def user_name() -> str:
    """Name of the user of this process; "" if it has none."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return ""
