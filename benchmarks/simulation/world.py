"""Simulated time, processes and network: one heap of events, driven by one seed.

A process runs until its node waits for a message; there `SimulatedClient.serve` raises `Sleep`, and the process wakes
with the next message or when that wait ends, by its own clock. `time.monotonic` is the clock of the running process.
"""

import heapq
import logging
import math
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from random import Random
from typing import Any, Protocol

from numpy.random import SeedSequence

from benchmarks.simulation.disk import Crash, Disk
from fleet.bus.protocol.keys import SESSION_LEASE_S
from fleet.errors import FleetError

BACKLOG = 4096
"""Most messages that wait at one process."""
MAX_TURNS = 16
"""Turns of one process in one event; then the others go on."""


class Sleep(Exception):
    """The running process waits until `until_s` on its own clock."""

    def __init__(self, until_s: float) -> None:
        super().__init__()
        self.until_s = until_s


class Violation(AssertionError):
    """A rule of the fleet is broken."""


class Node(Protocol):
    """What a process runs."""

    def serve(self, until_s: float) -> object:
        """Handle messages, and do what is due."""
        ...


class Process:
    """One process of the fleet, its machine's clock and its disk.

    Attributes:
        boot: Number of its starts; messages to an earlier one do not arrive.
        group: Processes of one group reach one another.
        seen_group: The same, as liveliness tokens show it: a lost connection is noticed after `SESSION_LEASE_S`.
    """

    def __init__(self, world: "World", name: str, build: Callable[["Process"], Node]) -> None:
        self.world, self.name, self._build = world, name, build
        self.rate, self.offset_s = world.clock_rate(), world.rng.uniform(0.0, 1e5)
        self.disk = Disk(world.rng)
        self.node: Node | None = None
        self.client: Any = None
        self.on_exit: Callable[[int], None] = lambda code: None
        self.boot = self.group = self.seen_group = 0
        self.up = self.paused = self.hung = self.broken = self._busy = False
        self.inbox: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._wake_s = math.inf
        world.processes[name] = self

    @property
    def real_s(self) -> float:
        """Its clock."""
        return self.offset_s + self.rate * self.world.now_s

    def start(self) -> None:
        """Start; it may exit at once."""
        if self.up:
            return
        self.boot, self.up, self.paused, self.hung = self.boot + 1, True, False, False
        self.world.log(self.name, "starts")
        self._call(self._start)
        self.wake(self.world.now_s)

    def _start(self) -> None:
        if self.broken:
            raise FleetError("this machine is broken")
        self.node = self._build(self)

    def put(self, handle: Callable[..., None], *arguments: Any) -> None:
        """Let it handle a message that arrives now."""
        if len(self.inbox) >= BACKLOG:
            self.inbox.popleft()
        self.inbox.append((handle, arguments))
        self.run()

    def wake(self, true_s: float) -> None:
        """Run it at that time, if nothing wakes it before."""
        if true_s < self._wake_s or self._wake_s < self.world.now_s:
            self._wake_s = true_s
            self.world.at(true_s, self._timer, self.boot, true_s)

    def _timer(self, boot: int, true_s: float) -> None:
        if boot == self.boot and true_s == self._wake_s:
            self._wake_s = math.inf
            self.run()

    def run(self) -> None:
        """Let it handle what has arrived and do what is due, until it waits again."""
        if self.up and not self.paused and not self._busy and self.node is not None:
            self.client.elapsed = True
            self._call(self._turns)

    def _turns(self) -> None:
        assert self.node is not None
        until_s = self.real_s
        try:
            for _ in range(MAX_TURNS):
                self.node.serve(math.inf)
        except Sleep as sleep:
            until_s = sleep.until_s
        late_s = self.world.lateness_s()
        self.wake(max((until_s - self.offset_s) / self.rate, self.world.now_s) + late_s)

    def _call(self, call: Callable[[], None]) -> None:
        """Call as this process; it may crash or exit."""
        world, caller = self.world, self.world.running
        world.running, self._busy = self, True
        try:
            call()
        except Crash as crash:
            self.kill(f"crashes at {crash}", power=crash.power)
        except Killed:
            pass
        except FleetError as error:
            world.log(self.name, f"exits: {error}")
            self.exit(2)
        except (Violation, Sleep):
            raise
        except Exception as error:
            raise Violation(f"'{self.name}' ends with {type(error).__name__}: {error}") from error
        finally:
            world.running, self._busy = caller, False
        world.after_run(self)

    def kill(self, why: str, *, power: bool = False) -> None:
        """End it at once; with `power`, its disk loses what was not written through."""
        if self.up:
            self.world.log(self.name, why)
            self.disk.lose(power=power)
            self.exit(-9)

    def exit(self, code: int) -> None:
        """End it."""
        self.up, self.node, self._wake_s = False, None, math.inf
        self.inbox.clear()
        self.world.bus.drop(self)
        self.disk.close_all()
        self.world.after_exit(self)
        self.on_exit(code)

    def pause(self, seconds: float) -> None:
        """Stop it as by SIGSTOP."""
        if self.up and not self.paused:
            self.paused = True
            self.world.log(self.name, f"is stopped for {seconds:.1f} s")
            self.world.after(SESSION_LEASE_S, self._hang, self.boot)
            self.world.after(seconds, self._resume, self.boot)

    def _hang(self, boot: int) -> None:
        if boot == self.boot and self.paused:
            self.hung = True
            self.world.bus.update_tokens()

    def _resume(self, boot: int) -> None:
        if boot == self.boot and self.paused:
            self.paused = self.hung = False
            self.world.log(self.name, "continues")
            self.world.bus.update_tokens()
            self.run()


class World:
    """One simulated fleet.

    Attributes:
        now_s: True time, s.
        events: Number of events so far.
        trace: Lines of what happened, oldest first; None to keep none.
    """

    def __init__(self, seed: int, *, trace: bool = False) -> None:
        self.rng = Random(int.from_bytes(SeedSequence(seed).generate_state(8).tobytes(), "little"))
        self.now_s = 0.0
        self.events = 0
        self.trace: list[str] | None = [] if trace else None
        self.processes: dict[str, Process] = {}
        self.running: Process | None = None
        self.after_run: Callable[[Process], None] = lambda process: None
        self.after_exit: Callable[[Process], None] = lambda process: None
        self.bus: Any = None
        self.base_s = 10.0 ** self.rng.uniform(-3.5, -1.5)
        """Mean delay of a message, s."""
        self.late_s = self.rng.choice([0.1, 0.4, 0.8])
        """Largest delay of a timer: of a busy machine."""
        self.loss = self.doubling = 0.0
        self.slow = 1.0
        """Factor of delays."""
        self._heap: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = 0

    def clock_rate(self) -> float:
        """Rate of a clock: two differ by less than `fleet.live.clock.CLOCK_DRIFT`."""
        return self.rng.uniform(0.9952, 1.0048)

    def lateness_s(self) -> float:
        """Delay of a timer."""
        return self.late_s * self.rng.random()

    def delay_s(self) -> float:
        """Delay of a message; independent of others, so messages overtake one another."""
        return self.base_s * self.slow * (0.2 + self.rng.expovariate(1.0))

    def log(self, who: str, what: str) -> None:
        """Add a line to the trace."""
        if self.trace is not None:
            self.trace.append(f"{self.now_s:12.6f} {who:<12} {what}")

    # Events

    def at(self, true_s: float, call: Callable[..., None], *arguments: Any) -> None:
        """Call at a true time."""
        self._count += 1
        heapq.heappush(self._heap, (true_s, self._count, call, arguments))

    def after(self, seconds: float, call: Callable[..., None], *arguments: Any) -> None:
        """Call after some true time."""
        self.at(self.now_s + seconds, call, *arguments)

    def step(self) -> None:
        """Handle the next event."""
        true_s, _, call, arguments = heapq.heappop(self._heap)
        self.now_s = max(self.now_s, true_s)
        self.events += 1
        running, self.running = self.running, None  # another process may wait inside a call
        call(*arguments)
        self.running = running

    def run(self, until_s: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Handle events up to a true time; return whether `done` came true before."""
        while self._heap and self._heap[0][0] <= until_s:
            self.step()
            if done():
                return True
        self.now_s = max(self.now_s, until_s)
        return False

    def wait(self, process: Process, until_s: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Let others run while a process waits inside a call, until `until_s` on its clock."""
        boot, deadline_s = process.boot, (until_s - process.offset_s) / process.rate
        self.run(deadline_s, lambda: done() or process.boot != boot or not process.up)
        if process.boot != boot or not process.up:
            raise Killed
        return done()

    # The network

    def reach(self, one: Process, other: Process) -> bool:
        """Whether messages pass between two processes."""
        return one.group == other.group

    def send(self, sender: Process, receiver: Process, what: Callable[..., None], *arguments: Any) -> None:
        """Send a message, which may be lost or arrive twice."""
        if self.rng.random() < self.loss:
            return
        self.after(self.delay_s(), self._arrive, sender, receiver, receiver.boot, what, arguments)
        if self.rng.random() < self.doubling:
            later_s = self.delay_s() * self.rng.choice([1.0, 10.0, 100.0, 1000.0])
            self.after(later_s, self._arrive, sender, receiver, receiver.boot, what, arguments)

    def _arrive(self, sender: Process, receiver: Process, boot: int, what: Callable[..., None], arguments: Any) -> None:
        if receiver.up and receiver.boot == boot and self.reach(sender, receiver):
            receiver.put(what, *arguments)

    def calm(self) -> None:
        """End the loss, doubling and delay of messages."""
        self.loss, self.doubling, self.slow = 0.0, 0.0, 1.0

    def split(self, group: dict[str, int]) -> None:
        """Cut the network in groups; names that are missing are in group 0."""
        for name, process in self.processes.items():
            process.group = group.get(name, 0)
        self.log("network", f"cut: {group}" if group else "heals")
        self.after(0.0 if not group else SESSION_LEASE_S, self._notice_groups)

    def _notice_groups(self) -> None:
        for process in self.processes.values():
            process.seen_group = process.group
        self.bus.update_tokens()

    # Time and chance of the product

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Have the product read this world's clock, and draw its secrets from this world's seed."""
        before = time.monotonic, time.sleep, secrets.token_hex
        handler = _TraceLog(self)
        logging.disable(logging.NOTSET if self.trace is not None else logging.CRITICAL)
        loggers = [logging.getLogger(name) for name in ("fleet", "scenarios")]
        for logger in loggers:
            logger.addHandler(handler)
            logger.propagate = False
        time.monotonic, time.sleep = self._monotonic_s, self._sleep
        secrets.token_hex = lambda nbytes=None: f"{self.rng.getrandbits(32):08x}"
        try:
            yield
        finally:
            time.monotonic, time.sleep, secrets.token_hex = before
            logging.disable(logging.NOTSET)
            for logger in loggers:
                logger.removeHandler(handler)
                logger.propagate = True

    def _monotonic_s(self) -> float:
        return self.now_s if self.running is None else self.running.real_s

    def _sleep(self, seconds: float) -> None:
        assert self.running is not None
        self.wait(self.running, self.running.real_s + seconds)


class Killed(FleetError):
    """The waiting process was killed meanwhile."""


class _TraceLog(logging.Handler):
    """Writes the log of the product to the trace."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self._world = world

    def emit(self, record: logging.LogRecord) -> None:
        running = self._world.running
        self._world.log("" if running is None else running.name, f"| {record.getMessage()}")
