"""What the schema says against a scenario, in the words of the person who wrote the file."""

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
"""msgspec's names of types."""
_LENGTH = re.compile(r"Expected `array` of length (\d+), got (\d+)")
_TYPE = re.compile(r"Expected `([^`]+)`, got `([^`]+)`")
_MISSING = re.compile(r"Object missing required field `([^`]+)`")
_OWN_FIELD = re.compile(r"[A-Z]\w*\.(\w.*)", re.DOTALL)
"""`Robot.tool_kg must be >= 0 (got -1.0).`"""
_OWN = re.compile(r"[A-Z]\w* (needs? .*)", re.DOTALL)
"""`Poisson needs 0 <= start_s <= stop_s (got 5.0, 1.0).`"""
_STEP = re.compile(r"\[(\d+)\]|\.?(\w+)")


def complaint(error: msgspec.ValidationError, raw: Any, schema: Any) -> str:
    """One sentence with the place first: `arms[0].tool_kg: expected a number, got a text ('heavy').`

    Args:
        error: From `msgspec.convert(raw, schema)`.
    """
    text, _, place = str(error).partition(" - at `$")
    place = place.strip("`").lstrip(".")
    text = text.rstrip(".")
    if found := _OWN_FIELD.fullmatch(text):
        return f"{place}.{found[1]}.".lstrip(".")
    if found := _OWN.fullmatch(text):
        return f"{place} {found[1]}.".lstrip()
    lead = f"{place}: " if place else ""
    value, kind = _follow(raw, schema, place)
    if found := _MISSING.fullmatch(text):
        return f"{lead}'{found[1]}' is missing."
    if found := _LENGTH.fullmatch(text):
        return f"{lead}expected {found[1]} values, got {found[2]}."
    if found := _TYPE.fullmatch(text):
        wanted = [_WORDS.get(name, name) for name in found[1].split(" | ") if name != "null"]
        return f"{lead}expected {' or '.join(wanted)}, got {_WORDS.get(found[2], found[2])}{_shown(value)}."
    if text.startswith("Invalid enum value"):
        return f"{lead}'{value}' is not possible{nearest(str(value), get_args(kind))}"
    return f"{lead}{text[:1].lower()}{text[1:]}."


def check_finite(raw: Any, file: str, place: str = "") -> None:
    """Refuse `nan` and `inf`, which TOML allows, all the way down.

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


def plain_kind(kind: Any) -> Any:
    """A type without its `| None`."""
    if get_origin(kind) in (Union, UnionType):
        rest = [arg for arg in get_args(kind) if arg is not type(None)]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _follow(raw: Any, kind: Any, place: str) -> tuple[Any, Any]:
    """Value and type at a place such as `arms[0].tool_kg`; None where the way is lost."""
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


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return f" ({str(value).lower()})"
    if isinstance(value, str | int | float):
        return f" ({value!r})"
    return ""
