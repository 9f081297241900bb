"""A fleet of processes that is struck: how it is watched, and what became of it."""

import math
import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from fleet.bus.client.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobStatus, Result, Status, StatusRequest
from fleet.bus.protocol.messages import State
from fleet.live.arm.journal_records import ArmRecord, Closed
from fleet.live.journal import Journal
from fleet.live.supervisor import Supervisor

PATIENCE_S = 150.0
STALE_S = 3.0


class CannotStrike(Exception):
    """This machine cannot make a fault; says what it lacks."""


@dataclass(eq=False)
class Outcome:
    """What became of a fleet that was struck."""

    by: str = ""
    """Which of several ways to make the fault was taken."""
    finished: int = 0
    unfinished: int = 0
    lost: tuple[str, ...] = ()
    twice: tuple[str, ...] = ()
    died: tuple[str, ...] = ()
    """Processes that ended and that nobody had killed."""
    wrong: tuple[str, ...] = ()
    """What must not have been: a trespass that was let in, a clock that was thrown off."""
    notes: tuple[str, ...] = ()
    detected_s: float = math.nan
    recovered_s: float = math.nan
    took_s: float = math.nan

    @property
    def good(self) -> bool:
        """Whether every job was done once or reported, nobody died of it, and nothing was as it must not be."""
        return not (self.lost or self.twice or self.died or self.wrong)


@dataclass(eq=False)
class Fleet:
    """A fleet of processes, and a line by which it is watched."""

    supervisor: Supervisor
    link: BusClient
    endpoint: str
    session: zenoh.Session
    """A stranger's, to speak rubbish with."""
    folder: Path
    arms: tuple[str, ...]
    auction: str = "auction"
    keys: Path | None = None
    """Of the participants, where the router wants certificates."""
    line: AbstractContextManager[object] | None = None
    """Between some arms and the router."""
    away: tuple[str, ...] = ()
    """Those arms."""
    clocks: object = None
    """The wall clocks of the participants, where they can be set."""
    notes: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    killed: Counter[str] = field(default_factory=Counter)
    tokens: set[str] = field(default_factory=set)
    states: dict[str, tuple[float, State]] = field(default_factory=dict)
    """By arm: when the last one came, real seconds, and what it said."""
    results: list[tuple[float, JobStatus]] = field(default_factory=list)

    def listen(self) -> None:
        """Hear who is there, how they are, and what becomes of jobs."""
        fleet = self.link.fleet
        self.link.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)
        self.link.subscribe(keys.of_every_arm(fleet, "state"), State, self._state)
        self.link.subscribe(keys.of_every_auction(fleet, "result"), Result, self._result)

    def note(self, what: str) -> None:
        """Say something beside the figures."""
        self.notes.append(what)

    def until(self, condition: Callable[[], bool], patience_s: float = PATIENCE_S) -> float:
        """Real seconds until it holds, infinite if it never does."""
        began_s = time.monotonic()
        while time.monotonic() - began_s < patience_s:
            if condition():
                return time.monotonic() - began_s
            self.supervisor.poll()
            self.link.serve(time.monotonic() + 0.02)
        return math.inf

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        """Send a signal to a participant."""
        pid = self.supervisor.pid(name)
        if pid is not None:
            os.kill(pid, number)
            if number == signal.SIGKILL:
                self.killed[name] += 1

    def working(self) -> str | None:
        """An arm that has a job in hand, by its last state."""
        for arm in self.arms:
            if arm in self.states and self.states[arm][1].mode == "working":
                return arm
        return None

    def unwell(self, arm: str) -> bool:
        """Whether the bus shows that an arm is not as it should be."""
        return arm not in self.tokens or time.monotonic() - self.states[arm][0] > STALE_S

    def status(self) -> dict[str, JobStatus]:
        """What the auctioneer says of all jobs; nothing, if it does not answer."""
        answers = self.link.query_and_wait(
            keys.of_jobs(self.link.fleet, "status"), StatusRequest(), Status, timeout_s=2.0
        )
        return {job.job: job for word in answers.messages.values() for job in word.jobs}

    def done_by(self) -> Counter[str]:
        """How often each job was finished, by the journals of the arms."""
        done: Counter[str] = Counter()
        for path in sorted((self.folder / "journals").glob("*.journal")):
            if path.stem == "auctioneer":
                continue
            copy = Path(tempfile.mkdtemp()) / path.name  # the arm holds its own
            copy.write_bytes(path.read_bytes())
            with Journal[ArmRecord](copy, ArmRecord) as journal:
                done.update(
                    record.job
                    for record in journal.records()
                    if isinstance(record, Closed) and record.outcome == "finished"
                )
        return done

    def _token(self, arm: str, there: bool) -> None:
        (self.tokens.add if there else self.tokens.discard)(arm)

    def _state(self, arm: str, word: State) -> None:
        self.states[arm] = time.monotonic(), word

    def _result(self, _auctioneer: str, word: Result) -> None:
        self.results.append((time.monotonic(), word.status))


Strike = Callable[[Fleet], float]
"""Does the harm; real seconds until it was detected, NaN where there is nothing to see."""


@dataclass(frozen=True)
class Fault:
    """A fault, and the fleet that it needs."""

    strike: Strike
    tls: bool = False
    line: bool = False
    """Half of the arms reach the router through what can be cut: network namespaces (`tls`), or a line of ours."""
    clocks: bool = False
    """The wall clock of each participant can be set."""
    alone: bool = False
    """Without an auctioneer: the arms share the jobs out among themselves."""
    away: int = 0
    """How many arms can be cut off; 0 for half of them."""
