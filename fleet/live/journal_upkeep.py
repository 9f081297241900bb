"""Journals that stay short while they are written, and fleet time in them."""

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic

from fleet.errors import JournalError, JournalFull, printable
from fleet.live.journal import Journal, JournalState, Record, TimedState
from fleet.live.journal_records import ClockTick, Started

_LOG = logging.getLogger(__name__)

TICK_S = 2.0
"""Real seconds between two records of the fleet's time."""


def put_aside(path: Path, name: str) -> Callable[[bytes, str], tuple[()]]:
    """Return what to do with a record of a journal that is not applied: append it to a file, and report it.

    Args:
        path: The file.
        name: Of the arm or auctioneer.
    """

    def put(record: bytes, reason: str) -> tuple[()]:
        begin = printable(record[:200].decode(errors="replace"))
        _LOG.error("'%s': put a journal record aside in '%s': %s. It begins %s.", name, path, reason, begin)
        try:
            with path.open("ab") as file:
                file.write(record + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise JournalError(
                f"A record cannot be put aside in '{path}': {error.strerror}. Make room there."
            ) from error
        return ()

    return put


def own_records(journal: Journal[Record], name: str) -> Iterator[Record]:
    """Yield the records of the journal of an arm or auctioneer, oldest first.

    Raises:
        JournalError: it is of another one, or damaged. Journals of earlier versions may name none.
    """
    for record in journal.records():
        if isinstance(record, Started) and record.name not in ("", name):
            raise JournalError(
                f"Journal '{journal.path}' is of '{printable(record.name)}'; '{name}' needs its own. If journals were "
                f"swapped or copied, bring that of '{name}' back. See Epochs in docs/bus/auctioneer.md before you "
                "move one away."
            )
        yield record


class CompactingJournal(Generic[Record]):
    """Appends to a journal, and compacts it when it has grown."""

    def __init__(self, journal: Journal[Record], state: JournalState[Record]) -> None:
        """Prepare; `state` is that of the journal, and belongs to this object from now on."""
        self._journal, self._state = journal, state

    def append(self, *records: Record) -> None:
        """Write records, as `Journal.append` does.

        Raises:
            JournalError: none of them is written.
        """
        self._journal.append(*records)
        for record in records:
            self._state.apply(record)
        if self._journal.needs_compaction:
            try:
                self._journal.compact(*self._state.compact())
            except JournalError as error:  # the records are written; the next ones are refused if it is serious
                _LOG.error("%s", error)


class TimeRecorder:
    """Records fleet time, so that it continues after a restart and never runs backwards."""

    def __init__(self, journal: Journal[Any], state: TimedState[Any], real_s: float) -> None:
        """Compact the journal, which gave this state."""
        self._journal, self._state, self._recorded_s = journal, state, real_s
        journal.compact(*state.compact())

    def start_s(self, speed: float) -> float:
        """Return the fleet time to start with: after a restart, one that was certainly not read before."""
        return self._state.time_s + TICK_S * speed if self._state.time_s else 0.0

    def step(self, real_s: float, time_s: float) -> None:
        """Record the fleet time every `TICK_S`, and compact the journal when it has grown.

        Raises:
            JournalError: the journal cannot be relied on any more.
        """
        if real_s < self._recorded_s + TICK_S:
            return
        self._recorded_s = real_s
        records = (*self._state.checks_due(), ClockTick(time_s))
        try:
            self._journal.append(*records)
        except JournalFull as error:
            _LOG.error("Could not record the fleet's time: %s", error)
        else:
            for record in records:
                self._state.apply(record)
        if self._journal.needs_compaction:
            self._journal.compact(*self._state.compact())
