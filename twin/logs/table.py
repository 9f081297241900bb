"""The numbers of a log as a table, and its damaged lines."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

Array = np.ndarray

MOST_SENTENCES = 20
"""Most sentences about one file; further ones are counted."""
STRAY_ROWS = 3
"""Longest run of rows with wrong times; a longer one is a clock that was reset."""


@dataclass(frozen=True)
class Damage:
    """An unusable line, or row of a parquet file."""

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
    """Unusable lines."""
    broken: tuple[str, ...] = ()
    """Damage of the whole file."""


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
