"""Arms and an auctioneer in a storm: messages lost, doubled and late, crashes at any moment, clocks of unlike rates.

The auctioneer here is a small model that keeps the rules of `fleet.bus.protocol.auction` on its side and never
forgets. Whatever
happens, no last cycle is done twice, no two arms hold a lease of one job, and once the storm is over every job is
finished, or reported unfinished because of a crash with leave to finish.
"""

import random
from dataclasses import dataclass, field
from functools import partial

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fleet.bus.protocol.auction import Award, JobSpec, Lease, LeaseRequest, Receipt, Report
from fleet.errors import JournalFull
from fleet.live.arm.award_executor import AwardExecutor, ExecutorConfig
from fleet.live.arm.journal_records import ArmHistory, AwardAccepted
from fleet.live.journal_records import CommitPermitted

LEASE_S, VALID_S = 6.0, 3.0
ARMS = ("a", "b")


class Crash(Exception):
    """The arm's process is gone in the middle of a call."""


@dataclass
class Order:
    """A job as the auctioneer knows it."""

    job: JobSpec
    state: str = "waiting"
    award: Award | None = None
    arm: str = ""
    lease_end_s: float = 0.0
    cycles: int = 0


@dataclass
class Arm:
    """An arm's process, its disk, its clock, and what may go wrong with it next."""

    name: str
    rate: float
    disk: list = field(default_factory=list)
    executor: AwardExecutor | None = None
    lives: int = 0
    full: bool = False
    crash: str = ""

    def keep(self, *records) -> None:
        crash, self.crash = self.crash, ""
        if crash == "before":
            raise Crash
        if self.full:
            raise JournalFull("no room")
        self.disk.extend(records)
        if crash == "after":
            raise Crash

    def start(self) -> None:
        history = ArmHistory().replay(self.disk).after_restart(self.name, 0.0)
        self.disk[:] = history.compact()
        self.lives += 1
        config = ExecutorConfig(valid_s=VALID_S, capacity=2, return_after_s=15.0)
        self.executor = AwardExecutor(self.name, self.keep, history, nonce=f"n{self.lives}", config=config)


class Storm(RuleBasedStateMachine):
    """The bus is a list of calls that have not been made yet."""

    def __init__(self) -> None:
        super().__init__()
        self.time_s = 100.0
        self.bus: list = []
        self.rounds = 0
        self.last_cycles: dict[str, int] = {}
        self.crashed_with_leave: set[str] = set()

    @initialize(
        rates=st.tuples(*[st.floats(0.9951, 1.0049)] * 3),
        repetitions=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    )
    def open_shop(self, rates, repetitions) -> None:
        self.rate = rates[0]
        self.arms = {name: Arm(name, rate) for name, rate in zip(ARMS, rates[1:], strict=True)}
        for arm in self.arms.values():
            arm.start()
        jobs = [JobSpec(name=f"j{i}", kind="hold", places=("p",), repetitions=n) for i, n in enumerate(repetitions)]
        self.orders = {job.name: Order(job) for job in jobs}

    def send(self, arm: str, call, *words) -> None:
        """Put something on its way to or from an arm."""
        self.bus.append((arm, partial(call, *words)))

    # The auctioneer

    @property
    def now_s(self) -> float:
        """On the auctioneer's clock."""
        return self.time_s * self.rate

    def expire(self) -> None:
        for order in self.orders.values():
            if order.state == "awarded" and self.now_s > order.lease_end_s:
                order.state = "waiting"

    @rule()
    def ask_for_quotes(self) -> None:
        jobs = tuple(o.job for o in self.orders.values() if o.state == "waiting")
        self.rounds += 1
        for name in self.arms if jobs else ():
            self.send(name, self.quote, name, jobs)

    def award_on(self, arm: str, quote: str, jobs) -> None:
        for job in jobs:
            order = self.orders[job.name]
            if order.state != "waiting":
                continue
            self.rounds += 1
            order.award = Award(
                award=f"w{self.rounds}",
                auction="r",
                auctioneer="x",
                quote=quote,
                job=order.job,
                cycles=order.cycles,
                lease_s=LEASE_S,
            )
            order.state, order.arm, order.lease_end_s = "awarded", arm, self.now_s + LEASE_S
            self.send(arm, self.award, arm, order.award)

    @rule(data=st.data())
    def award_again(self, data) -> None:
        self.repeat_award(data.draw(st.randoms(use_true_random=False)))

    def repeat_award(self, chance) -> None:
        awarded = [o for o in self.orders.values() if o.state == "awarded"]
        if awarded:
            order = chance.choice(awarded)
            self.send(order.arm, self.award, order.arm, order.award)

    def acknowledged(self, ack) -> None:
        for order in self.orders.values():
            if order.state == "awarded" and order.award.award == ack.award and not ack.accepted:
                order.state = "waiting"

    def lease(self, arm: str, life: int, request: LeaseRequest, asked_s: float) -> None:
        self.expire()
        granted, lost, leave = [], [], []
        for hold in request.entries:
            order = self.orders[hold.job]
            mine = order.award is not None and order.award.award == hold.award
            if mine and order.state in ("awarded", "finishing"):
                order.cycles = max(order.cycles, hold.cycles)
                order.lease_end_s = self.now_s + LEASE_S
                granted.append(hold.award)
                if hold.phase == "finishing":
                    order.state = "finishing"
                    leave.append(hold.award)
            else:
                lost.append(hold.award)
        answer = Lease("x", LEASE_S, tuple(granted), tuple(lost), tuple(leave))
        self.send(arm, self.leased, arm, life, answer, asked_s)

    def report(self, arm: str, report: Report) -> None:
        self.expire()
        order = self.orders[report.job]
        if order.award is not None and order.award.award == report.award and order.state in ("awarded", "finishing"):
            order.cycles = max(order.cycles, report.cycles)
            ended = "unfinished" if report.unsure else "waiting"
            order.state = "finished" if report.outcome == "finished" else ended
        elif report.outcome == "finished":
            assert order.state == "finished", "finished by one that the auctioneer had not given leave"
        self.send(arm, self.receipt, arm, Receipt("x", report.award))

    # The arms

    def clock_s(self, arm: Arm) -> float:
        return self.time_s * arm.rate

    def at(self, name: str, call) -> None:
        """Have an arm do something; it may crash in the middle."""
        arm = self.arms[name]
        try:
            call(arm, arm.executor)
        except Crash:
            self.restart(arm)

    def restart(self, arm: Arm) -> None:
        """Down and up again; what its journal says of leave is noted before."""
        left = {r.award for r in arm.disk if isinstance(r, CommitPermitted)}
        held = ArmHistory().replay(arm.disk).active
        self.crashed_with_leave |= {held[name].award.job.name for name in left if name in held}
        arm.crash = ""
        arm.start()

    def quote(self, name: str, jobs) -> None:
        def call(arm, executor) -> None:
            if executor.spare_capacity:
                quote = executor.add_quote({job.name: (job, True) for job in jobs}, self.clock_s(arm))
                self.send(name, self.award_on, name, quote, jobs)

        self.at(name, call)

    def award(self, name: str, award: Award) -> None:
        def call(arm, executor) -> None:
            ack = executor.answer_award(award, self.clock_s(arm))
            assert executor.answer_award(award, self.clock_s(arm)) == ack, "the same award, another answer"
            if ack.accepted:
                known = [*ArmHistory().replay(arm.disk).accepted]
                assert award.award in known, "accepted, but not on disk"
            self.send(name, self.acknowledged, ack)

        self.at(name, call)

    def leased(self, name: str, life: int, lease: Lease, asked_s: float) -> None:
        if self.arms[name].lives == life:  # Replies reach only the life that asked.
            self.at(name, lambda arm, executor: executor.apply_lease(lease, asked_s))

    def receipt(self, name: str, receipt: Receipt) -> None:
        self.at(name, lambda arm, executor: executor.apply_receipt(receipt))

    @rule(name=st.sampled_from(ARMS))
    def speak(self, name) -> None:
        """Ask for leases, report, give up what has no lease."""

        def call(arm, executor) -> None:
            now_s = self.clock_s(arm)
            executor.retry_writes()
            executor.return_expired(0.0, now_s)
            for _, request in executor.lease_requests(now_s):
                self.send(name, self.lease, name, arm.lives, request, now_s)
            for _, report in executor.due_reports(now_s):
                assert report.award not in ArmHistory().replay(arm.disk).active, "reported, but not on disk"
                self.send(name, self.report, name, report)

        self.at(name, call)

    @rule(name=st.sampled_from(ARMS))
    def work(self, name) -> None:
        """One cycle of the first job in hand, if it may be begun."""

        def call(arm, executor) -> None:
            if not executor.active:
                return
            now_s, first = self.clock_s(arm), executor.active[0]
            job = first.award.job
            if executor.allowed_cycles(now_s) > first.cycles:
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

    # What goes wrong

    @rule(name=st.sampled_from(ARMS))
    def crash_now(self, name) -> None:
        self.restart(self.arms[name])

    @rule(name=st.sampled_from(ARMS), when=st.sampled_from(["before", "after"]))
    def crash_while_writing(self, name, when) -> None:
        self.arms[name].crash = when

    @rule(name=st.sampled_from(ARMS), full=st.booleans())
    def disk(self, name, full) -> None:
        self.arms[name].full = full

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
        """Many things at random, cuts between an arm and the auctioneer among them, and new jobs meanwhile."""
        chance, cut = random.Random(seed), set()
        deeds = {
            lambda: self.arrive(chance, cut): 40,
            lambda: self.work(chance.choice(ARMS)): 6,
            lambda: self.speak(chance.choice(ARMS)): 6,
            self.ask_for_quotes: 1.5,
            self.one_more_job: 1,
            lambda: self.repeat_award(chance): 1,
            lambda: self.wait(chance.choice((0.01, 0.1, 0.7))): 6,
            self.to_the_edge: 0.5,
            lambda: cut.symmetric_difference_update({chance.choice(ARMS)}): 0.5,
            lambda: self.crash_now(chance.choice(ARMS)): 0.1,
            lambda: self.crash_while_writing(chance.choice(ARMS), chance.choice(("before", "after"))): 0.1,
            lambda: self.disk(chance.choice(ARMS), chance.random() < 0.2): 0.2,
            lambda: self.fault(chance.choice(ARMS)): 0.1,
        }
        for deed in chance.choices(list(deeds), list(deeds.values()), k=steps):
            deed()
            self.no_two_arms_hold_a_lease_of_one_job()

    def arrive(self, chance, cut) -> None:
        """The oldest message, or any, arrives; or twice, or never."""
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
        """The moment at which the auctioneer sees a lease end: the first at which another may get the job."""
        ends = [o.lease_end_s for o in self.orders.values() if o.state == "awarded"]
        if ends:
            self.time_s = max(self.time_s, min(ends) / self.rate + 1e-3)
            self.expire()

    @rule(turns=st.integers(1, 6))
    def fair_weather(self, turns) -> None:
        """All that is on the bus arrives, and all do what they should."""
        for _ in range(turns):
            self.turn()

    def turn(self) -> None:
        for _ in range(4):
            now, self.bus = self.bus, []
            for _, message in now:
                message()
        self.expire()
        self.ask_for_quotes()
        for name in ARMS:
            self.work(name)
            self.speak(name)
        self.time_s += 0.2

    # What must hold

    @invariant()
    def no_two_arms_hold_a_lease_of_one_job(self) -> None:
        if not hasattr(self, "arms"):
            return
        working = [
            (held.award.job.name, arm.name)
            for arm in self.arms.values()
            for held in arm.executor.active
            if self.clock_s(arm) < held.lease_end_s or held.may_commit
        ]
        jobs = [job for job, _ in working]
        assert len(jobs) == len(set(jobs)), working

    def teardown(self) -> None:
        if not hasattr(self, "arms"):
            return
        for arm in self.arms.values():
            arm.full, arm.crash = False, ""
        for _ in range(1500):
            if all(o.state in ("finished", "unfinished") for o in self.orders.values()):
                break
            self.turn()
        for name, order in self.orders.items():
            assert order.state in ("finished", "unfinished"), (name, order)
            if order.state == "finished":
                assert self.last_cycles.get(name) == 1
            else:
                assert name in self.crashed_with_leave


Storm.TestCase.settings = settings(stateful_step_count=20)
TestStorm = Storm.TestCase


@given(seed=st.integers(0, 2**32))
def test_a_long_gale_does_no_harm(seed):
    storm, chance = Storm(), random.Random(seed)
    storm.open_shop(tuple(chance.uniform(0.9951, 1.0049) for _ in range(3)), [1, 2, 3])
    storm.gale(seed, 4000)
    storm.teardown()
    assert sum(storm.last_cycles.values()) > 5  # there was work


def test_a_calm_shop_finishes_every_job_in_good_time():
    """The model itself works: without a storm three jobs on two arms need some twenty turns."""
    storm = Storm()
    storm.open_shop((1.0, 1.0, 1.0), [3, 1, 4])
    for _ in range(25):
        storm.turn()
    assert [o.state for o in storm.orders.values()] == ["finished"] * 3
    assert storm.last_cycles == {"j0": 1, "j1": 1, "j2": 1}
    assert not any(arm.executor.active for arm in storm.arms.values())


def test_a_crash_forgets_nothing_that_was_promised():
    """Accepted, worked and given leave: the next life gives it back, and says that it is unsure."""
    disk: list = []
    arm = Arm("a", 1.0, disk=disk)
    arm.start()
    job = JobSpec(name="j", kind="hold", places=("p",), repetitions=3)
    quote = arm.executor.add_quote({"j": (job, True)}, 0.0)
    award = Award(award="w", auction="r", auctioneer="x", quote=quote, job=job, lease_s=LEASE_S)
    assert arm.executor.answer_award(award, 0.1).accepted
    assert [r for r in disk if isinstance(r, AwardAccepted)]
    arm.executor.record_progress(2, 0.0)
    ((auctioneer, request),) = arm.executor.lease_requests(1.0)
    assert (auctioneer, request.entries[0].phase, request.entries[0].cycles) == ("x", "finishing", 2)
    arm.executor.apply_lease(Lease("x", LEASE_S, ("w",), (), ("w",)), 1.0)
    arm.start()
    assert not arm.executor.active
    ((_, report),) = arm.executor.due_reports(0.0)
    assert (report.outcome, report.cycles, report.unsure) == ("returned", 2, True)
    assert arm.executor.answer_award(award, 0.2).accepted  # the same answer, also in the next life
    assert not arm.executor.answer_award(replace_award(award), 0.2).accepted


def replace_award(award: Award) -> Award:
    """Another award on the same quote."""
    return Award(**{**{f: getattr(award, f) for f in award.__struct_fields__}, "award": "other"})
