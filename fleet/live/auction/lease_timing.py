"""How patient an auctioneer is."""

from dataclasses import dataclass

from fleet.bus.protocol.auction import LEASE_S

DRIFT = 0.01
"""Clocks may differ in rate by so much: by this share the auctioneer counts a lease longer than it is."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Patience of an auctioneer, in real seconds."""

    lease_s: float = LEASE_S
    """An arm may work so long without renewing."""
    margin_s: float = 0.25
    """After a lease, before the job is offered again."""
    window_s: float = 0.5
    """A round closes after this, if not every arm has answered before."""
    ack_s: float = 1.0
    """To wait for the answer to an award."""
    attempts: int = 3
    """Times that an award is sent."""
    pause_s: tuple[float, float] = (0.25, 2.0)
    """Between rounds in which nothing was awarded, first and at most."""
    max_jobs: int = 64
    """Jobs in one round; a quote for more would be a large message."""

    def __post_init__(self) -> None:
        for name in ("lease_s", "margin_s", "window_s", "ack_s", "attempts", "max_jobs"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Timing.{name} must be > 0 (got {getattr(self, name)}).")
        if not 0 < self.pause_s[0] <= self.pause_s[1]:
            raise ValueError(f"Timing.pause_s must be 0 < first <= most (got {self.pause_s}).")

    @property
    def counted_lease_s(self) -> float:
        """How long the auctioneer counts a lease."""
        return self.lease_s * (1.0 + DRIFT) + self.margin_s
