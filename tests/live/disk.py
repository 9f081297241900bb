"""A journal in memory that may be full, and at which a process may crash; for tests of state machines."""

from dataclasses import dataclass, field

from fleet.errors import JournalFull


class Crash(Exception):
    """The process is killed during a call."""


@dataclass(eq=False)
class Disk:
    """Records that are on disk, and the faults of the next writes."""

    records: list = field(default_factory=list)
    full: bool = False
    crash: str = ""
    """`before` or `after` the next write; "" for none."""

    def keep(self, *records) -> None:
        """Write records, as `Journal.append`."""
        crash, self.crash = self.crash, ""
        if crash == "before":
            raise Crash
        if self.full:
            raise JournalFull("no room")
        self.records.extend(records)
        if crash == "after":
            raise Crash
