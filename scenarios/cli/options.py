"""Options of commands: how they are declared, those that several commands share, and what they mean."""

import inspect
import shlex
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, Field, dataclass, fields, replace
from functools import wraps
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import typer

from fleet.bus.exchange.channel import Channel
from fleet.errors import FleetError, LogError, nearest, printable
from fleet.fields import Option, argument, option, option_of, options_of
from scenarios.spec import options as spec_options
from scenarios.table import TABLE_FILES

if TYPE_CHECKING:  # slow to import
    from scenarios.prepare.randomisation import Randomisation
    from scenarios.progress import Progress
    from scenarios.spec.schema import Scenario
    from twin.logs.recording import Recording


_GIVEN = ("COMMANDLINE", "ENVIRONMENT")
"""Names of typer's sources of a value that is not a default; their class is private."""
Given = dict[str, Any]
"""Values of fields that the command line gives, by field; the others keep the default of the dataclass."""


class From:
    """Marks a parameter `Annotated[Given, From(KIND, "field", …)]`, which gets options in its place.

    Args:
        kind: A dataclass whose fields are declared with `fleet.fields.option`.
        names: The fields; all of them if there are none.
        shown: Texts of defaults that depend on other options of this command, by field.
        defaults: Of fields whose default is another one in this command.
    """

    def __init__(
        self, kind: type, *names: str, shown: Mapping[str, str] = MappingProxyType({}), **defaults: Any
    ) -> None:
        known = options_of(kind)
        self.defaults = defaults
        self.options = {name: known[name] for name in names or known}
        self.options |= {name: replace(known[name], shown=None) for name in defaults}
        self.options |= {name: replace(known[name], shown=text) for name, text in shown.items()}
        self.fields: dict[str, Field[Any]] = {each.name: each for each in fields(kind) if each.name in self.options}

    def parameters(self) -> list[inspect.Parameter]:
        """One keyword parameter for each field."""
        return [
            _parameter(name, self.fields[name].type, known, self._default(name)) for name, known in self.options.items()
        ]

    def _default(self, name: str) -> Any:
        default = self.defaults.get(name, self.fields[name].default)
        return None if self.options[name].shown is not None or default in (MISSING, ()) else default

    def take(self, values: dict[str, Any], ctx: typer.Context) -> Given:
        """Remove the own values from those of all parameters, and return the given ones.

        Raises:
            FleetError: a text has another form.
        """
        own = {name: values.pop(name) for name in self.options}
        given = {name: value for name, value in own.items() if _is_given(ctx, name) or name in self.defaults}
        for name, value in given.items():
            if parse := self.options[name].parse:
                try:
                    given[name] = tuple(parse(text) for text in value)
                except ValueError as error:
                    raise FleetError(str(error)) from error
        return given


def _is_given(ctx: typer.Context, name: str) -> bool:
    return getattr(ctx.get_parameter_source(name), "name", "") in _GIVEN


def first_given(ctx: typer.Context, *names: str) -> str:
    """The first of these options that is given; "" if none is."""
    return next((f"--{name.replace('_', '-')}" for name in names if _is_given(ctx, name)), "")


def with_fields(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of a command, whose options and arguments are declared as typer reads them."""
    parameters, sources = list[inspect.Parameter](), dict[str, From]()
    has_context = False
    for each in inspect.signature(function, eval_str=True).parameters.values():
        marks = [mark for mark in get_args(each.annotation) if isinstance(mark, From)]
        if marks:
            sources[each.name] = marks[0]
            parameters += marks[0].parameters()
        elif isinstance(each.default, Field) and (known := option_of(each.default, each.annotation)):
            parameters.append(_parameter(each.name, each.annotation, known, each.default.default))
        elif each.annotation is typer.Context:
            has_context = True
        else:
            parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @wraps(function)
    def command(ctx: typer.Context, **values: Any) -> Any:
        given = {name: source.take(values, ctx) for name, source in sources.items()}
        return function(**values, **given, **({"ctx": ctx} if has_context else {}))

    parameters.append(inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context))
    command.__signature__ = inspect.Signature(parameters)  # pyright: ignore[reportAttributeAccessIssue]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    return command


def _parameter(name: str, kind: Any, known: Option, default: Any) -> inspect.Parameter:
    """A keyword parameter as typer reads it (Any: the type of a field or parameter, and a value of it)."""
    flag = known.flag or f"--{name.replace('_', '-')}"
    called = name.upper() if known.is_argument else flag.partition("/")[0]

    def check(_: typer.CallbackParam, value: object) -> object:
        if value is not None and (problem := known.problem(called, value, default)):
            raise FleetError(problem)
        return value

    shared: Any = {
        "help": known.help,
        "callback": check,
        "show_default": True if known.shown is None else known.shown or False,
        "rich_help_panel": known.panel or None,
        "metavar": known.metavar,
        "envvar": known.env,
        "autocompletion": (lambda: list(known.choices)) if known.choices else None,
    }
    declared = typer.Argument(**shared) if known.is_argument else typer.Option(flag, **shared)
    plain = list[str] if known.parse else _plain(kind, known)
    annotation = Annotated[plain | None if default is None else plain, declared]
    default = inspect.Parameter.empty if default is MISSING else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _plain(kind: Any, known: Option) -> Any:
    """The type of a field as typer reads it, without None; names are texts, whose choices the option has."""
    if known.choices:
        return str
    if get_origin(kind) in (Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    return kind


def flags_of(value: object, *names: str) -> tuple[str, ...]:
    """Arguments of a command line that give these fields of a dataclass; those that are empty or False are left out."""
    words: list[str] = []
    for name in names:
        given, flag = getattr(value, name), options_of(type(value))[name].flag or f"--{name.replace('_', '-')}"
        if given is True:
            words.append(flag)
        elif given not in (None, False, ""):
            words += [flag, str(given)]
    return tuple(words)


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
ENDPOINT_VARIABLE, FLEET_VARIABLE = "THERMOFLEET_ENDPOINT", "THERMOFLEET_FLEET"
ENDPOINT = option("Endpoint of the fleet's router.", spec_options.ENDPOINT, env=ENDPOINT_VARIABLE)
FLEET = option("Name of the fleet. Default: the only one at the router.", "", env=FLEET_VARIABLE, is_name=True)

_LISTEN = "ros2 listen"


@dataclass(frozen=True, kw_only=True)
class Ros2Spec:
    """How a fleet meets ROS 2."""

    domain: int = option("The ROS 2 domain.", 0, low=0, high=232, env="ROS_DOMAIN_ID")
    router: str = option("Router of ROS 2 (rmw_zenohd), as tcp/127.0.0.1:7447; default: the fleet's router.", "")
    warning_c: float = option("Motor temperature at which a warning begins, °C.", 60.0, low=0, high=200)
    error_c: float = option("bridge: motor temperature at which an error begins, °C.", 75.0, low=0, high=200)
    humble: bool = option("bridge: for ROS 2 Humble, whose keys have no type hash.", False)
    arm: str = option("Name of the arm in the fleet.", "real", is_name=True, panel=_LISTEN)
    temperatures: str = option(
        "Topic of the diagnostic_msgs/DiagnosticArray with its motor temperatures.", "", panel=_LISTEN
    )
    hardware: str = option(
        "Text before /JOINT in the hardware_id of these diagnostics; default: none.", "", panel=_LISTEN
    )
    joints: str = option("Names of its joints in ROS 2, from joint 1 on.", "", panel=_LISTEN)
    rate_hz: float = option("State messages per real second.", 10.0, low=0, high=100, above=True, panel=_LISTEN)
    twin: Path | None = option("Folder of the arm's twin, which scores the motion.", None, panel=_LISTEN)
    network: Path | None = option(
        "Folder of `thermofleet twin identify`; the temperatures that it yields are in the states.", None, panel=_LISTEN
    )


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
    """Names that are separated by commas.

    Raises:
        FleetError: one is empty.
    """
    names = [name.strip() for name in text.split(",")]
    if "" in names:
        raise FleetError(f"A name is empty in '{printable(text)}'. Separate names by one comma each.")
    return names


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
    if endpoint.startswith("tls/"):
        raise FleetError(
            f"With TLS nobody may list the fleets at {endpoint}, and there is no roster.json beside the certificate: "
            "name the fleet with --fleet."
        )
    raise FleetError(f"There is no fleet at {endpoint} yet. Name the one to wait for with --fleet.")


def recordings_of(
    log: Path, skip_damaged: bool, *, measured: bool = True, progress: "Progress | None" = None
) -> "list[Recording]":
    """The recordings of a log file, or of all logs in a folder.

    Args:
        measured: As in `twin.logs.reader.read`, of a file.
        progress: Of the command; None for a bar of its own.

    Raises:
        FleetError: names file and line, and how to go on without them.
    """
    from scenarios.terminal import progress_bar
    from twin.logs.reader import read, read_folder

    damaged = "skip" if skip_damaged else "refuse"
    with explain_damage(), nullcontext(progress) if progress else progress_bar(kept="") as report:
        report("reading the log", 0.0)
        return read_folder(log, damaged=damaged) if log.is_dir() else read(log, damaged=damaged, measured=measured)


def arm_recordings(
    log: Path, arm: str | None, skip_damaged: bool, *, measured: bool = True, progress: "Progress | None" = None
) -> "list[Recording]":
    """The recordings of one arm; raises as `recordings_of` and `twin.logs.reader.of_arm`."""
    from twin.logs.reader import of_arm

    return of_arm(recordings_of(log, skip_damaged, measured=measured, progress=progress), arm, log)


@contextmanager
def explain_damage() -> Iterator[None]:
    """Name the option of the command line in errors of damaged logs."""
    try:
        yield
    except LogError as error:
        raise FleetError(str(error).replace('damaged="skip"', "--skip-damaged")) from error
