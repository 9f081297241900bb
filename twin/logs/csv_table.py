"""Read a CSV log, plain or gzip, as a table of numbers with a list of its damaged lines."""

import gzip
import zlib
from contextlib import suppress
from math import isfinite
from pathlib import Path

import numpy as np

from fleet.errors import LogError
from twin.logs.table import Damage, Table

_GZIP = b"\x1f\x8b"


def read_csv(path: Path) -> Table:
    """The numbers of all good lines after the header; blank lines are ignored.

    Raises:
        LogError: the file cannot be opened, is empty, ends in .gz without gzip data, or has no header.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(str(path), None, f"cannot be read: {error.strerror or error}.") from error
    broken = None
    if data.startswith(_GZIP):
        data, broken = _decompress(data)
    elif data and path.suffix == ".gz":
        raise LogError(str(path), None, "ends in .gz but holds no gzip data; was it unpacked or downloaded as a page?")
    if not data.strip():
        raise LogError(str(path), None, f"holds no text ({broken})." if broken else "is empty.")
    header, *lines = data.split(b"\n")
    names = _header(path, header)
    rows: list[list[float]] = []
    where: list[int] = []
    damage: list[Damage] = []
    for line, raw in enumerate(lines, start=2):
        if not raw.strip():
            continue
        try:
            if line == len(lines) + 1:
                # The last number may have lost digits even if all fields are present.
                raise ValueError(f"the {'gzip data end' if broken else 'file ends'} in the middle of this line")
            rows.append(_numbers(raw, len(names)))
            where.append(line)
        except ValueError as error:
            damage.append(Damage(line, str(error)))
    values = np.array(rows, dtype=float).reshape(-1, len(names))
    return Table(names, values, np.array(where, dtype=int), tuple(damage), (broken,) if broken else ())


def _decompress(data: bytes) -> tuple[bytes, str | None]:
    """Content of a gzip file up to its first damage, and the damage."""
    try:
        return gzip.decompress(data), None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        reason = "cut off" if isinstance(error, EOFError) else f"damaged: {error}"
    stream, parts = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16), list[bytes]()
    with suppress(zlib.error):
        # Byte by byte, because a damaged piece returns nothing, not even what precedes the damage.
        for i in range(len(data)):
            parts.append(stream.decompress(data[i : i + 1]))
    return b"".join(parts), f"the gzip data are {reason}"


def _header(path: Path, line: bytes) -> tuple[str, ...]:
    try:
        names = tuple(name.strip().strip('"') for name in line.decode("utf-8-sig").split(","))
    except UnicodeDecodeError as error:
        reason = f"is not text in UTF-8 (byte {error.start}); save it as CSV in UTF-8."
        raise LogError(str(path), 1, reason) from error
    if double := sorted({name for name in names if names.count(name) > 1}):
        raise LogError(str(path), 1, f"names the column '{double[0]}' twice.")
    return names


def _numbers(raw: bytes, columns: int) -> list[float]:
    """Raises ValueError with the reason if the line has no such numbers."""
    try:
        cells = raw.decode("utf-8").split(",")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not text in UTF-8 (byte {error.start} of the line)") from error
    if len(cells) != columns:
        raise ValueError(f"{len(cells)} fields where the header has {columns}")
    numbers: list[float] = []
    for column, cell in enumerate(cells, start=1):
        try:
            numbers.append(float(cell))
        except ValueError:
            raise ValueError(f"field {column}, '{cell.strip()[:24]}', is not a number") from None
        if not isfinite(numbers[-1]):
            raise ValueError(f"field {column} is {cell.strip()}, not a finite number")
    return numbers
