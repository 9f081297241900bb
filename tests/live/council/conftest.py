"""Model of a fleet without an auctioneer, on an unreliable network.

Every arm is real except for its body: time is a number, every clock runs at its own rate, a journal is a list.
"""

import random
from contextlib import suppress
from functools import partial
from itertools import combinations
from types import SimpleNamespace

import pytest

from agents.auction import Consensus
from fleet.bus.protocol.auction import JobEstimate, JobSpec, PlanQuote
from fleet.bus.protocol.operator import ControlRequest, Operation
from fleet.errors import JournalFull, Refused
from fleet.live.arm.awards import ArmHistory, AwardExecutor, ExecutorConfig
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.rounds import Timing
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.jobs import RANKS, Register
from fleet.live.consensus.participant import Membership, Participant
from fleet.live.space import no_conflicts
from tests.live.disk import Crash, Disk

TIMING = Timing(lease_s=3.0, margin_s=0.05, window_s=0.3, pause_s=(0.2, 1.0))
CYCLE_S = 0.2
HOME_S = 0.5
"""Duration of the way home."""


class Arm:
    """One arm's process, which may be restarted."""

    def __init__(self, fleet, name: str, rate: float) -> None:
        self.fleet, self.name, self.rate, self.boots = fleet, name, rate, 0
        self.journal, self.grants = Disk(), Disk()
        self.hot, self.cycle_ends_s = False, None
        self.out, self.home_s = None, None
        """Award for which it is away from home, and the real second at which it is home again."""
        self.start()

    @property
    def space(self) -> tuple[str, ...]:
        """Space that it takes."""
        return (self.space_of(self.out.job, self.out.plan),) if self.out else ()

    @property
    def real_s(self) -> float:
        return self.fleet.true_s * self.rate

    def start(self) -> None:
        self.boots += 1
        self.cycle_ends_s = None
        self.out, self.home_s = None, None  # a person moves it home before it is started again
        history = ArmHistory().replay(self.journal.records).after_restart(self.name, 0.0)
        self.journal.records[:] = history.compact()
        register = Register().replay(self.grants.records)
        self.grants.records[:] = register.compact()
        again = Register().replay(self.grants.records)
        assert (again.returned_s, again.cycles) == (register.returned_s, register.cycles)
        config = ExecutorConfig(return_after_s=8.0)
        self.executor = AwardExecutor(self.name, self.journal.keep, history, nonce="n", config=config)
        granter = Granter(
            self.name,
            self.fleet.names,
            register,
            self.grants.keep,
            real_s=self.real_s,
            timing=TIMING,
            excludes=self.fleet.excludes,
        )
        self.participant = Participant(
            self,
            granter,
            Membership(
                fleet=LiveFleet(arms=self.fleet.names),
                choose=self.fleet.policy().choose,
                timing=TIMING,
                excludes=self.fleet.excludes,
            ),
            boot=history.boot,
            rng=random.Random(f"{self.name} {self.boots}"),
        )
        self.participant.add_jobs([*self.fleet.jobs, *register.jobs.values()])

    def estimate(self, jobs, cycles):
        return tuple(self.fleet.offer(self.name, job) for job in jobs)

    def space_of(self, job: JobSpec, plan: int) -> str:
        return f"{self.name}: {job.name} by {plan}"

    def unfit(self) -> str:
        return "hot" if self.hot else ""

    def answer_award(self, award, real_s: float):
        return self.executor.answer_award(award, real_s)

    def step(self) -> None:
        """Do what is due; it may crash at any moment."""
        self.run_until_crash(self._step)

    def run_until_crash(self, call) -> None:
        try:
            call()
        except Crash:
            self.crash()

    def crash(self) -> None:
        self.journal.crash = self.grants.crash = ""
        for active in ArmHistory().replay(self.journal.records).active.values():
            if active.may_commit:
                self.fleet.unsure_jobs.add(active.award.job.name)
        self.start()

    def _step(self) -> None:
        self.executor.retry_writes()
        self._work()
        self.executor.return_ended(0.0, self.real_s, at_home=not self.out)
        if self.executor.lease_requests(self.real_s) or self.executor.due_reports(self.real_s):
            self.participant.claimant.claim_soon()
        self.participant.set_present(self.fleet.alive_for(self.name))
        self.participant.tick(self.real_s, self.fleet.true_s)
        while self.participant.out:
            message = self.participant.out.popleft()
            if isinstance(message, Operation):
                self.fleet.operations.append(message)
            else:
                self.fleet.send(self.name, message)

    def _work(self) -> None:
        """Work, and go home when there is nothing to do; a hot arm stands where it stopped."""
        if self.hot:
            return
        if not self.out or (self.executor.active and self.executor.active[0].award == self.out):
            self._work_at_place()
        else:
            self.cycle_ends_s = None
        if self.cycle_ends_s is not None:
            self.out, self.home_s = self.executor.active[0].award, None
        elif self.out and self.home_s is None:
            self.home_s = self.real_s + HOME_S
        elif self.out and self.real_s >= self.home_s:
            self.out = None

    def _work_at_place(self) -> None:
        """Work cycle after cycle; a cycle that has begun is completed."""
        if not self.executor.active:
            self.cycle_ends_s = None
            return
        first = self.executor.active[0]
        name, repetitions = first.award.job.name, first.award.job.repetitions
        if self.cycle_ends_s is None and self.executor.allowed_cycles(self.real_s) > first.cycles:
            self.cycle_ends_s = name, self.real_s + self.fleet.cycle_s
            if first.cycles + 1 == repetitions:
                self.fleet.last_cycle(name)
        elif self.cycle_ends_s is not None and self.cycle_ends_s[0] != name:
            self.cycle_ends_s = None
        elif self.cycle_ends_s is not None and self.real_s >= self.cycle_ends_s[1]:
            self.cycle_ends_s = None
            self.fleet.cycles_done += 1
            if first.cycles + 1 == repetitions:
                self.executor.finish(self.fleet.true_s, self.real_s)
                return
            self.executor.record_progress(first.cycles + 1, 0.0)
        self.executor.record_progress(first.cycles, (repetitions - 1 - first.cycles) * self.fleet.cycle_s)

    def break_off(self) -> None:
        """Stop during a cycle, which then does not count."""
        if self.cycle_ends_s is not None:
            first = self.executor.active[0].award.job
            if self.executor.active[0].cycles + 1 == first.repetitions:
                self.fleet.last_cycles[first.name] -= 1
            self.cycle_ends_s = None

    def move_home(self) -> None:
        """Have a person move the arm home; its process lives on."""
        self.break_off()
        self.out, self.home_s = None, None

    def clear(self, absent: str) -> None:
        """Free the space of another arm, unless that is refused."""
        present = self.fleet.alive_for(self.name)
        with suppress(Refused, JournalFull):
            self.run_until_crash(
                lambda: self.participant.granter.clear(absent, "", present, self.real_s, self.fleet.true_s)
            )

    def fault(self) -> None:
        if self.executor.active:
            self.fleet.faults.setdefault(self.executor.active[0].job, []).append(self.name)
        self.break_off()
        self.executor.return_all(0.0, self.real_s, "hot", faulted=True)


class Fleet:
    """Arms, and the messages in transit between them."""

    def __init__(self, rates, jobs, policy=Consensus, excludes=no_conflicts) -> None:
        self.names = tuple(f"arm_{i}" for i in range(len(rates)))
        self.true_s, self.jobs, self.policy, self.excludes = 100.0, list(jobs), policy, excludes
        self.packets: list = []
        self.old: list = []
        self.cut: set[str] = set()
        self.cycle_s, self.cycles_done = CYCLE_S, 0
        self.last_cycles: dict[str, int] = {}
        self.unsure_jobs: set[str] = set()
        self.faults: dict[str, list[str]] = {}
        """Arm of each fault, by job."""
        self.cancelled: set[str] = set()
        """Jobs that a person has asked to cancel."""
        self.operations: list[Operation] = []
        """Requests of people that were published."""
        self.arms = {name: Arm(self, name, rate) for name, rate in zip(self.names, rates, strict=True)}

    def offer(self, arm: str, job: JobSpec) -> JobEstimate:
        """Return an estimate that depends on the names of arm and job only; some pairs are infeasible.

        Half of the others have two plans.
        """
        rng = random.Random(f"{arm} {job.name}")
        d = rng.random()
        plans = tuple(
            PlanQuote(plan=n, difficulty=d if n == 0 else rng.random(), space=self.arms[arm].space_of(job, n))
            for n in range(rng.choice([1, 2]))
        )
        return JobEstimate(job.name, plans if d > 0.1 or arm == self.names[0] else ())

    def last_cycle(self, job: str) -> None:
        self.last_cycles[job] = self.last_cycles.get(job, 0) + 1
        assert self.last_cycles[job] == 1, f"the last cycle of {job} was begun twice"

    def reach(self, one: str, other: str) -> bool:
        return (one in self.cut) == (other in self.cut)

    def alive_for(self, arm: str) -> frozenset[str]:
        return frozenset(other for other in self.names if self.reach(arm, other))

    def send(self, sender: str, message) -> None:
        boot = self.arms[sender].boots
        for other in self.names:
            if other != sender:
                self.packets.append((sender, other, partial(self.receive, sender, other, message, boot)))
                self.old.append(self.packets[-1])

    def receive(self, sender: str, other: str, message, boot: int) -> None:
        arm = self.arms[other]
        if type(message).__name__ == "Bid":
            arm.run_until_crash(lambda: arm.participant.apply_bid(message, arm.real_s))
            return

        def answer() -> None:
            try:
                reply = arm.participant.answer_claim(message, arm.real_s)
            except Refused:
                return
            self.packets.append((other, sender, partial(self.receive_reply, sender, reply, boot)))

        arm.run_until_crash(answer)

    def receive_reply(self, sender: str, reply, boot: int) -> None:
        arm = self.arms[sender]
        if arm.boots == boot:  # a reply does not reach a restarted process
            arm.run_until_crash(lambda: arm.participant.claimant.apply_reply(reply, arm.real_s))

    def deliver(self, index: int, *, keep: bool = False) -> None:
        one, other, call = self.packets[index] if keep else self.packets.pop(index)
        if self.reach(one, other):
            call()

    def control(self, action, name: str, arm: str = ""):
        """Return the reply of an arm, by default the first one, to the request of a person; a refusal is raised."""
        one, replies = self.arms[arm or self.names[0]], []
        request = ControlRequest(name, action, "ann")
        one.run_until_crash(lambda: replies.append(one.participant.control(request, one.real_s, self.true_s)))
        return replies[0] if replies else None

    def run(self, seconds: float, step_s: float = 0.1, stopped: str = "") -> None:
        """Run without message loss; one arm may be stopped."""
        for _ in range(round(seconds / step_s)):
            for name, arm in self.arms.items():
                if name != stopped:
                    arm.step()
            for _ in range(1000):
                if not self.packets:
                    break
                self.deliver(0)
            self.true_s += step_s
            self.check()

    def check(self) -> None:
        at_work = [
            (active.award.job, arm.name, active.may_commit)
            for arm in self.arms.values()
            for active in arm.executor.active
            if arm.real_s < active.lease_end_s or active.may_commit
        ]
        jobs = [job.name for job, _, _ in at_work]
        assert len(jobs) == len(set(jobs)), at_work
        away = {arm.name: arm.space[0] for arm in self.arms.values() if arm.out}
        for one, other in combinations(away, 2):
            assert not self.excludes(one, away[one], other, away[other]), f"{away} exclude each other"
        stations = [place for job, arm, may_commit in at_work if not may_commit for place in job.places]
        assert len(stations) == len(set(stations)), at_work

    def busy_arm(self, rng: random.Random, *, may_commit: bool) -> Arm | None:
        """Return an arm with a job, or with permission to commit; None if none appears soon."""
        for _ in range(30):
            arms = [arm for arm in self.arms.values() if arm.executor.active]
            arms = [arm for arm in arms if arm.executor.active[0].may_commit or not may_commit]
            if arms:
                return rng.choice(arms)
            self.run(0.1)
        return None

    def settled(self, names=()) -> dict[str, str]:
        """Return the outcomes that the arms know, of these jobs or of all that have not left: those that count most."""
        outcomes: dict[str, str] = {}
        for arm in self.arms.values():
            settled = arm.participant.granter.register.settled
            for job in names or settled:
                if (outcome := settled.known(job, arm.name)) is None:
                    continue
                if RANKS.index(outcome.outcome) > RANKS.index(outcomes.setdefault(job, outcome.outcome)):
                    outcomes[job] = outcome.outcome
        return outcomes


@pytest.fixture(scope="session")
def council() -> SimpleNamespace:
    """Classes of the model fleet."""
    return SimpleNamespace(Fleet=Fleet)
