"""Arms without an auctioneer on paper, and wires between them that are not to be trusted.

Every arm is the real one but for its body: time is a number, every clock runs at its own rate, a journal is a list.
"""

import random
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace

import pytest

from agents.consensus import Consensus
from fleet.bus.protocol.auction import JobEstimate, JobSpec
from fleet.errors import JournalFull, Refused
from fleet.live.arm.award_executor import AwardExecutor, ExecutorConfig
from fleet.live.arm.journal_records import ArmHistory
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.round import Timing
from fleet.live.consensus.granter import Granter, Register
from fleet.live.consensus.participant import Membership, Participant

TIMING = Timing(lease_s=3.0, margin_s=0.05, window_s=0.3, pause_s=(0.2, 1.0))
CYCLE_S = 0.2


class Crash(Exception):
    """The arm's process is gone in the middle of a call."""


@dataclass(eq=False)
class Disk:
    """A journal in history, and what goes wrong with it."""

    records: list = field(default_factory=list)
    full: bool = False
    crash: str = ""

    def keep(self, *records) -> None:
        crash, self.crash = self.crash, ""
        if crash == "before":
            raise Crash
        if self.full:
            raise JournalFull("no room")
        self.records.extend(records)
        if crash == "after":
            raise Crash


class Arm:
    """One arm's process, life after life."""

    def __init__(self, fleet, name: str, rate: float) -> None:
        self.fleet, self.name, self.rate, self.lives = fleet, name, rate, 0
        self.promises, self.grants = Disk(), Disk()
        self.hot, self.cycle_ends_s = False, None
        self.start()

    @property
    def real_s(self) -> float:
        return self.fleet.true_s * self.rate

    def start(self) -> None:
        self.lives += 1
        self.cycle_ends_s = None
        history = ArmHistory().replay(self.promises.records).after_restart(self.name, 0.0)
        self.promises.records[:] = history.compact()
        register = Register().replay(self.grants.records)
        self.grants.records[:] = register.compact()
        config = ExecutorConfig(return_after_s=8.0)
        self.executor = AwardExecutor(self.name, self.promises.keep, history, nonce="n", config=config)
        granter = Granter(self.name, self.fleet.names, register, self.grants.keep, real_s=self.real_s, timing=TIMING)
        arm = SimpleNamespace(
            executor=self.executor,
            estimate=lambda words: tuple(self.fleet.offer(self.name, word) for word in words),
            unfit=lambda: "hot" if self.hot else "",
            answer_award=self.executor.answer_award,
        )
        self.council = Participant(
            arm,
            granter,
            Membership(
                fleet=LiveFleet(arms=self.fleet.names, warning_c=60.0),
                choose=self.fleet.policy().choose,
                timing=TIMING,
            ),
            boot=history.boot,
            rng=random.Random(f"{self.name} {self.lives}"),
        )
        self.council.add_jobs([*self.fleet.jobs, *register.jobs.values()])

    def turn(self) -> None:
        """What an arm does again and again; it may crash in the middle."""
        self.safely(self._turn)

    def safely(self, call) -> None:
        try:
            call()
        except Crash:
            self.crash()

    def crash(self) -> None:
        self.promises.crash = self.grants.crash = ""
        for held in ArmHistory().replay(self.promises.records).active.values():
            if held.may_commit:
                self.fleet.doubtful.add(held.award.job.name)
        self.start()

    def _turn(self) -> None:
        self.executor.retry_writes()
        self._work()
        self.executor.return_expired(0.0, self.real_s)
        if self.executor.lease_requests(self.real_s) or self.executor.due_reports(self.real_s):
            self.council.claimant.claim_soon()
        self.council.set_present(self.fleet.alive_for(self.name))
        self.council.tick(self.real_s, self.fleet.true_s)
        while self.council.out:
            self.fleet.send(self.name, self.council.out.popleft())

    def _work(self) -> None:
        """Cycles, one after the other; one that was begun is ended."""
        if not self.executor.active:
            self.cycle_ends_s = None
            return
        first = self.executor.active[0]
        name, repetitions = first.award.job.name, first.award.job.repetitions
        if self.cycle_ends_s is None and self.executor.allowed_cycles(self.real_s) > first.cycles:
            self.cycle_ends_s = name, self.real_s + CYCLE_S
            if first.cycles + 1 == repetitions:
                self.fleet.last_cycle(name)
        elif self.cycle_ends_s is not None and self.cycle_ends_s[0] != name:
            self.cycle_ends_s = None
        elif self.cycle_ends_s is not None and self.real_s >= self.cycle_ends_s[1]:
            self.cycle_ends_s = None
            if first.cycles + 1 == repetitions:
                self.executor.finish(self.fleet.true_s, self.real_s)
                return
            self.executor.record_progress(first.cycles + 1, 0.0)
        self.executor.record_progress(first.cycles, (repetitions - 1 - first.cycles) * CYCLE_S)

    def fault(self) -> None:
        """It stops in the middle of a cycle, which then is not done."""
        if self.cycle_ends_s is not None:
            first = self.executor.active[0].award.job
            if self.executor.active[0].cycles + 1 == first.repetitions:
                self.fleet.last_cycles[first.name] -= 1
            self.cycle_ends_s = None
        self.executor.return_all(0.0, self.real_s, "hot")


class Fleet:
    """Arms, and the wires between them: a list of words that have not come yet."""

    def __init__(self, rates, jobs, policy=Consensus) -> None:
        self.names = tuple(f"arm_{i}" for i in range(len(rates)))
        self.true_s, self.jobs, self.policy = 100.0, list(jobs), policy
        self.wires: list = []
        self.old: list = []
        self.cut: set[str] = set()
        self.last_cycles: dict[str, int] = {}
        self.doubtful: set[str] = set()
        self.arms = {name: Arm(self, name, rate) for name, rate in zip(self.names, rates, strict=True)}

    def offer(self, arm: str, word: JobSpec) -> JobEstimate:
        """An arm finds a job as hard as both their names say; some cannot do some."""
        d = random.Random(f"{arm} {word.name}").random()
        return JobEstimate(job=word.name, feasible=d > 0.1 or arm == self.names[0], difficulty=d, finish_in_s=10.0)

    def last_cycle(self, job: str) -> None:
        self.last_cycles[job] = self.last_cycles.get(job, 0) + 1
        assert self.last_cycles[job] == 1, f"the last cycle of {job} was begun twice"

    def reach(self, one: str, other: str) -> bool:
        return (one in self.cut) == (other in self.cut)

    def alive_for(self, arm: str) -> frozenset[str]:
        return frozenset(other for other in self.names if self.reach(arm, other))

    def send(self, speaker: str, word) -> None:
        asked_s = self.arms[speaker].lives
        for other in self.names:
            if other != speaker:
                self.wires.append((speaker, other, partial(self.come, speaker, other, word, asked_s)))
                self.old.append(self.wires[-1])

    def come(self, speaker: str, other: str, word, life: int) -> None:
        arm = self.arms[other]
        if type(word).__name__ == "Bid":
            arm.safely(lambda: arm.council.apply_bid(word, arm.real_s))
            return

        def answer() -> None:
            try:
                grant = arm.council.answer_claim(word, arm.real_s)
            except Refused:
                return
            self.wires.append((other, speaker, partial(self.answered, speaker, grant, life)))

        arm.safely(answer)

    def answered(self, speaker: str, grant, life: int) -> None:
        arm = self.arms[speaker]
        if arm.lives == life:  # an answer reaches only the life that asked
            arm.safely(lambda: arm.council.claimant.apply_reply(grant, arm.real_s))

    def deliver(self, index: int, *, keep: bool = False) -> None:
        one, other, call = self.wires[index] if keep else self.wires.pop(index)
        if self.reach(one, other):
            call()

    def calm(self, seconds: float, step_s: float = 0.1, but: str = "") -> None:
        """Everything comes at once and in order; one arm may stand still."""
        for _ in range(round(seconds / step_s)):
            for name, arm in self.arms.items():
                if name != but:
                    arm.turn()
            for _ in range(1000):
                if not self.wires:
                    break
                self.deliver(0)
            self.true_s += step_s
            self.check()

    def check(self) -> None:
        at_work = [
            (held.award.job, arm.name, held.may_commit)
            for arm in self.arms.values()
            for held in arm.executor.active
            if arm.real_s < held.lease_end_s or held.may_commit
        ]
        jobs = [job.name for job, _, _ in at_work]
        assert len(jobs) == len(set(jobs)), at_work
        stations = [place for job, arm, leave in at_work if not leave for place in job.places]
        assert len(stations) == len(set(stations)), at_work

    def busy(self, rng: random.Random, *, leave: bool) -> Arm | None:
        """An arm with a job in hand, or one that may begin its last cycle, if there is one soon."""
        for _ in range(30):
            found = [arm for arm in self.arms.values() if arm.executor.active]
            found = [arm for arm in found if arm.executor.active[0].may_commit or not leave]
            if found:
                return rng.choice(found)
            self.calm(0.1)
        return None

    def settled(self) -> dict[str, str]:
        """What the arms know: they never differ."""
        told: dict[str, str] = {}
        for arm in self.arms.values():
            for job, settled in arm.council.granter.register.settled.items():
                assert told.setdefault(job, settled.outcome) == settled.outcome, job
        return told


@pytest.fixture(scope="session")
def council() -> SimpleNamespace:
    """What the tests of arms among themselves build their fleets of."""
    return SimpleNamespace(Fleet=Fleet)
