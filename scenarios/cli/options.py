"""Options that several commands share."""

import shlex
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError, LogError, nearest, printable
from fleet.fields import argument, option
from scenarios.spec import options as spec_options
from scenarios.table import TABLE_FILES

if TYPE_CHECKING:  # slow to import
    from scenarios.prepare.randomisation import Randomisation
    from scenarios.spec.schema import Scenario
    from twin.logs.recording import Recording


def command_line(ctx: typer.Context) -> str:
    """The command that is running with every value that is not its default, to be typed in a shell."""
    words = ["thermofleet", *(ctx.info_name or "").split()]
    for parameter in ctx.command.params:
        value = ctx.params.get(parameter.name or "")
        if parameter.param_type_name == "argument":
            words += [str(each) for each in (value if isinstance(value, list | tuple) else [value]) if each is not None]
        elif value is True:
            words.append(parameter.opts[0])
        elif value not in (None, False, (), [], parameter.default):
            for each in value if isinstance(value, list | tuple) else [value]:
                words += [parameter.opts[0], str(each)]
    return shlex.join(words)


def check_table_file(out: Path, others: tuple[str, ...] = ()) -> None:
    """Check the value of --out for a table, .csv or .xlsx, or a file with one of the other endings, before any work.

    Raises:
        FleetError: it has another ending, is a folder or a table that exists, or needs an extra that is not installed.
    """
    from scenarios.extras import require_extra
    from scenarios.result_folder import check_file

    check_file(out, (*others, *TABLE_FILES), overwrite=True)
    if out.suffix.lower() in TABLE_FILES and out.exists():
        raise FleetError(f"'{out}' exists; give another --out, or delete it.")
    if out.suffix.lower() == ".xlsx":
        require_extra("xlsx")


SCENARIO = argument("A library name (see `thermofleet show`), a .toml file, or an instance of the suite, as test/0017.")
RANDOMISE = option(
    "Randomise every shift of a scenario; the value is TOML: ambient_k=[LOW,HIGH] (K, added to the ambient "
    "temperature), arrivals=[LOW,HIGH] (factor of the arrival rate), variants=[{...},...] (fleets to choose from, "
    "as overrides of the scenario). May be repeated.",
    None,
    metavar="FIELD=VALUE",
)
WORKERS = option("Number of processes. Default: one per core.", None, low=1, high=1024)
JSON = option("Print JSON.", False, flag="--json")
OVERWRITE = option("Replace an earlier result.", False)

# Live fleets.
ENDPOINT = option("Endpoint of the fleet's router.", spec_options.ENDPOINT, env="THERMOFLEET_ENDPOINT")
FLEET = option("Name of the fleet. Default: the only one at the router.", "", env="THERMOFLEET_FLEET", is_name=True)

# Twins.
SCENARIO_OR_LOG = argument("A library name (see `thermofleet show`) or a .toml file; or use --log.", None)
LOG = option("A log of a real arm, or a folder of logs: .csv, .csv.gz, .parquet.", None)
SKIP_DAMAGED = option("Skip damaged lines of a log.", False)
TWINS = argument("A folder that `thermofleet twin train` wrote.")
TWIN_ARM = option("Name of the arm, if the folder contains several twins.", None)
NETWORK = option("A folder that `thermofleet twin identify` wrote. Default: a nominal Gen3.", None)
SCENARIO_ARM = option("Arm of the scenario; default: the first.", None)
LOG_ARM = option(
    "Name of the arm; in a log of several arms (telemetry.parquet), the one to choose.", None, is_name=True
)


def channel_of(scenario: "Scenario", **fields: Any) -> Channel:
    """The channel that the command line describes; `fields` are those of `Channel`, which checks them (hence Any).

    Raises:
        FleetError: a field has another form, or is out of range.
    """
    try:
        channel = Channel(**fields)
        channel.check([arm.name for arm in scenario.arms])
    except ValueError as error:
        raise FleetError(str(error)) from error
    return channel


def parse_randomisation(texts: list[str] | None) -> "Randomisation | None":
    """The randomisation of texts such as `ambient_k=[-2, 8]`, each a TOML document; None without any.

    Raises:
        FleetError: a field has another form, or is out of range.
    """
    from scenarios.prepare.randomisation import Randomisation

    if not texts:
        return None
    allowed, given = [field.name for field in fields(Randomisation)], dict[str, Any]()
    for text in texts:
        try:
            found = tomllib.loads(text)
        except (ValueError, RecursionError):
            found = None
        if not found:
            raise FleetError(
                f"--randomise must be FIELD=VALUE in TOML, as in 'ambient_k=[-2,8]' (got '{printable(text)}')."
            )
        for name in found:
            if name not in allowed:
                raise FleetError(f"--randomise has no field '{printable(name)}'{nearest(name, allowed)}")
            if name in given:
                raise FleetError(f"--randomise {name} is given twice; give it once.")
        given |= found
    try:
        varied = Randomisation(**given)
    except ValueError as error:
        raise FleetError(str(error).replace("Randomisation.", "--randomise ")) from error
    if not varied:
        raise FleetError(f"--randomise changes nothing (got '{printable(', '.join(texts))}'); leave it out.")
    return varied


def split_names(text: str) -> list[str]:
    """Names that are separated by commas."""
    return [name.strip() for name in text.split(",")]


def the_fleet(name: str, endpoint: str) -> str:
    """The named fleet, or the only one at the router.

    Raises:
        FleetError: there is no fleet, or there are several.
    """
    from fleet.bus.router import fleets_at

    if name:
        return name
    fleets = fleets_at(endpoint)
    if len(fleets) == 1:
        return fleets[0]
    if fleets:
        raise FleetError(f"There are several fleets at {endpoint}: {', '.join(fleets)}. Choose one with --fleet.")
    raise FleetError(f"There is no fleet at {endpoint} yet. Name the one to wait for with --fleet.")


def recordings_of(log: Path, skip_damaged: bool, *, measured: bool = True) -> "list[Recording]":
    """The recordings of a log file, or of all logs in a folder.

    Args:
        measured: As in `twin.logs.reader.read`, of a file.

    Raises:
        FleetError: names file and line, and how to go on without them.
    """
    from twin.logs.reader import read, read_folder

    damaged = "skip" if skip_damaged else "refuse"
    with explain_damage():
        return read_folder(log, damaged=damaged) if log.is_dir() else read(log, damaged=damaged, measured=measured)


def arm_recordings(log: Path, arm: str | None, skip_damaged: bool, *, measured: bool = True) -> "list[Recording]":
    """The recordings of one arm; raises as `recordings_of` and `twin.logs.reader.of_arm`."""
    from twin.logs.reader import of_arm

    return of_arm(recordings_of(log, skip_damaged, measured=measured), arm, log)


@contextmanager
def explain_damage() -> Iterator[None]:
    """Name the option of the command line in errors of damaged logs."""
    try:
        yield
    except LogError as error:
        raise FleetError(str(error).replace('damaged="skip"', "--skip-damaged")) from error
