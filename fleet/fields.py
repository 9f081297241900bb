"""Fields of dataclasses, and parameters of commands, with their sentence, bounds and choices."""

from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import cache
from math import inf
from numbers import Integral, Real
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from fleet.errors import NAME_RULE, ArgumentError, is_name, nearest, printable

MAX_SEED = 2**32 - 1
MIN_SPEED, MAX_SPEED = 0.001, 10_000.0
"""Of a fleet, in fleet seconds per real second."""
_KEY = "option"


@dataclass(frozen=True, kw_only=True)
class Option:
    """What a field means and which values it takes; its name, type and default are those of the field."""

    help: str
    """A sentence, with the unit of the value."""
    low: float = -inf
    high: float = inf
    above: bool = False
    """Whether the value must be more than `low`, not equal to it."""
    choices: tuple[str, ...] = ()
    """Allowed names."""
    kind: type | None = None
    """int, float or bool; None for other values. That of a field follows from its type."""
    takes_none: bool = False
    noun: str = ""
    """What an error calls one of these names; "" for the name of the field."""
    is_name: bool = False
    """Whether a text must follow the rule for names, which become parts of keys and files; "" is none."""
    is_argument: bool = False
    """Whether a command takes it by position."""
    flag: str = ""
    """Name on the command line; "" for that of the field."""
    panel: str = ""
    """Group in the help; "" for the group without a name."""
    shown: str | None = None
    """Text of the default in the help, if it depends on other options; "" for none."""
    parse: Callable[[str], object] | None = None
    """From the text of one of several values, for a field that is a tuple; raises ValueError."""
    metavar: str | None = None
    env: str | None = None
    """Environment variable with the value."""

    @property
    def limits(self) -> str:
        """The bounds as text."""
        if self.above:
            return f"> {self.low:.10g} and at most {self.high:.10g}"
        return f"{self.low:.10g} to {self.high:.10g}"

    def problem(self, name: str, value: object, default: object = "") -> str:
        """Sentence that says what is wrong with a value and what is allowed; "" if nothing is wrong.

        Args:
            name: What the sentence calls the value, as `--seed` or `RunSpec.seed`.
            default: Allowed although it does not follow the rule for names.
        """
        if value is None and self.takes_none:
            return ""
        if self.choices and value not in self.choices:
            noun = self.noun or name.rpartition(".")[2].removeprefix("--").lower()
            return f"No {noun} '{printable(str(value))}'{nearest(str(value), self.choices)}"
        if self.is_name and value != default and not (isinstance(value, str) and is_name(value)):
            return f"{name} must have {NAME_RULE} (got '{printable(str(value))}')."
        if self.kind is bool:
            return "" if isinstance(value, bool) else f"{name} must be True or False (got {value!r})."
        number = Integral if self.kind is int else Real
        if self.kind and (isinstance(value, bool) or not isinstance(value, number)):
            return f"{name} must be {'an integer' if self.kind is int else 'a number'} (got {value!r})."
        if self.kind and not self._within(value):
            return f"{name} must be {self.limits} (got {value if isinstance(value, Integral) else f'{value:.15g}'})."
        return ""

    def _within(self, value: Any) -> bool:  # a number, also of NumPy
        return bool((self.low < value if self.above else self.low <= value) and value <= self.high)  # NaN fails


def option(help: str, default: Any, **more: Any) -> Any:
    """A field of a dataclass, or a parameter of a command, that is an option; `more` are fields of `Option`.

    Any: the type stands beside the name, as with `dataclasses.field`.
    """
    return field(default=default, metadata={_KEY: Option(help=help, **more)})


def argument(help: str, default: Any = MISSING, **more: Any) -> Any:
    """An option that a command takes by position; without a default it must be given."""
    return option(help, default, is_argument=True, **more)


def option_of(given: "Field[Any]", kind: Any) -> Option | None:
    """The option that a field or parameter of a type is; None of any other field.

    The names of a Literal type are the allowed ones, unless others are given.
    """
    known: Option | None = given.metadata.get(_KEY)
    if known is None:
        return None
    kinds = get_args(kind) if NoneType in get_args(kind) else (kind,)
    literal = next((each for each in kinds if get_origin(each) is Literal), None)
    return replace(
        known,
        choices=known.choices or get_args(literal),
        kind=next((each for each in kinds if each in (int, float, bool)), None),
        takes_none=NoneType in kinds,
    )


@cache
def options_of(kind: type) -> Mapping[str, Option]:
    """The options of a dataclass by field; fields without an option are left out."""
    return {each.name: known for each in fields(kind) if (known := option_of(each, each.type))}


def check_value(name: str, value: Any, kind: type | None = None, **more: Any) -> Any:
    """Check an argument of a function, and return it; a number of NumPy becomes a plain one.

    Args:
        kind, more: Fields of `Option`.

    Raises:
        ArgumentError: names the argument, the value and what is allowed.
    """
    if problem := Option(help="", kind=kind, **more).problem(name, value):
        raise ArgumentError(problem)
    return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Real) and type(value) not in (bool, int, float):
        return int(value) if isinstance(value, Integral) else float(value)
    return value


def check_instance(name: str, value: object, kind: type, example: str) -> None:
    """Check that an argument of a function is an instance of a class.

    Raises:
        ArgumentError: names the argument, the value, the class and an example of it.
    """
    if not isinstance(value, kind):
        shown = printable(repr(value), 80)
        raise ArgumentError(f"{name} must be of type {kind.__name__}, for example {example} (got {shown}).")


def check(value: object) -> None:
    """Check the fields of a dataclass, in its `__post_init__`; numbers of NumPy become plain ones.

    Raises:
        ValueError: names the field, the value and what is allowed.
    """
    for name, known in options_of(type(value)).items():
        given = getattr(value, name)
        if problem := known.problem(f"{type(value).__name__}.{name}", given):
            raise ValueError(problem)
        object.__setattr__(value, name, _plain(given))
