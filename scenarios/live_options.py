"""Options that commands for a running fleet share, and which fleet is meant where none is named."""

from typing import Annotated

import typer

from fleet.errors import FleetError

ENDPOINT = "tcp/127.0.0.1:7447"
EndpointOption = Annotated[str, typer.Option(envvar="THERMOFLEET_ENDPOINT", help="Of the fleet's router.")]
PolicyOption = Annotated[
    str,
    typer.Option(
        help="Who gets what: matching, ssi (sequential single-item), each also as quickest_…, which heeds the time "
        "until the finish and not the heat; for arms without an auctioneer: consensus."
    ),
]
FleetOption = Annotated[
    str, typer.Option(envvar="THERMOFLEET_FLEET", help="Name of the fleet; not needed where only one is there.")
]


def the_fleet(named: str, endpoint: str) -> str:
    """The fleet that is meant: the one named, or the only one at the router.

    Raises:
        FleetError: nobody is there, or several fleets are.
    """
    from fleet.bus.discover import fleets_at

    if named:
        return named
    there = fleets_at(endpoint)
    if len(there) == 1:
        return there[0]
    if there:
        raise FleetError(f"Several fleets meet at {endpoint}: {', '.join(there)}. Choose one with --fleet.")
    raise FleetError(f"Nobody is at {endpoint} yet, so there is no fleet to choose. Name the one to wait for: --fleet.")
