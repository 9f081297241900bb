"""Options that commands of a live fleet share, with the ranges of their values."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from fleet.bus.protocol.auction import MAX_SPEED, MIN_SPEED
from scenarios.cli.options import MAX_SEED, check_name, number

SpeedOption = Annotated[float, number("Fleet seconds per real second.", MIN_SPEED, MAX_SPEED)]
RateOption = Annotated[float, number("State messages per real second.", 0, 100, above=True)]
SeedOption = Annotated[int, number("Random seed of the scenario's jobs, the sensor noise and the policy.", 0, MAX_SEED)]
ModelOption = Annotated[Literal["twin", "blind"], typer.Option(help="Difficulty model.")]
JobsOption = Annotated[
    Literal["scenario", "none"],
    typer.Option(help="scenario: the scenario's job stream; none: submitted jobs only."),
]
JournalOption = Annotated[Path | None, typer.Option(help="Folder of the journals; an existing journal is continued.")]
NewEpochOption = Annotated[
    bool, typer.Option("--new-epoch", help="Begin with empty journals although other participants know older ones.")
]
ScenarioFleetOption = Annotated[
    str, typer.Option(help="Name of the fleet. Default: the scenario's name.", callback=check_name)
]
