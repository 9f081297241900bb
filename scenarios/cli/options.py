"""Options that several commands share."""

import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from fleet.bus.exchange.channel import Channel, Partition
from fleet.errors import NAME_RULE, FleetError, LogError, is_name, nearest, printable
from fleet.fields import MAX_SEED, Option
from scenarios.cli.from_fields import declared
from scenarios.spec.options import ENDPOINT as ENDPOINT
from scenarios.spec.options import RunSpec

Number = TypeVar("Number", int, float, None)

if TYPE_CHECKING:  # slow to import
    from scenarios.prepare.randomisation import Randomisation
    from scenarios.spec.schema import Scenario
    from twin.logs.recording import Recording


def number(text: str, low: float, high: float, *names: str, above: bool = False, **more: Any) -> Any:
    """Option whose number must be from `low` to `high`, or with `above` more than `low`; without a value, it is None.

    Any: typer keeps the class of options private, and `more` goes to `typer.Option`.
    """
    known = Option(help=text, low=low, high=high, above=above)

    def check(option: typer.CallbackParam, value: Number) -> Number:
        if problem := known.problem(option.opts[0], value):
            raise FleetError(problem)
        return value

    return typer.Option(*names, help=text, callback=check, **more)


def check_name(option: typer.CallbackParam, value: str) -> str:
    """Callback of a parameter that names a fleet or a participant, which becomes part of keys and of a file name.

    Its default needs no check: "" for none.

    Raises:
        FleetError: it does not follow the rule for names.
    """
    if value != option.default and not is_name(value):
        name = option.opts[0] if option.param_type_name == "option" else option.opts[0].upper()
        raise FleetError(f"{name} must have {NAME_RULE} (got '{printable(value)}').")
    return value


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


ScenarioArg = Annotated[
    str,
    typer.Argument(
        help="A library name (see `thermofleet show`), a .toml file, or an instance of the suite, as test/0017."
    ),
]
SeedOption = Annotated[int, number("Random seed of jobs, sensor noise and policy.", 0, MAX_SEED)]
DifficultyOption = Annotated[str, declared(RunSpec, "difficulty")]
RiskOption = Annotated[str, declared(RunSpec, "risk")]
RandomiseOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FIELD=VALUE",
        help="Randomise every shift of a scenario; the value is TOML: ambient_k=[LOW,HIGH] (K, added to the ambient "
        "temperature), arrivals=[LOW,HIGH] (factor of the arrival rate), variants=[{...},...] (fleets to choose from, "
        "as overrides of the scenario). May be repeated.",
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an earlier result in --out.")]

# Communication between the arms of a simulated shift.
TopologyOption = Annotated[str, declared(Channel, "topology")]
RadiusOption = Annotated[float, declared(Channel, "radius")]
TopologySeedOption = Annotated[int, declared(Channel, "topology_seed")]
DelayOption = Annotated[float, declared(Channel, "delay_s")]
JitterOption = Annotated[float, declared(Channel, "jitter_s")]
LossOption = Annotated[float, declared(Channel, "loss")]
PartitionOption = Annotated[list[str] | None, declared(Channel, "partitions")]

# Live fleets.
EndpointOption = Annotated[str, typer.Option(envvar="THERMOFLEET_ENDPOINT", help="Endpoint of the fleet's router.")]
FleetOption = Annotated[
    str,
    typer.Option(
        envvar="THERMOFLEET_FLEET", help="Name of the fleet; not needed if there is only one.", callback=check_name
    ),
]

# Twins.
ScenarioOrLog = Annotated[
    str | None, typer.Argument(help="A library name (see `thermofleet show`) or a .toml file; or use --log.")
]
LogOption = Annotated[
    Path | None, typer.Option("--log", help="A log of a real arm, or a folder of logs: .csv, .csv.gz, .parquet.")
]
DamagedOption = Annotated[bool, typer.Option("--skip-damaged", help="Skip damaged lines of a log.")]
ArmOption = Annotated[str | None, typer.Option(help="Train only this arm; default: every arm of the scenario.")]
TwinsArg = Annotated[Path, typer.Argument(help="A folder that `thermofleet twin train` wrote.")]
WhichOption = Annotated[
    str | None, typer.Option("--arm", help="Name of the arm, if the folder contains several twins.")
]


def channel_of(scenario: "Scenario", partition: Sequence[str] | None = None, **fields: Any) -> Channel:
    """The channel that the command line describes; `fields` are those of `Channel`, which checks them (hence Any).

    Raises:
        FleetError: says what was given and what is allowed.
    """
    try:
        if partition is not None:
            fields["partitions"] = tuple(Partition.parse(text) for text in partition)
        channel = Channel(**fields)
        channel.check([arm.name for arm in scenario.arms])
    except ValueError as error:
        raise FleetError(str(error)) from error
    return channel


def parse_randomisation(texts: list[str] | None) -> "Randomisation | None":
    """The randomisation of texts such as `ambient_k=[-2, 8]`, each a TOML document; None without any.

    Raises:
        FleetError: says what was given and what is allowed.
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
