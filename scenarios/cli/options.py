"""Options that several commands share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agents.registry import names_of
from fleet.errors import FleetError, LogError

if TYPE_CHECKING:
    from twin.logs.recording import Recording

ScenarioArg = Annotated[str, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file.")]
SeedOption = Annotated[int, typer.Option(help="Random seed of jobs, sensor noise and policy; 0 or more.")]
DifficultyOption = Annotated[str, typer.Option(help="What scores the plans: twin, blind or oracle.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result in --out.")]

# Communication between the arms of a simulated shift.
_CHANNEL = "Communication between arms"
TopologyOption = Annotated[
    str,
    typer.Option(
        help="Which arms receive each other's messages: complete, star, ring, line, random_geometric.",
        rich_help_panel=_CHANNEL,
    ),
]
RadiusOption = Annotated[
    float, typer.Option(help="random_geometric: range of an arm in a unit square.", rich_help_panel=_CHANNEL)
]
TopologySeedOption = Annotated[
    int, typer.Option(help="random_geometric: seed of the arms' positions.", rich_help_panel=_CHANNEL)
]
DelayOption = Annotated[float, typer.Option(help="Least delay of a message, simulated s.", rich_help_panel=_CHANNEL)]
JitterOption = Annotated[
    float, typer.Option(help="Largest extra delay, drawn for each message, simulated s.", rich_help_panel=_CHANNEL)
]
LossOption = Annotated[
    float, typer.Option(help="Probability that a message is lost on a link.", rich_help_panel=_CHANNEL)
]
PartitionOption = Annotated[
    list[str] | None,
    typer.Option(
        help="FROM_S:TO_S:ARM,ARM|ARM,ARM: between these times messages stay inside each group. May be repeated.",
        rich_help_panel=_CHANNEL,
    ),
]

# Live fleets.
ENDPOINT = "tcp/127.0.0.1:7447"
EndpointOption = Annotated[str, typer.Option(envvar="THERMOFLEET_ENDPOINT", help="Endpoint of the fleet's router.")]
PolicyOption = Annotated[
    str,
    typer.Option(
        help=f"Who gets which job. In the auctioneer: {names_of('central')}. In each arm, without an auctioneer: "
        f"{names_of('arm')}, or a folder of train. Your own as FILE.py:CLASS runs where its scope says."
    ),
]
FleetOption = Annotated[
    str, typer.Option(envvar="THERMOFLEET_FLEET", help="Name of the fleet; not needed if there is only one.")
]

# Twins.
ScenarioOrLog = Annotated[
    str | None, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file; or use --log.")
]
LogOption = Annotated[
    Path | None, typer.Option("--log", help="A log of a real arm, or a folder of logs: .csv, .csv.gz, .parquet.")
]
DamagedOption = Annotated[
    bool, typer.Option("--skip-damaged", help="Skip the lines of a log that cannot be read, instead of stopping.")
]
ArmOption = Annotated[str | None, typer.Option(help="Train only this arm; default: every arm of the scenario.")]
TwinsArg = Annotated[Path, typer.Argument(help="A folder that `thermofleet twin train` wrote.")]
WhichOption = Annotated[str | None, typer.Option("--arm", help="The arm of the twin, if the folder holds several.")]


def the_fleet(name: str, endpoint: str) -> str:
    """The named fleet, or the only one at the router.

    Raises:
        FleetError: there is no fleet, or there are several.
    """
    from fleet.bus.client.discover import fleets_at

    if name:
        return name
    fleets = fleets_at(endpoint)
    if len(fleets) == 1:
        return fleets[0]
    if fleets:
        raise FleetError(f"There are several fleets at {endpoint}: {', '.join(fleets)}. Choose one with --fleet.")
    raise FleetError(f"There is no fleet at {endpoint} yet. Name the one to wait for with --fleet.")


def check_one_source(scenario: str | None, log: Path | None) -> None:
    """Check that either a scenario or a log is given.

    Raises:
        FleetError: none or both are given.
    """
    if (scenario is None) == (log is None):
        given = "neither" if scenario is None else "both"
        raise FleetError(f"Give either a scenario or --log FILE_OR_FOLDER (got {given}).")


def recordings_of(log: Path, skip_damaged: bool) -> "list[Recording]":
    """The recordings of a log file, or of all logs in a folder.

    Raises:
        FleetError: names file and line, and how to go on without them.
    """
    from twin.logs.reader import read, read_folder

    damaged = "skip" if skip_damaged else "refuse"
    try:
        return read_folder(log, damaged=damaged) if log.is_dir() else read(log, damaged=damaged)
    except LogError as error:
        raise FleetError(str(error).replace('damaged="skip"', "--skip-damaged")) from error
