"""A journal in memory that may be full."""

from dataclasses import dataclass, field

from fleet.errors import JournalFull


@dataclass(eq=False)
class Disk:
    """Records that are on disk."""

    records: list = field(default_factory=list)
    full: bool = False

    def keep(self, *records) -> None:
        """Write records, as `Journal.append`."""
        if self.full:
            raise JournalFull("no room")
        self.records.extend(records)
