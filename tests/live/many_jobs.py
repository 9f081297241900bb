"""A participant that replies about many jobs in any states, as an arm without an auctioneer does: without results."""

from msgspec.structs import replace

from fleet.bus.client import BusClient
from fleet.bus.protocol.auction import JobSpec, JobState
from fleet.live.book import JobBook
from fleet.live.desk import JobDesk
from fleet.live.records import JobEntry


class ManyJobs(JobDesk):
    """Replies with the status of entries, which a test may change.

    Attributes:
        entries: By name.
    """

    def __init__(self, *entries: JobEntry) -> None:
        super().__init__("arm_0", 1.0, None)
        self.book, self.entries = JobBook(), {entry.name: entry for entry in entries}

    @property
    def time_s(self) -> float:
        return 900.0

    def reply_on(self, link: BusClient) -> None:
        """Reply to the requests of a fleet."""
        self._declare_desk(link)

    def move(self, name: str, state: JobState, **change) -> None:
        """Change the state of a job."""
        self.entries[name] = replace(self.entries[name], state=state, **change)

    def reply(self, request):
        """Return the reply to a status request."""
        return self._reply_status(request)

    def _check_first(self) -> None:
        """Reply always."""

    def _trouble(self) -> str:
        return ""

    def _entries(self):
        return list(self.entries.values())

    def _status_of(self, entries):
        return [self.book.status_of(entry) for entry in entries]

    def _submit(self, submission):
        raise NotImplementedError

    def _clear(self, request):
        raise NotImplementedError

    def _control(self, request):
        raise NotImplementedError


def entries(count: int, state: JobState = "finished", **change) -> list[JobEntry]:
    """Jobs in one state, the first to settle first."""
    return [
        JobEntry(
            name := f"{state}_{number:04d}",
            JobSpec(name, "hold", ("rack",)),
            state=state,
            settled_s=float(number) if state in ("finished", "given_up", "cancelled") else None,
            **change,
        )
        for number in range(count)
    ]
