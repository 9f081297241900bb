"""The processes of a simulated fleet: the real participants on a simulated bus, disk and machine.

Started and restarted by the real `Supervisor`, whose processes and threads are simulated here.
"""

import math
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from types import SimpleNamespace
from typing import Any

import apsw

from benchmarks.simulation.bus import SimulatedClient
from benchmarks.simulation.disk import Disk, DiskPath, SimulatedConnection, SqliteFiles
from benchmarks.simulation.machine import Deeds, SimulatedArm, SimulatedEstimator
from benchmarks.simulation.recording import simulated_files
from benchmarks.simulation.world import Process, World
from fleet.breaks import Break
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec, Submission, SubmissionReply
from fleet.errors import BusError
from fleet.live import book as book_module
from fleet.live import journal as journal_module
from fleet.live import supervisor as supervisor_module
from fleet.live.arm import node as arm_module
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardExecutor, ExecutorConfig
from fleet.live.arm.node import ArmConfig, ArmNode, AuctioneerClient
from fleet.live.auction.node import AuctionNode
from fleet.live.auction.rounds import Allocate
from fleet.live.consensus.node import ConsensusNode
from fleet.live.consensus.participant import Membership
from fleet.live.journal import CompactingJournal, Journal
from fleet.live.leases import Timing
from fleet.live.records import BookRecord
from fleet.live.space import Excludes
from fleet.live.supervisor import Part, Supervisor
from scenarios.live.arm import fleet_clock, restart_history

AUCTIONEER, CLIENT = "auctioneer", "client"
RETRY_S = 1.0
"""Real seconds between two submissions of a job without a reply."""


def _journal(process: Process, name: str, kind: Any) -> Any:
    path: Any = process.disk.path(name)
    return Journal[Any](path, kind).open()


class ArmProcess:
    """Starts one arm.

    Attributes:
        machine: Its machine since the last start.
        unsure: Jobs that it returned at a start without knowing whether the last cycle was done.
        new_epoch: Whether it begins without the journals that its peers know.
        breaks: Its breaks.
        first_number: Number after which the claims of its last start are counted; None without an auctioneer before.
    """

    def __init__(
        self, deeds: Deeds, first: str, speed: float, rate_hz: float, capacity: int, membership: Membership | None
    ) -> None:
        self._deeds, self._first, self._speed, self._rate_hz = deeds, first, speed, rate_hz
        self._capacity, self.membership = capacity, membership
        self.machine: SimulatedArm | None = None
        self.unsure: set[str] = set()
        self.new_epoch = False
        self.breaks: tuple[Break, ...] = ()
        self.first_number: int | None = None
        self._kept: ArmHistory | None = None

    @property
    def epoch(self) -> str:
        """Epoch that it knows with an auctioneer, since its last start."""
        return "" if self._kept is None else self._kept.epoch

    def __call__(self, process: Process) -> ArmNode:
        self.first_number = None
        link: Any = SimulatedClient(process)
        name = process.name
        journal = _journal(process, "awards", ArmRecord)
        clock = fleet_clock(link, self._speed)
        if link.tokens(keys.of_arm(link.fleet, name, "alive")):
            raise BusError(f"'{name}' is already running.")
        history = restart_history(journal, name, clock.now_s(process.real_s))
        self.unsure |= {report.job for _, report in history.reports.values() if report.unsure}
        config = ExecutorConfig(capacity=self._capacity)
        kept = self._kept = ArmHistory().replay(history.compact())
        keep = CompactingJournal(journal, kept).append
        executor = AwardExecutor(name, keep, history, nonce=f"{process.boot}", config=config)
        self._deeds.is_home(name)  # a person moves it home before it is started
        self.machine = SimulatedArm(name, self._deeds, clock.now_s(process.real_s))
        body: Any = self.machine
        estimator: Any = SimulatedEstimator(name, self._first)
        settings = ArmConfig(warning_c=80.0, rate_hz=self._rate_hz, boot=history.boot, breaks=self.breaks)
        if self.membership is None:
            return ArmNode(link, body, executor, estimator, clock, settings, partial(AuctioneerClient, history=kept))
        grants, membership = _journal(process, "grants", BookRecord), self.membership

        def join(arm: ArmNode) -> ConsensusNode:
            node = ConsensusNode(arm, membership, grants, boot=history.boot, new_epoch=self.new_epoch)
            self.first_number = node.participant._number
            return node

        return ArmNode(link, body, executor, estimator, clock, settings, join)


def auctioneer_process(
    arms: tuple[str, ...],
    speed: float,
    allocate: Allocate,
    timing: Timing,
    excludes: Excludes,
    name: str = AUCTIONEER,
    **more: Any,
) -> Callable[[Process], AuctionNode]:
    """Return what starts the auctioneer, with `more` arguments of `AuctionNode`."""

    def build(process: Process) -> AuctionNode:
        link: Any = SimulatedClient(process)
        journal = _journal(process, "auction", BookRecord)
        return AuctionNode(
            link, name, journal, allocate=allocate, speed=speed, timing=timing, arms=arms, excludes=excludes, **more
        )

    return build


class Submitter:
    """A client that submits each job until it is answered.

    Attributes:
        waiting: Jobs without an answer, oldest first.
        accepted: Accepted jobs by name.
        rejected: Reasons for the others, by name.
    """

    def __init__(self, process: Process) -> None:
        self._process, self._link = process, SimulatedClient(process)
        self.waiting: list[JobSpec] = []
        self.accepted: dict[str, JobSpec] = {}
        self.rejected: dict[str, str] = {}
        self._asked, self._retry_s = False, -math.inf

    def serve(self, until_s: float) -> None:
        """Submit what is due."""
        due = bool(self.waiting) and not self._asked
        self._link.serve(min(until_s, self._retry_s) if due else until_s)
        if self.waiting and not self._asked and self._process.real_s >= self._retry_s:
            self._asked = True
            key, request = keys.of_jobs("f", "submit"), Submission((self.waiting[0],), "client")
            self._link.query(key, request, SubmissionReply, self._done, timeout_s=2.0)

    def _done(self, replies: Any) -> None:
        self._asked, self._retry_s = False, self._process.real_s + RETRY_S
        for reply in replies.messages.values():
            for admission in reply.jobs:
                job = next((job for job in self.waiting if job.name == admission.job), None)
                if job is not None:
                    self.waiting.remove(job)
                    self._retry_s = self._process.real_s
                    if admission.accepted:
                        self.accepted[job.name] = job
                        self._process.world.log(self._process.name, f"'{job.name}' is accepted")
                    else:
                        self.rejected[job.name] = admission.reason


# The supervisor


class Popen:
    """A started process, as `subprocess.Popen`."""

    def __init__(self, world: World, argv: tuple[str, ...], **options: Any) -> None:
        self.pid, self.returncode = world.rng.getrandbits(16), None
        self.stdout: Any = nullcontext(["ready\n"])
        self._process, self._world, self.threads = world.processes[argv[0]], world, list["Thread"]()
        world.after(world.rng.uniform(0.05, 0.8), self._start)

    def _start(self) -> None:
        if self.returncode is None:
            self._process.on_exit = self._exit
            self._process.start()

    def _exit(self, code: int) -> None:
        if self.returncode is None:
            self.returncode: int | None = code
            for thread in self.threads:
                thread.run()

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        return self.returncode

    def kill(self) -> None:
        self._process.kill("is killed")
        self._exit(-9)

    terminate = kill

    def send_signal(self, number: int) -> None:
        """Do nothing: only SIGCONT is sent."""


class Thread:
    """A thread that reads the output of a process, or awaits its end: it runs when the process has ended."""

    def __init__(self, target: Callable[..., None], args: tuple[Any, ...], daemon: bool = True) -> None:
        self._call = lambda: target(*args)
        args[1].threads.append(self)

    def run(self) -> None:
        """Run to the end."""
        with suppress(OSError):  # an error ends a thread, and nothing else
            self._call()

    def start(self) -> None:
        """Do nothing."""

    def join(self, timeout: float | None = None) -> None:
        """Do nothing."""


class Watch:
    """The supervisor of a fleet, which may be killed and started again."""

    POLL_S = 0.5

    def __init__(self, world: World, names: tuple[str, ...]) -> None:
        self._world, self._names = world, names
        self._supervisor: Supervisor | None = None
        self.log = Disk(world.rng)
        self.start()
        self._poll()

    def start(self) -> None:
        """Start all processes."""
        folder: Any = DiskPath(self.log, "logs")
        self._supervisor = Supervisor(folder)
        for name in self._names:
            self._supervisor.start(Part(name=name, argv=(name,)))

    def kill(self) -> None:
        """Kill it, and with it all of its processes; start it again later."""
        supervisor, self._supervisor = self._supervisor, None
        if supervisor is not None:
            self._world.log("supervisor", "is killed")
            for running in supervisor._parts.values():
                if running.process is not None:
                    running.process.kill()
            self._world.after(self._world.rng.uniform(1.0, 10.0), self.start)

    def _poll(self) -> None:
        if self._supervisor is not None:
            self._supervisor.poll()
        self._world.after(self.POLL_S, self._poll)


@contextmanager
def simulated_system(world: World) -> Iterator[None]:
    """Have the product use the disks and processes of a world."""
    replaced: list[tuple[Any, str, Any]] = []

    def replace(module: Any, name: str, value: Any) -> None:
        replaced.append((module, name, module.__dict__.get(name)))
        setattr(module, name, value)

    def disk() -> Any:
        assert world.running is not None
        return world.running.disk

    def connection(name: str) -> SimulatedConnection:
        return SimulatedConnection(files, disk(), name)

    files = SqliteFiles()
    replace(journal_module, "apsw", SimpleNamespace(**{**vars(apsw), "Connection": connection}))
    replace(
        supervisor_module,
        "subprocess",
        SimpleNamespace(**{**vars(subprocess), "Popen": lambda argv, **_: Popen(world, argv)}),
    )
    replace(supervisor_module, "threading", SimpleNamespace(Thread=Thread, Event=threading.Event))
    replace(journal_module, "COMPACT_BYTES", 5_000)  # so that both happen in a short shift
    replace(book_module, "MAX_SETTLED", 5)
    replace(arm_module, "space_name", lambda plan: plan.space)
    try:
        with files, world.installed(), simulated_files(disk):
            yield
    finally:
        for module, name, value in reversed(replaced):
            if value is None:
                delattr(module, name)
            else:
                setattr(module, name, value)
