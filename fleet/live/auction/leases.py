"""Leases of open awards, as the auctioneer counts them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from fleet.bus.protocol.auction import Award
from fleet.live.auction.round import Timing


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


def unanswered(leases: Mapping[str, CountedLease]) -> list[tuple[CountedLease, SendAward]]:
    """Return the leases of awards that their arms have not answered, and these awards."""
    return [(lease, lease.unanswered) for lease in leases.values() if lease.unanswered is not None]


def send_again(leases: Mapping[str, CountedLease], real_s: float, timing: Timing) -> list[SendAward]:
    """Return the unanswered awards that are due to be sent again; they count as sent."""
    due: list[SendAward] = []
    for lease, message in unanswered(leases):
        if real_s >= lease.sent_s + timing.ack_s and lease.attempts < timing.attempts:
            lease.sent_s, lease.attempts = real_s, lease.attempts + 1
            due.append(message)
    return due
