"""Arms without an auctioneer in a storm: messages lost, doubled and late, crashes at any moment, cuts, full disks.

Every arm here is the real one but for its body and its wires. Whatever happens, no two arms hold a lease of one job or
of one station, no last cycle is done twice, and once the storm is over every job is finished, or reported unfinished
because of a crash with leave to finish.
"""

import random
from dataclasses import dataclass, field
from functools import partial

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.consensus import consensus
from agents.cost import Bids, thermal
from fleet.bus.trade import JobWord, Offer
from fleet.errors import JournalFull
from fleet.live import granting, promises
from fleet.live.auctioneer import Objection
from fleet.live.contractor import Contractor, Terms
from fleet.live.council import Council, Faculties
from fleet.live.granting import Grantor
from fleet.live.timing import Timing
from scenarios.live_policies import allocation

TIMING = Timing(lease_s=3.0, margin_s=0.05, window_s=0.3, pause_s=(0.2, 1.0))
CYCLE_S = 0.2


class Crash(Exception):
    """The arm's process is gone in the middle of a call."""


@dataclass(eq=False)
class Disk:
    """A journal in memory, and what goes wrong with it."""

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
        memory = promises.restarted(promises.recall(self.promises.records), self.name, 0.0)
        self.promises.records[:] = promises.retold(memory)
        register = granting.recalled(self.grants.records)
        self.grants.records[:] = granting.retold(register)
        terms = Terms(patience_s=8.0)
        self.contractor = Contractor(self.name, self.promises.keep, memory, nonce="n", terms=terms)
        grantor = Grantor(self.name, self.fleet.names, register, self.grants.keep, real_s=self.real_s, timing=TIMING)
        faculties = Faculties(
            offers=lambda words: tuple(self.fleet.offer(self.name, word) for word in words),
            unfit=lambda: "hot" if self.hot else "",
            take=self.contractor.awarded,
        )
        self.council = Council(
            self.contractor,
            grantor,
            faculties,
            agree=self.fleet.agree,
            life=memory.boot,
            rng=random.Random(f"{self.name} {self.lives}"),
            timing=TIMING,
        )
        self.council.know([*self.fleet.jobs, *register.jobs.values()])

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
        for held in promises.recall(self.promises.records).held.values():
            if held.leave:
                self.fleet.doubtful.add(held.award.job.name)
        self.start()

    def _turn(self) -> None:
        self.contractor.catch_up()
        self._work()
        self.contractor.give_up(0.0, self.real_s)
        if self.contractor.lease_requests(self.real_s) or self.contractor.reports(self.real_s):
            self.council.claimant.hurry()
        self.council.seen(self.fleet.alive_for(self.name))
        self.council.tick(self.real_s, self.fleet.true_s)
        while self.council.out:
            self.fleet.send(self.name, self.council.out.popleft())

    def _work(self) -> None:
        """Cycles, one after the other; one that was begun is ended."""
        if not self.contractor.held:
            self.cycle_ends_s = None
            return
        first = self.contractor.held[0]
        name, repetitions = first.award.job.name, first.award.job.repetitions
        if self.cycle_ends_s is None and self.contractor.may(self.real_s) > first.cycles:
            self.cycle_ends_s = name, self.real_s + CYCLE_S
            if first.cycles + 1 == repetitions:
                self.fleet.last_cycle(name)
        elif self.cycle_ends_s is not None and self.cycle_ends_s[0] != name:
            self.cycle_ends_s = None
        elif self.cycle_ends_s is not None and self.real_s >= self.cycle_ends_s[1]:
            self.cycle_ends_s = None
            if first.cycles + 1 == repetitions:
                self.contractor.finished(self.fleet.true_s, self.real_s)
                return
            self.contractor.worked(first.cycles + 1, 0.0)
        self.contractor.worked(first.cycles, (repetitions - 1 - first.cycles) * CYCLE_S)

    def fault(self) -> None:
        """It stops in the middle of a cycle, which then is not done."""
        if self.cycle_ends_s is not None:
            first = self.contractor.held[0].award.job
            if self.contractor.held[0].cycles + 1 == first.repetitions:
                self.fleet.last_cycles[first.name] -= 1
            self.cycle_ends_s = None
        self.contractor.returned(0.0, self.real_s, "hot")


class Fleet:
    """Arms, and the wires between them: a list of words that have not come yet."""

    def __init__(self, rates, jobs, agree) -> None:
        self.names = tuple(f"arm_{i}" for i in range(len(rates)))
        self.true_s, self.jobs, self.agree = 100.0, list(jobs), agree
        self.wires: list = []
        self.old: list = []
        self.cut: set[str] = set()
        self.last_cycles: dict[str, int] = {}
        self.doubtful: set[str] = set()
        self.arms = {name: Arm(self, name, rate) for name, rate in zip(self.names, rates, strict=True)}

    def offer(self, arm: str, word: JobWord) -> Offer:
        """An arm finds a job as hard as both their names say; some cannot do some."""
        d = random.Random(f"{arm} {word.name}").random()
        return Offer(job=word.name, feasible=d > 0.1 or arm == self.names[0], d=d, finish_in_s=10.0)

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
            arm.safely(lambda: arm.council.heard(word, arm.real_s))
            return

        def answer() -> None:
            try:
                grant = arm.council.asked(word, arm.real_s)
            except Objection:
                return
            self.wires.append((other, speaker, partial(self.answered, speaker, grant, life)))

        arm.safely(answer)

    def answered(self, speaker: str, grant, life: int) -> None:
        arm = self.arms[speaker]
        if arm.lives == life:  # an answer reaches only the life that asked
            arm.safely(lambda: arm.council.answered(grant, arm.real_s))

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
            (held.award.job, arm.name, held.leave)
            for arm in self.arms.values()
            for held in arm.contractor.held
            if arm.real_s < held.until_s or held.leave
        ]
        jobs = [job.name for job, _, _ in at_work]
        assert len(jobs) == len(set(jobs)), at_work
        stations = [place for job, arm, leave in at_work if not leave for place in job.places]
        assert len(stations) == len(set(stations)), at_work

    def settled(self) -> dict[str, str]:
        """What the arms know: they never differ."""
        told: dict[str, str] = {}
        for arm in self.arms.values():
            for job, settled in arm.council.grantor.register.settled.items():
                assert told.setdefault(job, settled.outcome) == settled.outcome, job
        return told


def jobs_of(rng: random.Random, count: int) -> list[JobWord]:
    words: list[JobWord] = []
    for number in range(count):
        after = (rng.choice(words).name,) if words and rng.random() < 0.2 else ()
        place, n = rng.choice("xyzuvw"), rng.choice([1, 2, 3, 12])
        words.append(JobWord(name=f"job {number}", kind="hold", places=(place,), repetitions=n, after=after))
    return words


def gale(fleet: Fleet, rng: random.Random) -> None:
    loss = rng.choice([0.0, 0.1, 0.4])
    for _ in range(rng.randrange(5, 40)):
        for arm in fleet.arms.values():
            if rng.random() > 0.1:
                arm.turn()
        for _ in range(rng.randrange(1, 4) * len(fleet.wires)):
            if fleet.wires and rng.random() < loss:
                del fleet.wires[rng.randrange(len(fleet.wires))]
            if fleet.wires:
                fleet.deliver(rng.choice((0, 0, rng.randrange(len(fleet.wires)))), keep=rng.random() < 0.05)
        del fleet.wires[200:]
        fleet.true_s += rng.choice([0.0, 0.01, 0.1, 0.1, 0.3])
        fleet.check()


def crash(fleet: Fleet, rng: random.Random) -> None:
    fleet.arms[rng.choice(fleet.names)].crash()


def crash_while_writing(fleet: Fleet, rng: random.Random) -> None:
    arm = fleet.arms[rng.choice(fleet.names)]
    rng.choice([arm.promises, arm.grants]).crash = rng.choice(["before", "after"])


def fill_disk(fleet: Fleet, rng: random.Random) -> None:
    arm = fleet.arms[rng.choice(fleet.names)]
    rng.choice([arm.promises, arm.grants]).full = rng.random() < 0.5


def cut(fleet: Fleet, rng: random.Random) -> None:
    """Some arms hear only each other, and the others only themselves."""
    fleet.cut = {name for name in fleet.names if rng.random() < 0.5}
    fleet.calm(rng.choice([0.5, 2.0, 4.0]))


def heal(fleet: Fleet, rng: random.Random) -> None:
    fleet.cut = set()


def overheat(fleet: Fleet, rng: random.Random) -> None:
    arm = fleet.arms[rng.choice(fleet.names)]
    arm.hot = not arm.hot
    if arm.hot:
        arm.safely(arm.fault)


def wait(fleet: Fleet, rng: random.Random) -> None:
    """Nobody gets to do anything for as long as a lease, or a little less or more."""
    fleet.true_s += rng.choice([0.5, 2.9, 2.97, 3.0, 3.05, 3.1, 10.0])
    fleet.check()


def busy(fleet: Fleet, rng: random.Random, *, leave: bool) -> Arm | None:
    """An arm with a job in hand, or one that may begin its last cycle, if there is one soon."""
    for _ in range(30):
        found = [arm for arm in fleet.arms.values() if arm.contractor.held]
        found = [arm for arm in found if arm.contractor.held[0].leave or not leave]
        if found:
            return rng.choice(found)
        fleet.calm(0.1)
    return None


def cut_off_at_work(fleet: Fleet, rng: random.Random) -> None:
    """An arm is cut off in the middle of a job; maybe others are killed, or it stands still, or it is killed too."""
    arm = busy(fleet, rng, leave=rng.random() < 0.5)
    if arm is None:
        return
    fleet.cut = {arm.name}
    for other in fleet.arms.values():
        if other is not arm and rng.random() < 0.3:
            other.crash()
    still = arm.name if rng.random() < 0.5 else ""
    fleet.calm(rng.choice([0.5, 1.0, 2.9, 3.2, 4.0]), but=still)
    if rng.random() < 0.3:
        arm.crash()
    fleet.cut = set()


def fill_disk_at_work(fleet: Fleet, rng: random.Random) -> None:
    """An arm has no room for what it has to note at the end of a job."""
    arm = busy(fleet, rng, leave=True)
    if arm is not None:
        arm.promises.full = True
        fleet.calm(rng.choice([0.5, 2.0, 4.0]))
        arm.promises.full = rng.random() < 0.3


def kill_at_work(fleet: Fleet, rng: random.Random) -> None:
    arm = busy(fleet, rng, leave=rng.random() < 0.7)
    if arm is not None:
        arm.crash()
        fleet.calm(rng.choice([0.1, 1.0, 4.0]))


def late_answers(fleet: Fleet, rng: random.Random) -> None:
    """What an arm at work is answered comes when its lease is nearly over, and after that nothing."""
    arm = busy(fleet, rng, leave=False)
    if arm is None:
        return
    arm.contractor.lease_requests(arm.real_s)
    arm.council.claimant.hurry()
    arm.turn()
    for _ in range(len(fleet.wires)):
        fleet.deliver(0)  # to the others; what they answer waits
    fleet.true_s += rng.choice([1.0, 2.0, 2.8])
    for _ in range(len(fleet.wires)):
        fleet.deliver(0)
    fleet.cut = {arm.name}
    fleet.calm(rng.choice([1.0, 2.0, 3.0]))
    fleet.cut = set()


def echo(fleet: Fleet, rng: random.Random) -> None:
    """Words of long ago come again."""
    busy(fleet, rng, leave=False)
    for one, other, call in rng.sample(fleet.old, min(len(fleet.old), 20)):
        if fleet.reach(one, other):
            call()
    fleet.calm(rng.choice([0.1, 1.0]))


def fair_weather(fleet: Fleet, rng: random.Random) -> None:
    fleet.calm(rng.choice([0.3, 1.0, 2.0]))


DEEDS = (
    *(gale, gale, crash, crash_while_writing, fill_disk, cut, heal, overheat, wait, fair_weather, echo, late_answers),
    *(cut_off_at_work, cut_off_at_work, fill_disk_at_work, kill_at_work),
)
rates = st.lists(st.floats(1 - 1e-3, 1 + 1e-3), min_size=1, max_size=5)


def storm(rates, seed: int, deeds) -> None:
    rng = random.Random(seed)
    every = jobs_of(rng, rng.randrange(3, 14))
    handed_in = [word for word in every if rng.random() < 0.4]
    fleet = Fleet(rates, [word for word in every if word not in handed_in], allocation("consensus", 60.0))
    for word in handed_in:  # to one arm, which has to tell the others
        council = fleet.arms[rng.choice(fleet.names)].council
        council.grantor.admit((word,))
        council.know([word])
    for deed in deeds:
        deed(fleet, rng)
        fleet.check()
    fleet.cut = set()
    for arm in fleet.arms.values():
        arm.hot = arm.promises.full = arm.grants.full = False
        arm.promises.crash = arm.grants.crash = ""
    for _ in range(60):
        fleet.calm(1.0)
        if all(arm.council.over(arm.real_s) for arm in fleet.arms.values()):
            break
    told = fleet.settled()
    for arm in fleet.arms.values():
        assert arm.council.grantor.register.settled.keys() == told.keys(), f"{arm.name} does not know all"
    for word in every:
        if told.get(word.name) == "unfinished":
            assert word.name in fleet.doubtful
        elif word.name not in told:
            lost = {name for name, outcome in told.items() if outcome == "unfinished"}
            assert waits_for(every, word, lost), f"{word.name} is neither finished nor lost"
        else:
            assert fleet.last_cycles[word.name] == 1


def test_who_is_cut_off_does_not_say_that_all_is_done():
    """Not even if all that is left is a job that another had leave to finish."""
    fleet = Fleet([1.0] * 3, [JobWord(name="j", kind="hold", places=("p",))], allocation("consensus", 60.0))
    holder = busy(fleet, random.Random(0), leave=True)
    fleet.cut = {next(name for name in fleet.names if name != holder.name)}
    fleet.calm(8.0, but=holder.name)
    alone = fleet.arms[min(fleet.cut)]
    assert alone.council.left(alone.real_s) == []
    assert not alone.council.over(alone.real_s)


def waits_for(words, word: JobWord, lost) -> bool:
    """Whether a job can never begin, since one that it waits for was lost."""
    by_name = {each.name: each for each in words}
    return any(before in lost or waits_for(words, by_name[before], lost) for before in word.after)


@settings(max_examples=120, deadline=None)
@given(rates, st.integers(0, 2**32), st.lists(st.sampled_from(DEEDS), min_size=3, max_size=14))
def test_no_job_is_done_twice_and_none_is_lost(rates, seed, deeds):
    storm(rates, seed, deeds)


@pytest.mark.slow
@settings(max_examples=1500, deadline=None)
@given(rates, st.integers(0, 2**32), st.lists(st.sampled_from(DEEDS), max_size=25))
def test_no_job_is_done_twice_in_a_long_storm(rates, seed, deeds):
    storm(rates, seed, deeds)


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 7))
def test_with_every_word_heard_they_do_what_consensus_says(seed, arms, jobs):
    """The first job of every arm is that of `agents.consensus` on the same costs, where no two want one station."""
    rng = random.Random(seed)
    words = [JobWord(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=50) for i in range(jobs)]
    fleet = Fleet([1.0] * arms, words, allocation("consensus", 60.0))
    for name in rng.sample(fleet.names, rng.randrange(arms)):
        fleet.arms[name].hot = True
    fleet.calm(0.6)
    cool = [name for name, arm in fleet.arms.items() if not arm.hot]
    offers = {name: [fleet.offer(name, word) for word in words] for name in cool}
    cost = thermal(
        Bids(
            feasible=np.array([[offer.feasible for offer in offers[name]] for name in cool]),
            difficulty=np.array([[offer.d for offer in offers[name]] for name in cool]),
            p_saturation=np.full((len(cool), jobs), np.nan),
            peak_headroom_k=np.full((len(cool), jobs), np.nan),
            finish_s=np.full((len(cool), jobs), 10.0),
            tardiness_s=np.zeros((len(cool), jobs)),
            value=np.ones(jobs),
        )
    )
    bids = {name: dict(zip([w.name for w in words], row, strict=True)) for name, row in zip(cool, cost, strict=True)}
    bids = {name: {job: c for job, c in costs.items() if np.isfinite(c)} for name, costs in bids.items()}
    wanted = consensus(bids, nx.complete_graph(cool))
    has = {name: next((h.award.job.name for h in fleet.arms[name].contractor.held), None) for name in cool}
    assert has == wanted
    assert all(fleet.arms[name].council.rounds <= 2 for name in cool)
