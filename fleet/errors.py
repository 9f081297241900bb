"""What a caller may want to catch, and the words that help the person at the keyboard."""

from collections.abc import Iterable
from difflib import get_close_matches


class FleetError(Exception):
    """Base of every error that thermofleet raises on purpose."""


class ScenarioError(FleetError):
    """A scenario file says something that cannot be: names the file, the place and what is allowed."""


class InfeasibleJob(FleetError):
    """An arm cannot do a piece of work.

    Attributes:
        arm: Name of the arm.
        place: Name of the place it cannot serve.
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
    """The bus could not be opened, or a word on it could not be delivered in time."""


class IdentificationError(FleetError):
    """Recordings cannot tell an arm's thermal parameters; says what to record."""


class CheckpointError(FleetError):
    """A stored twin does not fit what is asked of it; names what differs."""


class LogError(FleetError):
    """A log file cannot be used as it is.

    Attributes:
        file: The file, as it was given.
        line: Line of a text file, or row of a table, from 1; None where the whole file is meant.
        reason: What is wrong, and what would be right.
    """

    def __init__(self, file: str, line: int | None, reason: str) -> None:
        super().__init__(f"{file}: {reason}" if line is None else f"{file}, line {line}: {reason}")
        self.file = file
        self.line = line
        self.reason = reason

    def __reduce__(self) -> tuple[type, tuple[str, int | None, str]]:
        return type(self), (self.file, self.line, self.reason)


class JournalError(FleetError):
    """A journal cannot be used as it is: damaged, in use by another, or not writable; names the file."""


class JournalFull(JournalError):
    """There is no room for a record; the journal is as it was before."""


def nearest(name: str, allowed: Iterable[str]) -> str:
    """The end of an error sentence: the allowed names, and the nearest one if there is one.

    Returns:
        For example `; did you mean 'ambient_c'? Allowed: ambient_c, arms.`
    """
    names = sorted(allowed)
    close = get_close_matches(name, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else "."
    return f"{hint} Allowed: {', '.join(names)}."
