"""Inject faults into live fleets: count lost jobs and jobs done twice, and measure the recovery.

    python -m benchmarks.chaos [--only NAME,NAME] [--jobs 24] [--speed 120] [--keep DIR]

Every fault gets a new fleet of four arms: router, auctioneer, recorder and arms, each its own process, on loopback.
`alone-…` is without an auctioneer, `trespass` with TLS. The fault is injected while arms work on jobs. Then every job
must be finished once or reported unfinished. Jobs that were done twice are found in the journals of the arms. For
random faults see `benchmarks.simulation`.

Detected: real seconds until the bus shows the fault (a missing token, a state older than 3 s). Recovered: until all
participants are present and publish, and the auctioneer replies; this includes the duration of the fault.
Exit code 1: a job was lost or done twice, a process exited that was not killed, a participant got past the access
rules, or a clock was wrong. Exit code 2: all faults that were run passed, but this machine could not inject some.
Each phase of a fault takes `TIMEOUT_S` at most.
"""

import argparse
import logging
import math
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from benchmarks.chaos.campaign import SCENARIO, campaign
from benchmarks.chaos.fleet_under_test import CannotInject, Fault
from benchmarks.chaos.messages import malformed, poison, replayed_awards
from benchmarks.chaos.partition import cut_off_half, cut_off_one, partition
from benchmarks.chaos.processes import (
    full_disk,
    full_disks,
    full_log_disk,
    kill_arm,
    kill_auctioneer,
    kill_router,
    kill_router_often,
    stop_arm,
    stuck_subscriber,
)
from benchmarks.chaos.trespass import trespass
from benchmarks.chaos.wall_clock import clock_jump
from scenarios.prepare.fleet import prepare
from scenarios.spec.load import load

FAULTS = {
    "kill-arm": Fault(kill_arm),
    "stop-arm": Fault(stop_arm),
    "kill-auctioneer": Fault(kill_auctioneer),
    "kill-router": Fault(kill_router),
    "stuck-subscriber": Fault(stuck_subscriber),
    "kill-router-often": Fault(kill_router_often),
    "full-disk": Fault(full_disk),
    "full-log-disk": Fault(full_log_disk),
    "full-disks": Fault(full_disks),
    "malformed": Fault(malformed),
    "poison": Fault(poison),
    "replayed-awards": Fault(replayed_awards),
    "trespass": Fault(trespass, tls=True),
    "partition": Fault(partition, cut=True),
    "clock-jump": Fault(clock_jump, clocks=True),
    "alone-kill-arm": Fault(kill_arm, no_auctioneer=True),
    "alone-stop-arm": Fault(stop_arm, no_auctioneer=True),
    "alone-kill-router": Fault(kill_router, no_auctioneer=True),
    "alone-malformed": Fault(malformed, no_auctioneer=True),
    "alone-poison": Fault(poison, no_auctioneer=True),
    "alone-cut-one": Fault(cut_off_one, no_auctioneer=True, cut=True, cut_arms=1),
    "alone-halves": Fault(cut_off_half, no_auctioneer=True, cut=True),
}


COLUMNS = {
    **{"fault": 18, "jobs": 5, "finished": 9, "unfinished": 11, "lost": 5, "twice": 6, "exited": 7},
    **{"detected s": 11, "recovered s": 12, "all s": 7},
}
"""Headings and widths of the table."""


def main() -> None:
    """Inject every fault and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(FAULTS), help="faults, comma-separated")
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--speed", type=float, default=120.0, help="fleet seconds per real second")
    parser.add_argument("--keep", type=Path, help="folder for journals, logs and recordings; default: temporary")
    arguments = parser.parse_args()
    chosen = arguments.only.split(",")
    if unknown := [name for name in chosen if name not in FAULTS]:
        parser.error(f"unknown fault '{unknown[0]}'; faults: {', '.join(FAULTS)}")
    logging.basicConfig(level=logging.ERROR)
    prepare(load(SCENARIO), difficulty="blind")  # fills the cache, so that arms do not plan during a fault
    print("".join(f"{name:>{width}}" for name, width in COLUMNS.items()), flush=True)
    good, not_run = True, list[str]()
    for name in chosen:
        with ExitStack() as stack:
            folder = arguments.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            amount = {"jobs": arguments.jobs, "speed": arguments.speed}
            try:
                found = campaign(FAULTS[name], folder / name, **amount)
            except CannotInject as lack:
                print(f"{name:>{COLUMNS['fault']}}  not run: {lack}.", flush=True)
                not_run.append(name)
                continue
        good = good and found.good
        numbers = (len(found.lost), len(found.twice), len(found.exited))
        times = (found.detected_s, found.recovered_s, found.took_s)
        cells = (name, arguments.jobs, found.finished, found.unfinished, *numbers, *times)
        print(
            "".join(f"{_text(cell):>{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True)), flush=True
        )
        for what in ("lost", "twice", "exited", "violations", "notes"):
            if names := getattr(found, what):
                print(f"    {what}: {', '.join(names)}", flush=True)
    if not_run:
        print(f"Not run: {', '.join(not_run)}.", flush=True)
    sys.exit(1 if not good else 2 if not_run else 0)


def _text(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else "never" if math.isinf(value) else f"{value:.1f}"
    return str(value)


if __name__ == "__main__":
    main()
