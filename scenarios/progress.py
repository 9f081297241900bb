"""Progress of long-running functions: stages, fractions and the time left."""

import re
from collections.abc import Callable

from fleet.errors import ScenarioError

Progress = Callable[[str, float], None]
"""Called with the name of the present stage and the fraction of it that is done, 0 to 1; a `Count` tells how many."""

COUNTED = "computing "
"""Prefix of a stage name that counts what is left. Without a progress bar, each such name is printed."""

STAGES = {
    "planning": "Planning motions",
    "identifying": "Identifying the arms",
    "training": "Training the twins",
    "calibrating": "Calibrating the twins",
    "learning the log": "Training the twin of the log",
    "working": "Simulating the shift",
    "comparing": "Simulating shifts",
    "teaching": "Training the networks",
    "writing": "Writing the files",
}
"""Text of a stage; other stages are shown by their names."""
HINTS = {
    "training": "only those missing from the cache; up to a minute per arm and core, minutes at full size",
    "learning the log": "up to a minute, several minutes at full size",
    "teaching": "only those missing from the cache; the longest part",
}
"""Added to the first line of a long stage."""
LEAST_S = 5.0
"""A stage gets an estimate of the time left after this long."""


class Count(float):
    """The fraction `done / total`, which keeps both numbers; `total` is at least 1."""

    done: float
    total: int
    at_once: int

    def __new__(cls, done: float, total: int, at_once: int = 1) -> "Count":
        """The fraction; `at_once` are worked on at the same time."""
        count = super().__new__(cls, done / total)
        count.done, count.total, count.at_once = done, total, at_once
        return count


class StageClock:
    """The present stage, how much of it is done, and how long the rest takes.

    `update` and the readers take seconds of one clock that never goes back.
    """

    def __init__(self) -> None:
        self.stage, self.fraction = "", 0.0
        self._began_s, self._first = 0.0, 0.0

    def update(self, stage: str, fraction: float, now_s: float) -> bool:
        """Take a report; returns whether a new stage begins. Names that differ in numbers only are one stage."""
        new = _kind(stage) != _kind(self.stage)
        if new or fraction < self._first:
            self._began_s, self._first = now_s, float(fraction)
        self.stage, self.fraction = stage, fraction
        return new

    def elapsed_s(self, now_s: float) -> float:
        """Time since the stage began, s."""
        return now_s - self._began_s

    def left_s(self, now_s: float) -> float | None:
        """Time until the stage ends at its mean pace so far, s; None while there is nothing to judge by."""
        done, left, spent_s = self.fraction - self._first, 1.0 - self.fraction, self.elapsed_s(now_s)
        if spent_s < LEAST_S or done <= 0:
            return None
        if isinstance(self.fraction, Count):  # what others work on when one is done is half done, on average
            half = min((self.fraction.at_once - 1) / self.fraction.total, left) / 2
            done, left = done + half, left - half
        return spent_s / done * left

    @property
    def label(self) -> str:
        """What is going on, and the count."""
        name = STAGES.get(self.stage, f"{self.stage[:1].upper()}{self.stage[1:]}")
        return f"{name} {int(self.fraction.done)}/{self.fraction.total}" if isinstance(self.fraction, Count) else name

    def first_line(self) -> str:
        """The line of a stage that begins."""
        hint = HINTS.get(self.stage)
        return f"{self.label} ({hint}) …" if hint else f"{self.label} …"

    def line(self, now_s: float) -> str:
        """The stage, its count, the part done and the time left, as one line."""
        left_s = self.left_s(now_s)
        left = (
            f"about {brief(left_s)} left of this stage" if left_s is not None else f"for {brief(self.elapsed_s(now_s))}"
        )
        return f"{self.label}: {self.fraction:.0%}, {left}."


def check_progress(progress: object) -> None:
    """Check that `progress` can be called.

    Raises:
        ScenarioError: it is no function.
    """
    if not callable(progress):
        raise ScenarioError(
            f"progress must be a function of the name of a stage and the fraction done, as "
            f"lambda stage, done: print(stage, done) (got {progress!r})."
        )


def brief(time_s: float) -> str:
    """A duration in one unit: 12 s, 3 min, 1.5 h."""
    if time_s < 90:
        return f"{time_s:.0f} s"
    return f"{time_s / 60:.0f} min" if time_s < 5400 else f"{time_s / 3600:.1f} h"


def quiet(stage: str, fraction: float) -> None:
    """Ignore all progress."""


def _kind(stage: str) -> str:
    """A stage name up to its first number; each counted stage is one of its own."""
    return stage if stage.startswith(COUNTED) else re.split(r"\d", stage, maxsplit=1)[0]
