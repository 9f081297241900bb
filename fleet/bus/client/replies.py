"""Replies to one query: messages, refusals and timeouts, by the key of the replier."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import msgspec

from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import MalformedMessage, Refusal, check_name, decode_as, encoding
from fleet.bus.protocol.registry import channel_of
from fleet.errors import BusError, Refused

Message = TypeVar("Message", bound=msgspec.Struct)
Entry = TypeVar("Entry")

_SENDER: Mapping[str, str] = {"arm": "arm", "auction": "auctioneer"}
"""The field of a message that names the sender, by the role in its key."""


class AnotherReplies(Exception):
    """Raised by a handler of requests: another participant will reply."""


@dataclass(eq=False)
class NoReply(BusError):
    """Nobody replied to a query, and nobody refused it."""

    key: str
    late: bool
    """Whether a participant received the query and did not reply in time."""

    def __str__(self) -> str:
        if self.late:
            return f"The {replier(self.key)} did not reply in time."
        return f"There is no {replier(self.key)} in this fleet."


@dataclass(eq=False)
class Replies(Generic[Message]):
    """Replies so far; complete when the handler gets them."""

    messages: dict[str, Message] = field(default_factory=dict)
    """By the key of the replier; a second reply under the same key gets a number, as `KEY (2)`."""
    refused: dict[str, str] = field(default_factory=dict)
    """Reasons by the key of the replier; "" for one that did not reply in time, whose key is not known."""
    took_s: float = math.nan
    """Real seconds until they were complete."""

    @property
    def refusals(self) -> list[str]:
        """Reasons of the participants that refused, without those that did not reply in time."""
        return [reason for reason in self.refused.values() if reason]

    def first(self, key: str) -> Message:
        """The first reply to a query of `key`.

        Raises:
            Refused: there is none, and a participant refuses, with its reason.
            NoReply: there is neither.
        """
        for message in self.messages.values():
            return message
        for reason in self.refusals:
            raise Refused(reason)
        raise NoReply(key, late=bool(self.refused))

    def take(self, key: str, sent_encoding: str, payload: bytes, kind: type[Message]) -> Message | None:
        """Add a reply of this kind, or a refusal; return the reply.

        Raises:
            MalformedMessage: it is neither, or names another sender than its key; added to `refused`.
        """
        try:
            if sent_encoding == encoding(Refusal):
                _add(self.refused, key, read_message(Refusal, key, sent_encoding, payload)[1].reason)
                return None
            message = read_message(kind, key, sent_encoding, payload)[1]
        except ValueError as error:
            _add(self.refused, key, str(error))
            raise MalformedMessage(str(error)) from error
        _add(self.messages, key, message)
        return message

    def miss(self, reason: str) -> None:
        """Add an error of Zenoh's own, which does not say whose it is."""
        _add(self.refused, "?", "" if reason == "Timeout" else reason)


def replier(key: str) -> str:
    """Who replies to the queries of a key, for example `auctioneer` or `arm 'arm_0'`."""
    sender = channel_of(key).sender
    return f"{sender} '{keys.parse(key).name}'" if sender == "arm" and "*" not in key else sender


def read_message(kind: type[Message], key: str, sent_encoding: str, payload: bytes) -> tuple[str, Message]:
    """The name in the key and the message of this type in the payload.

    Raises:
        ValueError: not a key of this bus.
        MalformedMessage: another encoding, not of this type, or the message names another sender than its key.
    """
    sender = keys.parse(key)
    message = decode_as(kind, sent_encoding, payload)
    name = _SENDER.get(sender.role, "")
    return sender.name, check_name(message, sender.name, name) if hasattr(message, name) else message


def _add(table: dict[str, Entry], key: str, entry: Entry) -> None:
    """Add without replacing another entry: several may reply under one key, as two auctioneers do."""
    name, number = key, 1
    while name in table:
        number += 1
        name = f"{key} ({number})"
    table[name] = entry
