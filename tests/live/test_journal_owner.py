"""A journal belongs to one arm or auctioneer: no other one starts with it, before or after a compaction."""

import pytest

from fleet.errors import JournalError
from fleet.live.arm.awards import ArmRecord
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.records import AuctionRecord
from fleet.live.consensus.jobs import GrantRecord
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.journal import Journal, Started
from scenarios.live.arm import restart_history
from tests.live.council.test_council_poison import Arm
from tests.live.test_poison import Wire

KINDS = {"arm": ArmRecord, "arm without auctioneer": GrantRecord, "auctioneer": AuctionRecord}


def start(kind: str, name: str, journal) -> None:
    """Start a participant of this name, as its process does."""
    match kind:
        case "arm":
            restart_history(journal, name, 0.0)
        case "auctioneer":
            AuctionNode(Wire(), name, journal, allocate=lambda bidding: {}, speed=1.0)
        case _:
            arm = Arm()
            arm.executor.arm = name
            fleet = LiveFleet(arms=("arm_1", "arm_2"))
            ConsensusNode(arm, Membership(fleet=fleet, choose=lambda *_: {}), journal, boot=1)


@pytest.mark.parametrize("starts", [1, 2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_a_journal_of_another_name_is_refused_and_stays_as_it_is(kind, starts, tmp_path):
    path = tmp_path / "arm_2.journal"  # under the name of the other one, as after a swap
    for _ in range(starts):
        with Journal(path, KINDS[kind]) as journal:
            start(kind, "arm_1", journal)
    before = path.read_bytes()
    with Journal(path, KINDS[kind]) as journal, pytest.raises(JournalError, match=r"of 'arm_1'; 'arm_2' needs its own"):
        start(kind, "arm_2", journal)
    assert path.read_bytes() == before


@pytest.mark.parametrize("kind", KINDS)
def test_a_journal_without_a_name_is_read_and_gets_one(kind, tmp_path):
    """As earlier versions wrote it."""
    with Journal(tmp_path / "old", KINDS[kind]) as journal:
        journal.append(Started(boot=3))
        start(kind, "arm_1", journal)
        with pytest.raises(JournalError, match="arm_1"):
            start(kind, "arm_2", journal)
