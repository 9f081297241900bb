"""Start-up time, memory and load of a fleet without jobs: `thermofleet up SCENARIO --jobs none`, as a user starts it.

    python -m benchmarks.bench_idle [--scenario quickstart] [--seconds 60] [--page]

Memory is the sum of the proportional set sizes (PSS) of all processes, with `up` itself; load is their CPU time over
the window. `--award` runs the scenario's own jobs instead, and prints only the seconds until the first award.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from benchmarks.harness import cpu_s, options, pss_mb

READY_S = 600.0


def descendants(pid: int) -> list[int]:
    """A process and all its descendants, the parents first."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(each for child in children for each in descendants(int(child)))]


def name_of(pid: int) -> str:
    """Name of a process of a fleet; forks of `up` have that of their part."""
    return Path(f"/proc/{pid}/comm").read_text().strip()


def main() -> None:
    """Print the table."""
    given = options(
        __doc__,
        scenario="quickstart",
        seconds=(60.0, "measurement window"),
        settle=(10.0, "seconds between the start and the window"),
        page=(False, "with the live page"),
        award=(False, "only measure the seconds until the first award"),
    )
    with tempfile.TemporaryDirectory() as folder, Path(folder, "up.log").open("w+") as log:
        jobs = "scenario" if given.award else "none"
        command = (sys.executable, "-m", "scenarios", "up", given.scenario, "--jobs", jobs, "--out", folder)
        command += ("--port", "0", *(["--page"] if given.page else []))
        began_s = time.monotonic()
        fleet = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            wait_until(fleet, lambda: " is up" in Path(log.name).read_text())
            print(f"up after {time.monotonic() - began_s:.1f} s")
            if given.award:
                journal = Path(folder, "journals", "auctioneer.journal-wal")
                wait_until(fleet, lambda: journal.exists() and b'"award"' in journal.read_bytes())
                print(f"first award after {time.monotonic() - began_s:.1f} s")
                return
            time.sleep(given.settle)
            pids = descendants(fleet.pid)
            before, begun_s = {pid: cpu_s(pid) for pid in pids}, time.monotonic()
            time.sleep(given.seconds)
            took_s = time.monotonic() - begun_s
            load = {pid: 100 * (cpu_s(pid) - before[pid]) / took_s for pid in pids}
            memory = {pid: pss_mb(pid) for pid in pids}
            print(f"\n{'process':<42}{'PSS MB':>10}{'% of core':>10}")
            for pid in pids:
                print(f"{name_of(pid):<42}{memory[pid]:>10.1f}{load[pid]:>10.2f}")
            print(f"{'all':<42}{sum(memory.values()):>10.1f}{sum(load.values()):>10.2f}")
        finally:
            with suppress(ProcessLookupError):
                os.kill(fleet.pid, signal.SIGTERM)
            fleet.wait(60)


def wait_until(fleet: "subprocess.Popen[bytes]", reached: "object") -> None:
    """Wait until something is true, while the fleet runs."""
    end_s = time.monotonic() + READY_S
    assert callable(reached)
    while not reached():
        assert fleet.poll() is None, "the fleet has ended"
        assert time.monotonic() < end_s, "the fleet is not ready"
        time.sleep(0.05)


if __name__ == "__main__":
    main()
