"""Leases of open awards, as the auctioneer counts them."""

import math
from dataclasses import dataclass

from fleet.bus.protocol.auction import Award


@dataclass(frozen=True)
class SendAward:
    """Send this award to its arm."""

    arm: str
    award: Award


@dataclass(eq=False)
class CountedLease:
    """Lease of an open award, as the auctioneer counts it."""

    until_s: float
    """Real second at which it ends."""
    cycles: int = 0
    """Last reported progress."""
    unanswered: SendAward | None = None
    """The award, until its arm answers."""
    sent_s: float = -math.inf
    attempts: int = 1
