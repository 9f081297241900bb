"""The numbers of a log as a table, and the lines that cannot be used."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import isfinite

import numpy as np

from twin.logs.lines import Lines

Array = np.ndarray

MOST_SENTENCES = 20
"""Most sentences about one file; the rest is counted."""
STRAY_ROWS = 3
"""Longest run of rows with wrong times; a longer one is a clock that was reset."""


@dataclass(frozen=True)
class Damage:
    """A line, or row, that cannot be used."""

    line: int
    """From 1."""
    reason: str


@dataclass(frozen=True, eq=False)
class Table:
    """The numbers of one arm's log as written."""

    names: tuple[str, ...]
    """Column names."""
    values: Array
    """Finite, [row, column]."""
    where: Array
    """Line in the file of each row, from 1, [row]."""
    damage: tuple[Damage, ...]
    """Lines that cannot be used."""


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
    """The numbers of all good lines after the header; blank lines are ignored.

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
            # The last number may have lost digits even if all fields are there.
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


def time_damage(time_s: Array, where: Array) -> list[Damage]:
    """The fewest rows to drop so that time increases strictly.

    Args:
        time_s: [row].
        where: Line of each row, [row].

    Raises:
        ValueError: the clock was reset, so the file holds several recordings.
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
                f"time starts again at line {where[start]} ({time_s[start - 1]:.10g} s, then {time_s[start]:.10g} s): "
                "the file holds several recordings; split it."
            )
        damage += [Damage(int(where[row]), _time_reason(time_s, row)) for row in rows]
    return damage


def _time_reason(time_s: Array, row: int) -> str:
    beside = time_s[row - 1] if row else time_s[1]
    how = "repeats" if time_s[row] == beside else "runs backwards" if row and time_s[row] < beside else "jumps ahead"
    return f"time {how}: {time_s[row]:.10g} s beside {beside:.10g} s"


def _longest_increasing(values: Array) -> Array:
    """Mask of a longest strictly increasing subsequence (patience sorting); of several, the first."""
    tops: list[float] = []
    at: list[int] = []
    previous = np.full(len(values), -1)
    # The algorithm finds the last of several, so it runs on the reversed values.
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


def out_of_range(values: Array, where: Array, bounds: tuple[float, float], reason: str) -> list[Damage]:
    """Rows with a reading outside the bounds.

    Args:
        values: [row, joint].
        where: Line of each row, [row].
        reason: Template with {value} and {joint}, counted from 1.
    """
    outside = (values < bounds[0]) | (values > bounds[1])
    rows = np.flatnonzero(outside.any(axis=1))
    joints = outside[rows].argmax(axis=1)
    return [
        Damage(int(where[row]), reason.format(value=values[row, joint], joint=joint + 1))
        for row, joint in zip(rows, joints, strict=True)
    ]


def damage_summary(damage: Sequence[Damage]) -> tuple[str, ...]:
    """One sentence per run of lines with the same reason, `line 40: …` or `lines 40 to 52: …`."""
    ordered = sorted(damage, key=lambda d: d.line)
    sentences: list[str] = []
    for _, group in groupby(enumerate(ordered), key=lambda pair: (pair[1].line - pair[0], _kind(pair[1].reason))):
        some = [d for _, d in group]
        lines = f"line {some[0].line}" if len(some) == 1 else f"lines {some[0].line} to {some[-1].line}"
        sentences.append(f"{lines}: {some[0].reason}")
    if len(sentences) > MOST_SENTENCES:
        more = len(sentences) - MOST_SENTENCES
        sentences[MOST_SENTENCES:] = [f"and {more} more damaged place{'s' * (more > 1)}"]
    return tuple(sentences)


def _kind(reason: str) -> str:
    return "".join(c for c in reason.partition(":")[0] if not c.isdigit())
