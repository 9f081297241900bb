"""Arms and an auctioneer under faults: lost, repeated and late messages, crashes at any moment, clocks that drift.

The auctioneer is a small model that obeys docs/bus.md and never crashes. No last cycle is done twice, no two arms hold
a lease of one job or are away from home on plans that exclude each other, and after the faults every job is finished,
or reported unfinished because of a crash with permission to commit.
"""

import random
from dataclasses import dataclass, field
from functools import partial

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fleet.bus.protocol.auction import Award, JobSpec, Lease, LeaseRequest, Receipt, Report
from fleet.live.arm.award_executor import AwardExecutor, ExecutorConfig
from fleet.live.arm.journal_records import ArmHistory
from fleet.live.journal_records import CommitPermitted
from tests.live.disk import Crash, Disk

LEASE_S, VALID_S = 6.0, 3.0
ARMS = ("a", "b")


@dataclass
class Order:
    """A job of the auctioneer."""

    job: JobSpec
    state: str = "waiting"
    award: Award | None = None
    arm: str = ""
    lease_end_s: float = 0.0
    cycles: int = 0


@dataclass
class Arm:
    """An arm's process, its disk and its clock, and the next fault."""

    name: str
    rate: float
    disk: Disk = field(default_factory=Disk)
    executor: AwardExecutor | None = None
    lives: int = 0
    out: str = ""
    """Job for which it is away from home; "" at home."""

    def start(self) -> None:
        history = ArmHistory().replay(self.disk.records).after_restart(self.name, 0.0)
        self.disk.records[:] = history.compact()
        self.lives += 1
        config = ExecutorConfig(valid_s=VALID_S, capacity=2, return_after_s=15.0)
        self.executor = AwardExecutor(self.name, self.disk.keep, history, nonce=f"n{self.lives}", config=config)


class Storm(RuleBasedStateMachine):
    """The bus is a list of calls that are not delivered yet."""

    def __init__(self) -> None:
        super().__init__()
        self.time_s = 100.0
        self.bus: list = []
        self.rounds = 0
        self.arms: dict[str, Arm] = {}
        self.orders: dict[str, Order] = {}
        self.last_cycles: dict[str, int] = {}
        self.crashed_in_commit: set[str] = set()
        self.closed: dict[str, dict[str, str]] = {name: {} for name in ARMS}
        """Jobs of closed awards whose space an arm may still take, by award."""

    @initialize(
        rates=st.tuples(*[st.floats(0.9951, 1.0049)] * 3),
        repetitions=st.lists(st.integers(1, 4), min_size=1, max_size=3),
        conflicts=st.tuples(st.integers(0, 2**32), st.sampled_from([0.0, 0.5, 1.0])),
    )
    def start(self, rates, repetitions, conflicts=(0, 0.0)) -> None:
        self.rate, self.conflicts = rates[0], conflicts
        self.arms = {name: Arm(name, rate) for name, rate in zip(ARMS, rates[1:], strict=True)}
        for arm in self.arms.values():
            arm.start()
        jobs = [JobSpec(name=f"j{i}", kind="hold", places=("p",), repetitions=n) for i, n in enumerate(repetitions)]
        self.orders = {job.name: Order(job) for job in jobs}

    def send(self, arm: str, call, *words) -> None:
        """Send a message to or from an arm."""
        self.bus.append((arm, partial(call, *words)))

    # The auctioneer

    @property
    def now_s(self) -> float:
        """On the auctioneer's clock."""
        return self.time_s * self.rate

    @rule(name=st.sampled_from(ARMS))
    def clear(self, name) -> None:
        """A person sees an arm at home that has lost its lease, and frees its space; its process lives on."""
        current = [o for o in self.orders.values() if o.arm == name and o.state in ("awarded", "finishing")]
        if not self.arms[name].out and all(o.state == "finishing" and self.now_s > o.lease_end_s for o in current):
            for order in current:
                order.state = "unfinished"
            self.closed[name] = {}

    def expire(self) -> None:
        for order in self.orders.values():
            if order.state == "awarded" and self.now_s > order.lease_end_s:
                self.close(order, "waiting")

    def close(self, order: Order, state: str) -> None:
        order.state = state
        self.closed[order.arm][order.award.award] = order.job.name

    def excluded(self, arm: str, job: str, other: str, other_job: str) -> bool:
        """Whether the plans of two arms exclude each other."""
        seed, share = self.conflicts
        return random.Random(f"{seed} {sorted([(arm, job), (other, other_job)])}").random() < share

    def is_free(self, arm: str, job: str) -> bool:
        """Whether no other arm may take space that excludes an arm's plan for a job."""
        taken = [(o.arm, o.job.name) for o in self.orders.values() if o.state in ("awarded", "finishing")]
        taken += [(other, each) for other, jobs in self.closed.items() for each in jobs.values()]
        return not any(other != arm and self.excluded(arm, job, other, each) for other, each in taken)

    @rule()
    def ask_for_quotes(self) -> None:
        jobs = tuple(o.job for o in self.orders.values() if o.state == "waiting")
        self.rounds += 1
        for name in self.arms if jobs else ():
            self.send(name, self.quote, name, jobs, set(self.closed[name]))

    def award_on(self, arm: str, quote: str, jobs, asked: set[str], space: set[str]) -> None:
        """Award jobs on a quote.

        Args:
            asked: Awards that were closed when the quote was requested.
            space: Jobs for which the arm takes space, by its quote.
        """
        kept = self.closed[arm].items()
        self.closed[arm] = {award: job for award, job in kept if award not in asked or job in space}
        for job in jobs:
            order = self.orders[job.name]
            if order.state != "waiting" or not self.is_free(arm, job.name):
                continue
            self.rounds += 1
            order.award = Award(f"w{self.rounds}", "r", "x", quote, order.job, order.cycles, LEASE_S)
            order.state, order.arm, order.lease_end_s = "awarded", arm, self.now_s + LEASE_S
            self.send(arm, self.award, arm, order.award)

    @rule(rng=st.randoms(use_true_random=False))
    def repeat_award(self, rng) -> None:
        awarded = [o for o in self.orders.values() if o.state == "awarded"]
        if awarded:
            order = rng.choice(awarded)
            self.send(order.arm, self.award, order.arm, order.award)

    def apply_ack(self, ack) -> None:
        for order in self.orders.values():
            if order.state == "awarded" and order.award.award == ack.award and not ack.accepted:
                order.state = "waiting"

    def lease(self, arm: str, life: int, request: LeaseRequest, asked_s: float) -> None:
        self.expire()
        granted, revoked, may_commit = [], [], []
        for hold in request.entries:
            order = self.orders[hold.job]
            mine = order.award is not None and order.award.award == hold.award
            if mine and order.state in ("awarded", "finishing"):
                order.cycles = max(order.cycles, hold.cycles)
                order.lease_end_s = self.now_s + LEASE_S
                granted.append(hold.award)
                if hold.phase == "finishing":
                    order.state = "finishing"
                    may_commit.append(hold.award)
            else:
                revoked.append(hold.award)
        answer = Lease("x", LEASE_S, tuple(granted), tuple(revoked), tuple(may_commit))
        self.send(arm, self.apply_lease, arm, life, answer, asked_s)

    def report(self, arm: str, report: Report) -> None:
        self.expire()
        order = self.orders[report.job]
        has_job = order.state in ("awarded", "finishing", "unfinished")
        if order.award is not None and order.award.award == report.award and has_job:
            order.cycles = max(order.cycles, report.cycles)
            ended = "unfinished" if report.unsure else "waiting"
            self.close(order, "finished" if report.outcome == "finished" else ended)
        elif report.outcome == "finished":
            assert order.state == "finished", "finished without permission to commit"
        receipt = Receipt("x", report.award)
        self.send(arm, self.at, arm, lambda _, executor: executor.apply_receipt(receipt))

    # The arms

    def clock_s(self, arm: Arm) -> float:
        return self.time_s * arm.rate

    def at(self, name: str, call) -> None:
        """Call an arm, which may crash in the middle."""
        arm = self.arms[name]
        try:
            call(arm, arm.executor)
        except Crash:
            self.restart(arm)

    def restart(self, arm: Arm) -> None:
        """Restart a crashed arm; note the jobs that it was permitted to commit."""
        left = {r.award for r in arm.disk.records if isinstance(r, CommitPermitted)}
        held = ArmHistory().replay(arm.disk.records).active
        self.crashed_in_commit |= {held[name].award.job.name for name in left if name in held}
        arm.disk.crash = arm.out = ""  # a person moves it home before it is started again
        arm.start()

    def quote(self, name: str, jobs, asked: set[str]) -> None:
        def call(arm, executor) -> None:
            space = {active.job for active in executor.active} | ({arm.out} - {""})
            wanted = jobs if executor.spare_capacity else ()
            quote = executor.add_quote({job.name: (job, True) for job in wanted}, self.clock_s(arm))
            self.send(name, self.award_on, name, quote, wanted, asked, space)

        self.at(name, call)

    def award(self, name: str, award: Award) -> None:
        def call(arm, executor) -> None:
            ack = executor.answer_award(award, self.clock_s(arm))
            assert executor.answer_award(award, self.clock_s(arm)) == ack, "the same award, another answer"
            if ack.accepted:
                known = [*ArmHistory().replay(arm.disk.records).accepted]
                assert award.award in known, "accepted, but not on disk"
            self.send(name, self.apply_ack, ack)

        self.at(name, call)

    def apply_lease(self, name: str, life: int, lease: Lease, asked_s: float) -> None:
        if self.arms[name].lives == life:  # replies reach only the process that asked
            self.at(name, lambda arm, executor: executor.apply_lease(lease, asked_s))

    @rule(name=st.sampled_from(ARMS))
    def communicate(self, name) -> None:
        """Request leases, report, return awards without a lease."""

        def call(arm, executor) -> None:
            now_s = self.clock_s(arm)
            executor.retry_writes()
            executor.return_expired(0.0, now_s)
            for _, request in executor.lease_requests(now_s):
                self.send(name, self.lease, name, arm.lives, request, now_s)
            for _, report in executor.due_reports(now_s):
                assert report.award not in ArmHistory().replay(arm.disk.records).active, "reported, but not on disk"
                self.send(name, self.report, name, report)

        self.at(name, call)

    @rule(name=st.sampled_from(ARMS))
    def work(self, name) -> None:
        """Do one cycle of the current job, if it is allowed; else go home, or leave for the next job from there."""

        def call(arm, executor) -> None:
            now_s, first = self.clock_s(arm), next(iter(executor.active), None)
            allowed = first is not None and executor.allowed_cycles(now_s) > first.cycles
            if arm.out and not (allowed and first.job == arm.out):
                arm.out = ""
            executor.return_revoked(0.0, now_s, at_home=not arm.out)
            first = next(iter(executor.active), None)
            if first is None:
                return
            job = first.award.job
            if allowed:
                arm.out = job.name
                if first.cycles + 1 == job.repetitions:
                    self.last_cycles[job.name] = self.last_cycles.get(job.name, 0) + 1
                    assert self.last_cycles[job.name] == 1, "the last cycle was done twice"
                    executor.finish(0.0, now_s)
                    return
                executor.record_progress(first.cycles + 1, 0.0)
            executor.record_progress(first.cycles, (job.repetitions - 1 - first.cycles) * 0.7)

        self.at(name, call)

    @rule(name=st.sampled_from(ARMS))
    def fault(self, name) -> None:
        self.at(name, lambda arm, executor: executor.return_all(0.0, self.clock_s(arm), "too hot"))

    # Faults

    @rule(name=st.sampled_from(ARMS))
    def crash_now(self, name) -> None:
        self.restart(self.arms[name])

    @rule(name=st.sampled_from(ARMS), when=st.sampled_from(["before", "after"]))
    def crash_while_writing(self, name, when) -> None:
        self.arms[name].disk.crash = when

    @rule(name=st.sampled_from(ARMS), full=st.booleans())
    def disk(self, name, full) -> None:
        self.arms[name].disk.full = full

    @rule(seconds=st.sampled_from([0.01, 0.3, 1.0, 2.9, 6.1, 40.0]))
    def wait(self, seconds) -> None:
        self.time_s += seconds
        self.expire()

    @precondition(lambda self: self.bus)
    @rule(data=st.data(), fate=st.sampled_from(["deliver", "deliver", "deliver", "twice", "lose"]))
    def one_message(self, data, fate) -> None:
        index = data.draw(st.integers(0, len(self.bus) - 1))
        _, message = self.bus[index] if fate == "twice" else self.bus.pop(index)
        if fate != "lose":
            message()

    @rule(seed=st.integers(0, 2**32), steps=st.integers(1, 300))
    def gale(self, seed, steps) -> None:
        """Many random actions, with new jobs, and with cuts between an arm and the auctioneer."""
        chance, cut = random.Random(seed), set()
        actions = {
            lambda: self.arrive(chance, cut): 40,
            lambda: self.work(chance.choice(ARMS)): 6,
            lambda: self.communicate(chance.choice(ARMS)): 6,
            self.ask_for_quotes: 1.5,
            self.one_more_job: 1,
            lambda: self.repeat_award(chance): 1,
            lambda: self.wait(chance.choice((0.01, 0.1, 0.7))): 6,
            self.to_the_edge: 0.5,
            lambda: self.stop_and_clear(chance): 0.5,
            lambda: cut.symmetric_difference_update({chance.choice(ARMS)}): 0.5,
            lambda: self.crash_now(chance.choice(ARMS)): 0.1,
            lambda: self.crash_while_writing(chance.choice(ARMS), chance.choice(("before", "after"))): 0.1,
            lambda: self.disk(chance.choice(ARMS), chance.random() < 0.2): 0.2,
            lambda: self.fault(chance.choice(ARMS)): 0.1,
        }
        for action in chance.choices(list(actions), list(actions.values()), k=steps):
            action()
            self.no_two_arms_hold_a_lease_of_one_job()

    def arrive(self, chance, cut) -> None:
        """Deliver the oldest message or any other: once, twice or never."""
        if not self.bus:
            return
        index = chance.choice((0, 0, chance.randrange(len(self.bus))))
        twice = chance.random() < 0.1
        arm, message = self.bus[index] if twice else self.bus.pop(index)
        if arm not in cut and chance.random() > 0.05:
            message()

    def one_more_job(self) -> None:
        if len(self.orders) < 60 and sum(o.state == "waiting" for o in self.orders.values()) < 2:
            name = f"j{len(self.orders)}"
            self.orders[name] = Order(JobSpec(name=name, kind="hold", places=("p",), repetitions=len(name) + 1))

    def to_the_edge(self) -> None:
        """Advance to the first end of a lease on the auctioneer's clock: then another arm may get the job."""
        ends = [o.lease_end_s for o in self.orders.values() if o.state == "awarded"]
        if ends:
            self.time_s = max(self.time_s, min(ends) / self.rate + 1e-3)
            self.expire()

    def stop_and_clear(self, chance) -> None:
        """Stop an arm that has permission to commit until its lease has ended; then a person frees its space."""
        finishing = [o for o in self.orders.values() if o.state == "finishing"]
        if finishing:
            order = chance.choice(finishing)
            self.time_s = max(self.time_s, order.lease_end_s / self.rate + 1e-3)
            self.expire()
            self.clear(order.arm)

    @rule(turns=st.integers(1, 6))
    def fair_weather(self, turns) -> None:
        for _ in range(turns):
            self.turn()

    def turn(self) -> None:
        """Deliver all messages, and let every participant work."""
        for _ in range(4):
            now, self.bus = self.bus, []
            for _, message in now:
                message()
        self.expire()
        self.ask_for_quotes()
        for name in ARMS:
            self.work(name)
            self.communicate(name)
        self.time_s += 0.2

    # Invariants

    @invariant()
    def no_two_arms_hold_a_lease_of_one_job(self) -> None:
        working = [
            (held.award.job.name, arm.name)
            for arm in self.arms.values()
            for held in arm.executor.active
            if self.clock_s(arm) < held.lease_end_s or held.may_commit
        ]
        assert len(working) == len({job for job, _ in working}), working
        (one, out), (other, other_out) = ((arm.name, arm.out) for arm in self.arms.values())
        assert not (out and other_out and self.excluded(one, out, other, other_out)), (out, other_out)

    def teardown(self) -> None:
        for arm in self.arms.values():
            arm.disk.full, arm.disk.crash = False, ""
        for _ in range(1500):
            idle = not any(arm.executor.active or arm.executor.has_pending_reports for arm in self.arms.values())
            if idle and all(o.state in ("finished", "unfinished") for o in self.orders.values()):
                break
            self.turn()
        for name, order in self.orders.items():
            assert order.state in ("finished", "unfinished"), (name, order)
            assert self.last_cycles.get(name) == 1 if order.state == "finished" else name in self.crashed_in_commit


Storm.TestCase.settings = settings(stateful_step_count=20)
TestStorm = Storm.TestCase


@given(seed=st.integers(0, 2**32))
def test_no_job_is_lost_or_done_twice_in_a_long_gale(seed):
    storm, chance = Storm(), random.Random(seed)
    conflicts = seed, chance.choice([0.0, 0.5, 1.0])
    storm.start(tuple(chance.uniform(0.9951, 1.0049) for _ in range(3)), [1, 2, 3], conflicts)
    storm.gale(seed, 4000)
    storm.teardown()
    assert sum(storm.last_cycles.values()) > 2  # jobs were done


def test_without_faults_every_job_is_finished_soon():
    """The model itself: three jobs on two arms need about twenty turns."""
    storm = Storm()
    storm.start((1.0, 1.0, 1.0), [3, 1, 4])
    for _ in range(25):
        storm.turn()
    assert [o.state for o in storm.orders.values()] == ["finished"] * 3
    assert storm.last_cycles == {"j0": 1, "j1": 1, "j2": 1}
    assert not any(arm.executor.active for arm in storm.arms.values())
