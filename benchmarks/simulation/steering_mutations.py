"""Rules of requests of people and of the recorder, each broken on purpose."""

from collections.abc import Callable
from typing import Any

from benchmarks.simulation.mutation import add_mutation, unwritten
from fleet.bus.protocol.operator import Cancel, Change, ControlRequest, Pause, Resume, Settle
from fleet.errors import Refused
from fleet.live.auction import auctioneer as auctioneer_module
from fleet.live.auction.ledger import Ledger, LedgerView
from fleet.live.auction.records import Operated
from fleet.live.journal import Journal
from scenarios.live import recorder as recorder_module
from scenarios.live.recorder import GapFetcher, Recorder
from scenarios.live.recording import PartOpened


def _ignores(action: type) -> Callable[[Any], Any]:
    """Record a request of this kind, and change nothing."""

    def make(operate: Any) -> Any:
        def patched(self: Any, request: ControlRequest, time_s: float) -> Any:
            if isinstance(request.action, action):
                self.requests[request.request] = None
                return []
            return operate(self, request, time_s)

        return patched

    return make


def _redone_at_once(objection: Any) -> Any:
    """Redo a job although its arm may still do its last cycle."""

    def patched(ledger: Any, request: ControlRequest, heard: Any) -> str:
        try:
            return objection(ledger, request, heard)
        except Refused as refused:
            if "may still do the last cycle" in str(refused):
                return ""
            raise

    return patched


def _cleared_at_once(clear: Any) -> Any:
    """Free the space of an absent arm that may have a lease."""

    def patched(ledger: Any, *arguments: Any) -> Any:
        before = {name: award.silent for name, award in ledger.open.items()}
        try:
            for award in ledger.open.values():
                award.silent = True
            return clear(ledger, *arguments)
        finally:
            for name, silent in before.items():
                ledger.open[name].silent = silent

    return patched


def _gaps_unnoticed(take: Any) -> Any:
    def patched(self: Any, record: Any) -> bool:
        new = take(self, record)
        self.sought.clear()
        return new

    return patched


def _of_any_part(_: Any) -> Any:
    def patched(journal: Any, number: int) -> Any:
        return [record for record in journal.records() if not isinstance(record, PartOpened)]

    return patched


add_mutation(
    "request-unwritten",
    "a request of a person is on disk before the reply",
    (Journal, "append", unwritten(Operated)),
    alone=False,
)
add_mutation(
    "request-repeated",
    "a request of one name is carried out once",
    (
        Ledger,
        "_operate",
        lambda operate: (
            lambda self, request, time_s: (operate(self, request, time_s), self.requests.pop(request.request, None))[0]
        ),
    ),
    alone=False,
)
for action in (Cancel, Settle, Change, Pause, Resume):
    add_mutation(
        f"{action.__name__.lower()}-ignored",
        f"a request to {action.__name__.lower()} has its effect",
        (Ledger, "_operate", _ignores(action)),
        alone=False,
    )
add_mutation(
    "pause-without-effect",
    "a paused arm gets no job",
    (LedgerView, "is_paused", lambda _: lambda self, arm: False),
    alone=False,
)
add_mutation(
    "cancelled-awarded",
    "a cancelled job goes to no other arm",
    (Ledger, "_cancel", lambda _: lambda self, entry: []),
    alone=False,
)
add_mutation(
    "redo-at-once",
    "nothing is redone that an arm may still do",
    (auctioneer_module, "objection", _redone_at_once),
    alone=False,
)
add_mutation(
    "clear-at-once",
    "space is freed only after the lease of its arm",
    (auctioneer_module, "cleared_space", _cleared_at_once),
    alone=False,
)
add_mutation(
    "gap-unnoticed",
    "the recorder notices missing numbers",
    (Recorder, "_take", _gaps_unnoticed),
)
add_mutation(
    "gap-not-fetched",
    "the recorder fetches what it missed",
    (GapFetcher, "_begin", lambda _: lambda self, senders: None),
)
add_mutation(
    "repeats-recorded",
    "a message is recorded once",
    (Recorder, "_fill", lambda _: lambda self, series, count, time_s: True),
)
add_mutation(
    "part-twice",
    "the journal of a complete part is ignored",
    (recorder_module, "records_of", _of_any_part),
)
