"""The lines of a log file, plain or gzip, and damage that shows before any number is read."""

import gzip
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fleet.errors import LogError

_GZIP = b"\x1f\x8b"
_CHUNK = 65536
"""Bytes of a damaged gzip file read at a time."""


@dataclass(frozen=True)
class Lines:
    """A text file, line by line, the first one being line 1."""

    lines: tuple[bytes, ...]
    """Without line ends."""
    cut: str | None
    """Why the last line may be incomplete; None if it has a line end."""
    broken: str | None
    """Damage of the compression; None if there is none."""


def read_lines(path: Path) -> Lines:
    """All lines of a file; compression is detected from the content, not the name.

    Raises:
        LogError: it cannot be opened, is empty, or ends in .gz but is not a gzip file.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(str(path), None, f"cannot be read: {error.strerror or error}.") from error
    if not data:
        raise LogError(str(path), None, "is empty.")
    broken = None
    if data.startswith(_GZIP):
        data, broken = _decompress(data)
    elif path.suffix == ".gz":
        raise LogError(str(path), None, "ends in .gz but holds no gzip data; was it unpacked or downloaded as a page?")
    if not data.strip():
        raise LogError(str(path), None, f"holds no text ({broken})." if broken else "is empty.")
    whole, end, rest = data.rpartition(b"\n")
    if not rest.strip():
        return Lines(tuple(whole.split(b"\n")), None, broken)
    cut = "the file ends in the middle of this line" if not broken else "the gzip data end in the middle of this line"
    return Lines((*whole.split(b"\n"), rest) if end else (rest,), cut, broken)


def _decompress(data: bytes) -> tuple[bytes, str | None]:
    """Content of a gzip file up to its first damage, and the damage."""
    try:
        return gzip.decompress(data), None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        reason = "cut off" if isinstance(error, EOFError) else f"damaged: {error}"
    return _until_damage(data), f"the gzip data are {reason}"


def _until_damage(data: bytes) -> bytes:
    """Content of a gzip file before its first damaged byte."""
    stream, parts = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16), list[bytes]()
    for first in range(0, len(data), _CHUNK):
        before = stream.copy()
        try:
            parts.append(stream.decompress(data[first : first + _CHUNK]))
        except zlib.error:
            # A damaged chunk returns nothing, not even what precedes the damage: read it again byte by byte.
            with suppress(zlib.error):
                for i in range(first, first + _CHUNK):
                    parts.append(before.decompress(data[i : i + 1]))
            break
    return b"".join(parts)
