"""Ledger of an auctioneer with the leases of its open awards: a record is on disk before it changes anything."""

import logging
from collections import deque
from collections.abc import Callable

from msgspec.structs import asdict

from fleet.bus.protocol.auction import Announcement, QuoteRequest, Result
from fleet.bus.protocol.operator import Operation
from fleet.errors import JournalFull
from fleet.live.auction.leases import CountedLease, SendAward
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import AuctionRecord, Change, Operated

_LOG = logging.getLogger(__name__)

Out = QuoteRequest | SendAward | Announcement | Result | Operation


class LedgerWriter:
    """Writes records, applies them, and announces the changes.

    Attributes:
        ledger: Jobs and awards.
        leases: Leases of the open awards.
        out: Messages to send, oldest first.
    """

    def __init__(self, name: str, ledger: Ledger, keep: Callable[..., None], counted_until_s: float) -> None:
        """Start with a ledger.

        Args:
            name: Of the auctioneer.
            keep: Writes records; returns when they are on disk, or raises `JournalError` and has written none.
            counted_until_s: Real second until which its open awards count as leased.
        """
        self.ledger = ledger
        self.leases = {award: CountedLease(counted_until_s) for award in ledger.open}
        self._name, self._keep = name, keep
        self.out: deque[Out] = deque(self._result(change) for change in ledger.recent)
        first = ledger.operated - len(ledger.operations)
        self.out.extend(self._operation(record, first + place) for place, record in enumerate(ledger.operations))

    def record(self, *records: AuctionRecord) -> None:
        """Write records, then apply them.

        Raises:
            JournalError: nothing was written, and nothing has changed.
        """
        if not records:
            return
        records = (*self.ledger.checks_due(), *records)
        self._keep(*records)
        for record in records:
            self.out.extend(map(self._result, self.ledger.apply(record)))
            if isinstance(record, Operated):
                self.out.append(self._operation(record, self.ledger.operated - 1))
        for award in self.leases.keys() - self.ledger.open.keys():
            del self.leases[award]

    def try_to_record(self, failure: str, *records: AuctionRecord) -> bool:
        """Record; return whether that is on disk, and log the failure if not."""
        try:
            self.record(*records)
        except JournalFull as error:
            _LOG.error("%s: %s", failure, error)
            return False
        return True

    def _result(self, change: Change) -> Result:
        return Result(self._name, epoch=self.ledger.epoch, **asdict(change))

    def _operation(self, record: Operated, number: int) -> Operation:
        return Operation(self._name, record.time_s, record.request, number, self.ledger.epoch)
