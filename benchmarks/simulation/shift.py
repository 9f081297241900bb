"""One simulated life of a fleet: jobs and faults by one seed, rules after every event, and all settled at the end.

The rules: the last cycle of a job is done at most once; no two arms have one job; no two arms are away from home on
plans that exclude each other; an accepted job stays known; after the faults every job is finished, given up for the
reasons that the product names, or unfinished because an arm stopped in its last cycle; every wait ends; requests of
people have their effect (`steering`); the recording has every result once (`recording`).
"""

from collections.abc import Mapping
from random import Random
from typing import Any

from bus import Bus
from faults import FAULTS, heal, request
from participants import AUCTIONEER, CLIENT, ArmProcess, Submitter, Watch, auctioneer_process, simulated_system
from recording import RECORDER, Sent, recorder_process
from steering import check_steering
from world import Process, Violation, World

from fleet.bus.protocol.auction import ABANDONED, SETTLED, JobSpec
from fleet.bus.protocol.operator import Resume
from fleet.job import reason_to_give_up
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.round import Assignment, Timing
from fleet.live.consensus.participant import Membership
from fleet.live.space import ANYWHERE, Excludes
from fleet.robot import ThermalLimits

SPEEDS = (1.0, 10.0, 60.0, 120.0, 120.0, 240.0)
"""Fleet seconds per real second."""
FIRST = "arm_0"
"""Can do every job."""
MEAN_JOB_S = 150.0
"""Mean duration of a job, fleet s."""
MOST_JOBS = 60
"""In one shift, about."""
CHECK_S = 2.0
"""True seconds between two checks whether all is settled."""
RECORD_S = 120.0
"""True seconds after the last result in which the recorder has it."""
SETTLE_S = 240.0
"""True seconds after the faults in which all jobs must be settled, besides the time that they take."""


def first_come(bidding: Any) -> Mapping[str, Assignment]:
    """Give each job to the first free arm with an open plan."""
    out: dict[str, Assignment] = {}
    busy: set[str] = set()
    for job in bidding.jobs:
        for arm in sorted(bidding.quotes):
            plans = bidding.plans(arm, job.name)
            if plans and arm not in busy:
                out[job.name] = Assignment(arm, min(plans))
                busy.add(arm)
                break
    return out


def first_legal(observation: Any, arm: int) -> int:
    """Claim the first job that the arm may claim."""
    legal = observation.action_mask[1:-1].nonzero()[0].tolist()
    return 1 + legal[0] if legal else 0


def random_conflicts(seed: int, share: float) -> Excludes:
    """Return a symmetric relation in which this share of all plans exclude each other, and unknown ones all others."""
    known: dict[tuple[str, str], bool] = {}

    def excludes(arm: str, space: str, other: str, other_space: str) -> bool:
        if ANYWHERE in (space, other_space):
            return True
        pair = (space, other_space) if space < other_space else (other_space, space)
        if pair not in known:
            known[pair] = Random(f"{seed} {pair}").random() < share
        return known[pair]

    return excludes


class Shift:
    """A fleet and its world.

    Attributes:
        accepted: Jobs that were accepted, by name.
        finished: How many times the last cycle of a job ended.
    """

    def __init__(self, seed: int, *, trace: bool = False) -> None:
        self.seed = seed
        self.world = world = World(seed, trace=trace)
        rng = self.rng = world.rng
        self.arms = (FIRST, *(f"arm_{i}" for i in range(1, rng.choice([2, 3, 3, 4]))))
        self.speed = rng.choice(SPEEDS)
        self.alone = rng.random() < 0.4 and len(self.arms) > 2
        """Without an auctioneer."""
        self.job_gap_s = rng.choice([0.8, 2.0, 5.0, 20.0]) * MEAN_JOB_S / self.speed / len(self.arms)
        self.faulty_s = max(60.0, min(rng.uniform(60.0, 900.0), MOST_JOBS * self.job_gap_s))
        self.fault_gap_s = rng.choice([4.0, 10.0, 30.0, 60.0])
        self.possible = tuple(fault for fault in FAULTS if rng.random() < 0.4) or FAULTS
        """Faults of this shift: few kinds often meet what all kinds together rarely do."""
        self.excludes = random_conflicts(seed, rng.choice([0.0, 0.5, 0.5, 1.0]))
        self.begun: dict[str, int] = {}
        self.finished: dict[str, int] = {}
        self.away: dict[str, str] = {}
        self.faults: dict[str, list[str]] = {}
        self.unsure: set[str] = set()
        self.cancelled: set[str] = set()
        """Jobs that a person has asked to cancel."""
        self.work_s = 0.0
        self.healed = False
        self.jobs: list[JobSpec] = []
        timing = Timing(lease_s=rng.choice([3.0, 6.0]), max_jobs=8)
        membership: Membership | None = None
        if self.alone:
            live = LiveFleet(arms=self.arms, limits=ThermalLimits(warning_c=80.0, error_c=95.0))
            membership = Membership(fleet=live, choose=first_legal, slots=4, excludes=self.excludes, timing=timing)
        world.bus = Bus(world)
        rate_hz, capacity = rng.choice([0.5, 1.0]), rng.choice([1, 1, 2])
        self.builders = {name: ArmProcess(self, FIRST, self.speed, rate_hz, capacity, membership) for name in self.arms}
        for name in self.arms:
            Process(world, name, self.builders[name])
        if not self.alone:
            build = auctioneer_process(self.arms, self.speed, first_come, timing, self.excludes)
            Process(world, AUCTIONEER, build)
        self.sent = Sent(world.bus)
        Process(world, RECORDER, recorder_process(rng.choice([5.0, 20.0, 60.0])))
        self.names = tuple(world.processes)
        Process(world, CLIENT, Submitter)
        world.after_run, world.after_exit = self._after_run, self._after_exit

    def run(self) -> None:
        """Live through faults, heal, and settle.

        Raises:
            Violation: a rule is broken.
        """
        world, rng = self.world, self.rng
        with simulated_system(world):
            world.log("shift", f"{len(self.arms)} arms, speed {self.speed:g}, {'alone' if self.alone else AUCTIONEER}")
            world.processes[CLIENT].start()
            self.watch = Watch(world, self.names)
            at_s = 3.0
            while at_s < self.faulty_s:
                world.at(at_s, self._submit)
                at_s += rng.expovariate(1.0 / self.job_gap_s)
            at_s = rng.expovariate(1.0 / self.fault_gap_s)
            while at_s < self.faulty_s:
                world.at(at_s, self._fault)
                at_s += rng.expovariate(1.0 / self.fault_gap_s)
            world.run(self.faulty_s)
            heal(self)
            self._settle()
            self._end_recording()

    @property
    def submitter(self) -> Submitter:
        node: Any = self.world.processes[CLIENT].node
        return node

    def node(self, name: str) -> Any:
        """Node of a process; None while it is down."""
        return self.world.processes[name].node

    def _submit(self) -> None:
        rng, names = self.rng, [job.name for job in self.jobs]
        after = tuple(rng.sample(names[-5:], int(bool(names) and rng.random() < 0.15)))
        due: dict[str, Any] = {}
        if self.alone is False and self.node(AUCTIONEER) is not None and rng.random() < 0.1:
            due = {"due_s": self.node(AUCTIONEER).time_s + rng.uniform(0.0, 30.0) * self.speed, "expires": True}
        spec = JobSpec(
            name=f"job_{len(self.jobs)}",
            kind="hold",
            places=(rng.choice("uvwxyz"),),
            dwell_s=rng.choice([0.5, 5.0, 20.0]),
            repetitions=rng.choice([1, 1, 2, 4, 12, 40]),
            after=after,
            **due,
        )
        self.jobs.append(spec)
        self.work_s += (20.0 + spec.repetitions * (spec.dwell_s + 10.0)) / self.speed
        self.submitter.waiting.append(spec)
        self.world.processes[CLIENT].wake(self.world.now_s)

    def _fault(self) -> None:
        fault = self.rng.choice(self.possible)
        self.world.log("fault", fault.__name__)
        fault(self)

    # Deeds of the arms

    def departs(self, arm: str, space: str) -> None:
        """Note that an arm leaves home, and check that no other arm is in its way."""
        self.world.log(arm, f"leaves home on {space}")
        for other, taken in self.away.items():
            if other != arm and self.excludes(arm, space, other, taken):
                raise Violation(f"'{arm}' leaves home on {space} while '{other}' is away on {taken}.")
        self.away[arm] = space

    def is_home(self, arm: str) -> None:
        """Note that an arm is at home."""
        if self.away.pop(arm, None):
            self.world.log(arm, "is at home")

    def begins_last_cycle(self, arm: str, job: str) -> None:
        """Check that the last cycle of a job is begun once."""
        self.world.log(arm, f"begins the last cycle of '{job}'")
        self.begun[job] = self.begun.get(job, 0) + 1
        if self.begun[job] > 1:
            raise Violation(f"'{arm}' begins the last cycle of '{job}' a second time.")

    def breaks_last_cycle_off(self, arm: str, job: str) -> None:
        """Note that a last cycle was certainly not done."""
        self.begun[job] -= 1

    def finishes(self, arm: str, job: str) -> None:
        """Note that a job is done."""
        self.world.log(arm, f"has done '{job}'")
        self.finished[job] = self.finished.get(job, 0) + 1

    # Rules

    def _after_run(self, process: Process) -> None:
        if process.name in self.builders:
            self._check_holders()
        elif process.name == AUCTIONEER and process.node is not None:
            self._check_known()

    def _check_holders(self) -> None:
        holders: dict[str, str] = {}
        for name in self.arms:
            process = self.world.processes[name]
            node: Any = process.node
            if node is None:
                continue
            for active in node.executor.active:
                if active.may_commit or process.real_s < active.lease_end_s:
                    if active.job in holders:
                        raise Violation(f"'{name}' and '{holders[active.job]}' both have '{active.job}'.")
                    holders[active.job] = name

    def _check_known(self) -> None:
        ledger = self.node(AUCTIONEER).auctioneer.ledger
        if len(self.submitter.accepted) > len(ledger.jobs) + len(ledger.past):
            lost = [name for name in self.submitter.accepted if name not in ledger.jobs and name not in ledger.past]
            raise Violation(f"The auctioneer does not know '{lost[0]}', which it accepted.")

    def _after_exit(self, process: Process) -> None:
        if process.name in self.builders:
            machine = self.builders[process.name].machine
            if machine is not None and machine.job in self.begun and self.begun[machine.job]:
                self.unsure.add(machine.job)

    # The end

    def statuses(self) -> dict[str, str]:
        """State of every job, as the participants know it."""
        if not self.alone:
            ledger, auctioneer = self.node(AUCTIONEER).auctioneer.ledger, self.node(AUCTIONEER).auctioneer
            past = [name for name in self.submitter.accepted if name in ledger.past]
            states = {name: "finished" if ledger.past.is_finished(name) else "given_up" for name in past}
            return states | {each.job: each.state for each in auctioneer.status()}
        states = {}
        for name in self.arms:
            known = {each.job: each.state for each in self.node(name).work_source.statuses()}
            past = self.node(name).work_source.participant.granter.register.past
            left = [job for job in self.submitter.accepted if job in past and job not in known]
            known |= {job: "finished" if past.is_finished(job) else "given_up" for job in left}
            for job, state in known.items():
                if states.setdefault(job, state) in ("waiting", "unfinished", *ABANDONED):
                    states[job] = state
        return states

    def _open(self) -> list[str]:
        """What is not settled yet, in words."""
        what = [f"'{name}' is down" for name in self.names if self.node(name) is None]
        what += [f"'{job.name}' is not answered" for job in self.submitter.waiting]
        if what:
            return what
        states = self.statuses()
        for name in self.arms:
            executor = self.node(name).executor
            what += [f"'{name}' has '{active.job}'" for active in executor.active]
            what += [f"'{name}' has a report" for _ in range(executor.has_pending_reports)]
        for name, job in self.submitter.accepted.items():
            if states.get(name) not in SETTLED and not self._stuck(job, states):
                what.append(f"'{name}' is {states.get(name, 'unknown')}")
        return what

    def _stuck(self, job: JobSpec, states: Mapping[str, str]) -> bool:
        """Whether a job waits for one that stays unfinished."""
        return any(
            states.get(before) in ("unfinished", "given_up", "cancelled")
            or self._stuck(self.submitter.accepted[before], states)
            for before in job.after
            if before in self.submitter.accepted
        )

    def _is_paused(self) -> bool:
        if not self.alone:
            return (node := self.node(AUCTIONEER)) is not None and bool(node.auctioneer.ledger.paused)
        nodes = (node for name in self.arms if (node := self.node(name)) is not None)
        return any(node.work_source.participant.granter.register.operations.paused for node in nodes)

    def _settle(self) -> None:
        deadline_s = self.world.now_s + SETTLE_S + 3.0 * self.work_s
        while self._open():
            if self.world.now_s > deadline_s:
                raise Violation(f"No end after {self.world.now_s:.0f} s: {'; '.join(self._open()[:4])}.")
            if self._is_paused():
                request(self, Resume())
            self.world.run(self.world.now_s + CHECK_S)
        self.unsure |= {job for builder in self.builders.values() for job in builder.unsure}
        states = self.statuses()
        for name, job in self.submitter.accepted.items():
            state, done = states[name], self.finished.get(name, 0)
            if state == "finished" and done != 1:
                raise Violation(f"'{name}' is called finished, and was done {done} times.")
            if done and state != "finished" and name not in self.unsure:
                raise Violation(f"'{name}' was done, and is called {state}.")
            if state == "unfinished" and name not in self.unsure:
                raise Violation(f"'{name}' is unfinished, and no arm stopped in its last cycle.")
            if state == "cancelled" and name not in self.cancelled:
                raise Violation(f"'{name}' is cancelled, and nobody asked for it.")
            lost = any(states.get(before) in ABANDONED for before in job.after)
            if state == "given_up" and not (
                lost or name in self.cancelled or job.expires or reason_to_give_up(self.faults.get(name, ()))
            ):
                raise Violation(f"'{name}' is given up without a reason.")

        if not self.alone:
            check_steering(self.sent, states, self.node(AUCTIONEER).auctioneer.ledger.jobs)

    def _end_recording(self) -> None:
        process, deadline_s = self.world.processes[RECORDER], self.world.now_s + RECORD_S
        while missing := self.sent.missing(self.node(RECORDER)):
            if self.world.now_s > deadline_s:
                raise Violation(f"The recorder has not: {'; '.join(missing[:4])}.")
            self.world.run(self.world.now_s + CHECK_S)
        process._call(self.node(RECORDER).end)
        self.sent.check(process)
