"""Fields of dataclasses with their sentence, bounds and choices, for the command line, files and docs."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from math import inf
from typing import Any

from fleet.errors import NAME_RULE, is_name, nearest, printable

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
    noun: str = ""
    """What an error calls one of these names; "" for the name of the field."""
    is_name: bool = False
    """Whether a text must follow the rule for names, which become parts of keys and files; "" is none."""
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
        """The bounds in words."""
        if self.above:
            return f"> {self.low:.10g} and at most {self.high:.10g}"
        return f"{self.low:.10g} to {self.high:.10g}"

    def problem(self, name: str, value: object) -> str:
        """Sentence that says what is wrong with a value and what is allowed; "" if nothing is wrong.

        Args:
            name: What the sentence calls the value, as `--seed` or `RunSpec.seed`.
        """
        if self.choices and isinstance(value, str) and value not in self.choices:
            noun = self.noun or name.rpartition(".")[2].removeprefix("--")
            return f"No {noun} '{printable(value)}'{nearest(value, self.choices)}"
        if self.is_name and isinstance(value, str) and value and not is_name(value):
            return f"{name} must have {NAME_RULE} (got '{printable(value)}')."
        if isinstance(value, int | float) and not self._within(value):
            return f"{name} must be {self.limits} (got {value:g})."
        return ""

    def _within(self, value: float) -> bool:
        return (self.low < value if self.above else self.low <= value) and value <= self.high  # NaN fails


def option(help: str, default: Any, **more: Any) -> Any:
    """A field of a dataclass that is an option; `more` are fields of `Option`.

    Any: a dataclass declares the type beside the name, as with `dataclasses.field`.
    """
    return field(default=default, metadata={_KEY: Option(help=help, **more)})


def options_of(kind: type) -> Mapping[str, Option]:
    """The options of a dataclass by field; fields without an option are left out."""
    return dict(_options(kind))


def check(value: object) -> None:
    """Check the fields of a dataclass, in its `__post_init__`.

    Raises:
        ValueError: names the field, the value and what is allowed.
    """
    for name, known in _options(type(value)):
        if problem := known.problem(f"{type(value).__name__}.{name}", getattr(value, name)):
            raise ValueError(problem)


def _options(kind: type) -> Iterator[tuple[str, Option]]:
    for each in fields(kind):
        if _KEY in each.metadata:
            yield each.name, each.metadata[_KEY]
