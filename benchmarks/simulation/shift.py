"""One simulated life of a fleet: jobs and faults by one seed, rules after every event, and all settled at the end.

Rules besides those of `simulated_fleet`: after the faults every job is finished, given up for the reasons that the
product names, or unfinished because an arm stopped in its last cycle; every wait ends, and has a stated reason; no
job that could begin waits for long while all arms are idle;
arms that are idle at home take no space; requests of people have their effect (`steering`); the recording has every
result once (`recording`).
"""

from collections.abc import Mapping
from typing import Any

from benchmarks.simulation.maintenance import LAST_DIGITS, Maintenance
from benchmarks.simulation.participants import AUCTIONEER, CLIENT, Watch, simulated_system
from benchmarks.simulation.recording import RECORDER
from benchmarks.simulation.simulated_fleet import FIRST, Fleet, random_conflicts
from benchmarks.simulation.steering import check_steering
from benchmarks.simulation.world import Process, Violation, World
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ABANDONED, SETTLED, JobSpec
from fleet.bus.protocol.operator import (
    ALL_ARMS,
    Action,
    Cancel,
    Change,
    Controlled,
    ControlRequest,
    Pause,
    Resume,
    Settle,
)
from fleet.job import reason_to_give_up
from fleet.live.leases import Timing

LONGEST_WRITES = 60
"""Changing disk calls until a planned crash, at most."""
SPEEDS = (1.0, 10.0, 60.0, 120.0, 120.0, 240.0)
"""Fleet seconds per real second."""
MEAN_JOB_S = 150.0
"""Mean duration of a job, fleet s."""
MOST_JOBS = 60
"""In one shift, about."""
CHECK_S = 2.0
"""True seconds between two checks whether all is settled."""
IDLE_S = 3.0
"""True seconds after the faults in which a job begins if one can and all arms are idle."""
RECORD_S = 120.0
"""True seconds after the last result in which the recorder has it."""
FREE_S = 60.0
"""True seconds after the last job in which the space of all arms must be free."""
SETTLE_S = 240.0
"""True seconds after the faults in which all jobs must be settled, besides the time that they take."""


class Shift(Fleet):
    """A random fleet with random jobs and faults."""

    def __init__(self, seed: int, *, trace: bool = False) -> None:
        world = World(seed, trace=trace)
        rng = self.rng = world.rng
        arms = (FIRST, *(f"arm_{i}" for i in range(1, rng.choice([2, 3, 3, 4]))))
        speed = rng.choice(SPEEDS)
        alone = rng.random() < 0.4 and len(arms) > 2
        self.job_gap_s = rng.choice([0.8, 2.0, 5.0, 20.0]) * MEAN_JOB_S / speed / len(arms)
        self.faulty_s = max(60.0, min(rng.uniform(60.0, 900.0), MOST_JOBS * self.job_gap_s))
        self.fault_gap_s = rng.choice([4.0, 10.0, 30.0, 60.0])
        self.possible = tuple(fault for fault in FAULTS if rng.random() < 0.4) or FAULTS
        """Faults of this shift: few kinds often meet what all kinds together rarely do."""
        excludes = random_conflicts(seed, rng.choice([0.0, 0.5, 0.5, 1.0]))
        self.faults: dict[str, list[str]] = {}
        self.cancelled: set[str] = set()
        """Jobs that a person has asked to cancel."""
        self.broken_off: set[str] = set()
        """Jobs of which an arm broke the last cycle off."""
        self.requests = 0
        """Number of requests of people."""
        self.work_s = 0.0
        self.healed = False
        self.jobs: list[JobSpec] = []
        timing = Timing(lease_s=rng.choice([3.0, 6.0]), max_jobs=8)
        rate_hz, capacity = rng.choice([0.5, 1.0]), rng.choice([1, 1, 2])
        options: dict[str, Any] = {"rate_hz": rate_hz, "capacity": capacity}
        super().__init__(world, arms, alone=alone, speed=speed, excludes=excludes, timing=timing, **options)
        self.maintenance = Maintenance(self, seed) if seed % 10 in LAST_DIGITS else None

    def run(self) -> None:
        """Live through faults, heal, and settle.

        Raises:
            Violation: a rule is broken.
        """
        world, rng = self.world, self.rng
        with simulated_system(world):
            world.log("shift", f"{len(self.arms)} arms, speed {self.speed:g}, {'alone' if self.alone else AUCTIONEER}")
            world.processes[CLIENT].start()
            self.watch = Watch(world, self.all_names)
            at_s = 3.0
            while at_s < self.faulty_s:
                world.at(at_s, self._submit)
                at_s += rng.expovariate(1.0 / self.job_gap_s)
            at_s = rng.expovariate(1.0 / self.fault_gap_s)
            while at_s < self.faulty_s:
                world.at(at_s, self._fault)
                at_s += rng.expovariate(1.0 / self.fault_gap_s)
            if self.maintenance is not None:
                self.maintenance.plan(self.faulty_s)
            world.run(self.faulty_s)
            heal(self)
            self._settle()
            self._check_space()
            self._end_recording()

    def departs(self, arm: str, space: str) -> None:
        """Check as a fleet does, and that the arm may leave home now."""
        super().departs(arm, space)
        if self.maintenance is not None:
            self.maintenance.check_departure(arm)

    def begins_last_cycle(self, arm: str, job: str) -> None:
        """Check as a fleet does. The arm breaks down if a person has asked to redo the job.

        It may begin again what it broke off when a person moved it home and did not stop its process: that was no
        second time, as it breaks down at once.
        """
        super().begins_last_cycle(arm, job)
        if job in self.redone and not self.healed:
            self.redone.discard(job)
            if job in self.broken_off:
                self.unsure.add(job)
                super().breaks_last_cycle_off(arm, job)
            self.world.after(0.0, _break_down, self, self.world.processes[arm])

    def breaks_last_cycle_off(self, arm: str, job: str) -> None:
        """Note that a last cycle was certainly not done."""
        super().breaks_last_cycle_off(arm, job)
        self.broken_off.add(job)

    def _after_exit(self, process: Process) -> None:
        super()._after_exit(process)
        if self.maintenance is not None and process.name in (AUCTIONEER, *self.builders):
            self.maintenance.keep_copy(process)

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
        self.submit(spec)
        self._check_reasons()

    def _check_reasons(self) -> None:
        """Check that every waiting job has a reason.

        Raises:
            Violation: one has none.
        """
        if self.alone:
            nodes = [node for name in self.arms if (node := self.node(name)) is not None]
            known = [status for node in nodes for status in node.work_source.statuses()]
        else:
            node = self.node(AUCTIONEER)
            known = [] if node is None else node.auctioneer.status()
        for status in known:
            if status.state == "waiting" and not status.reason:
                raise Violation(f"'{status.job}' waits, and nothing says why.")

    def end_faults(self) -> None:
        """End all faults; the network stays as slow as it is."""
        super().end_faults()
        self.watch.log.full = False

    @property
    def is_quiet(self) -> bool:
        """Whether no faults begin."""
        return self.healed or self.world.now_s < self.quiet_until_s

    def _fault(self) -> None:
        if self.is_quiet:
            return
        fault = self.rng.choice(self.possible)
        self.world.log("fault", fault.__name__)
        fault(self)

    # The end

    def statuses(self) -> dict[str, str]:
        """State of every job, as the participants know it."""
        if not self.alone:
            book, auctioneer = self.node(AUCTIONEER).book, self.node(AUCTIONEER).auctioneer
            past = [name for name in self.submitter.accepted if name in book.past]
            states = {name: "finished" if book.past.is_finished(name) else "given_up" for name in past}
            return states | {each.job: each.state for each in auctioneer.status()}
        states = {}
        for name in self.arms:
            known = {each.job: each.state for each in self.node(name).work_source.statuses()}
            past = self.node(name).work_source.book.past
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
            return (node := self.node(AUCTIONEER)) is not None and bool(node.book.operations.paused)
        nodes = (node for name in self.arms if (node := self.node(name)) is not None)
        return any(node.work_source.book.operations.paused for node in nodes)

    def _is_idle(self) -> bool:
        """Whether all processes are up, and no arm has a job, is away or cannot work."""
        if self._is_paused() or self.submitter.waiting or any(self.node(name) is None for name in self.names):
            return False
        nodes = [self.node(name) for name in self.arms]
        return not (self.away or any(node.executor.active or node.unfit() for node in nodes))

    def _ready(self) -> list[str]:
        """Jobs that wait for no other job; the first arm can do all of them."""
        states = self.statuses()
        waiting = (job for name, job in self.submitter.accepted.items() if states.get(name) == "waiting")
        return [job.name for job in waiting if all(states.get(before) == "finished" for before in job.after)]

    def _settle_done(self) -> None:
        """Have a person settle the unfinished jobs that were done, and see that it has its effect."""
        done = [name for name, state in self.statuses().items() if state == "unfinished" and self.finished.get(name)]
        for name in done:
            request(self, Settle(name, "done"))
        deadline_s = self.world.now_s + SETTLE_S
        while done:
            self.world.run(self.world.now_s + CHECK_S)
            if all(self.node(name) is not None for name in self.names):  # a person may restart one still
                done = [name for name, state in self.statuses().items() if name in done and state == "unfinished"]
            if done and self.world.now_s > deadline_s:
                raise Violation(f"'{done[0]}' was settled as done, and is called unfinished.")

    def _wait_until_settled(self) -> None:
        deadline_s = self.world.now_s + SETTLE_S + 3.0 * self.work_s
        idle_s = self.world.now_s
        while self._open():
            if self.world.now_s > deadline_s:
                raise Violation(f"No end after {self.world.now_s:.0f} s: {'; '.join(self._open()[:4])}.")
            if self._is_paused():
                request(self, Resume())
            for _ in range(4):
                self.world.run(self.world.now_s + CHECK_S / 4)
                if not (self._is_idle() and (jobs := self._ready())):
                    idle_s = self.world.now_s
                elif self.world.now_s > (since_s := max(idle_s, self.departed_s)) + IDLE_S:
                    idle_for_s = self.world.now_s - since_s
                    raise Violation(f"'{jobs[0]}' could begin, and all arms are idle for {idle_for_s:.1f} s.")

    def _settle(self) -> None:
        self._wait_until_settled()
        self._settle_done()
        self._wait_until_settled()
        self.unsure |= {job for builder in self.builders.values() for job in builder.unsure}
        states = self.statuses()
        # A job that was given up may be finished after all, when those that wait for it have left already.
        abandoned = self.sent.abandoned
        for name, job in self.submitter.accepted.items():
            state, done = states[name], self.finished.get(name, 0)
            if state == "finished" and done != 1:
                raise Violation(f"'{name}' is called finished, and was done {done} times.")
            if done and state != "finished" and name not in self.unsure:
                raise Violation(f"'{name}' was done, and is called {state}.")
            unsure = name in self.unsure | self.doubtful or (self.maintenance is not None and self.maintenance.ends)
            if state == "unfinished" and not unsure and not self._lacks_permission(name):
                raise Violation(f"'{name}' is unfinished, and no arm stopped in its last cycle.")
            if state == "cancelled" and name not in self.cancelled:
                raise Violation(f"'{name}' is cancelled, and nobody asked for it.")
            lost = any(before in abandoned or states.get(before) in ABANDONED for before in job.after)
            if state == "given_up" and not (
                lost or name in self.cancelled or job.expires or reason_to_give_up(self.faults.get(name, ()))
            ):
                raise Violation(f"'{name}' is given up without a reason.")

        if not self.alone:
            check_steering(self.sent, states, self.node(AUCTIONEER).auctioneer.book.jobs)

    def _lacks_permission(self, name: str) -> bool:
        """Whether the arm of a job was restarted before it received the permission to commit that it was given."""
        if self.alone:
            return False
        entry = self.node(AUCTIONEER).book.jobs[name]
        permitted = entry.award in entry.grants and entry.grants[entry.award].may_commit
        return permitted and "lacks its permission to commit" in entry.reason

    def _check_space(self) -> None:
        """Check that arms that are idle at home take no space: it would stay closed if they left now.

        Raises:
            Violation: one does.
        """
        deadline_s = self.world.now_s + FREE_S
        while taken := self._taken():
            if self.world.now_s > deadline_s:
                raise Violation(f"'{taken[0]}' is idle at home, and its space is closed.")
            self.world.run(self.world.now_s + CHECK_S)

    def _taken(self) -> list[str]:
        """Arms whose space is closed, as the participants know it; the fleet may be about to start one again."""
        if any(self.node(name) is None for name in self.names):
            return ["a process"]
        if not self.alone:
            space = self.node(AUCTIONEER).auctioneer.book.taken_space()
            return [arm for arm in self.arms if space.get(arm)] if self.submitter.accepted else []
        spaces = [self.node(name).work_source.book.taken_space() for name in self.arms]
        return [arm for arm in self.arms if any(space[arm] for space in spaces)]

    def _end_recording(self) -> None:
        process, deadline_s = self.world.processes[RECORDER], self.world.now_s + RECORD_S
        while missing := self.sent.missing(self.node(RECORDER)):
            if self.world.now_s > deadline_s:
                raise Violation(f"The recorder has not: {'; '.join(missing[:4])}.")
            self.world.run(self.world.now_s + CHECK_S)
        process._call(self.node(RECORDER).end)
        self.sent.check(process)


def _one(shift: Shift) -> Process:
    return shift.world.processes[shift.rng.choice(shift.names)]


def _arm(shift: Shift, *, busy: bool = False) -> Process:
    """A process of an arm; with `busy`, one with a job if there is one, preferably in its last cycle."""
    names = list(shift.arms)
    if busy:
        held = {name: shift.node(name).executor.active for name in names if shift.node(name) is not None}
        names = (
            [name for name, active in held.items() if any(each.may_commit for each in active)]
            or [name for name, active in held.items() if active]
            or names
        )
    return shift.world.processes[shift.rng.choice(names)]


def kill(shift: Shift) -> None:
    """Kill any process."""
    _one(shift).kill("is killed")


def kill_at_work(shift: Shift) -> None:
    """Kill an arm at work."""
    _arm(shift, busy=True).kill("is killed at work")


def lose_power(shift: Shift) -> None:
    """Cut the power of any machine."""
    _one(shift).kill("loses power", power=True)


def lose_rack(shift: Shift) -> None:
    """Kill some processes at once, some of them by a loss of power."""
    for name in shift.names:
        if shift.rng.random() < 0.5:
            shift.world.processes[name].kill("is killed with others", power=shift.rng.random() < 0.5)


def crash_at_write(shift: Shift) -> None:
    """Let a process crash in one of its next disk calls."""
    disk = _one(shift).disk
    disk.power, disk.crash_in = shift.rng.random() < 0.5, shift.rng.randint(1, LONGEST_WRITES)


def fill_disk(shift: Shift) -> None:
    """Fill a disk for some time."""
    disk = _one(shift).disk
    disk.full = True
    shift.world.after(shift.rng.uniform(0.5, 30.0), setattr, disk, "full", False)


def fill_log_disk(shift: Shift) -> None:
    """Fill the disk of the logs for some time."""
    shift.watch.log.full = True
    shift.world.after(shift.rng.uniform(0.5, 30.0), setattr, shift.watch.log, "full", False)


def break_disk(shift: Shift) -> None:
    """Let one of the next writes fail."""
    _one(shift).disk.broken = shift.rng.randint(1, 10)


def stop(shift: Shift) -> None:
    """Stop a process for some time."""
    _one(shift).pause(shift.rng.choice([0.5, 2.5, 3.0, 6.1, 20.0]) * shift.rng.uniform(0.9, 1.1))


def stop_at_work(shift: Shift) -> None:
    """Stop an arm at work for some time, and maybe kill some others."""
    arm = _arm(shift, busy=True)
    _kill_others(shift, arm)
    arm.pause(shift.rng.choice([0.5, 2.5, 3.0, 6.1, 20.0]) * shift.rng.uniform(0.9, 1.1))


def cut(shift: Shift) -> None:
    """Cut the network in two groups for some time."""
    group = {name: shift.rng.randrange(2) for name in shift.world.processes}
    _cut(shift, group, shift.rng.choice([1.0, 5.0, 10.0, 40.0]))


def cut_off_at_work(shift: Shift) -> None:
    """Cut one arm at work off for some time, and maybe kill some others."""
    arm = _arm(shift, busy=True)
    _cut(shift, {arm.name: 1}, shift.rng.choice([3.0, 7.0, 15.0, 40.0]))
    _kill_others(shift, arm)


def _kill_others(shift: Shift, arm: Process) -> None:
    share = shift.rng.choice([0.0, 0.0, 0.5, 1.0])
    for name in shift.names:
        if name != arm.name and shift.rng.random() < share:
            shift.world.processes[name].kill("is killed meanwhile")


def swizzle(shift: Shift) -> None:
    """Cut processes off one after another, and connect them again in another order, as FoundationDB does."""
    names = [name for name in shift.world.processes if shift.rng.random() < 0.6]
    after_s = 0.0
    for group in (1, 0):
        shift.rng.shuffle(names)
        for number, name in enumerate(names):
            shift.world.after(after_s, _isolate, shift, name, group * (number + 1))
            after_s += shift.rng.uniform(0.0, 4.0)


def _isolate(shift: Shift, name: str, group: int) -> None:
    if shift.is_quiet:
        return
    groups = {process.name: process.group for process in shift.world.processes.values()} | {name: group}
    shift.world.split({name: group for name, group in groups.items() if group})


def lose_router(shift: Shift) -> None:
    """Let nobody reach anybody for some time."""
    _cut(shift, {name: i for i, name in enumerate(shift.world.processes)}, shift.rng.choice([0.5, 3.0, 10.0]))


def _cut(shift: Shift, group: dict[str, int], seconds: float) -> None:
    if shift.is_quiet:
        return
    shift.world.split(group)
    shift.world.after(seconds * shift.rng.uniform(0.7, 1.3), shift.world.split, {})


def lose_messages(shift: Shift) -> None:
    """Lose, double and delay messages for some time."""
    world, rng = shift.world, shift.rng
    world.loss, world.doubling = rng.choice([0.0, 0.05, 0.3, 0.7]), rng.choice([0.0, 0.05, 0.3])
    world.slow = rng.choice([1.0, 3.0, 30.0])
    world.after(rng.uniform(1.0, 30.0), world.calm)


def overheat(shift: Shift) -> None:
    """Let an arm fault."""
    process = _arm(shift, busy=True)
    node: Any = process.node
    machine = shift.builders[process.name].machine
    if node is not None and machine is not None:
        if node.executor.active:
            shift.faults.setdefault(node.executor.active[0].job, []).append(process.name)
        machine.fail(shift.rng.uniform(1.0, 20.0) * shift.speed)


def break_machine(shift: Shift) -> None:
    """Kill an arm that does not start again for some time; a person moves it home and frees its space."""
    _break_down(shift, _arm(shift, busy=True))


def _break_down(shift: Shift, process: Process) -> None:
    process.broken = True
    process.kill("breaks down")
    shift.world.after(shift.rng.uniform(3.0, 15.0), clear, shift, process.name)
    shift.world.after(shift.rng.uniform(20.0, 60.0), shift.repair, process)


def move_home(shift: Shift) -> None:
    """Cut a working arm off; a person moves it home and frees its space, and its process lives on."""
    process = _arm(shift, busy=True)
    _cut(shift, {process.name: 1}, shift.rng.choice([10.0, 20.0]))
    shift.world.after(shift.rng.uniform(4.0, 12.0), clear, shift, process.name)


def clear(shift: Shift, arm: str) -> None:
    """Have a person move an arm home and free its space, unless the person sees on the bus that it is there."""
    process = shift.world.processes[arm]
    if not process.up or process.group:
        shift.clear(arm)


def steer(shift: Shift) -> None:
    """Have a person cancel, settle or change a job, or pause arms; a person knows what was done."""
    if not shift.submitter.accepted:
        return
    node: Any = shift.node(AUCTIONEER) if AUCTIONEER in shift.names else None
    entries = {} if node is None else node.auctioneer.book.jobs
    unfinished = [name for name, entry in entries.items() if entry.state == "unfinished"]  # a person sees them
    job = shift.rng.choice(unfinished or list(shift.submitter.accepted))
    arm = shift.rng.choice([ALL_ARMS, *shift.arms])
    actions: list[Action] = [Cancel(job), Change(job, value=shift.rng.random()), Pause(arm), Resume()]
    if shift.finished.get(job):
        actions.append(Settle(job, "done"))
    elif not shift.begun.get(job):
        actions.append(Settle(job, "redo"))
    request(shift, shift.rng.choice(actions))


def redo_early(shift: Shift, tries: int = 100) -> None:
    """Cut off an arm that may begin the last cycle of a job, and has not; a person asks to redo the job meanwhile."""
    nodes = [(name, node) for name in shift.arms if (node := shift.node(name)) is not None]
    ready = [(name, each.job) for name, node in nodes for each in node.executor.active if each.may_commit]
    if early := [(name, job) for name, job in ready if not shift.begun.get(job)]:
        name, job = early[0]
        _cut(shift, {name: 1}, 14.0)
        shift.world.after(9.0, request, shift, Settle(job, "redo"))
    elif tries:
        shift.world.after(0.2, redo_early, shift, tries - 1)


def request(shift: Shift, action: Action) -> None:
    """Send a request of a person, again until there is a reply or the fleet is healed; and sometimes once more.

    A job is not to be redone once its last cycle was begun.
    """
    redone = action.job if isinstance(action, Settle) and action.outcome == "redo" else ""
    if shift.begun.get(redone):
        return
    if isinstance(action, Cancel):
        shift.cancelled.add(action.job)
    elif redone:
        shift.redone.add(redone)
    shift.requests += 1
    message = ControlRequest(f"request {shift.requests}", action, "a person")
    shift.world.log("person", f"requests {action}")
    link: Any = shift.world.processes[CLIENT].client

    def send() -> None:
        if shift.begun.get(redone):
            return
        link.query(keys.of_jobs("f", "control"), message, Controlled, done, timeout_s=2.0)

    def done(replies: Any) -> None:
        if not (replies.messages or any(replies.refused.values()) or shift.healed):
            send()

    send()
    if not shift.healed and shift.rng.random() < 0.3:
        shift.world.after(shift.rng.uniform(0.0, 30.0), send)


def stop_politely(shift: Shift) -> None:
    """Stop an arm at work as by SIGTERM: its process retires, and exits soon after."""
    shift.retire(_arm(shift, busy=True))


def kill_supervisor(shift: Shift) -> None:
    """Kill the supervisor, and with it all processes."""
    if shift.rng.random() < 0.3:
        shift.watch.kill()


FAULTS = (
    *(kill, kill_at_work, lose_power, crash_at_write, crash_at_write, fill_disk, break_disk, stop, stop_at_work, cut),
    *(cut_off_at_work, cut_off_at_work, lose_router, lose_messages, lose_messages, overheat, break_machine, move_home),
    *(kill_supervisor, fill_log_disk, lose_rack, swizzle, steer, steer, redo_early),
    *(stop_politely, stop_politely),
)


def heal(shift: Shift) -> None:
    """End all faults."""
    shift.healed = True
    shift.end_faults()
    shift.world.log("shift", "heals")
