"""Faults against a whole fleet, each participant a process: what is lost or done twice, and how soon it recovers.

    python benchmarks/chaos.py [--only NAME,NAME] [--jobs 24] [--speed 120] [--keep DIR]

For every fault a fleet of four arms is started anew (router, auctioneer, recorder, arms; plain TCP on loopback), gets
jobs, and while they are worked on the fault strikes. Then all jobs must come to an end: finished once, or reported
unfinished. Whether a job was done twice is read from the journals of the arms, not from what the auctioneer says.
Detected: real seconds until the bus shows that something is wrong (a token gone, a state older than 3 s). Recovered:
until everybody is there and speaks again and the auctioneer answers. Exit code 1 if a job is
lost or done twice, or a process has died that nobody killed. Bounded: at most `PATIENCE_S` for a fault.
"""

import argparse
import json
import logging
import math
import os
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from fleet.bus import keys
from fleet.bus.link import Link
from fleet.bus.messages import State, encoding
from fleet.bus.router import open_client
from fleet.bus.trade import (
    Award,
    JobStatus,
    JobWord,
    LeaseRequest,
    QuoteRequest,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    Submitted,
)
from fleet.live.journal import Journal
from fleet.live.promises import Closed, Promise
from fleet.live.supervisor import Backoff, Supervisor
from scenarios.build import prepare
from scenarios.live_up import free_port, parts_of
from scenarios.load import load

PATIENCE_S = 150.0
START_S = 60.0
STALE_S = 3.0
SCENARIO = "quickstart"
FLEET = "chaos"
RUBBISH = 100_000


@dataclass(eq=False)
class Outcome:
    """What became of a fleet that was struck."""

    finished: int = 0
    unfinished: int = 0
    lost: tuple[str, ...] = ()
    twice: tuple[str, ...] = ()
    died: tuple[str, ...] = ()
    """Processes that ended and that nobody had killed."""
    detected_s: float = math.nan
    recovered_s: float = math.nan
    took_s: float = math.nan

    @property
    def good(self) -> bool:
        """Whether every job was done once or reported, and nobody died of it."""
        return not (self.lost or self.twice or self.died)


@dataclass(eq=False)
class Fleet:
    """A fleet of processes, and a line by which it is watched."""

    supervisor: Supervisor
    link: Link
    endpoint: str
    session: zenoh.Session
    """A stranger's, to speak rubbish with."""
    folder: Path
    arms: tuple[str, ...]
    auction: str = "auction"
    killed: Counter[str] = field(default_factory=Counter)
    tokens: set[str] = field(default_factory=set)
    states: dict[str, tuple[float, State]] = field(default_factory=dict)
    """By arm: when the last one came, real seconds, and what it said."""
    results: list[tuple[float, JobStatus]] = field(default_factory=list)

    def listen(self) -> None:
        """Hear who is there, how they are, and what becomes of jobs."""
        fleet = self.link.fleet
        self.link.watch(keys.of_every_arm(fleet, "alive"), self._token)
        self.link.listen(keys.of_every_arm(fleet, "state"), State, self._state)
        self.link.listen(keys.of_every_auction(fleet, "result"), Result, self._result)

    def until(self, condition: Callable[[], bool], patience_s: float = PATIENCE_S) -> float:
        """Real seconds until it holds, infinite if it never does."""
        began_s = time.monotonic()
        while time.monotonic() - began_s < patience_s:
            if condition():
                return time.monotonic() - began_s
            self.supervisor.look()
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
        answers = self.link.ask_and_wait(
            keys.of_jobs(self.link.fleet, "status"), StatusRequest(), Status, timeout_s=2.0
        )
        return {job.job: job for word in answers.words.values() for job in word.jobs}

    def done_by(self) -> Counter[str]:
        """How often each job was finished, by the journals of the arms."""
        done: Counter[str] = Counter()
        for path in sorted((self.folder / "journals").glob("*.journal")):
            if path.stem == "auctioneer":
                continue
            copy = Path(tempfile.mkdtemp()) / path.name  # the arm holds its own
            copy.write_bytes(path.read_bytes())
            with Journal[Promise](copy, Promise) as journal:
                done.update(
                    record.report.job
                    for record in journal.replay()
                    if isinstance(record, Closed) and record.report.outcome == "finished"
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


def kill_arm(fleet: Fleet) -> float:
    """SIGKILL of an arm in the middle of a job."""
    arm = fleet.working() or fleet.arms[0]
    fleet.kill(f"arm-{arm}")
    return fleet.until(lambda: fleet.unwell(arm), 10.0)


def stop_arm(fleet: Fleet) -> float:
    """SIGSTOP of an arm in the middle of a job, for longer than its lease, then SIGCONT."""
    arm = fleet.working() or fleet.arms[0]
    fleet.kill(f"arm-{arm}", signal.SIGSTOP)
    seen_s = fleet.until(lambda: fleet.unwell(arm), 10.0)
    fleet.until(lambda: False, 12.0)
    fleet.kill(f"arm-{arm}", signal.SIGCONT)
    return seen_s


def kill_auctioneer(fleet: Fleet) -> float:
    """SIGKILL of the auctioneer while a batch is under way."""
    begun = len(fleet.results)
    fleet.until(lambda: len(fleet.results) > begun, 20.0)  # it has just decided something
    fleet.kill(fleet.auction)
    return math.nan


def kill_router(fleet: Fleet) -> float:
    """SIGKILL of the router."""
    fleet.kill("router")
    return fleet.until(lambda: not fleet.tokens, 10.0)


def stuck_subscriber(fleet: Fleet) -> float:
    """A stranger that hears everything and stands still, and one that takes 50 ms for every word."""
    code = (
        "import sys, time, zenoh, json\n"
        "config = zenoh.Config.from_json5(json.dumps({'mode': 'client', 'connect': {'endpoints': [sys.argv[1]]},"
        " 'scouting': {'multicast': {'enabled': False}}}))\n"
        "with zenoh.open(config) as z:\n"
        "    sub = z.declare_subscriber('thermofleet/v1/**', lambda s: time.sleep(0.05))\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(120)\n"
    )
    import subprocess

    endpoint = fleet.endpoint
    listeners = [
        subprocess.Popen([sys.executable, "-c", code, endpoint], stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    for listener in listeners:
        assert listener.stdout is not None
        listener.stdout.readline()
    os.kill(listeners[0].pid, signal.SIGSTOP)
    threading.Timer(40.0, lambda: [listener.kill() for listener in listeners]).start()
    return math.nan


def full_disk(fleet: Fleet) -> float:
    """No room in the journals of an arm and of the auctioneer for ten seconds."""
    arm = fleet.working() or fleet.arms[0]
    struck = [fleet.supervisor.pid(name) for name in (f"arm-{arm}", fleet.auction)]
    pids = [pid for pid in struck if pid is not None]
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    fleet.until(lambda: False, 10.0)
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return math.nan


def rubbish(fleet: Fleet) -> float:
    """100 000 malformed, oversized and adversarial messages, on every key there is."""
    import random

    rng = random.Random(0)
    of_fleet, session = fleet.link.fleet, fleet.session
    said = [str(key) for key in _every_key(of_fleet, fleet.arms)]
    kinds = [encoding(kind) for kind in (State, Award, QuoteRequest, LeaseRequest, Report, Submission)]
    bodies = [
        b"",
        b"{",
        b"null",
        b"[]",
        b"\xff\xfe\x00",
        b'{"arm":"arm_0"}',
        b'{"arm":1e999}',
        b"{" * 2000,
        b'{"arm":"arm_0","tick":-1}',
        b'"' + b"x" * 9000 + b'"',
        b"[" * 30000,
        b"x" * 70_000,
        json.dumps(
            {
                "arm": "arm_0",
                "tick": 10**18,
                "time_s": 1e300,
                "mode": "idle",
                "temp_c": [1e308] * 7,
                "headroom_k": -1e308,
            }
        ).encode(),
    ]
    for number in range(RUBBISH):
        key, body, kind = rng.choice(said), rng.choice(bodies), rng.choice(kinds)
        if number % 50 == 0:
            session.get(key, lambda _reply: None, payload=body, encoding=kind, timeout=1.0)
        else:
            session.put(key, body, encoding=kind)
        if number % 500 == 0:
            fleet.supervisor.look()
            fleet.link.serve()
    return math.nan


def replayed_awards(fleet: Fleet) -> float:
    """Awards that were made before are sent again, by somebody else."""
    arm = fleet.arms[0]
    path = fleet.folder / "journals" / f"{arm}.journal"
    words = [json.loads(line)["records"] for line in path.read_bytes().splitlines() if line.endswith(b"}")]
    awards = [record["award"] for records in words for record in records if record["type"] == "accepted"]
    for award in awards * 50:
        payload = json.dumps(award).encode()
        fleet.session.get(
            keys.of_arm(fleet.link.fleet, arm, "award"),
            lambda _reply: None,
            payload=payload,
            encoding=encoding(Award),
            timeout=2.0,
        )
        fleet.supervisor.look()
        fleet.link.serve()
    return math.nan


FAULTS: dict[str, Strike] = {
    "kill-arm": kill_arm,
    "stop-arm": stop_arm,
    "kill-auctioneer": kill_auctioneer,
    "kill-router": kill_router,
    "stuck-subscriber": stuck_subscriber,
    "full-disk": full_disk,
    "rubbish": rubbish,
    "replayed-awards": replayed_awards,
}


def campaign(name: str, folder: Path, *, jobs: int, speed: float) -> Outcome:
    """One fleet, one fault, and what became of it."""
    scenario = load(SCENARIO)
    arms = tuple(arm.name for arm in scenario.arms)
    router, of_arms, record, auction = parts_of(
        SCENARIO,
        arms,
        port=free_port(),
        fleet=FLEET,
        folder=folder,
        speed=speed,
        rule="quickest",
        assignment="matching",
        difficulty="blind",
        jobs="none",
        seed=0,
    )
    work = tuple(_job(number) for number in range(jobs))
    with ExitStack() as stack:
        supervisor = stack.enter_context(Supervisor(folder / "logs", backoff=Backoff(first_s=0.2)))
        supervisor.start(router, ready_s=START_S)
        for part in (record, auction, *of_arms):
            supervisor.start(part)
        for part in (record, auction, *of_arms):
            supervisor.await_ready(part.name, START_S)
        link = stack.enter_context(Link(router.ready, FLEET))
        session = stack.enter_context(open_client(router.ready, timeout_s=5.0))
        fleet = Fleet(supervisor, link, router.ready, session, folder, arms)
        fleet.listen()
        if math.isinf(fleet.until(lambda: len(fleet.states) == len(arms) and len(fleet.tokens) == len(arms), 30.0)):
            raise RuntimeError(f"Only {sorted(fleet.states)} of {arms} are on the bus.")
        answers = link.ask_and_wait(keys.of_jobs(FLEET, "submit"), Submission(work), Submitted, timeout_s=10.0)
        taken = {job.job for word in answers.words.values() for job in word.jobs if job.accepted}
        if len(taken) != jobs:
            raise RuntimeError(f"Only {len(taken)} of {jobs} jobs were accepted: {answers.refused}")
        fleet.until(lambda: fleet.working() is not None and sum(s.state == "finished" for _, s in fleet.results) >= 2)
        struck_s = time.monotonic()
        detected_s = FAULTS[name](fleet)
        well_s = fleet.until(lambda: _well(fleet))
        recovered_s = time.monotonic() - struck_s if math.isfinite(well_s) else math.inf
        settled_s = fleet.until(lambda: _settled(fleet, taken))
        outcome = _outcome(fleet, taken)
        outcome.detected_s, outcome.recovered_s = detected_s, recovered_s
        outcome.took_s = time.monotonic() - struck_s if math.isfinite(settled_s) else math.inf
    return outcome


def _job(number: int) -> JobWord:
    """Work that the scenario's arms have planned, at three pairs of stations in turn, some minutes each."""
    name, repetitions = f"job {number:03d}", 4 + number % 3
    if number % 3 == 0:
        return JobWord(name=name, kind="sort", places=("belt", "bin"), payload_kg=0.1, repetitions=repetitions)
    if number % 3 == 1:
        trays = ("tray_left", "tray_right")
        return JobWord(name=name, kind="pick_place", places=trays, payload_kg=0.5, repetitions=repetitions)
    return JobWord(name=name, kind="hold", places=("clamp",), payload_kg=3.0, dwell_s=60.0, repetitions=2)


def _well(fleet: Fleet) -> bool:
    """Whether everybody is there and speaks, the auctioneer answers, and everything that was killed is back."""
    fleet.link.serve(time.monotonic() + 0.05)
    there = all(fleet.supervisor.ready(name) for name in fleet.supervisor.restarts())
    return there and not any(fleet.unwell(arm) for arm in fleet.arms) and bool(fleet.status())


_SETTLED = ("finished", "unfinished")


def _settled(fleet: Fleet, taken: set[str]) -> bool:
    fleet.link.serve(time.monotonic() + 0.2)
    status = fleet.status()
    return taken <= set(status) and all(job.state in _SETTLED for job in status.values())


def _outcome(fleet: Fleet, taken: set[str]) -> Outcome:
    status, done = fleet.status(), fleet.done_by()
    finished = {name for name, job in status.items() if job.state == "finished"}
    unfinished = {name for name, job in status.items() if job.state == "unfinished"}
    restarts = fleet.supervisor.restarts()
    return Outcome(
        finished=len(finished),
        unfinished=len(unfinished),
        lost=tuple(sorted(taken - finished - unfinished)),
        twice=tuple(sorted(name for name, times in done.items() if times > 1)),
        died=tuple(sorted(name for name, count in restarts.items() if count > fleet.killed[name])),
    )


def _every_key(fleet: str, arms: tuple[str, ...]) -> list[keys.Key]:
    named = [keys.Key(fleet, "arm", arm, topic) for arm in (*arms, "nobody") for topic in keys.TOPICS["arm"]]
    auction = [
        keys.Key(fleet, "auction", "auctioneer", topic, arms[0] if topic in keys.ASKED else "")
        for topic in keys.TOPICS["auction"]
    ]
    rest = [keys.Key(fleet, role, "", topic) for role in keys.NAMELESS for topic in keys.TOPICS[role]]
    return [*named, *auction, *rest]


def main() -> None:
    """Strike with every fault and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(FAULTS), help="some faults, comma-separated")
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--speed", type=float, default=120.0, help="fleet seconds per real second")
    parser.add_argument("--keep", type=Path, help="folder in which journals, logs and recordings stay")
    arguments = parser.parse_args()
    chosen = arguments.only.split(",")
    if unknown := [name for name in chosen if name not in FAULTS]:
        parser.error(f"no fault '{unknown[0]}'; there are {', '.join(FAULTS)}")
    logging.basicConfig(level=logging.ERROR)
    prepare(load(SCENARIO), difficulty="blind")  # once, so that no arm has to plan while it is struck
    columns = ("fault", "jobs", "finished", "unfinished", "lost", "twice", "died", "detected s", "recovered s", "all s")
    widths = (18, 5, 9, 11, 5, 6, 5, 11, 12, 7)
    print("".join(f"{name:>{width}}" for name, width in zip(columns, widths, strict=True)), flush=True)
    good = True
    for name in chosen:
        with ExitStack() as stack:
            folder = arguments.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            found = campaign(name, folder / name, jobs=arguments.jobs, speed=arguments.speed)
        good = good and found.good
        numbers = (
            len(found.lost),
            len(found.twice),
            len(found.died),
            found.detected_s,
            found.recovered_s,
            found.took_s,
        )
        cells = (name, arguments.jobs, found.finished, found.unfinished, *numbers)
        print("".join(f"{_text(cell):>{width}}" for cell, width in zip(cells, widths, strict=True)), flush=True)
        for what in ("lost", "twice", "died"):
            if names := getattr(found, what):
                print(f"    {what}: {', '.join(names)}", flush=True)
    sys.exit(0 if good else 1)


def _text(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else "never" if math.isinf(value) else f"{value:.1f}"
    return str(value)


if __name__ == "__main__":
    main()
