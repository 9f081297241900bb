"""Faults of processes and of the disk."""

import math
import os
import resource
import signal
import subprocess
import sys
import threading

from fleet_under_test import Fleet


def kill_arm(fleet: Fleet) -> float:
    """SIGKILL an arm during a job."""
    arm = fleet.working_arm() or fleet.arms[0]
    fleet.send_signal(f"arm-{arm}")
    return fleet.wait_until(lambda: fleet.is_absent(arm), 10.0)


def stop_arm(fleet: Fleet) -> float:
    """SIGSTOP an arm during a job, for longer than its lease, then SIGCONT."""
    arm = fleet.working_arm() or fleet.arms[0]
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
    arm = fleet.working_arm() or fleet.arms[0]
    struck = [fleet.supervisor.pid(name) for name in (f"arm-{arm}", fleet.auction)]
    pids = [pid for pid in struck if pid is not None]
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
    fleet.wait_until(lambda: False, 10.0)
    for pid in pids:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return math.nan
