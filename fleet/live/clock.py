"""Fleet time: seconds since the fleet started, at a given speed, read from a monotonic clock.

A clock is a value: real time is an argument (`time.monotonic()`, which a jump of the wall clock does not change), and a
correction returns a new clock. Corrections are gradual, so a clock never runs backwards. Another clock is read by
Cristian's algorithm: its reading is taken as the time halfway between request and reply, so the error is at most half
of the time between them. (Cristian 1989, Distributed Computing 3, 146-158.)
"""

from dataclasses import dataclass, replace
from math import isfinite
from typing import Self

SLEW = 0.1
"""Relative change of a clock's speed while it removes an offset."""

CLOCK_DRIFT = 0.01
"""Largest difference in rate between the clocks of two participants, relative."""


@dataclass(frozen=True)
class FleetClock:
    """Reads `zero_s` at the real second `real_s`, and `speed` seconds more with every real second after it."""

    speed: float
    """Fleet seconds per real second."""
    real_s: float = 0.0
    """On this machine's monotonic clock."""
    zero_s: float = 0.0
    """Fleet time at `real_s`."""
    offset_s: float = 0.0
    """Fleet seconds to be gained from `real_s` on (negative: to be lost)."""
    epoch: str = ""
    """As in `fleet.bus.protocol.auction.Clock`; "" for unknown."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "epoch" and not isfinite(value):
                raise ValueError(f"FleetClock.{name} must be finite (got {value}).")
        if self.speed <= 0:
            raise ValueError(f"FleetClock.speed must be > 0 (got {self.speed:g}).")

    def now_s(self, real_s: float) -> float:
        """Fleet time at a real second, s; before the clock's first second it is stopped."""
        passed_s = self.speed * max(0.0, real_s - self.real_s)
        gained_s = min(abs(self.offset_s), SLEW * passed_s)
        return self.zero_s + passed_s + (gained_s if self.offset_s >= 0 else -gained_s)

    def slewed_to(self, asked_s: float, answered_s: float, time_s: float) -> Self:
        """Return a clock that reads the same at `answered_s` and approaches another clock gradually.

        Args:
            asked_s: Real second of the request.
            answered_s: Real second of the reply.
            time_s: Reading of the other clock, taken in between.

        Returns:
            A clock that is off by at most `speed · (answered_s − asked_s) / 2` once the offset is removed.
        """
        now_s = self.now_s(answered_s)
        offset_s = self._reading_s(asked_s, answered_s, time_s) - now_s
        return replace(self, real_s=answered_s, zero_s=now_s, offset_s=offset_s)

    def set_to(self, asked_s: float, answered_s: float, time_s: float) -> Self:
        """Return a clock that reads the other clock's time at once, for use before the first reading."""
        zero_s = self._reading_s(asked_s, answered_s, time_s)
        return replace(self, real_s=answered_s, zero_s=zero_s, offset_s=0.0)

    def _reading_s(self, asked_s: float, answered_s: float, time_s: float) -> float:
        """Reading of the other clock at `answered_s`."""
        if answered_s < asked_s:
            raise ValueError(f"answered_s must be >= asked_s (got {answered_s} and {asked_s}).")
        return time_s + 0.5 * self.speed * (answered_s - asked_s)


def next_due_s(due_s: float, now_s: float, period_s: float) -> float:
    """Return when a periodic action is due again that was due at `due_s` and is done now.

    The mean rate is right, but the gap is never less than half a period: a router that limits rates by the gap between
    messages would drop the second of two.
    """
    return max(due_s + period_s, now_s + 0.5 * period_s)
