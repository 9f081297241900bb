"""From the lines of a log to a table of numbers in which time only grows, and word of every line left out."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import isfinite

import numpy as np

from twin.log_lines import Lines

Array = np.ndarray

TOLD_LINES = 20
"""Most sentences about one file; the rest is counted."""
STRAY_ROWS = 3
"""More rows in a row whose time does not fit are no stray times but another clock."""


@dataclass(frozen=True)
class Damage:
    """One line, or row, that cannot be used."""

    line: int
    """From 1."""
    reason: str


@dataclass(frozen=True, eq=False)
class Table:
    """The numbers of one arm's log as they were written."""

    names: tuple[str, ...]
    """Of the columns."""
    values: Array
    """Finite, [row, column]."""
    where: Array
    """Line in the file of each row, from 1, [row]."""
    damage: tuple[Damage, ...]
    """Lines that hold no such row."""


def header_of(lines: Lines) -> list[str]:
    """The column names of the first line.

    Raises:
        ValueError: the line is no text in UTF-8, or names a column twice.
    """
    try:
        names = [name.strip().strip('"') for name in lines.lines[0].decode("utf-8-sig").split(",")]
    except UnicodeDecodeError as error:
        raise ValueError(f"is not text in UTF-8 (byte {error.start}); save it as CSV in UTF-8.") from error
    double = sorted({name for name in names if names.count(name) > 1})
    if double:
        raise ValueError(f"names the column '{double[0]}' twice.")
    return names


def table_of(lines: Lines) -> Table:
    """The numbers of all lines after the header that hold as many as there are columns; blank lines count for nothing.

    Raises:
        ValueError: the first line is no header.
    """
    names = header_of(lines)
    rows: list[list[float]] = []
    where: list[int] = []
    damage: list[Damage] = []
    for line, raw in enumerate(lines.lines[1:], start=2):
        if not raw.strip():
            continue
        if lines.cut and line == len(lines.lines):
            # Even with all its fields the last number may have lost its last digits.
            damage.append(Damage(line, lines.cut))
            continue
        try:
            rows.append(_numbers(raw, len(names)))
        except ValueError as error:
            damage.append(Damage(line, str(error)))
        else:
            where.append(line)
    values = np.array(rows, dtype=float).reshape(-1, len(names))
    return Table(tuple(names), values, np.array(where, dtype=int), tuple(damage))


def _numbers(raw: bytes, columns: int) -> list[float]:
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


def backwards(time_s: Array, where: Array) -> list[Damage]:
    """The samples to leave out so that time grows strictly and as many as possible stay.

    One stray time costs one sample, whether it points back or ahead.

    Args:
        time_s: [row].
        where: Line of each row, [row].

    Raises:
        ValueError: the clock was set anew, which makes two recordings that no order joins.
    """
    if (np.diff(time_s) > 0).all():
        return []
    keep = _longest_increasing(time_s)
    damage: list[Damage] = []
    for kept, group in groupby(range(len(time_s)), key=keep.__getitem__):
        rows = [] if kept else list(group)
        if len(rows) > STRAY_ROWS:
            start = next(row for row in range(1, len(time_s)) if time_s[row] <= time_s[row - 1])
            raise ValueError(
                f"time starts anew at line {where[start]} ({time_s[start - 1]:.10g} s, then {time_s[start]:.10g} s): "
                "these are several recordings; make a file of each."
            )
        damage += [Damage(int(where[row]), _misfit(time_s, row)) for row in rows]
    return damage


def _misfit(time_s: Array, row: int) -> str:
    beside = time_s[row - 1] if row else time_s[1]
    how = "repeats" if time_s[row] == beside else "runs backwards" if row and time_s[row] < beside else "jumps ahead"
    return f"time {how}: {time_s[row]:.10g} s beside {beside:.10g} s"


def _longest_increasing(values: Array) -> Array:
    """Mask of a longest strictly increasing subsequence (patience sorting); of two that fit, the first stays."""
    tops: list[float] = []
    at: list[int] = []
    previous = np.full(len(values), -1)
    # Of equally long ones this finds the last, so it runs from the end.
    for i, value in enumerate((-values[::-1]).tolist()):
        pile = bisect_left(tops, value)
        previous[i] = at[pile - 1] if pile else -1
        tops[pile : pile + 1], at[pile : pile + 1] = [value], [i]
    keep = np.zeros(len(values), dtype=bool)
    i = at[-1]
    while i >= 0:
        keep[i] = True
        i = previous[i]
    return keep[::-1]


def beyond(values: Array, where: Array, bounds: tuple[float, float], words: str) -> list[Damage]:
    """The rows in which a reading lies outside the bounds.

    Args:
        values: [row, joint].
        where: Line of each row, [row].
        words: The complaint, with places for {value} and {joint}, counted from 1.
    """
    outside = (values < bounds[0]) | (values > bounds[1])
    rows = np.flatnonzero(outside.any(axis=1))
    joints = outside[rows].argmax(axis=1)
    return [
        Damage(int(where[row]), words.format(value=values[row, joint], joint=joint + 1))
        for row, joint in zip(rows, joints, strict=True)
    ]


def told(damage: Sequence[Damage]) -> tuple[str, ...]:
    """One sentence per run of lines with the same complaint, `line 40: …` or `lines 40 to 52: …`."""
    ordered = sorted(damage, key=lambda d: d.line)
    sentences: list[str] = []
    for _, group in groupby(enumerate(ordered), key=lambda pair: (pair[1].line - pair[0], _kind(pair[1].reason))):
        some = [d for _, d in group]
        lines = f"line {some[0].line}" if len(some) == 1 else f"lines {some[0].line} to {some[-1].line}"
        sentences.append(f"{lines}: {some[0].reason}")
    if len(sentences) > TOLD_LINES:
        more = len(sentences) - TOLD_LINES
        sentences[TOLD_LINES:] = [f"and {more} more damaged place{'s' * (more > 1)}"]
    return tuple(sentences)


def _kind(reason: str) -> str:
    return "".join(c for c in reason.partition(":")[0] if not c.isdigit())
