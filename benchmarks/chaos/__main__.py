"""Faults against a whole fleet, each participant a process: what is lost or done twice, and how soon it recovers.

    python benchmarks/chaos [--only NAME,NAME] [--jobs 24] [--speed 120] [--keep DIR] [--no-namespaces]

For every fault a fleet of four arms is started anew (router, auctioneer, recorder, arms, on loopback; `alone-…` without
an auctioneer, the arms share the jobs out among themselves; `trespass` with TLS, as is `partition` where root can make
network namespaces), gets jobs, and while they are worked on the fault strikes. Then all jobs must come to an end:
finished once, or reported unfinished. Whether a job was done twice is read from the journals of the arms, not asked.
Detected: real seconds until the bus shows that something is wrong (a token gone, a state older than 3 s). Recovered:
until everybody is there and speaks again and the auctioneer answers; it counts the fault itself, where that takes time.
Exit code 1 if a job is lost or done twice, a process has died that nobody killed, somebody did what it may not, or a
clock was thrown off; 2 if all that was run went well, but this machine lacks what a fault needs, which was not run.
Bounded: at most `PATIENCE_S` for each part of a fault.
"""

import argparse
import logging
import math
import signal
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from campaign import SCENARIO, campaign
from council import cut_in_halves, cut_one_off
from namespaces import why_not
from partition import partition
from processes import full_disk, kill_arm, kill_auctioneer, kill_router, stop_arm, stuck_subscriber
from rubbish import replayed_awards, rubbish
from struck import CannotStrike, Fault
from trespass import trespass
from wall_clock import clock_jump

from scenarios.load import load
from scenarios.prepare.fleet import prepare

FAULTS = {
    "kill-arm": Fault(kill_arm),
    "stop-arm": Fault(stop_arm),
    "kill-auctioneer": Fault(kill_auctioneer),
    "kill-router": Fault(kill_router),
    "stuck-subscriber": Fault(stuck_subscriber),
    "full-disk": Fault(full_disk),
    "rubbish": Fault(rubbish),
    "replayed-awards": Fault(replayed_awards),
    "trespass": Fault(trespass, tls=True),
    "partition": Fault(partition, line=True),
    "clock-jump": Fault(clock_jump, clocks=True),
    "alone-kill-arm": Fault(kill_arm, alone=True),
    "alone-stop-arm": Fault(stop_arm, alone=True),
    "alone-kill-router": Fault(kill_router, alone=True),
    "alone-rubbish": Fault(rubbish, alone=True),
    "alone-cut-one": Fault(cut_one_off, alone=True, line=True, away=1),
    "alone-halves": Fault(cut_in_halves, alone=True, line=True),
}


def main() -> None:
    """Strike with every fault and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(FAULTS), help="some faults, comma-separated")
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--speed", type=float, default=120.0, help="fleet seconds per real second")
    parser.add_argument("--keep", type=Path, help="folder in which journals, logs and recordings stay")
    parser.add_argument("--no-namespaces", action="store_true", help="cut by a line of our own, also where root is")
    arguments = parser.parse_args()
    chosen = arguments.only.split(",")
    if unknown := [name for name in chosen if name not in FAULTS]:
        parser.error(f"no fault '{unknown[0]}'; there are {', '.join(FAULTS)}")
    logging.basicConfig(level=logging.ERROR)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # in order: namespaces outlive a process
    no_namespaces = ""
    if any(FAULTS[name].line for name in chosen):
        no_namespaces = "--no-namespaces" if arguments.no_namespaces else why_not()
    prepare(load(SCENARIO), difficulty="blind")  # once, so that no arm has to plan while it is struck
    columns = ("fault", "jobs", "finished", "unfinished", "lost", "twice", "died", "detected s", "recovered s", "all s")
    widths = (18, 5, 9, 11, 5, 6, 5, 11, 12, 7)
    print("".join(f"{name:>{width}}" for name, width in zip(columns, widths, strict=True)), flush=True)
    good, not_run = True, list[str]()
    for name in chosen:
        with ExitStack() as stack:
            folder = arguments.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            amount = {"jobs": arguments.jobs, "speed": arguments.speed}
            try:
                found = campaign(FAULTS[name], folder / name, **amount, namespaces=not no_namespaces)
            except CannotStrike as lack:
                print(f"{name:>{widths[0]}}  not run: {lack}.", flush=True)
                not_run.append(name)
                continue
        good = good and found.good
        numbers = (
            len(found.lost),
            len(found.twice),
            len(found.died),
            found.detected_s,
            found.recovered_s,
            found.took_s,
        )
        named = f"{name} ({found.by})" if found.by else name
        if found.by == "line":
            found.notes += (f"without namespaces: {no_namespaces}",)
        cells = (named, arguments.jobs, found.finished, found.unfinished, *numbers)
        print("".join(f"{_text(cell):>{width}}" for cell, width in zip(cells, widths, strict=True)), flush=True)
        for what in ("lost", "twice", "died", "wrong", "notes"):
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
