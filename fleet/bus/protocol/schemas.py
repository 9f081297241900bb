"""JSON schemas of every message on the bus, read from the structs; `docs/tables.py` writes them to docs/contract.

The description of a field is the text under it in the source.
"""

import ast
import inspect
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from typing import Any

import msgspec

from fleet.bus.protocol import auction, cell, consensus, history, keys, messages, operator, policy
from fleet.bus.protocol.registry import MESSAGES, MessageType
from fleet.job import Job, Work

JSON_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
FIELD_SOURCES: Mapping[type, tuple[type, ...]] = {auction.JobSpec: (Work, Job)}
"""Classes that describe the fields which a message does not describe itself."""
Schema = dict[str, Any]
"""A JSON schema or a part of one: JSON as Python holds it."""


def schemas(ref: str = "#/$defs/{name}") -> dict[str, Schema]:
    """JSON schema (draft 2020-12) of every message and every nested struct, by name.

    Args:
        ref: How one schema refers to another.
    """
    _, parts = msgspec.json.schema_components(MESSAGES, ref_template=ref)
    for name, part in parts.items():
        if struct := _structs().get(name):
            part["description"] = inspect.cleandoc(struct.__doc__ or "")
            for field, text in descriptions(struct).items():
                if field in part["properties"]:
                    part["properties"][field] = _described(part["properties"][field], text)
    for message in MESSAGES:
        parts[message.__name__]["title"] = messages.schema(message)
    return parts


def schema_document() -> Schema:
    """All schemas in one document; a message is validated against `#/$defs/NAME` of it."""
    return {
        "$schema": JSON_SCHEMA,
        "$id": f"urn:{keys.PREFIX.replace('/', ':')}:messages",
        "title": f"Messages of the thermofleet bus, version {messages.VERSION}",
        "$defs": schemas(),
    }


@cache
def descriptions(kind: type) -> Mapping[str, str]:
    """The text under each field of a class in its source, in one line each; fields without text are left out."""
    tree = ast.parse(inspect.getsource(sys.modules[kind.__module__]))
    body = next((node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__), ())
    texts: dict[str, str] = {}
    for source in FIELD_SOURCES.get(kind, ()):
        texts |= descriptions(source)
    for field, text in pairwise(body):  # none of `ArmObservation`, which is made of a table
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            texts[field.target.id] = " ".join(str(text.value.value).split())
    return texts


@cache
def _structs() -> Mapping[str, MessageType]:
    """Every struct that occurs in the schemas, by name."""
    return {
        name: value
        for module in (messages, auction, cell, consensus, history, operator, policy)
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, msgspec.Struct)
    }


def _described(part: Schema, text: str) -> Schema:
    """The part with its description; a reference is wrapped, as older readers ignore everything beside `$ref`."""
    return {"allOf": [part], "description": text} if "$ref" in part else {**part, "description": text}
