"""What an auctioneer publishes again after a restart."""

from fleet.bus.protocol.auction import JobSpec, Result
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import Operated
from fleet.live.auction.rounds import LedgerWriter
from fleet.live.journal import EpochBegun, JobsAccepted


def writer(ledger: Ledger) -> LedgerWriter:
    return LedgerWriter("boss", ledger, lambda *records: None, 0.0)


def test_a_restart_publishes_as_much_again_as_was_cached():
    """Or what a recorder had not yet received when the auctioneer ended is lost."""
    ledger = Ledger().replay([EpochBegun("e")])
    before = writer(ledger)
    for start in range(0, 2 * HISTORY, 128):
        jobs = tuple(JobSpec(name=str(start + i), kind="hold", places=("rack",)) for i in range(128))
        before.record(JobsAccepted(jobs, "bob", 1.0))
    before.record(*(Operated(ControlRequest(str(number), Pause("arm_0"), "ann"), 2.0) for number in range(3)))
    after = writer(Ledger().replay(ledger.compact()))
    for kind in (Result, Operation):
        sent, again = ([message for message in each.out if isinstance(message, kind)] for each in (before, after))
        assert [message.number for message in sent] == list(range(len(sent)))
        assert {message.epoch for message in sent} == {"e"}
        assert again == sent[-HISTORY:]
