"""Faults of processes and of the disk: killed, stopped, stuck, full."""

import math
import os
import resource
import signal
import subprocess
import sys
import threading

from struck import Fleet


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
        "    sub = z.declare_subscriber('thermofleet/v2/**', lambda s: time.sleep(0.05))\n"
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
