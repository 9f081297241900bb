"""Tables for docs/bus.md and docs/env.md, from the same source as the schemas and the environment."""

import json
import re
from collections.abc import Mapping
from typing import Any

from fleet.bus import messages
from fleet.bus.contract import CHANNELS, WAYS, Channel, Word, schemas
from fleet.bus.specimens import SPECIMENS
from fleet.errors import FleetError

_PART = re.compile(r"(<!-- made by thermofleet contract: (?P<name>\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str) -> str:
    """The page with every marked part made anew.

    Raises:
        FleetError: a part is asked for that is not made here.
    """
    from scenarios.contract_numbers import limit_table, time_table

    parts = {
        "keys": key_table,
        "ways": way_table,
        "words": word_tables,
        "times": time_table,
        "limits": limit_table,
        "observation": observation_table,
        "rewards": reward_table,
    }

    def part(match: re.Match[str]) -> str:
        if match["name"] not in parts:
            raise FleetError(f"The page asks for '{match['name']}'. There are: {', '.join(parts)}.")
        return f"{match[1]}\n{parts[match['name']]()}\n\n{match[3]}"

    return _PART.sub(part, page)


def key_table() -> str:
    """Every key: who says what there, to whom, how."""
    rows = [
        (
            f"`…/{channel.address.split('/{fleet}/')[1]}`",
            channel.by,
            channel.to,
            channel.way + (f" ({channel.kept})" if channel.kept else ""),
            " → ".join(f"[{word.__name__}](#{word.__name__.lower()})" for word in _said(channel)) or "no payload",
        )
        for channel in CHANNELS
    ]
    return table(("key", "said or answered by", "to", "way", "word"), rows)


def _said(channel: Channel) -> list[Word]:
    """The words of a key, without the refusal that may come instead of any answer."""
    return [word for word in (channel.word, channel.answer) if word is not None]


def way_table() -> str:
    """What the ways of saying mean."""
    return table(("way", "meaning"), list(WAYS.items()))


def word_tables() -> str:
    """Every word field by field, with its encoding and an example; parts of words after the words."""
    parts = schemas()
    words = {word.__name__: word for word in SPECIMENS}
    order = [*words, *(name for name in parts if name not in words)]
    return "\n\n".join(_word(name, parts[name], _where(name), words.get(name)) for name in order if name in parts)


def observation_table() -> str:
    """What an arm knows, field by field."""
    from scenarios.env_tables import field_rows

    return table(("field", "of 4 arms, 8 slots", "shape", "unit", "range", "meaning"), field_rows())


def reward_table() -> str:
    """What the reward is made of."""
    from scenarios.env_tables import reward_rows

    return table(("info", "weight", "what for"), reward_rows())


def _word(name: str, part: Mapping[str, Any], where: str, word: type | None) -> str:
    said = [f"### {name}", str(part.get("description", ""))]
    if word is not None:
        said.append(f"{where}Encoding `{messages.encoding(word)}`.")
    if part.get("properties"):
        required = part.get("required", ())
        rows = [
            (
                f"`{field}`",
                _type(kind),
                "required" if field in required else _default(kind),
                kind.get("description", ""),
            )
            for field, kind in part["properties"].items()
        ]
        said.append(table(("field", "type", "if left out", "meaning"), rows))
    else:
        said.append("No fields: the payload is `{}`.")
    if word is not None:
        said.append(f"```json\n{messages.encode(SPECIMENS[word]).decode()}\n```")
    return "\n\n".join(said)


def _where(name: str) -> str:
    return "".join(
        f"Key `…/{channel.address.split('/{fleet}/')[1]}`. "
        for channel in CHANNELS
        if name in [word.__name__ for word in _said(channel)]
    )


def _type(kind: Mapping[str, Any]) -> str:
    """A schema in words, for example `list of 1..2 (string, not empty)`."""
    if "$ref" in kind:
        name = str(kind["$ref"]).rsplit("/", 1)[1]
        return f"[{name}](#{name.lower()})"
    if "allOf" in kind:
        return _type(kind["allOf"][0])
    if "anyOf" in kind:
        return " or ".join(_type(choice) for choice in kind["anyOf"])
    if "enum" in kind:
        return " \\| ".join(f"`{json.dumps(value)}`" for value in kind["enum"])
    if kind["type"] == "array":
        return f"list{_span(kind, 'minItems', 'maxItems')} of {_type(kind['items'])}"
    if kind["type"] == "string":
        return f"string{_span(kind, 'minLength', 'maxLength')}"
    limits = [
        f"{sign} {kind[name]:g}"
        for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"))
        if name in kind
    ]
    return f"{kind['type']}{' ' if limits else ''}{', '.join(limits)}"


def _span(kind: Mapping[str, Any], low: str, high: str) -> str:
    if high in kind:
        return f" ({kind.get(low, 0)}..{kind[high]})"
    return ", not empty" if low in kind else ""


def _default(kind: Mapping[str, Any]) -> str:
    return f"`{json.dumps(kind['default'])}`" if "default" in kind else ""


def table(head: tuple[str, ...], rows: list[Any]) -> str:
    """A table in Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
