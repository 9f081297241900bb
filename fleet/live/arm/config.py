"""Configuration of an arm of a live fleet."""

from collections.abc import Callable
from dataclasses import dataclass

from fleet.bus.protocol.registry import STATE_HZ


@dataclass(frozen=True, kw_only=True)
class ArmConfig:
    """How an arm takes part in the fleet."""

    warning_c: float
    """Motor temperature above which it accepts no work."""
    rate_hz: float = STATE_HZ
    """State messages per real second."""
    boot: int = 1
    """Number of this start."""
    ambient_c: Callable[[float], float] = lambda time_s: 25.0
    """Measured ambient temperature of the cell by fleet time."""
    takes_jobs: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 1000:
            raise ValueError(f"ArmConfig.rate_hz must be > 0 and <= 1000 (got {self.rate_hz:g}).")
