"""The contract of the bus as documents: JSON schemas and an example of every message, and an AsyncAPI 3 document.

`docs/tables.py` writes them to docs/contract. The description of a field is the text under it in the source.
AsyncAPI has no binding for Zenoh and refuses unknown ones; what is specific to Zenoh is under `x-zenoh`.
"""

import ast
import inspect
import json
import sys
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from fleet.bus.protocol import auction, cell, consensus, keys, messages, operator, policy
from fleet.bus.protocol.keys import CHANNELS, MESSAGES, PATTERNS, BusChannel, MessageType
from fleet.job import Job, Work


def _read() -> Mapping[type[msgspec.Struct], msgspec.Struct]:
    kinds = {kind.__name__: kind for kind in MESSAGES}
    examples = json.loads(Path(__file__).with_name("contract").joinpath("examples.json").read_bytes())
    return {kinds[name]: msgspec.convert(example, kinds[name]) for name, example in examples.items()}


EXAMPLES = _read()


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
        for module in (messages, auction, cell, consensus, operator, policy)
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, msgspec.Struct)
    }


def _described(part: Schema, text: str) -> Schema:
    """The part with its description; a reference is wrapped, as older readers ignore everything beside `$ref`."""
    return {"allOf": [part], "description": text} if "$ref" in part else {**part, "description": text}


_PARAMETERS = {
    "arm": "Name of the arm",
    "peer": "Name of the arm that sends the query",
    "auctioneer": "Name of the auctioneer",
    "policy": "Name of the policy",
    "fleet": "Name of the fleet",
}


def asyncapi() -> Schema:
    """The document: a router as server, a channel per key, an operation per thing that can be done there."""
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "thermofleet",
            "version": f"{messages.VERSION}.0.0",
            "description": "Arms, auctioneers and outsiders of one fleet on a Zenoh router. See docs/bus/messages.md.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {
            "router": {
                "host": "127.0.0.1:7447",
                "protocol": "zenoh",
                "description": "The router of the fleet; everybody else is a client of it.",
                "x-zenoh": {"mode": "client", "connect": "tcp/127.0.0.1:7447", "scouting": False},
            },
            "routerTls": {
                "host": "HOST:7447",
                "protocol": "zenoh",
                "description": "The same with mutual TLS, required beyond loopback. See docs/security.md.",
                "security": [{"$ref": "#/components/securitySchemes/certificate"}],
                "x-zenoh": {"mode": "client", "connect": "tls/HOST:7447", "scouting": False},
            },
        },
        "channels": {channel.name: _channel(channel) for channel in CHANNELS},
        "operations": {name: operation for channel in CHANNELS for name, operation in _operations(channel).items()},
        "components": {
            "securitySchemes": {
                "certificate": {
                    "type": "X509",
                    "description": "A certificate of the fleet's own authority; its common name, as `arm:arm_0`, is "
                    "the role and the name of the participant. The router permits the keys of that role only.",
                }
            },
            "messages": {kind.__name__: _message(kind) for kind in EXAMPLES},
            "schemas": schemas("#/components/schemas/{name}"),
        },
    }


def _channel(channel: BusChannel) -> Schema:
    parameters = [name for name in _PARAMETERS if f"{{{name}}}" in channel.address]
    zenoh: Schema = {"pattern": channel.pattern, "sender": channel.sender, "receiver": channel.receiver}
    if channel.pattern != "token":
        zenoh |= {"congestionControl": channel.congestion, "priority": channel.priority, "reliability": "RELIABLE"}
    if channel.pattern == "publish":
        zenoh |= {"cache": channel.history, "sporadicHeartbeatSeconds": channel.heartbeat_s}
    if channel.pattern == "query":
        zenoh |= {"complete": True, "target": "ALL", "consolidation": "NONE"}
    numbers = {"rateHz": channel.rate_hz, "limitHz": channel.limit_hz, "leaseSeconds": channel.lease_s}
    zenoh |= {name: number for name, number in numbers.items() if number is not None}
    return {
        "address": channel.address,
        "description": f"From {channel.sender} to {channel.receiver}: {PATTERNS[channel.pattern]}.",
        "parameters": {name: {"description": f"{_PARAMETERS[name]}, percent-encoded."} for name in parameters},
        "messages": {kind.__name__: {"$ref": f"#/components/messages/{kind.__name__}"} for kind in channel.messages},
        "x-zenoh": zenoh,
    }


def _operations(channel: BusChannel) -> Schema:
    """What can be done at a key, from both sides: publish and subscribe, or query and answer."""
    if channel.message is None:
        return {}
    sends, receives = ("query", "answer") if channel.reply else ("publish", "subscribe")
    operation: Schema = {
        "channel": {"$ref": f"#/channels/{channel.name}"},
        "summary": first_line(channel.message),
        "messages": [_in(channel, channel.message)],
    }
    if channel.reply is not None:
        operation["reply"] = {
            "channel": {"$ref": f"#/channels/{channel.name}"},
            "messages": [_in(channel, kind) for kind in channel.messages[1:]],
        }
    by = (channel.receiver, channel.sender) if channel.reply else (channel.sender, channel.receiver)
    return {
        f"{verb}_{channel.name}": {"action": action, **operation, "x-zenoh": {"by": who}}
        for verb, action, who in zip((sends, receives), ("send", "receive"), by, strict=True)
    }


def _in(channel: BusChannel, kind: MessageType) -> dict[str, str]:
    return {"$ref": f"#/channels/{channel.name}/messages/{kind.__name__}"}


def _message(kind: MessageType) -> Schema:
    return {
        "name": messages.schema(kind),
        "title": kind.__name__,
        "summary": first_line(kind),
        "contentType": "application/json",
        "payload": {"$ref": f"#/components/schemas/{kind.__name__}"},
        "examples": [{"payload": msgspec.json.decode(messages.encode(EXAMPLES[kind]))}],
        "x-zenoh": {"encoding": messages.encoding(kind)},
    }


def first_line(kind: MessageType) -> str:
    """The first line of a message's docstring."""
    return (kind.__doc__ or "").strip().partition("\n")[0]
