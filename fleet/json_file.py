"""JSON files of a fixed format version, written atomically and checked when read."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import msgspec

from fleet.errors import CheckpointError
from fleet.files import atomic_path

Card = TypeVar("Card")


class _Head(msgspec.Struct):
    """The part that is read first."""

    format: object


def write_card(card: msgspec.Struct | Mapping[str, object], path: Path) -> None:
    """Write a card atomically; its folder is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as draft:
        draft.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=2))


def read_card(path: Path, kind: type[Card], *, format_: int, what: str) -> Card:
    """The card in a file of the supported format version; `what` names its content in errors.

    Raises:
        CheckpointError: the file is missing, damaged or not readable, or of another format.
    """
    try:
        text = path.read_bytes()
        head = msgspec.json.decode(text, type=_Head)
        if head.format != format_:
            raise CheckpointError(
                f"{path}: format {head.format!r} is not supported, only {format_}. Make it again with this version."
            )
        return msgspec.json.decode(text, type=kind)
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(f"No {what} in {path.parent}: {path.name} is missing.") from None
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}.") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:  # not JSON, or of another shape
        raise CheckpointError(f"{path}: {error}") from error


def check_version(where: Path, stated: str, actual: str) -> None:
    """Raise CheckpointError if the hash of the content is not the version stated in its card."""
    if actual != stated:
        raise CheckpointError(f"{where}: the content has changed since it was saved (version {stated}, now {actual}).")
