"""The live fleet of a fault: what the bus and the journals show, and the outcome."""

import math
import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import zenoh

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    SETTLED,
    JobSpec,
    JobStatus,
    Result,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.messages import State
from fleet.errors import JournalError
from fleet.live.arm.awards import ArmRecord, Closed, JobsFinished
from fleet.live.job_client import query_statuses
from fleet.live.journal import Journal
from fleet.live.supervisor import Supervisor

TIMEOUT_S = 150.0
STALE_S = 3.0
AT_ONCE = 64
"""Jobs in a submission or a request for their status."""


class CannotInject(Exception):
    """This machine cannot inject a fault; the message says what it lacks."""


@dataclass(eq=False)
class Outcome:
    """Jobs, processes and times after a fault."""

    finished: int = 0
    unfinished: int = 0
    lost: tuple[str, ...] = ()
    twice: tuple[str, ...] = ()
    exited: tuple[str, ...] = ()
    """Processes that exited without being killed."""
    violations: tuple[str, ...] = ()
    """Successful trespasses and wrong clocks."""
    notes: tuple[str, ...] = ()
    detected_s: float = math.nan
    recovered_s: float = math.nan
    took_s: float = math.nan

    @property
    def good(self) -> bool:
        """Whether no job was lost or done twice, no process exited by itself, and there are no violations."""
        return not (self.lost or self.twice or self.exited or self.violations)


@dataclass(eq=False)
class Fleet:
    """A fleet of processes, and the client that monitors it."""

    supervisor: Supervisor
    client: BusClient
    endpoint: str
    session: zenoh.Session
    """Of a process outside the fleet, which sends malformed messages."""
    folder: Path
    arms: tuple[str, ...]
    auction: str = "auction"
    keys: Path | None = None
    """Folder of certificates, if the fleet uses TLS."""
    cut: AbstractContextManager[object] | None = None
    """Can cut the connection between some arms and the router."""
    cut_arms: tuple[str, ...] = ()
    """The arms that it can cut off."""
    clocks: object = None
    """Wall clocks of the participants, if they can be set."""
    notes: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    killed: Counter[str] = field(default_factory=Counter)
    tokens: set[str] = field(default_factory=set)
    states: dict[str, tuple[float, State]] = field(default_factory=dict)
    """By arm: real time of the last state, and the state."""
    results: list[JobStatus] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.journals = JournalFiles(self.folder / "journals")
        self._last_result = -1

    def listen(self) -> None:
        """Subscribe to tokens, states and results."""
        fleet = self.client.fleet
        self.client.watch_tokens(keys.of_every_arm(fleet, "alive"), self._token)
        self.client.subscribe(keys.of_every_arm(fleet, "state"), State, self._state)
        self.client.subscribe(keys.of_every_auction(fleet, "result"), Result, self._result)

    def note(self, what: str) -> None:
        """Add a note to the outcome."""
        self.notes.append(what)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> float:
        """Wait for a condition; return the real seconds until it was true, infinite after the timeout."""
        began_s = time.monotonic()
        while time.monotonic() - began_s < timeout_s:
            if condition():
                return time.monotonic() - began_s
            self.step(0.02)
        return math.inf

    def step(self, wait_s: float = 0.0) -> None:
        """Restart exited processes, and wait for messages and handle them."""
        self.supervisor.poll()
        self.client.serve(time.monotonic() + wait_s)
        self.journals.follow()

    def victim(self) -> str:
        """Return the arm that a fault hits: one that works, if any does."""
        return self.working_arm() or self.arms[0]

    def send_signal(self, name: str, number: int = signal.SIGKILL) -> None:
        """Send a signal to a participant."""
        pid = self.supervisor.pid(name)
        if pid is not None:
            os.kill(pid, number)
            if number == signal.SIGKILL:
                self.killed[name] += 1

    def working_arm(self) -> str | None:
        """Return an arm that works, by its last state."""
        for arm in self.arms:
            if arm in self.states and self.states[arm][1].mode == "working":
                return arm
        return None

    def is_absent(self, arm: str) -> bool:
        """Whether an arm has no token or no recent state."""
        return arm not in self.tokens or time.monotonic() - self.states[arm][0] > STALE_S

    def status(self) -> dict[str, JobStatus]:
        """Query the status of all jobs; empty without a reply."""
        answers = self.client.wait(partial(query_statuses, self.client, timeout_s=2.0), 2.0)
        return {job.job: job for word in answers.messages.values() for job in word.jobs}

    def submit(self, jobs: Sequence[JobSpec]) -> None:
        """Submit jobs, `AT_ONCE` in a message.

        Raises:
            RuntimeError: a job was not accepted.
        """
        for first in range(0, len(jobs), AT_ONCE):
            some = Submission(tuple(jobs[first : first + AT_ONCE]))
            key = keys.of_jobs(self.client.fleet, "submit")
            replies = self.client.query_and_wait(key, some, SubmissionReply, timeout_s=20.0)
            accepted = {job.job for reply in replies.messages.values() for job in reply.jobs if job.accepted}
            if len(accepted) != len(some.jobs):
                raise RuntimeError(f"Only {len(accepted)} of {len(some.jobs)} jobs were accepted: {replies.refused}")

    def done_twice(self) -> tuple[str, ...]:
        """Jobs that were finished more than once, by the journals of the arms since their first start."""
        return tuple(sorted(name for name, times in self.journals.count_finished().items() if times > 1))

    def exited(self) -> tuple[str, ...]:
        """Processes that exited without being killed."""
        return tuple(sorted(name for name, n in self.supervisor.restarts().items() if n > self.killed[name]))

    def outcome(self, accepted: Iterable[str], status: Mapping[str, JobStatus]) -> Outcome:
        """What became of the accepted jobs, by their last status and the journals of the arms."""
        states = Counter(job.state for job in status.values())
        settled = {name for name, job in status.items() if job.state in SETTLED}
        return Outcome(
            finished=states["finished"],
            unfinished=states["unfinished"] + states["given_up"],
            lost=tuple(sorted(set(accepted) - settled)),
            twice=self.done_twice(),
            exited=self.exited(),
            violations=tuple(self.violations),
            notes=tuple(self.notes),
        )

    def _token(self, arm: str, there: bool) -> None:
        (self.tokens.add if there else self.tokens.discard)(arm)

    def _state(self, arm: str, word: State) -> None:
        self.states[arm] = time.monotonic(), word

    def _result(self, _auctioneer: str, word: Result) -> None:
        if word.number > self._last_result:  # an auctioneer repeats its last results when it starts
            self._last_result = word.number
            self.results.append(word.status)


Inject = Callable[[Fleet], float]
"""Injects a fault; returns the real seconds until the bus shows it, NaN if it never does."""


@dataclass(frozen=True)
class Fault:
    """A fault and the kind of fleet that it needs."""

    inject: Inject
    tls: bool = False
    cut: bool = False
    """The connection of some arms can be cut."""
    clocks: bool = False
    """The wall clock of every participant can be set."""
    no_auctioneer: bool = False
    """The arms allocate the jobs by consensus."""
    cut_arms: int = 0
    """Number of arms that can be cut off; 0 for half of them."""


class JournalFiles:
    """Finished jobs by the journals of arms since the start, including records that a compaction has removed."""

    EVERY_S = 0.2
    """Real seconds between two readings of a journal, which is compacted less often."""

    def __init__(self, folder: Path) -> None:
        """Follow the journals of a folder, which need not exist yet."""
        self._folder = folder
        self._read_s: dict[Path, float] = {}
        self._stamps: dict[Path, list[tuple[int, int]]] = {}
        self._ended: dict[str, set[tuple[str, str]]] = {}
        """Finished jobs with their awards, by arm."""
        self._named: dict[str, set[str]] = {}
        """Jobs that an arm names as finished, by arm."""

    def follow(self, every_s: float = EVERY_S) -> None:
        """Read what is due; to be called more often than journals are compacted."""
        for path in self._folder.glob("*.journal"):
            if path.stem != "auctioneer" and time.monotonic() >= self._read_s.get(path, 0.0) + every_s:
                self._read_s[path] = time.monotonic()
                before, self._stamps[path] = self._stamps.get(path), stamp_of(path)
                for record in records_of(path) if self._stamps[path] != before else ():
                    if isinstance(record, Closed) and record.report.outcome == "finished":
                        self._ended.setdefault(path.stem, set()).add((record.report.job, record.report.award))
                    elif isinstance(record, JobsFinished):
                        self._named.setdefault(path.stem, set()).update(job.name for job in record.jobs)

    def count_finished(self) -> Counter[str]:
        """Count how often each job was finished: once for each award, and at least once by each arm that names it."""
        self._stamps.clear()  # also what has changed twice in one tick of the file system's clock
        self.follow(every_s=0.0)
        done: Counter[str] = Counter()
        for arm in self._ended.keys() | self._named.keys():
            ended = Counter(job for job, _ in self._ended.get(arm, ()))
            done.update(ended)
            done.update(self._named.get(arm, set()) - ended.keys())
        return done


def _files_of(journal: Path) -> tuple[Path, Path]:
    return journal, journal.with_name(f"{journal.name}-wal")


def stamp_of(path: Path) -> list[tuple[int, int]]:
    """Return size and time of each file of a journal."""
    found: list[tuple[int, int]] = []
    for each in _files_of(path):
        with suppress(FileNotFoundError):
            found.append(((status := each.stat()).st_size, status.st_mtime_ns))
    return found


def records_of(path: Path) -> list[ArmRecord]:
    """Return the records of an arm's journal by a copy, as its process has it open; none if it changes meanwhile."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            for each in _files_of(path):
                if each.exists():
                    shutil.copyfile(each, Path(folder) / each.name)
            with Journal[ArmRecord](Path(folder) / path.name, ArmRecord, durable=False) as journal:
                return list(journal.records())
        except (JournalError, OSError):
            return []
