"""Faults of processes and of the disk."""

import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from benchmarks.chaos.fleet_under_test import Fleet
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobSpec, Submission, SubmissionReply

DISK_S, ANSWER_S = 10.0, 3.0
"""Real seconds: of a full disk; in which a submission must be answered once the router is back."""


def kill_arm(fleet: Fleet) -> float:
    """SIGKILL an arm during a job."""
    arm = fleet.victim()
    fleet.send_signal(f"arm-{arm}")
    return fleet.wait_until(lambda: fleet.is_absent(arm), 10.0)


def stop_arm(fleet: Fleet) -> float:
    """SIGSTOP an arm during a job, for longer than its lease, then SIGCONT."""
    arm = fleet.victim()
    fleet.send_signal(f"arm-{arm}", signal.SIGSTOP)
    seen_s = fleet.wait_until(lambda: fleet.is_absent(arm), 10.0)
    fleet.wait_until(lambda: False, 12.0)
    fleet.send_signal(f"arm-{arm}", signal.SIGCONT)
    return seen_s


def kill_auctioneer(fleet: Fleet) -> float:
    """SIGKILL the auctioneer during an auction."""
    begun = len(fleet.results)
    fleet.wait_until(lambda: len(fleet.results) > begun, 20.0)  # it has just published a result
    fleet.send_signal(fleet.auction)
    return math.nan


def kill_router(fleet: Fleet) -> float:
    """SIGKILL the router."""
    fleet.send_signal("router")
    return fleet.wait_until(lambda: not fleet.tokens, 10.0)


def stuck_subscriber(fleet: Fleet) -> float:
    """Add two subscribers to all keys: one is stopped, one takes 50 ms for every message."""
    code = (
        "import sys, time, zenoh, json\n"
        "config = zenoh.Config.from_json5(json.dumps({'mode': 'client', 'connect': {'endpoints': [sys.argv[1]]},"
        " 'scouting': {'multicast': {'enabled': False}}}))\n"
        "with zenoh.open(config) as z:\n"
        "    sub = z.declare_subscriber('thermofleet/v4/**', lambda s: time.sleep(0.05))\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(120)\n"
    )
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
    """Leave no space for the journals of an arm and of the auctioneer for ten seconds."""
    arm = fleet.victim()
    with _without_space(_pids(fleet, f"arm-{arm}", fleet.auction)):
        fleet.wait_until(lambda: False, DISK_S)
    return math.nan


def full_log_disk(fleet: Fleet) -> float:
    """Leave no space for the logs of all participants for ten seconds, in which they log; then kill an arm."""
    with _without_space([os.getpid()]):
        _make_them_log(fleet)
    return kill_arm(fleet)


def full_disks(fleet: Fleet) -> float:
    """Leave no space for any journal, log or recording for ten seconds; then kill an arm."""
    names = [*(f"arm-{arm}" for arm in fleet.arms), fleet.auction, "record"]
    with _without_space([os.getpid(), *_pids(fleet, *names)]):
        _make_them_log(fleet)
    return kill_arm(fleet)


def kill_router_often(fleet: Fleet) -> float:
    """SIGKILL the router eight times; a submission must be answered within 3 s of its last start."""
    for _ in range(8):
        fleet.send_signal("router")
        fleet.wait_until(lambda: not fleet.supervisor.ready("router"), 5.0)
        fleet.wait_until(lambda: fleet.supervisor.ready("router"), 30.0)
    began_s = time.monotonic()
    key, nothing = keys.of_jobs(fleet.client.fleet, "submit"), Submission((JobSpec("after", "hold", ("clamp",)),))

    def answered() -> bool:
        return bool(fleet.client.query_and_wait(key, nothing, SubmissionReply, timeout_s=0.5).messages)

    waited_s = fleet.wait_until(answered, 30.0)
    fleet.note(f"a submission was answered {time.monotonic() - began_s:.1f} s after the last start of the router")
    if waited_s > ANSWER_S:
        fleet.violations.append(f"a submission waited {waited_s:.1f} s")
    return math.nan


def _make_them_log(fleet: Fleet) -> None:
    """Send invalid messages, which every receiver logs, for as long as a disk is full."""
    end_s = time.monotonic() + DISK_S
    while time.monotonic() < end_s:
        for arm in fleet.arms:
            fleet.session.put(keys.of_arm(fleet.client.fleet, arm, "state"), b"{}")
        fleet.wait_until(lambda: False, 0.5)


def _pids(fleet: Fleet, *names: str) -> list[int]:
    return [pid for name in names if (pid := fleet.supervisor.pid(name)) is not None]


@contextmanager
def _without_space(pids: list[int]) -> Iterator[None]:
    """Let processes, and those that they start meanwhile, write to no file."""
    before = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in pids}
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for pid, (_, most) in before.items():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, most))
    try:
        yield
    finally:
        for pid, limits in before.items():
            with suppress(ProcessLookupError):
                resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
