"""A fleet in simulated time: tests submit, steer, cut and kill, and read what the participants report."""

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.simulation.participants import AUCTIONEER, CLIENT, auctioneer_process
from benchmarks.simulation.simulated_fleet import Fleet, first_come
from benchmarks.simulation.world import Process, World
from fleet.bus.client import NoReply
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Admission, JobSpec, JobStatus, Status, StatusRequest, Submission, SubmissionReply
from fleet.bus.protocol.operator import Action, Cleared, ClearRequest, Controlled, ControlRequest
from fleet.errors import Refused
from fleet.live.leases import Timing
from fleet.live.space import Excludes, no_conflicts

TIMING = Timing(lease_s=3.0, margin_s=0.05, window_s=0.3, ack_s=0.5, pause_s=(0.2, 1.0), max_jobs=8)
SPEED = 10.0
"""Fleet seconds per real second: a way takes up to a second, and a cycle, too, besides the dwell of the job."""
LONG = {"dwell_s": 120.0}
"""Of a job whose cycle is longer than several leases."""


def job(name: str, repetitions: int = 100, *, place: str = "", **more: Any) -> JobSpec:
    """A job at a place of its own."""
    return JobSpec(name=name, kind="hold", places=(place or f"place of {name}",), repetitions=repetitions, **more)


class SimulatedFleet(Fleet):
    """A fleet with an auctioneer, or without one; every started arm is on the bus."""

    def __init__(
        self,
        alone: bool,
        arms: int = 3,
        *,
        excludes: Excludes = no_conflicts,
        seed: int = 0,
        trace: bool = False,
        **options: Any,
    ) -> None:
        names = tuple(f"arm_{number}" for number in range(arms))
        options = {"speed": SPEED, "timing": TIMING, **options}
        super().__init__(World(seed, trace=trace), names, alone=alone, excludes=excludes, **options)
        self._requests = 0
        self.published: list[Any] = []
        """All published messages, in order."""
        record = self.world.bus.on_publish

        def add(publisher: Any, message: Any) -> None:
            self.published.append(message)
            record(publisher, message)

        self.world.bus.on_publish = add

    def start(self, *names: str) -> None:
        """Start these processes, by default all; and wait until the fleet replies."""
        self.world.processes[CLIENT].start()
        for name in names or [name for name in self.names if name != "recorder"]:
            self.world.processes[name].start()
        self.run(2.0)

    def restart(self, *names: str) -> None:
        """Kill and start processes, by default those that allocate jobs."""
        for name in names or (self.arms if self.alone else (AUCTIONEER,)):
            self.world.processes[name].kill("is killed")
            self.world.processes[name].start()

    def auctioneer(self, process: str = AUCTIONEER, **options: Any) -> None:
        """Start an auctioneer, in place of one that runs in this process, with these options of `AuctionNode`."""
        build = auctioneer_process(self.arms, self.speed, first_come, TIMING, self.excludes, **options)
        if process in self.world.processes:
            self.world.processes[process].kill("is killed")
            self.world.processes[process]._build = build
        else:
            Process(self.world, process, build)
        self.world.processes[process].start()

    def logged(self, part: str) -> list[str]:
        """Lines of the trace with this part, from there on."""
        return [line[line.index(part) :] for line in self.world.trace or () if part in line]

    def stop(self, arm: str) -> None:
        """Stop an arm as by SIGSTOP, for ever."""
        self.world.processes[arm].pause(1e9)

    def cut(self, *arms: str) -> None:
        """Cut arms off from all others; without any, heal the network."""
        self.world.split(dict.fromkeys(arms, 1))

    def run(self, seconds: float) -> None:
        """Run for some true seconds."""
        self.world.run(self.world.now_s + seconds)

    def until(self, condition: Callable[[], bool], patience_s: float = 60.0) -> None:
        """Run until a condition holds."""
        for _ in range(round(patience_s / 0.1)):
            if condition():
                return
            self.run(0.1)
        raise AssertionError("the condition was never met")

    # Requests

    def ask(self, key: str, request: Any, kind: Any) -> Any:
        """Return the first reply to a request of the client, which is repeated until there is one.

        Raises:
            Refused: a participant refuses.
        """
        client: Any = self.world.processes[CLIENT].client
        for _ in range(20):
            replies: list[Any] = []
            client.query(key, request, kind, replies.append, timeout_s=1.0)
            self.world.run(self.world.now_s + 10.0, partial(bool, replies))
            try:
                return replies[0].first(key)
            except NoReply:
                self.run(0.5)
        raise AssertionError(f"no reply under {key}")

    def submit(self, *jobs: JobSpec) -> tuple[Admission, ...]:
        """Submit jobs in one request."""
        reply = self.ask(keys.of_jobs("f", "submit"), Submission(jobs, "bob"), SubmissionReply)
        accepted = {each.job for each in reply.jobs if each.accepted}
        self.submitter.accepted.update({job.name: job for job in jobs if job.name in accepted})
        return reply.jobs

    def control(self, action: Action, name: str = "", by: str = "ann") -> Controlled:
        """Request what a person may; the request has a new name unless one is given."""
        self._requests += 1
        request = ControlRequest(name or f"request {self._requests}", action, by)
        return self.ask(keys.of_jobs("f", "control"), request, Controlled)

    def free_space(self, arm: str) -> Cleared:
        """Request to free the space of an arm."""
        return self.ask(keys.of_jobs("f", "clear"), ClearRequest(arm, "ann"), Cleared)

    def status(self, name: str) -> JobStatus:
        """Status of a job, as the fleet replies."""
        (status,) = self.ask(keys.of_jobs("f", "status"), StatusRequest((name,)), Status).jobs
        return status

    # What the participants know and do

    def known(self) -> list[dict[str, JobStatus]]:
        """Statuses by job of every running participant that allocates jobs."""
        world = self.world
        out: list[dict[str, JobStatus]] = []
        for process in map(world.processes.__getitem__, self.arms if self.alone else (AUCTIONEER,)):
            if process.up and process.node is not None:
                world.running = process
                node: Any = process.node
                statuses = node.work_source.statuses() if self.alone else node.auctioneer.status()
                out.append({status.job: status for status in statuses})
                world.running = None
        return out

    def states(self, name: str) -> set[str]:
        """State of a job, as each participant knows it."""
        return {known[name].state for known in self.known() if name in known}

    def is_everywhere(self, name: str, state: str) -> bool:
        """Whether all participants know a job in this state."""
        known = self.known()
        return bool(known) and all(name in each and each[name].state == state for each in known)

    def holder(self, name: str) -> str:
        """Arm that has a job and may work on it; "" for none."""
        for arm in self.arms:
            node, process = self.node(arm), self.world.processes[arm]
            if node is not None:
                for active in node.executor.active:
                    if active.job == name and (active.may_commit or process.real_s < active.lease_end_s):
                        return arm
        return ""

    def intercept(self, name: str, topic: str, handle: Callable[[Any, Callable[[Any], Any]], Any]) -> None:
        """Have `handle(request, reply_to)` reply to the requests of a topic instead of a process, until it restarts."""
        client = self.world.processes[name].client
        for number, (key, reply_to) in enumerate(client.queryables):
            if keys.parse(key).topic == topic:
                client.queryables[number] = key, partial(handle, reply_to=reply_to)

    def lose(self, topic: str) -> list[Any]:
        """Lose all requests of a topic from now on; return the list to which they are added."""
        lost: list[Any] = []
        send = self.world.send

        def send_others(sender: Process, receiver: Process, what: Callable[..., None], *arguments: Any) -> None:
            query: Any = getattr(what, "__self__", None)
            if what.__name__ == "answer" and f"/{topic}" in query.key:
                lost.append(query.request)
            else:
                send(sender, receiver, what, *arguments)

        self.world.send = send_others
        return lost

    def call(self, name: str, function: Callable[[], object]) -> None:
        """Call a function as a process."""
        self.world.processes[name]._call(function)

    def messages(self, kind: type) -> list[Any]:
        """Published messages of a kind, in order."""
        return [message for message in self.published if isinstance(message, kind)]

    def fault(self, arm: str, seconds: float = 1.0) -> None:
        """Have an arm fault for some real seconds."""
        machine = self.builders[arm].machine
        assert machine is not None
        machine.fail(seconds * self.speed)


def refused(call: Callable[[], object]) -> str:
    """Return the reason for which a request is refused; "" if it is not."""
    try:
        call()
    except Refused as refusal:
        return str(refusal)
    return ""
