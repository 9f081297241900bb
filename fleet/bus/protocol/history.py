"""Messages about what an arm has done: an auctioneer, or an arm, whose journal is lost learns it from them."""

from typing import Annotated

import msgspec

from fleet.bus.protocol.auction import MOST_JOBS, Award, JobSpec
from fleet.bus.protocol.consensus import JobOutcome
from fleet.bus.protocol.messages import Count, Name

MOST_FINISHED = 256
"""Jobs that an arm remembers to have finished, the last ones."""


class HistoryRequest(msgspec.Struct, frozen=True):
    """Request to `arm/*/history`: what the arm has done and has. An auctioneer asks before it awards the arm a job."""


class History(msgspec.Struct, frozen=True):
    """Reply to a `HistoryRequest`, from the disk of the arm."""

    arm: Name
    epoch: str = ""
    """Of the last award that it accepted, or of its grants; "" for none."""
    finished: Annotated[tuple[JobSpec, ...], msgspec.Meta(max_length=MOST_FINISHED)] = ()
    """Jobs that it finished, in any epoch, oldest first; as many of the last ones as fit into one message."""
    awards: Annotated[tuple[Award, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Awards that it has accepted and that have not ended, with the cycles that are done now."""
    may_commit: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Awards among these with permission to commit."""
    claims: Annotated[dict[Name, Count], msgspec.Meta(max_length=MOST_JOBS)] = {}
    """Number of the last claim of each arm, where arms allocate jobs without an auctioneer."""
    committed: Annotated[tuple[JobOutcome, ...], msgspec.Meta(max_length=MOST_JOBS)] = ()
    """Likewise: jobs of arms with permission to commit, which are unfinished if their arms have lost their journals."""
