"""A simulated fleet: its processes, what its arms do, and the rules that hold at every moment.

The last cycle of a job is done at most once; no two arms have one job; no two arms are away from home on plans that
exclude each other; an accepted job stays known; whoever has granted an award keeps the grant until the lease of the arm
ends.
"""

import math
from collections.abc import Mapping
from functools import partial
from random import Random
from typing import Any

from benchmarks.simulation.bus import Bus
from benchmarks.simulation.participants import AUCTIONEER, CLIENT, ArmProcess, Submitter, auctioneer_process
from benchmarks.simulation.recording import RECORDER, Sent, recorder_process
from benchmarks.simulation.world import Process, Violation, World
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec
from fleet.bus.protocol.operator import Cleared, ClearRequest
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.auction.rounds import Allocate, Assignment
from fleet.live.consensus.participant import Choose, Membership
from fleet.live.leases import Timing
from fleet.live.space import ANYWHERE, Excludes
from fleet.robot import ThermalLimits
from scenarios.live.arm import RETIRE_S

FIRST = "arm_0"
"""Can do every job."""


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


class Fleet:
    """Arms, maybe an auctioneer, a recorder and a client, each a process of one world.

    Attributes:
        alone: Without an auctioneer.
        begun: How many times the last cycle of a job was begun and not broken off.
        finished: How many times the last cycle of a job ended.
        away: Plan of each arm that is away from home.
        departed_s: True second at which an arm has left home last.
        unsure: Jobs whose arm stopped in the last cycle.
        sent: What the participants have published.
        redone: Jobs that a person has asked to redo before their last cycle was begun.
        quiet_until_s: True second up to which no faults begin.
        forgetful_until_s: True second up to which an auctioneer may lack accepted jobs, which are submitted again.
        doubtful: Jobs with permission to commit of which lost journals may have been the only record.
    """

    def __init__(
        self,
        world: World,
        arms: tuple[str, ...],
        *,
        alone: bool,
        speed: float,
        excludes: Excludes,
        timing: Timing,
        rate_hz: float = 1.0,
        capacity: int = 1,
        allocate: Allocate = first_come,
        choose: Choose = first_legal,
        **more: Any,
    ) -> None:
        """Set up the processes; `more` is of the membership of arms without an auctioneer."""
        self.world, self.arms, self.alone, self.speed, self.excludes = world, arms, alone, speed, excludes
        self.begun: dict[str, int] = {}
        self.finished: dict[str, int] = {}
        self.away: dict[str, str] = {}
        self.departed_s = 0.0
        self.unsure: set[str] = set()
        self.redone: set[str] = set()
        self.doubtful: set[str] = set()
        self.quiet_until_s = self.forgetful_until_s = -math.inf
        self._excused: set[tuple[str, str]] = set()
        """Granters that have lost their journals, with the awards of that time."""
        membership: Membership | None = None
        if alone:
            live = LiveFleet(arms=arms, limits=ThermalLimits(warning_c=80.0, error_c=95.0))
            membership = Membership(fleet=live, choose=choose, slots=4, excludes=excludes, timing=timing, **more)
        world.bus = Bus(world)
        self.builders = {name: ArmProcess(self, FIRST, speed, rate_hz, capacity, membership) for name in arms}
        for name in arms:
            Process(world, name, self.builders[name])
        self._auctioneer = partial(auctioneer_process, speed=speed, allocate=allocate, timing=timing, excludes=excludes)
        if not alone:
            Process(world, AUCTIONEER, self.auctioneer_builder())
        self.sent = Sent(world.bus)
        Process(world, RECORDER, recorder_process(world.rng.choice([5.0, 20.0, 60.0])))
        self.names = self.all_names = tuple(world.processes)
        """Processes of the fleet, and those with absent arms; the client is not one of them."""
        Process(world, CLIENT, Submitter)
        world.after_run, world.after_exit = self._after_run, self._after_exit

    @property
    def submitter(self) -> Submitter:
        node: Any = self.world.processes[CLIENT].node
        return node

    def node(self, name: str) -> Any:
        """Node of a process; None while it is down."""
        return self.world.processes[name].node

    def auctioneer_builder(self, **options: Any) -> Any:
        """Return what starts an auctioneer for the present arms."""
        return self._auctioneer(self.arms, **options)

    def build_auctioneer(self, **options: Any) -> None:
        """Have the next start of the auctioneer be with these options, for the present arms."""
        self.world.processes[AUCTIONEER]._build = self.auctioneer_builder(**options)

    def end_faults(self) -> None:
        """End all faults; the processes that are down start again."""
        world = self.world
        world.calm()
        world.split({})
        for process in world.processes.values():
            process.disk.full, process.disk.broken, process.disk.crash_in = False, 0, 0
            self.repair(process)
            process._resume(process.boot)

    def repair(self, process: Process) -> None:
        """Let a broken machine start again, unless its arm has left."""
        process.broken = process.name in self.builders and process.name not in self.arms

    def retire(self, process: Process) -> None:
        """Stop an arm as by SIGTERM: its process retires, and exits soon after."""
        node: Any = process.node
        if node is not None and not process.paused:
            process._call(lambda: node.retire(process.real_s))
            self.world.after(RETIRE_S, self._exit, process, process.boot)

    def _exit(self, process: Process, boot: int) -> None:
        if process.boot == boot:
            process.kill("exits")

    def doubt(self, arm: str) -> None:
        """Note that the jobs whose last cycle an arm may have done, and has not reported, may end as unfinished."""
        if (node := self.node(arm)) is not None:
            self.unsure |= {active.job for active in node.executor.active if active.may_commit}
            self.unsure |= {report.job for report, _ in node.executor.pending_reports()}

    def forget(self, name: str) -> None:
        """Note that a participant is about to lose what its journals have."""
        nodes = {arm: node for arm in self.arms if (node := self.node(arm)) is not None}
        self._excused |= {(name, each.award.award) for node in nodes.values() for each in node.executor.active}
        central = None if self.alone else self.node(AUCTIONEER)
        self._excused |= {(name, award) for award in central.book.open} if central else set()  # an award may be late
        for source in [node.work_source for node in nodes.values()] if self.alone else [central] if central else []:
            jobs, accepted = source.book.jobs.items(), self.submitter.accepted
            self.doubtful |= {job for job, entry in jobs if any(grant.may_commit for grant in entry.grants.values())}
            for job in [job for job in accepted if self.alone and job in source.book.past]:
                del accepted[job]  # a history lacks jobs that have left the book
        self.sent.renumber(name)
        if name in self.builders:
            self.doubt(name)

    def submit(self, job: JobSpec) -> None:
        """Have the client submit a job until there is a reply."""
        self.submitter.waiting.append(job)
        self.world.processes[CLIENT].wake(self.world.now_s)

    def clear(self, arm: str) -> None:
        """Have a person move an absent arm home, and free its space unless that is refused."""
        self.move_home(arm)
        link: Any = self.world.processes[CLIENT].client
        link.query(keys.of_jobs("f", "clear"), ClearRequest(arm, "a person"), Cleared, lambda _: None, timeout_s=2.0)

    def move_home(self, arm: str) -> None:
        """Have a person move an arm home; its process lives on."""
        process, node, machine = self.world.processes[arm], self.node(arm), self.builders[arm].machine
        self.world.log("person", f"moves '{arm}' home, and asks to free its space")
        if node is not None and machine is not None:
            self.unsure |= {active.job for active in node.executor.active if active.may_commit}
            machine.move_home()
            machine.set_time(node.clock.now_s(process.real_s))  # it does nothing in the time before, either
        self.is_home(arm)

    # Deeds of the arms

    def departs(self, arm: str, space: str) -> None:
        """Note that an arm leaves home, and check that no other arm is in its way."""
        self.world.log(arm, f"leaves home on {space}")
        for other, taken in self.away.items():
            if other != arm and self.excludes(arm, space, other, taken):
                raise Violation(f"'{arm}' leaves home on {space} while '{other}' is away on {taken}.")
        self.away[arm], self.departed_s = space, self.world.now_s

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
                if process.real_s < active.lease_end_s:
                    self._check_granters(process, active)
                if active.may_commit or process.real_s < active.lease_end_s:
                    if active.job in holders:
                        raise Violation(f"'{name}' and '{holders[active.job]}' both have '{active.job}'.")
                    holders[active.job] = name

    def _check_granters(self, holder: Process, active: Any) -> None:
        name, ends_s = active.award.award, {AUCTIONEER: active.lease_end_s}
        if self.alone:
            vote = self.node(holder.name).work_source.participant.claimant._votes.get(name)
            ends_s = {arm: asked_s + active.lease_s for arm, asked_s in vote.granted_s.items()} if vote else {}
        for granter, end_s in ends_s.items():
            node = self.node(granter) if holder.real_s < end_s else None
            source = node.work_source if self.alone and node is not None else node
            if source is None or name in source.book.open:
                continue
            if (granter, name) not in self._excused or (self.alone and source._joined):
                raise Violation(f"'{granter}' has no grant of '{name}', which '{holder.name}' still leases.")

    def _check_known(self) -> None:
        book = self.node(AUCTIONEER).book
        if len(self.submitter.accepted) > len(book.jobs) + len(book.past):
            lost = [name for name in self.submitter.accepted if name not in book.jobs and name not in book.past]
            if self.world.now_s > self.forgetful_until_s:
                raise Violation(f"The auctioneer does not know '{lost[0]}', which it accepted.")
            for name in lost:  # its client sees that
                self.submit(self.submitter.accepted.pop(name))

    def _after_exit(self, process: Process) -> None:
        if process.name in self.builders:
            machine = self.builders[process.name].machine
            if machine is not None and machine.job in self.begun and self.begun[machine.job]:
                self.unsure.add(machine.job)
