"""An auctioneer, model arms and an unreliable network.

Time is a number, every clock runs at its own rate, and a journal is a list.
"""

import math
import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Award,
    JobSpec,
    Lease,
    LeaseRequest,
    Quote,
    QuoteRequest,
    Receipt,
    Report,
    Result,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.operator import Cancel, ClearRequest, Controlled, ControlRequest, Settle
from fleet.errors import JournalFull, Refused
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.ledger import Ledger
from fleet.live.auction.records import AuctionRecord
from fleet.live.auction.rounds import Allocate, SendAward, Timing
from fleet.live.journal import Closed, Started
from fleet.live.space import Excludes, no_conflicts
from tests.live.model_arm import TIMING, ModelArm, first_come


class Killed(Exception):
    """The auctioneer is killed between writing a record and sending a message."""


@dataclass
class Packet:
    """A message in transit."""

    to: str
    """Name of an arm, or "" for the auctioneer."""
    message: object
    asked_s: float = 0.0
    """When the arm sent the request, on its clock."""


def sender(packet: Packet) -> str:
    return getattr(packet.message, "arm", "")


class ModelFleet:
    """The auctioneer, its arms and the messages in transit."""

    def __init__(
        self,
        arms: list[ModelArm],
        rate: float = 1.0,
        timing: Timing = TIMING,
        allocate: Allocate = first_come,
        excludes: Excludes = no_conflicts,
    ) -> None:
        self.true_s, self.allocate = 0.0, allocate
        self.rate, self.timing, self.excludes = rate, timing, excludes
        self.arms = {arm.name: arm for arm in arms}
        self.journal: list[AuctionRecord] = []
        self.packets: list[Packet] = []
        self.results: dict[int, Result] = {}
        self.accepted: dict[str, JobSpec] = {}
        self.unsure_jobs: set[str] = set()
        """Jobs that an arm returned without knowing whether the last cycle was done."""
        self.requests: list[ControlRequest] = []
        self.answered: set[str] = set()
        """Names of the requests that were carried out and answered."""
        self.cancelled: set[str] = set()
        """Jobs whose cancellation was answered, and that no person has had redone since."""
        self.boots = 0
        self.full = self.kill_next = False
        self.auctioneer: Auctioneer = self.restart()

    @property
    def real_s(self) -> float:
        """The auctioneer's clock, which is different after every start."""
        return 1000.0 * self.boots + self.rate * self.true_s

    def restart(self) -> Auctioneer:
        """Start the auctioneer from its journal, which it compacts at every second start."""
        self.boots += 1
        ledger = Ledger(arms=tuple(self.arms)).replay(self.journal)
        if self.boots % 2:
            self.journal[:] = ledger.compact()
        self.journal.append(Started("auctioneer", self.true_s))
        return Auctioneer(
            "auctioneer",
            ledger,
            allocate=self.allocate,
            keep=self.keep,
            boot=str(self.boots),
            real_s=self.real_s,
            timing=self.timing,
            excludes=self.excludes,
        )

    def clear(self, name: str, *, restart: bool = True) -> None:
        """Have a person move an arm home and free its space; its process is started again, or lives on."""
        arm = self.arms[name]
        if restart:
            arm.crash(self.true_s)
        else:
            arm.move_home()
        request = ClearRequest(name, "a person")
        with suppress(Refused):
            self.attempt(lambda: self.auctioneer.clear(request, frozenset(self.arms) - {name}, self.true_s))

    def keep(self, *records: AuctionRecord) -> None:
        if self.full:
            raise JournalFull("no room")
        self.journal.extend(records)
        awards = self.auctioneer.ledger.awards
        self.unsure_jobs |= {awards[r.award].record.job for r in records if isinstance(r, Closed) and r.unsure}
        if self.kill_next:
            raise Killed

    def attempt(self, call: Callable[[], object]) -> object:
        """Return the auctioneer's answer; None if it is killed meanwhile, or cannot write."""
        try:
            answer = call()
        except Killed:
            self.kill_next = False
            self.auctioneer = self.restart()
            answer = None
        except JournalFull:
            answer = None
        while self.auctioneer.out:
            match self.auctioneer.out.popleft():
                case QuoteRequest() as request:
                    self.packets.extend(Packet(name, request) for name in self.arms)
                case SendAward(arm, award):
                    self.packets.append(Packet(arm, award))
                case Result() as result:
                    assert self.results.setdefault(result.number, result) == result, "two results of one number"
                case Announcement():
                    pass
        return answer

    def control(self, request: ControlRequest) -> Controlled | None:
        """Request what a person may; return the answer, None if there is none or it is refused."""
        self.requests.append(request)
        try:
            answer = self.attempt(lambda: self.auctioneer.control(request, self.true_s))
        except Refused:
            return None
        if not isinstance(answer, Controlled):
            return None
        if request.request in self.answered:
            assert not answer.changed, "carried out twice"
        self.answered.add(request.request)
        if answer.changed and isinstance(request.action, Cancel | Settle):
            (self.cancelled.add if isinstance(request.action, Cancel) else self.cancelled.discard)(request.action.job)
        return answer

    def submit(self, *jobs: JobSpec) -> None:
        reply = self.attempt(lambda: self.auctioneer.submit(Submission(jobs), self.real_s, self.true_s))
        if isinstance(reply, SubmissionReply):
            self.accepted |= {job.name: job for job in jobs}

    def step(self, dt_s: float, absent: str = "") -> None:
        """Advance time; the auctioneer updates which arms are present, and does what is due."""
        self.true_s += dt_s
        self.auctioneer.set_present(frozenset(name for name, arm in self.arms.items() if arm.up and name != absent))
        self.attempt(lambda: self.auctioneer.tick(self.real_s, self.true_s))

    def step_arm(self, name: str) -> None:
        """Let an arm work, request leases and repeat its reports."""
        arm = self.arms[name]
        if not arm.up:
            return
        arm.work(self.true_s)
        if arm.current:
            self.packets.append(Packet("", arm.request(), arm.own_s(self.true_s)))
        self.packets.extend(Packet("", report) for report in arm.reports.values())

    def deliver(self, index: int, *, keep: bool = False) -> None:
        """Deliver a message in transit; `keep` leaves a copy in transit."""
        packet = self.packets[index] if keep else self.packets.pop(index)
        arm = self.arms.get(packet.to)
        if arm is not None and not arm.up:
            return
        match packet.message:
            case QuoteRequest() as request if arm is not None:
                self.packets.append(Packet("", arm.quote(request, self.true_s)))
            case Award() as award if arm is not None:
                self.packets.append(Packet("", arm.answer_award(award, self.true_s)))
            case Lease() as lease if arm is not None:
                arm.apply_lease(lease, packet.asked_s)
            case Receipt() as receipt if arm is not None:
                arm.reports.pop(receipt.award, None)
            case Quote() | Ack() | LeaseRequest() | Report() as message:
                answer = self.attempt(lambda: self.answer(message))
                if isinstance(answer, Lease | Receipt):
                    self.packets.append(Packet(message.arm, answer, packet.asked_s))

    def answer(self, message: Quote | Ack | LeaseRequest | Report) -> object:
        """Return the auctioneer's answer to an arm."""
        match message:
            case Quote():
                self.auctioneer.add_quote(message)
                return self.auctioneer.tick(self.real_s, self.true_s)
            case Ack():
                return self.auctioneer.apply_ack(message, self.real_s, self.true_s)
            case LeaseRequest():
                return self.auctioneer.renew_leases(message, self.real_s, self.true_s)
            case Report():
                return self.auctioneer.apply_report(message, self.real_s, self.true_s)

    def deliver_all(self, rng: random.Random | None = None) -> None:
        """Deliver all messages in transit, in order or in random order."""
        for _ in range(len(self.packets)):
            self.deliver(rng.randrange(len(self.packets)) if rng else 0)

    def run_until(self, condition, absent: str = "") -> None:
        """Run without faults, one arm unheard, until a condition is true."""
        for _ in range(400):
            if condition():
                return
            self.run_without_faults(0.1, 0.1, absent)
            self.check()
        raise AssertionError("the condition was never met")

    def run_without_faults(self, seconds: float, dt_s: float = 0.25, absent: str = "") -> None:
        """Run without faults for some time; one arm may be absent."""
        self.full = self.kill_next = False
        for arm in self.arms.values():
            arm.up = True
        for _ in range(max(1, round(seconds / dt_s))):
            for name in self.arms.keys() - {absent}:
                self.step_arm(name)
            for _ in range(4):
                self.packets = [
                    packet for packet in self.packets if not absent or absent not in (packet.to, sender(packet))
                ]
                self.deliver_all()
            self.step(dt_s, absent)

    def idle(self) -> bool:
        """Return whether no award is open and no job is ready."""
        return (
            not self.auctioneer.ledger.open
            and not any(a.current or a.reports for a in self.arms.values())
            and (not self.auctioneer.ledger.ready(math.inf, 1))
        )

    # Invariants

    def at_work(self) -> dict[str, list[str]]:
        """Return the arms that may be working on a job now, by job."""
        out: dict[str, list[str]] = {}
        for arm in self.arms.values():
            for work in arm.may_work(self.true_s):
                out.setdefault(work.award.job.name, []).append(arm.name)
        return out

    def check(self) -> None:
        """Check the safety rules, which hold at every moment."""
        finished = [job for arm in self.arms.values() for job in arm.done]
        assert len(finished) == len(set(finished)), f"done twice: {finished}"
        for job, arms in self.at_work().items():
            assert len(arms) == 1, f"{arms} may all work on '{job}'"
            assert job not in finished, f"{arms} may work on '{job}', which is done"
        away = {arm.name: f"{arm.name}: {arm.out}" for arm in self.arms.values() if arm.out}
        for one, other in combinations(away, 2):
            assert not self.excludes(one, away[one], other, away[other]), f"{away} exclude each other"
        statuses = {status.job: status for status in self.auctioneer.status()}
        assert self.accepted.keys() <= statuses.keys(), "a job is lost"
        for status in statuses.values():
            assert status.state != "finished" or status.job in finished, "reported finished, but not done"
            assert status.state != "cancelled" or status.job not in self.at_work(), "cancelled, but an arm may work"

    def check_settled(self) -> None:
        """Check after a run without faults: every job is done, or its arm crashed in the last cycle."""
        ledger = self.auctioneer.ledger
        states = {status.job: status.state for status in self.auctioneer.status()}
        for job, state in states.items():
            if state == "given_up":
                assert any(states[before] in ("cancelled", "given_up") for before in ledger.jobs[job].spec.after), job
                continue
            if state == "cancelled" or job in self.cancelled:
                assert any(getattr(r.action, "job", "") == job for r in self.requests), "nobody cancelled it"
                assert state != "waiting", f"'{job}' waits after its cancellation"
                continue
            blocked = any(states[before] != "finished" for before in ledger.jobs[job].spec.after)
            expected = "unfinished" if job in self.unsure_jobs else "waiting" if blocked else "finished"
            assert state == expected or (job in self.unsure_jobs and state == "finished"), f"'{job}' is {state}"
