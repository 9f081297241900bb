"""The bus as an AsyncAPI 3 document, from the table of `contract`.

AsyncAPI has no binding for Zenoh, and refuses unknown ones; what only Zenoh knows stands under `x-zenoh`.
"""

from typing import Any

import msgspec

from fleet.bus import messages
from fleet.bus.contract import CHANNELS, WAYS, Channel, Word, schemas
from fleet.bus.specimens import SPECIMENS

_WHO = {
    "arm": "Name of the arm",
    "peer": "Name of the arm that asks",
    "auctioneer": "Name of the auctioneer",
    "fleet": "Name of the fleet",
}


def asyncapi() -> dict[str, Any]:
    """The document: a router as server, a channel per key, an operation per thing that can be done there."""
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "thermofleet",
            "version": f"{messages.VERSION}.0.0",
            "description": "Arms, auctioneers and outsiders of one fleet on a Zenoh router. See docs/bus.md.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {
            "router": {
                "host": "127.0.0.1:7447",
                "protocol": "zenoh",
                "description": "The router of the fleet; everybody else is a client of it.",
                "x-zenoh": {"mode": "client", "connect": "tcp/127.0.0.1:7447", "scouting": False},
            }
        },
        "channels": {channel.name: _channel(channel) for channel in CHANNELS},
        "operations": {name: operation for channel in CHANNELS for name, operation in _operations(channel).items()},
        "components": {
            "messages": {word.__name__: _message(word) for word in SPECIMENS},
            "schemas": schemas("#/components/schemas/{name}"),
        },
    }


def _channel(channel: Channel) -> dict[str, Any]:
    named = [name for name in _WHO if f"{{{name}}}" in channel.address]
    zenoh: dict[str, Any] = {"way": channel.way, "by": channel.by}
    if channel.way in ("dropped", "remembered"):
        zenoh |= {"congestionControl": "DROP", "priority": "DATA"}
    if channel.kept:
        zenoh |= {"cache": channel.kept}
    if channel.way == "answered":
        zenoh |= {"complete": True, "target": "ALL", "consolidation": "NONE"}
    return {
        "address": channel.address,
        "description": f"By the {channel.by}, to {channel.to}: {WAYS[channel.way]}.",
        "parameters": {name: {"description": f"{_WHO[name]}, percent-encoded to one chunk."} for name in named},
        "messages": {word.__name__: {"$ref": f"#/components/messages/{word.__name__}"} for word in channel.words},
        "x-zenoh": zenoh,
    }


def _operations(channel: Channel) -> dict[str, Any]:
    """What can be done at a key: said by its owner, or asked by others and answered by its owner."""
    if channel.word is None:
        return {}
    operation = {
        "action": "send",
        "channel": {"$ref": f"#/channels/{channel.name}"},
        "summary": first_line(channel.word),
        "messages": [_in(channel, channel.word)],
        "x-zenoh": {"by": channel.to if channel.answer else channel.by},
    }
    if channel.answer is None:
        return {f"say_{channel.name}": operation}
    reply = {
        "channel": {"$ref": f"#/channels/{channel.name}"},
        "messages": [_in(channel, word) for word in channel.words[1:]],
    }
    return {f"ask_{channel.name}": {**operation, "reply": reply}}


def _in(channel: Channel, word: Word) -> dict[str, str]:
    return {"$ref": f"#/channels/{channel.name}/messages/{word.__name__}"}


def _message(word: Word) -> dict[str, Any]:
    return {
        "name": messages.schema(word),
        "title": word.__name__,
        "summary": first_line(word),
        "contentType": "application/json",
        "payload": {"$ref": f"#/components/schemas/{word.__name__}"},
        "examples": [{"payload": msgspec.json.decode(messages.encode(SPECIMENS[word]))}],
        "x-zenoh": {"encoding": messages.encoding(word)},
    }


def first_line(word: Word) -> str:
    """The first line that the source says about a word."""
    return (word.__doc__ or "").strip().partition("\n")[0]
