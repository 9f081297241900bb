"""Exceptions of the public interface, checks of numbers and names, and suggestions for unknown names."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import chain
from math import inf


class FleetError(Exception):
    """Base of all errors of thermofleet."""


class ArgumentError(FleetError, ValueError):
    """An argument of a function has another type, or a value that is not allowed."""


class ScenarioError(FleetError):
    """Invalid scenario file; names the file, the place in it and what is allowed."""


@dataclass(eq=False)
class InfeasibleJob(FleetError):
    """An arm cannot execute a task."""

    arm: str
    place: str
    """Name of the place that the arm cannot serve."""
    reason: str
    """`reach`, `joint limit`, `torque`, `collision`, `no IK solution`, the payload rating, or an arm at home, with its
    numbers."""

    too_heavy: bool = False
    """Whether the load exceeds the rating."""

    def __str__(self) -> str:
        return f"Arm '{self.arm}' cannot work at '{self.place}': {self.reason}."


class BusError(FleetError):
    """The bus cannot be opened, or a message was not delivered in time."""


class NoRouter(BusError):
    """No router replies; one may start later."""


class StoppedWaiting(NoRouter):
    """Stopped by a signal, as was asked, before there was a router or a fleet."""


class IdentificationError(FleetError):
    """Recordings do not determine an arm's thermal parameters; the message states what to record."""


class CheckpointError(FleetError):
    """A stored twin does not fit its use; names the difference."""


@dataclass(eq=False)
class LogError(FleetError):
    """A log file cannot be used."""

    file: str
    line: int | None
    """Line of a text file, or row of a table, from 1; None for the whole file."""
    reason: str

    def __str__(self) -> str:
        return f"{self.file}: {self.reason}" if self.line is None else f"{self.file}, line {self.line}: {self.reason}"


class Refused(FleetError):
    """A request is refused; its sender gets this sentence instead of a reply."""

    temporary = False
    """Whether the same request may be accepted later, without a change by its sender."""


class RefusedForNow(Refused):
    """A request is refused by a state that passes; repeated later, it may be accepted."""

    temporary = True


class JournalError(FleetError):
    """A journal is damaged, in use by another process, or not writable; names the file."""


class JournalFull(JournalError, RefusedForNow):
    """No space for a record; the journal is unchanged, and a request that needs the record is refused."""


def check_positive(value: object, *fields: str) -> None:
    """Raise a ValueError unless these fields of a dataclass are finite numbers > 0."""
    for name in fields:
        if not 0 < getattr(value, name) < inf:
            raise ValueError(f"{type(value).__name__}.{name} must be > 0 and finite (got {getattr(value, name)}).")


def check_nonnegative(value: object, *fields: str) -> None:
    """Raise a ValueError unless these fields of a dataclass are finite numbers >= 0."""
    for name in fields:
        if not 0 <= getattr(value, name) < inf:
            raise ValueError(f"{type(value).__name__}.{name} must be >= 0 and finite (got {getattr(value, name)}).")


def check_between(value: object, low: float, high: float, *fields: str) -> None:
    """Raise a ValueError unless these fields of a dataclass, or all elements of a tuple, are from `low` to `high`."""
    for name in fields:
        given = getattr(value, name)
        if not all(low <= number <= high for number in (given if isinstance(given, tuple) else (given,))):
            shown = list(given) if isinstance(given, tuple) else given
            raise ValueError(f"{type(value).__name__}.{name} must be between {low:.15g} and {high:.15g} (got {shown}).")


MOST_M = 10.0
"""Largest coordinate in a cell."""


def check_coordinates(value: object, *fields: str) -> None:
    """Raise a ValueError unless these fields of a dataclass are points within `MOST_M` of the origin on every axis."""
    for name in fields:
        point = getattr(value, name)
        if not all(abs(coordinate) <= MOST_M for coordinate in point):
            raise ValueError(
                f"{type(value).__name__}.{name} must be coordinates between -{MOST_M:g} and {MOST_M:g} m "
                f"(got {listed(point)}); were millimetres meant?"
            )


MOST_LISTED, NEAREST = 60, 5
"""Values that an error message lists at most; of more names, as many as are most similar."""


def listed(values: Iterable[object]) -> str:
    """Values in an error message, with commas between them, the first ones of very many; "none" if there are none."""
    texts = list(map(str, values))
    if len(texts) > MOST_LISTED:
        texts[MOST_LISTED:] = [f"and {len(texts) - MOST_LISTED} more"]
    return ", ".join(texts) or "none"


def distinguish(one: float, other: float, digits: int = 4) -> tuple[str, str]:
    """Two numbers in an error message, with as many significant digits as show that they differ."""
    for count in range(digits, 17):
        texts = f"{one:.{count}g}", f"{other:.{count}g}"
        if texts[0] != texts[1] or one == other:
            return texts
    return repr(float(one)), repr(float(other))


def nearest(name: str, allowed: Iterable[str]) -> str:
    """End of an error message: the allowed names, or the most similar ones of very many, and which one was meant.

    Returns:
        For example `; did you mean 'ambient_c'? Allowed: ambient_c, arms.`
    """
    names = sorted(set(allowed))
    close = get_close_matches(name, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else "."
    if len(names) > MOST_LISTED:
        similar = get_close_matches(name, names, n=NEAREST, cutoff=0.0)
        return f"{hint} The most similar of {len(names)}: {listed(similar)}."
    return f"{hint} Allowed: {listed(names)}."


MAX_NAME = 128
"""Characters; a file name with it and an ending has at most 255 bytes."""
JOB_RULE, NAME_RULE = (
    f"1 to {MAX_NAME} printable characters{without}, and no dot or space at the start"
    for without in ("", " without / \\ [ ]")
)
"""Rules for names of jobs and persons, and of fleets, arms, auctioneers and places."""
_FORBIDDEN = frozenset("/\\[]")


def is_name(text: str, *, of_job: bool = False) -> bool:
    """Whether a text follows the rule for names, `NAME_RULE`: it is one file name, and is shown as it is written."""
    is_shown = 0 < len(text) <= MAX_NAME and text[0] not in ". " and text.isprintable()
    return is_shown and (of_job or _FORBIDDEN.isdisjoint(text))


def check_names(owner: object, *fields: str, of_jobs: bool = False) -> None:
    """Check that these fields, or all elements of a tuple of names or of such tuples, are names.

    Raises:
        ValueError: names the field, the value and the rule.
    """
    for field in fields:
        given = getattr(owner, field)
        several = given if isinstance(given, tuple) else (given,)
        for name in chain.from_iterable((each,) if isinstance(each, str) else each for each in several):
            if not is_name(name, of_job=of_jobs):
                rule = JOB_RULE if of_jobs else NAME_RULE
                raise ValueError(f"{type(owner).__name__}.{field} must have {rule} (got '{printable(name)}').")


def printable(text: str, longest: int = 4 * MAX_NAME) -> str:
    """A name or sentence from outside as one short line of a message; escaped as by `visible`."""
    return visible(text[:longest]) + ("…" if len(text) > longest else "")


def visible(text: str, keep: str = "") -> str:
    """Text for a terminal or a page, with control characters and direction marks as JSON escapes.

    Args:
        keep: Characters that stay as they are, for example line breaks.
    """
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() or char in keep else json.dumps(char)[1:-1] for char in text)


def install(extra: str, constraints: str = "constraints.txt") -> str:
    """Command that installs an extra, for an error message; no package index has thermofleet."""
    return f"pip install -e '.[{extra}]' -c {constraints}, in a copy of the repository"
