"""Requests of people who operate a fleet."""

import msgspec

from fleet.bus.protocol.messages import Name


class ClearRequest(msgspec.Struct, frozen=True):
    """Request to `jobs/clear`: free the space of an absent arm, and end its awards. The same request again changes
    nothing.

    Only a person who has seen that the arm is at home or removed, and switched off, may request it.
    """

    arm: Name
    by: str = ""
    """Who requests it, for the records."""


class Cleared(msgspec.Struct, frozen=True):
    """Reply to a `ClearRequest`: it is on disk, and the arm takes no space until it sends messages again."""

    auctioneer: Name
    arm: Name
