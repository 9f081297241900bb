"""The fleet's time: seconds since the fleet started, at a speed, read off a monotonic clock.

A clock is a value: real time comes as an argument (`time.monotonic()`, which no jump of the wall clock touches), and a
correction gives another clock. It never goes backwards: what it is ahead or behind, it makes up for little by little.
Another's clock is measured by Cristian's algorithm: what it said counts for the middle between question and answer, so
the error is at most half of the time between them. (Cristian 1989, Distributed Computing 3, 146-158.)
"""

from dataclasses import dataclass
from math import isfinite
from typing import Self

SLEW = 0.1
"""By this share of its speed a clock goes faster or slower while it makes up for an offset."""


@dataclass(frozen=True)
class FleetClock:
    """Reads `zero_s` at the real second `real_s`, and from there `speed` seconds more with every real second."""

    speed: float
    """Fleet seconds per real second."""
    real_s: float = 0.0
    """Of the monotonic clock of this machine."""
    zero_s: float = 0.0
    """The fleet's time at `real_s`."""
    owed_s: float = 0.0
    """Fleet seconds that it was behind at `real_s` (negative: ahead), and makes up for from there."""

    def __post_init__(self) -> None:
        for name in ("speed", "real_s", "zero_s", "owed_s"):
            if not isfinite(getattr(self, name)):
                raise ValueError(f"FleetClock.{name} must be finite (got {getattr(self, name)}).")
        if self.speed <= 0:
            raise ValueError(f"FleetClock.speed must be > 0 (got {self.speed:g}).")

    def now_s(self, real_s: float) -> float:
        """The fleet's time at a real second, s; before its own first one it stands still."""
        passed_s = self.speed * max(0.0, real_s - self.real_s)
        made_up_s = min(abs(self.owed_s), SLEW * passed_s)
        return self.zero_s + passed_s + (made_up_s if self.owed_s >= 0 else -made_up_s)

    def corrected(self, asked_s: float, answered_s: float, time_s: float) -> Self:
        """A clock that reads the same at `answered_s` and goes towards what another clock said.

        Args:
            asked_s: Real second of the question.
            answered_s: Real second of the answer.
            time_s: The fleet's time as the other said it, some time in between.

        Returns:
            Off by no more than `speed · (answered_s − asked_s) / 2` once it has made up for its offset.
        """
        now_s = self.now_s(answered_s)
        return type(self)(self.speed, answered_s, now_s, self._then_s(asked_s, answered_s, time_s) - now_s)

    def set_by(self, asked_s: float, answered_s: float, time_s: float) -> Self:
        """A clock that reads at once what another clock said: for one that has told nobody the time yet."""
        return type(self)(self.speed, answered_s, self._then_s(asked_s, answered_s, time_s))

    def _then_s(self, asked_s: float, answered_s: float, time_s: float) -> float:
        """What the other clock reads at `answered_s`."""
        if answered_s < asked_s:
            raise ValueError(f"An answer comes after its question (got {asked_s} and {answered_s}).")
        return time_s + 0.5 * self.speed * (answered_s - asked_s)


def next_due_s(due_s: float, now_s: float, period_s: float) -> float:
    """When to do again what is done every `period_s`, was due at `due_s` and is done now.

    At its rate on average, but never sooner than after half a period: what was missed is not made up for, and a router
    that limits a rate by the gap between two words drops the second of two at once.
    """
    return max(due_s + period_s, now_s + 0.5 * period_s)
