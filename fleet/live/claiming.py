"""What an arm claims of its peers, and what a majority of them makes of it.

A state machine without a clock and without I/O. To the arm's `Contractor` it speaks as an auctioneer would: a job that
a majority grants is an award, the moment at which a majority was asked is that of its lease, and what a majority has on
disk is receipted. Every claim holds all that the arm has in hand, wants and has to report, in one word: a peer that
finds there no more what it has granted knows that the arm has let go of it.
"""

import logging
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from fleet.bus.council import Claim, Grant, Settled, Stake
from fleet.bus.trade import MOST_JOBS, Ack, Award, JobWord, Lease, Receipt, Report
from fleet.errors import JournalError
from fleet.live.auctioneer import Objection
from fleet.live.contractor import Contractor
from fleet.live.granting import Grantor
from fleet.live.timing import Timing

_LOG = logging.getLogger(__name__)

CLAIM_S = 0.5
"""Real seconds after which a claim is said again to those who have not answered."""
WISH_S = 2.0
"""Real seconds after which an arm gives up a job that no majority grants it."""
MOST_CORRECTIONS = 32
"""In one claim."""
CLAIMS = 64
"""Whose answers still count."""


@dataclass(eq=False)
class Vote:
    """What the fleet has said about one award."""

    granted_s: dict[str, float] = field(default_factory=dict)
    """When it was last asked, real seconds, by the arm that granted it."""
    denied: set[str] = field(default_factory=set)
    leave: set[str] = field(default_factory=set)
    cycles: int = 0

    def since_s(self, majority: int) -> float:
        """When the last majority was asked; -inf for none."""
        asked = sorted(self.granted_s.values(), reverse=True)
        return asked[majority - 1] if len(asked) >= majority else -math.inf


@dataclass(frozen=True, eq=False)
class Wish:
    """A job that the arm wants, by the result that all have worked out."""

    word: JobWord
    quote: str
    made_s: float


class Claimant:
    """What one arm claims, in one life.

    Attributes:
        majority: Of the fleet, whoever is there.
        wishes: What it wants and does not hold yet, by award.
        vain: Jobs that it wanted and did not get, oldest first; whoever drives it takes them out.
    """

    def __init__(
        self,
        contractor: Contractor,
        grantor: Grantor,
        take: Callable[[Award, float], Ack],
        *,
        life: int,
        timing: Timing | None = None,
    ) -> None:
        """Begin.

        Args:
            take: Takes an award in hand.
            life: Counts up with every start of the arm.
        """
        self.arm, self.contractor, self.grantor = contractor.arm, contractor, grantor
        self.majority = len(grantor.roster) // 2 + 1
        self.wishes: dict[str, Wish] = {}
        self.vain: list[str] = []
        self._take_up, self._timing = take, timing or Timing()
        self._number = life * 1_000_000_000
        self._votes: dict[str, Vote] = {}
        self._receipts: dict[str, set[str]] = {}
        """Arms that have a report on disk, by award."""
        self._corrections: dict[str, Settled] = {}
        self._news: dict[str, JobWord] = {}
        self._sent: OrderedDict[int, tuple[Claim, float, int]] = OrderedDict()
        self._told: dict[str, int] = {}
        """Version of the claim that each arm has answered."""
        self._version, self._due, self._claimed_s = 1, True, -math.inf

    @property
    def room(self) -> int:
        """How many more jobs it may want."""
        word = MOST_JOBS - len(self.contractor.held) - len(self.contractor.unreceipted())
        return min(self.contractor.spare, word) - len(self.wishes)

    def want(self, word: JobWord, real_s: float) -> None:
        """Claim a job."""
        quote = self.contractor.quoted({word.name: (word, True)}, real_s)
        award = f"{self.arm}-{quote}:{word.name}"
        self.wishes[award] = Wish(word, quote, real_s)
        self._votes[award] = Vote()
        self._change()

    def correct(self, settled: Settled) -> None:
        """Tell the others, one of whom does not seem to know, how it ended with a job."""
        self._corrections[settled.job] = settled
        self._due = True

    def tell(self, word: JobWord) -> None:
        """Tell the others, one of whom does not seem to know, of a job."""
        self._news[word.name] = word
        self._due = True

    def hurry(self) -> None:
        """A lease is to be renewed, leave asked for, or a report said again."""
        self._due = True

    def claim(self, there: frozenset[str], real_s: float) -> Claim | None:
        """What it has to say: when that is new, in time for its leases, and to those who have not answered.

        Args:
            there: Arms that show that they are alive.
        """
        self._forget(real_s)
        untold = any(self._told.get(arm, 0) < self._version for arm in there)
        if not self._due and not (untold and real_s >= self._claimed_s + CLAIM_S):
            return None
        stakes, settled = self._stakes()
        corrections = list(self._corrections.values())[: min(MOST_CORRECTIONS, MOST_JOBS - len(settled))]
        self._number += 1
        jobs = tuple(self._news.values())[:MOST_CORRECTIONS]
        claim = Claim(self.arm, self._number, tuple(stakes), (*settled, *corrections), jobs)
        self._claimed_s = real_s
        try:
            own = self.grantor.asked(claim, real_s)
        except Objection as objection:
            self._due = False  # again when it is due anew, or after a while
            _LOG.warning("Nothing is claimed: %s", objection)
            return None
        self._due = False
        self._corrections.clear()
        self._news.clear()
        self._sent[claim.number] = claim, real_s, self._version
        if len(self._sent) > CLAIMS:
            self._sent.popitem(last=False)
        self.answered(own, real_s)
        return claim

    def answered(self, grant: Grant, real_s: float) -> None:
        """A peer, or this arm itself, has answered a claim."""
        sent = self._sent.get(grant.number)
        if sent is None or grant.arm not in self.grantor.roster:
            return
        claim, asked_s, version = sent
        self._told[grant.arm] = max(version, self._told.get(grant.arm, 0))
        for granted in grant.granted:
            if vote := self._votes.get(granted.award):
                vote.granted_s[grant.arm] = max(asked_s, vote.granted_s.get(grant.arm, -math.inf))
                vote.denied.discard(grant.arm)
                vote.cycles = max(vote.cycles, granted.cycles)
                if granted.leave:
                    vote.leave.add(grant.arm)
        for denied in grant.denied:
            if denied.settled is not None:
                self._learn(denied.settled)
            vote = self._votes.get(denied.award)
            if vote is not None and asked_s >= vote.granted_s.get(grant.arm, -math.inf):
                vote.granted_s.pop(grant.arm, None)
                vote.denied.add(grant.arm)
        for settled in claim.settled:
            self._receipts.get(settled.award, set()).add(grant.arm)
        self._judge(real_s)

    # Inside

    def _change(self) -> None:
        """Something is to be told to everybody."""
        self._version += 1
        self._due = True

    def _stakes(self) -> tuple[list[Stake], list[Settled]]:
        """All that it holds and wants, and all that it has to report; what is not on disk yet it still holds."""
        places = {held.award.award: held.award.job.places for held in self.contractor.held}
        holds = self.contractor.holds(self.arm)
        stakes = [Stake(hold.award, hold.job, places[hold.award], hold.cycles, hold.phase) for hold in holds]
        for award, wish in self.wishes.items():
            stakes.append(Stake(award, wish.word.name, wish.word.places, 0, "wanted"))
        settled: list[Settled] = []
        for report, written in self.contractor.unreceipted():
            gift = self.grantor.register.gifts.get(report.job)
            if written:
                settled.append(_settled(report))
            elif gift is not None and gift.award == report.award:
                phase = "finishing" if gift.leave else "working"
                stakes.append(Stake(report.award, report.job, gift.places, report.cycles, phase))
        for hold in holds:
            self._votes.setdefault(hold.award, Vote())
        for each in settled:
            self._receipts.setdefault(each.award, set())
        return stakes, settled

    def _judge(self, real_s: float) -> None:
        """Draw the consequences of what a majority has said."""
        for award, wish in list(self.wishes.items()):
            vote = self._votes[award]
            if len(vote.granted_s) >= self.majority:
                self._take(award, wish, vote, real_s)
            elif self._hopeless(vote):
                self._drop(award)
        for held in self.contractor.held:
            if vote := self._votes.get(held.award.award):
                self._renew(held.award.award, vote, held.leave, real_s)
        for report, _ in self.contractor.unreceipted():
            if len(self._receipts.get(report.award, ())) >= self.majority:
                del self._receipts[report.award]
                self.contractor.receipted(Receipt(self.arm, report.award))

    def _renew(self, award: str, vote: Vote, left: bool, real_s: float) -> None:
        """Tell the contractor what has become of an award in hand."""
        lease_s, asked_s = self._timing.lease_s, vote.since_s(self.majority)
        leave = (award,) if len(vote.leave) >= self.majority else ()
        if self._hopeless(vote) and not left and not leave:
            self.contractor.leased(Lease(self.arm, lease_s, (), (award,)), real_s)
            self._change()
        elif asked_s > -math.inf:
            self.contractor.leased(Lease(self.arm, lease_s, (award,), (), leave), asked_s)
        elif leave:
            self.contractor.leased(Lease(self.arm, lease_s, (), (), leave), real_s)

    def _hopeless(self, vote: Vote) -> bool:
        return len(vote.denied) > len(self.grantor.roster) - self.majority

    def _take(self, award: str, wish: Wish, vote: Vote, real_s: float) -> None:
        cycles = min(vote.cycles, wish.word.repetitions - 1)  # somebody has to do at least the last one
        given = Award(award, award, self.arm, wish.quote, wish.word, cycles, self._timing.lease_s)
        ack = self._take_up(given, real_s)
        if ack.accepted:
            del self.wishes[award]
        else:
            _LOG.info("'%s' is not taken: %s", wish.word.name, ack.reason)
            self._drop(award)

    def _drop(self, award: str) -> None:
        """Let go of a wish; peers hear of it with the next claim."""
        self.vain.append(self.wishes.pop(award).word.name)
        self._change()

    def _forget(self, real_s: float) -> None:
        """Let go of what nobody grants in time, and of what nobody needs; note what is to be reported now."""
        for award, wish in list(self.wishes.items()):
            if real_s >= wish.made_s + WISH_S:
                self._drop(award)
        needed = {*self.wishes, *(held.award.award for held in self.contractor.held)}
        for award in self._votes.keys() - needed:
            del self._votes[award]
        reports = {report.award for report, written in self.contractor.unreceipted() if written}
        if reports - self._receipts.keys():
            self._change()

    def _learn(self, settled: Settled) -> None:
        try:
            self.grantor.learn(settled)
        except JournalError as error:
            _LOG.error("What became of '%s' is not noted: %s", settled.job, error)


def _settled(report: Report) -> Settled:
    """A report as peers are told of it."""
    outcome = "finished" if report.outcome == "finished" else "unfinished" if report.unsure else "returned"
    return Settled(report.job, report.award, report.arm, outcome, report.cycles, report.time_s, report.reason)
