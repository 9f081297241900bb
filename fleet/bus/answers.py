"""What comes back to a question: words, refusals and silence, by who gave them."""

import math
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import msgspec

from fleet.bus import keys
from fleet.bus.messages import MalformedMessage, Refusal, encoding, read, read_as, spoken_by

Said = TypeVar("Said", bound=msgspec.Struct)
Word = TypeVar("Word")


@dataclass(eq=False)
class Answers(Generic[Said]):
    """What came back to a question, so far; complete when the handler gets it."""

    words: dict[str, Said] = field(default_factory=dict)
    """By the key of who answered; a second answer under the same key has its number behind it, as `KEY (2)`."""
    refused: dict[str, str] = field(default_factory=dict)
    """Why not, by the key of who refused; "" for one who did not answer in time, whose key is not known."""
    took_s: float = math.nan
    """Real seconds until it was complete."""

    def take(self, key: str, said_encoding: str, payload: bytes, kind: type[Said]) -> None:
        """Note an answer, which should be of this kind, or a refusal.

        Raises:
            MalformedMessage: it is neither, or speaks for another than its key says; noted as refused.
        """
        try:
            speaker = keys.parse(key)
            if said_encoding == encoding(Refusal):
                _add(self.refused, key, read(Refusal, payload).reason)
            else:
                _add(self.words, key, by(read_as(kind, said_encoding, payload), speaker))
        except ValueError as error:
            _add(self.refused, key, str(error))
            raise MalformedMessage(str(error)) from error

    def miss(self, reason: str) -> None:
        """Note an error of Zenoh's own, which does not tell whose it is."""
        _add(self.refused, "?", "" if reason == "Timeout" else reason)


def by(message: Said, speaker: keys.Key) -> Said:
    """The message, if it speaks for nobody but the speaker.

    Raises:
        MalformedMessage: it speaks for another.
    """
    for field_name, role in (("arm", "arm"), ("auctioneer", "auction")):
        if speaker.role == role and hasattr(message, field_name):
            return spoken_by(message, speaker.name, field_name)
    return message


def _add(table: dict[str, Word], key: str, word: Word) -> None:
    """Put a word into a table without pushing another out: several may answer under one key, as two auctioneers."""
    name, number = key, 1
    while name in table:
        number += 1
        name = f"{key} ({number})"
    table[name] = word
