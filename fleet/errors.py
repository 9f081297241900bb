"""Exceptions that callers may want to catch, and hints for unknown names."""

from collections.abc import Iterable
from difflib import get_close_matches


class FleetError(Exception):
    """Base of every error that thermofleet raises on purpose."""


class ScenarioError(FleetError):
    """Invalid scenario file; names the file, the place in it and what is allowed."""


class InfeasibleJob(FleetError):
    """An arm cannot do a work.

    Attributes:
        arm: Name of the arm.
        place: Name of the place that it cannot serve.
        reason: One of `reach`, `joint limit`, `torque`, `collision`, `no IK solution`, with its numbers.
    """

    def __init__(self, arm: str, place: str, reason: str) -> None:
        super().__init__(f"Arm '{arm}' cannot work at '{place}': {reason}.")
        self.arm = arm
        self.place = place
        self.reason = reason

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.arm, self.place, self.reason)


class BusError(FleetError):
    """The bus cannot be opened, or a message was not delivered in time."""


class IdentificationError(FleetError):
    """Recordings do not determine an arm's thermal parameters; says what to record."""


class CheckpointError(FleetError):
    """A stored twin does not fit its use; names the difference."""


class LogError(FleetError):
    """A log file cannot be used.

    Attributes:
        file: The file as given.
        line: Line of a text file, or row of a table, from 1; None for the whole file.
        reason: What is wrong and what is allowed.
    """

    def __init__(self, file: str, line: int | None, reason: str) -> None:
        super().__init__(f"{file}: {reason}" if line is None else f"{file}, line {line}: {reason}")
        self.file = file
        self.line = line
        self.reason = reason

    def __reduce__(self) -> tuple[type, tuple[str, int | None, str]]:
        return type(self), (self.file, self.line, self.reason)


class Refused(FleetError):
    """A request is refused; its sender gets this sentence instead of a reply."""


class JournalError(FleetError):
    """A journal is damaged, in use by another process, or not writable; names the file."""


class JournalFull(JournalError, Refused):
    """No space for a record; the journal is unchanged, and a request that needs the record is refused."""


def nearest(name: str, allowed: Iterable[str]) -> str:
    """End of an error message: the allowed names, and the most similar one if there is one.

    Returns:
        For example `; did you mean 'ambient_c'? Allowed: ambient_c, arms.`
    """
    names = sorted(allowed)
    close = get_close_matches(name, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else "."
    return f"{hint} Allowed: {', '.join(names)}."
