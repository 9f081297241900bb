"""What an arm without an auctioneer knows of jobs and arms that people steer, for `fleet.live.auction.control`."""

from collections.abc import Container, Mapping
from dataclasses import dataclass

from fleet.bus.protocol.auction import JobSpec, JobState, JobStatus
from fleet.bus.protocol.operator import ControlRequest, Operation, Settle
from fleet.live.consensus.operations import MAX_AWARDS
from fleet.live.consensus.register import Register


@dataclass(frozen=True)
class KnownJob:
    """A job, as `SteeredJob`."""

    spec: JobSpec
    status: JobStatus
    cancelled: bool
    award: str
    """Of the arm that has it, or had it last."""

    @property
    def state(self) -> JobState:
        """Its state."""
        return self.status.state


@dataclass(frozen=True)
class KnownFleet:
    """The fleet, as `SteeredFleet`."""

    register: Register
    jobs: Mapping[str, KnownJob]
    past: Container[str]
    ended: bool

    @property
    def paused(self) -> Mapping[str, str]:
        """Who paused an arm, by arm."""
        return self.register.operations.paused

    @property
    def space(self) -> Mapping[str, frozenset[str]]:
        """Names of the spaces that an arm may take, by arm."""
        return self.register.space

    @property
    def aside(self) -> Container[str]:
        """Jobs whose record cannot be read: none."""
        return ()

    @property
    def requests(self) -> Mapping[str, int]:
        """Names of the last requests; their content is not kept."""
        return dict.fromkeys(self.register.operations.names, 0)

    def at_work(self) -> Mapping[str, tuple[str, bool]]:
        """Return the arm that has a job, and whether it has permission to commit, by job."""
        grants = self.register.grants.items()
        settled = self.register.settled
        return {
            job: (grant.arm, grant.may_commit)
            for job, grant in grants
            if not grant.revoked and (job not in settled or settled[job].outcome != "unfinished")
        }

    def operation(self, arm: str, request: ControlRequest, time_s: float) -> Operation:
        """Return a request as the arm `arm` carries it out."""
        awards: tuple[str, ...] = ()
        match request.action:
            case Settle(job, "redo") if (known := self.jobs.get(job)) is not None:
                before = self.register.operations.latest.get(("redo", job))
                earlier = () if before is None else before.awards
                awards = (*earlier, known.award)[-MAX_AWARDS:] if known.award else earlier
            case _:
                pass
        return Operation(arm, time_s, request, awards=awards)
