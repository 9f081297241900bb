"""Inject faults into live fleets: count lost jobs and jobs done twice, and measure the recovery.

    python -m benchmarks.chaos [--only NAME,NAME] [--jobs 24] [--speed 120] [--keep DIR] [--no-namespaces]
    python -m benchmarks.chaos --minutes 10 --seed 1 [--speed 120] [--keep DIR]

Every fault gets a new fleet of four arms: router, auctioneer, recorder and arms, each its own process, on loopback.
`alone-…` is without an auctioneer. `trespass` uses TLS, and so does `partition` as root, which makes network
namespaces. The fault is injected while arms work on jobs. Then every job must be finished once or reported unfinished.
Jobs that were done twice are found in the journals of the arms.

With --minutes, one fleet works all the time, with kills at random and every fault of `random_faults.py`, in an order
that the seed determines. At the end: jobs lost, done twice and unreported, and the longest time without a result after
the end of a fault, 5 s at most.

Detected: real seconds until the bus shows the fault (a missing token, a state older than 3 s). Recovered: until all
participants are present and publish, and the auctioneer replies; this includes the duration of the fault.
Exit code 1: a job was lost or done twice, a process exited that was not killed, a participant got past the access
rules, or a clock was wrong. Exit code 2: all faults that were run passed, but this machine could not inject some.
Each phase of a fault takes `TIMEOUT_S` at most.
"""

import argparse
import logging
import math
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from benchmarks.chaos.campaign import SCENARIO, campaign
from benchmarks.chaos.fleet_under_test import CannotInject, Fault
from benchmarks.chaos.messages import malformed, poison, replayed_awards
from benchmarks.chaos.namespaces import unavailable_reason
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
from benchmarks.chaos.random_faults import GAP_S, KILL, Figures, run
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
    parser.add_argument("--no-namespaces", action="store_true", help="partition by a proxy, also as root")
    parser.add_argument("--minutes", type=float, default=0.0, help="random faults on one fleet for as long")
    parser.add_argument("--seed", type=int, default=0, help="--minutes: determines the faults and their order")
    arguments = parser.parse_args()
    if arguments.minutes:
        sys.exit(random_campaign(arguments.seed, arguments.minutes, arguments.speed, arguments.keep))
    chosen = arguments.only.split(",")
    if unknown := [name for name in chosen if name not in FAULTS]:
        parser.error(f"unknown fault '{unknown[0]}'; faults: {', '.join(FAULTS)}")
    logging.basicConfig(level=logging.ERROR)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # remove the namespaces: they outlive the process
    no_namespaces = ""
    if any(FAULTS[name].cut for name in chosen):
        no_namespaces = "--no-namespaces" if arguments.no_namespaces else unavailable_reason()
    prepare(load(SCENARIO), difficulty="blind")  # fills the cache, so that arms do not plan during a fault
    print("".join(f"{name:>{width}}" for name, width in COLUMNS.items()), flush=True)
    good, not_run = True, list[str]()
    for name in chosen:
        with ExitStack() as stack:
            folder = arguments.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            amount = {"jobs": arguments.jobs, "speed": arguments.speed}
            try:
                found = campaign(FAULTS[name], folder / name, **amount, namespaces=not no_namespaces)
            except CannotInject as lack:
                print(f"{name:>{COLUMNS['fault']}}  not run: {lack}.", flush=True)
                not_run.append(name)
                continue
        good = good and found.good
        numbers = (len(found.lost), len(found.twice), len(found.exited))
        times = (found.detected_s, found.recovered_s, found.took_s)
        named = f"{name} ({found.by})" if found.by else name
        if found.by == "proxy":
            found.notes += (f"without namespaces: {no_namespaces}",)
        cells = (named, arguments.jobs, found.finished, found.unfinished, *numbers, *times)
        print(
            "".join(f"{_text(cell):>{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True)), flush=True
        )
        for what in ("lost", "twice", "exited", "violations", "notes"):
            if names := getattr(found, what):
                print(f"    {what}: {', '.join(names)}", flush=True)
    if not_run:
        print(f"Not run: {', '.join(not_run)}.", flush=True)
    sys.exit(1 if not good else 2 if not_run else 0)


def random_campaign(seed: int, minutes: float, speed: float, keep: Path | None) -> int:
    """Run the faults of a seed, print each one and the figures, and return the exit code."""
    logging.basicConfig(level=logging.ERROR)
    prepare(load(SCENARIO), difficulty="blind")
    print(f"seed {seed}, {minutes:g} min, {speed:g} times real time, load of the machine {os.getloadavg()[0]:.1f}")
    row = "{:>4}{:>8}{:>20}  {:<8}{:>8}{:>14}{:>12}"
    print(row.format("", "at s", "fault", "arm", "pause s", "next result s", "recovered s"), flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        clocks = shutil.which("cc") is not None
        steps = run(seed, (keep or Path(temporary)) / f"seed-{seed}", minutes=minutes, speed=speed, clocks=clocks)
        for number, each in enumerate(steps, start=1):
            if isinstance(each, Figures):
                return _print_figures(each)
            step, numbers = each.step, map(_text, (each.step.pause_s, each.gap_s, each.recovered_s))
            print(row.format(number, _text(each.at_s), step.fault, step.arm, *numbers), flush=True)
    raise AssertionError("no figures")


def _print_figures(figures: Figures) -> int:
    faults, gaps = Counter(each.step.fault for each in figures.injected), [each.gap_s for each in figures.injected]
    kills = sum(count for name, count in faults.items() if name in KILL)
    states = ", ".join(f"{count} {state}" for state, count in sorted(figures.states.items()))
    others = faults.total() - kills
    print(f"{len(faults)} kinds of faults: {kills} kills and {others} others in {figures.took_s:.0f} s")
    print(f"{figures.jobs} jobs: {states}")
    print(f"{len(figures.lost)} lost, {len(figures.twice)} twice, {len(figures.unreported)} unreported")
    late = sum(gap > GAP_S for gap in gaps)
    print(
        f"next result after a fault: median {_text(float(np.median(gaps)))} s, longest {_text(max(gaps))} s, "
        f"{late} of {len(gaps)} later than {GAP_S:g} s; load of the machine {os.getloadavg()[0]:.1f}"
    )
    for what in ("lost", "twice", "unreported", "violations", "notes"):
        for line in getattr(figures, what)[:16]:
            print(f"    {what}: {line}")
    print("passed" if figures.good else "not passed", flush=True)
    return int(not figures.good)


def _text(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else "never" if math.isinf(value) else f"{value:.1f}"
    return str(value)


if __name__ == "__main__":
    main()
