"""The readable part of what is kept: one JSON card of a known format, written whole and refused by name."""

from pathlib import Path
from typing import TypeVar

import msgspec

from fleet.drafts import drafted
from fleet.errors import CheckpointError

Card = TypeVar("Card")


class _Head(msgspec.Struct):
    """What must be known before the rest can be read."""

    format: int


def write_card(card: msgspec.Struct, path: Path) -> None:
    """Write a card into an existing folder. It appears whole or not at all."""
    with drafted(path) as draft:
        draft.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2))


def read_card(path: Path, kind: type[Card], *, format_: int, what: str) -> Card:
    """The card in a file.

    Args:
        format_: The only format that is read.
        what: What the card describes, for the error.

    Raises:
        CheckpointError: the file is missing or damaged, or of another format.
    """
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"No {what} in {path.parent}: {path.name} is missing.") from None
    try:
        head = msgspec.json.decode(text, type=_Head)
        if head.format != format_:
            raise CheckpointError(f"{path}: format {head.format} is not the one read here, {format_}.")
        return msgspec.json.decode(text, type=kind)
    except msgspec.DecodeError as error:  # not JSON, or (ValidationError) JSON of another shape
        raise CheckpointError(f"{path}: {error}") from error


def check_version(where: Path, said: str, found: str) -> None:
    """Refuse content that is not what was saved.

    Raises:
        CheckpointError: the version by content is not the one that the card says.
    """
    if found != said:
        raise CheckpointError(f"{where}: the content has changed since it was saved (says version {said}, is {found}).")
