"""What the commands of `thermofleet twin` have in common: options of one meaning, and logs as recordings."""

from pathlib import Path
from typing import Annotated, Any

import typer

from fleet.errors import FleetError, LogError

ScenarioArg = Annotated[
    str | None, typer.Argument(help="A library name (see `thermofleet list`) or a .toml file; or use --log.")
]
LogOption = Annotated[
    Path | None, typer.Option("--log", help="A log of a real arm, or a folder of logs: .csv, .csv.gz, .parquet.")
]
DamagedOption = Annotated[
    bool, typer.Option("--skip-damaged", help="Leave out lines of a log that cannot be used, instead of stopping.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result in --out.")]
ArmOption = Annotated[str | None, typer.Option(help="Only this arm; without it, every arm of the scenario.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print figures as JSON.")]
TwinsArg = Annotated[Path, typer.Argument(help="A folder that `thermofleet twin train` wrote.")]
WhichOption = Annotated[str | None, typer.Option("--arm", help="Whose twin, where the folder holds several.")]


def one_source(scenario: str | None, log: Path | None) -> str | None:
    """The scenario, or None where it is a log; exactly one of the two must be given."""
    if (scenario is None) == (log is None):
        told = "neither" if scenario is None else "both"
        raise FleetError(f"Give either a scenario or --log FILE_OR_FOLDER (got {told}).")
    return scenario


def recordings_of(log: Path, skip_damaged: bool) -> list[Any]:
    """The recordings of a log file, or of all logs of a folder.

    Raises:
        FleetError: names file and line, and how to go on without it.
    """
    from twin.logs import read, read_folder

    damaged = "skip" if skip_damaged else "refuse"
    try:
        return read_folder(log, damaged=damaged) if log.is_dir() else read(log, damaged=damaged)
    except LogError as error:
        raise FleetError(str(error).replace('damaged="skip"', "--skip-damaged")) from error
