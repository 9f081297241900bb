"""Options of a command: fields of dataclasses, and parameters whose default is an `option` or an `argument`."""

import inspect
from collections.abc import Callable
from dataclasses import MISSING, Field, fields, replace
from functools import wraps
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import typer

from fleet.errors import FleetError
from fleet.fields import Option, option_of, options_of

_GIVEN = ("COMMANDLINE", "ENVIRONMENT")
"""Names of typer's sources of a value that is not a default; their class is private."""
Given = dict[str, Any]
"""Values of fields that the command line gives, by field; the others keep the default of the dataclass."""


class From:
    """Marks a parameter `Annotated[Given, From(KIND, "field", …)]`, which gets options in its place.

    Args:
        kind: A dataclass whose fields are declared with `fleet.fields.option`.
        names: The fields; all of them if there are none.
        defaults: Of fields whose default is another one in this command.
    """

    def __init__(self, kind: type, *names: str, **defaults: Any) -> None:
        known = options_of(kind)
        self.defaults = defaults
        self.options = {name: known[name] for name in names or known}
        self.options |= {name: replace(known[name], shown=None) for name in defaults}
        self.fields: dict[str, Field[Any]] = {each.name: each for each in fields(kind) if each.name in self.options}

    def parameters(self) -> list[inspect.Parameter]:
        """One keyword parameter for each field."""
        return [
            _parameter(name, self.fields[name].type, option, self._default(name))
            for name, option in self.options.items()
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
        sources = {name: getattr(ctx.get_parameter_source(name), "name", "") for name in own}
        given = {name: value for name, value in own.items() if sources[name] in _GIVEN or name in self.defaults}
        for name, value in given.items():
            if parse := self.options[name].parse:
                try:
                    given[name] = tuple(parse(text) for text in value)
                except ValueError as error:
                    raise FleetError(str(error)) from error
        return given


def with_fields(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function of a command, whose options and arguments are declared as typer reads them."""
    parameters, sources = list[inspect.Parameter](), dict[str, From]()
    has_context = False
    for each in inspect.signature(function, eval_str=True).parameters.values():
        marks = [mark for mark in get_args(each.annotation) if isinstance(mark, From)]
        if marks:
            sources[each.name] = marks[0]
            parameters += marks[0].parameters()
        elif isinstance(each.default, Field) and (option := option_of(each.default, each.annotation)):
            parameters.append(_parameter(each.name, each.annotation, option, each.default.default))
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


def _parameter(name: str, kind: Any, option: Option, default: Any) -> inspect.Parameter:
    """A keyword parameter as typer reads it (Any: the type of a field or parameter, and a value of it)."""
    flag = option.flag or f"--{name.replace('_', '-')}"
    called = name.upper() if option.is_argument else flag.partition("/")[0]

    def check(_: typer.CallbackParam, value: object) -> object:
        if problem := option.problem(called, value, default):
            raise FleetError(problem)
        return value

    shared: Any = {
        "help": option.help,
        "callback": check,
        "show_default": True if option.shown is None else option.shown or False,
        "rich_help_panel": option.panel or None,
        "metavar": option.metavar,
        "envvar": option.env,
        "autocompletion": (lambda: list(option.choices)) if option.choices else None,
    }
    declared = typer.Argument(**shared) if option.is_argument else typer.Option(flag, **shared)
    plain = list[str] if option.parse else _plain(kind, option)
    annotation = Annotated[plain | None if default is None else plain, declared]
    default = inspect.Parameter.empty if default is MISSING else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _plain(kind: Any, option: Option) -> Any:
    """The type of a field as typer reads it, without None; names are texts, whose choices the option has."""
    if option.choices:
        return str
    if get_origin(kind) in (Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    return kind


def flags_of(value: object, *names: str) -> tuple[str, ...]:
    """Words of a command line that give these fields of a dataclass; those that are empty or False are left out."""
    words: list[str] = []
    for name in names:
        given, flag = getattr(value, name), options_of(type(value))[name].flag or f"--{name.replace('_', '-')}"
        if given is True:
            words.append(flag)
        elif given not in (None, False, ""):
            words += [flag, str(given)]
    return tuple(words)
