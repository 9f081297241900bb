"""Options that commands of a live fleet share, with the ranges of their values."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from fleet.errors import FleetError


def number(text: str, low: float = 0.0, high: float = math.inf, *, above: bool = False) -> Any:
    """Option whose number must be `low` or more, or with `above` more than that, and at most `high`.

    Any: typer keeps the class of options private.
    """
    if above:
        limits = f"> {low:g}" if high == math.inf else f"> {low:g} and at most {high:g}"
    else:
        limits = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"

    def check(option: typer.CallbackParam, value: float | None) -> float | None:
        if value is None or ((low < value if above else low <= value) and value <= high and math.isfinite(value)):
            return value
        raise FleetError(f"{option.opts[0]} must be {limits} (got {value:g}).")

    return typer.Option(help=text, callback=check)


SpeedOption = Annotated[float, number("Fleet seconds per real second.", above=True)]
RateOption = Annotated[float, number("State messages per real second.", high=100, above=True)]
SeedOption = Annotated[int, number("Random seed of the scenario's jobs, the sensor noise and the policy.")]
ModelOption = Annotated[Literal["twin", "blind"], typer.Option(help="Difficulty model.")]
JobsOption = Annotated[
    Literal["scenario", "none"],
    typer.Option(help="scenario: the scenario's job stream; none: submitted jobs only."),
]
JournalOption = Annotated[Path | None, typer.Option(help="Folder of the journals; an existing journal is continued.")]
ScenarioFleetOption = Annotated[str, typer.Option(help="Name of the fleet. Default: the scenario's name.")]
