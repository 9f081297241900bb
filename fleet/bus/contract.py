"""The contract of the bus as data: every key with who says what there and how, and JSON schemas of every word.

All of it is read from the structs in `messages`, `trade` and `council` and the keys in `keys`, so that nothing is said
twice; the description of a field is the text under it in the source. `thermofleet contract` writes it to docs/contract.
"""

import ast
import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, Literal

import msgspec

from fleet.bus import council, keys, messages, trade
from fleet.bus.keys import Role
from fleet.bus.link import REMEMBERED
from fleet.job import Job, Work

Word = type[msgspec.Struct]
Way = Literal["token", "dropped", "remembered", "answered"]
WAYS: Mapping[Way, str] = {
    "token": "a liveliness token, no payload",
    "dropped": "published, dropped under congestion",
    "remembered": "published, dropped under congestion; the last ones are kept for those who come later",
    "answered": "a queryable (complete): the question is in the query's payload, the answer or a Refusal in the reply",
}
ADDRESS: Mapping[Role, str] = {
    "arm": f"{keys.PREFIX}/{{fleet}}/arm/{{arm}}",
    "auction": f"{keys.PREFIX}/{{fleet}}/auction/{{auctioneer}}",
    "jobs": f"{keys.PREFIX}/{{fleet}}/jobs",
    "clock": f"{keys.PREFIX}/{{fleet}}/clock",
}
JSON_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
_ELDERS: Mapping[type, tuple[type, ...]] = {trade.JobWord: (Work, Job)}
"""Where the fields of a word are described that are not described in the word itself."""


@dataclass(frozen=True)
class Channel:
    """One key of the bus."""

    role: Role
    topic: str
    way: Way
    word: Word | None = None
    """What is published there, or asked there; None for a token."""
    answer: Word | None = None
    by: Literal["arm", "auctioneer"] = "arm"
    """Who publishes, or answers."""
    to: str = "anybody"
    """Who listens, or asks."""
    kept: int = 0
    """How many of the last words reach one who comes later."""

    @property
    def name(self) -> str:
        """For example `arm_state`."""
        return f"{self.role}_{self.topic}"

    @property
    def address(self) -> str:
        """The key with its parameters in braces."""
        asker = "" if self.topic not in keys.ASKED else "/{peer}" if self.role == "arm" else "/{arm}"
        return f"{ADDRESS[self.role]}/{self.topic}{asker}"

    @property
    def words(self) -> tuple[Word, ...]:
        """What travels there: nothing, a word, or a question, its answer and what may come instead."""
        instead = None if self.answer is None else messages.Refusal
        return tuple(word for word in (self.word, self.answer, instead) if word is not None)


@dataclass(frozen=True)
class Published:
    """One key at which words are published."""

    role: Role
    topic: str
    word: Word
    kept: int


CHANNELS: tuple[Channel, ...] = (
    Channel("arm", "alive", "token"),
    Channel("arm", "state", "remembered", messages.State, kept=REMEMBERED),
    Channel("arm", "info", "remembered", messages.Info, kept=1),
    Channel("arm", "difficulty", "remembered", messages.DifficultyWord, kept=1),
    Channel("arm", "event", "remembered", trade.ArmEvent, kept=REMEMBERED),
    Channel("arm", "quote", "answered", trade.QuoteRequest, trade.Quote, to="auctioneer, or anybody for a dry run"),
    Channel("arm", "award", "answered", trade.Award, trade.Ack, to="auctioneer"),
    Channel("arm", "bid", "remembered", council.Bid, to="arm", kept=1),
    Channel("arm", "grant", "answered", council.Claim, council.Grant, to="arm"),
    Channel("auction", "alive", "token", by="auctioneer"),
    Channel("auction", "announce", "remembered", trade.Announce, by="auctioneer", kept=REMEMBERED),
    Channel("auction", "result", "remembered", trade.Result, by="auctioneer", kept=REMEMBERED),
    Channel("auction", "lease", "answered", trade.LeaseRequest, trade.Lease, by="auctioneer", to="arm"),
    Channel("auction", "report", "answered", trade.Report, trade.Receipt, by="auctioneer", to="arm"),
    Channel("jobs", "submit", "answered", trade.Submission, trade.Submitted, by="auctioneer"),
    Channel("jobs", "status", "answered", trade.StatusRequest, trade.Status, by="auctioneer"),
    Channel("clock", "now", "answered", trade.ClockRequest, trade.Clock, by="auctioneer"),
)
PUBLISHED: tuple[Published, ...] = tuple(
    Published(channel.role, channel.topic, channel.word, channel.kept)
    for channel in CHANNELS
    if channel.way in ("dropped", "remembered") and channel.word is not None
)
"""What can be listened to."""
WORDS: tuple[Word, ...] = tuple(dict.fromkeys(word for channel in CHANNELS for word in channel.words))
"""Every word that travels by itself, in the order of the keys."""


def schemas(ref: str = "#/$defs/{name}") -> dict[str, dict[str, Any]]:
    """JSON schema (draft 2020-12) of every word and every part of one, by name.

    Args:
        ref: How one refers to another.
    """
    _, parts = msgspec.json.schema_components(WORDS, ref_template=ref)
    for name, part in parts.items():
        if told := _types().get(name):
            part["description"] = inspect.cleandoc(told.__doc__ or "")
            for field, said in descriptions(told).items():
                if field in part["properties"]:
                    part["properties"][field] = _described(part["properties"][field], said)
    for word in WORDS:
        parts[word.__name__]["title"] = messages.schema(word)
    return parts


def schema_document() -> dict[str, Any]:
    """All schemas in one document; a word is checked against `#/$defs/NAME` of it."""
    return {
        "$schema": JSON_SCHEMA,
        "$id": f"urn:{keys.PREFIX.replace('/', ':')}:words",
        "title": f"The words of the thermofleet bus, version {messages.VERSION}",
        "$defs": schemas(),
    }


@cache
def descriptions(kind: type) -> Mapping[str, str]:
    """What the source says under each field of a class, in one line each; fields without words are left out."""
    body = next(
        node.body
        for node in ast.parse(inspect.getsource(sys.modules[kind.__module__])).body
        if isinstance(node, ast.ClassDef) and node.name == kind.__name__
    )
    told: dict[str, str] = {}
    for elder in _ELDERS.get(kind, ()):
        told |= descriptions(elder)
    for field, text in pairwise(body):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            told[field.target.id] = " ".join(str(text.value.value).split())
    return told


@cache
def _types() -> Mapping[str, Word]:
    """Every struct that occurs in the schemas, by its name there."""
    return {
        name: value
        for module in (messages, trade, council)
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, msgspec.Struct)
    }


def _described(part: dict[str, Any], said: str) -> dict[str, Any]:
    """The part with its description; a reference is wrapped, since older readers ignore what stands beside one."""
    return {"allOf": [part], "description": said} if "$ref" in part else {**part, "description": said}
