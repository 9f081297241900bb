"""Readable errors for scenario files and for names among several.

`kind` is a type annotation such as `float | None`, for which Python has no type (hence Any).
"""

import math
import re
from collections.abc import Mapping
from dataclasses import is_dataclass
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from fleet.errors import ScenarioError, nearest

_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "datetime": "a date with a time",
    "date": "a date",
    "time": "a time of day",
    "null": "nothing",
}
"""Plain words for msgspec's type names."""
_LENGTH = re.compile(r"Expected `array` of length (\d+), got (\d+)")
_TYPE = re.compile(r"Expected `([^`]+)`, got `([^`]+)`")
_MISSING = re.compile(r"Object missing required field `([^`]+)`")
_OWN_FIELD = re.compile(r"[A-Z]\w*\.(\w.*)", re.DOTALL)
"""`Robot.tool_kg must be >= 0 (got -1.0).`"""
_OWN = re.compile(r"[A-Z]\w* (needs? .*)", re.DOTALL)
"""`Poisson needs 0 <= start_s <= stop_s (got 5.0, 1.0).`"""
_STEP = re.compile(r"\[(\d+)\]|\.?(\w+)")


def readable_error(error: msgspec.ValidationError, raw: object, schema: Any) -> str:
    """One sentence that begins with the place: `arms[0].tool_kg: expected a number, got a text ('heavy').`

    Args:
        error: Raised by `msgspec.convert(raw, schema)`.
        raw: Parsed TOML.
        schema: Annotation of the type to convert to.
    """
    text, _, place = str(error).partition(" - at `$")
    place = place.strip("`").lstrip(".")
    text = text.rstrip(".")
    if match := _OWN_FIELD.fullmatch(text):
        return f"{place}.{match[1]}{'' if match[1].endswith('?') else '.'}".lstrip(".")
    if match := _OWN.fullmatch(text):
        return f"{place} {match[1]}.".lstrip()
    lead = f"{place}: " if place else ""
    value, kind = _follow(raw, schema, place)
    if match := _MISSING.fullmatch(text):
        return f"{lead}'{match[1]}' is missing."
    if match := _LENGTH.fullmatch(text):
        return f"{lead}expected {match[1]} values, got {match[2]}."
    if match := _TYPE.fullmatch(text):
        wanted = [_WORDS.get(name, name) for name in match[1].split(" | ") if name != "null"]
        return f"{lead}expected {' or '.join(wanted)}, got {_WORDS.get(match[2], match[2])}{_shown(value)}."
    if text.startswith("Invalid enum value"):
        return f"{lead}'{value}' is not allowed{nearest(str(value), get_args(kind))}"
    return f"{lead}{text[:1].lower()}{text[1:]}."


def check_finite(raw: object, file: str, place: str = "") -> None:
    """Check that no number, at any depth, is `nan` or `inf`, which TOML allows.

    Raises:
        ScenarioError: names the place.
    """
    if isinstance(raw, Mapping):
        for key, value in raw.items():
            check_finite(value, file, f"{place}.{key}" if place else key)
    elif isinstance(raw, list | tuple):
        for i, value in enumerate(raw):
            check_finite(value, file, f"{place}[{i}]")
    elif isinstance(raw, float) and not math.isfinite(raw):
        raise ScenarioError(f"{file}: {place}: expected a finite number, got {raw}.")


def choose(what: str, name: str, kind: Any) -> Any:
    """Return the name if it is one of a Literal type.

    Raises:
        ScenarioError: names the nearest allowed one.
    """
    if name not in get_args(kind):
        raise ScenarioError(f"No {what} '{name}'{nearest(str(name), get_args(kind))}")
    return name


def plain_kind(kind: Any) -> Any:
    """A type without its `| None`."""
    if get_origin(kind) in (Union, UnionType):
        rest = [arg for arg in get_args(kind) if arg is not type(None)]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _follow(raw: object, kind: Any, place: str) -> tuple[object, Any]:
    """Value and type at a place such as `arms[0].tool_kg`; None if there is no such place."""
    for index, name in _STEP.findall(place):
        kind = plain_kind(kind)
        if name:
            raw = raw.get(name) if isinstance(raw, Mapping) else None
            kind = get_type_hints(kind).get(name) if is_dataclass(kind) else None
        else:
            inside = get_args(kind)
            raw = raw[int(index)] if isinstance(raw, list | tuple) and int(index) < len(raw) else None
            each = inside[:1] if inside[-1:] == (Ellipsis,) else inside[int(index) :]
            kind = each[0] if each else None
    kind = plain_kind(kind)
    return raw, kind if get_origin(kind) is Literal else None


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return f" ({str(value).lower()})"
    if isinstance(value, str | int | float):
        return f" ({value!r})"
    return ""
