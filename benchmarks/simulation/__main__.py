"""Simulate whole fleets under faults, seed after seed, until a rule is broken or the run is stopped.

    python -m benchmarks.simulation [--seeds N] [--hours H] [--first SEED]    seeds from SEED on, N or H hours
    python -m benchmarks.simulation --seed 123                                one seed, with the trace of its events
    python -m benchmarks.simulation --mutations [NAME,NAME]                   break rules on purpose, and find each

A fleet-hour is an hour of fleet time, in which jobs take as long as on a real arm; the participants' own clocks advance
less, by the speed of the fleet (1 to 240, drawn by the seed). Both are printed. One seed gives the same events in every
run: two runs of it print the same digest. Exit code 1: a rule is broken, or a mutation is not found.
"""

import argparse
import hashlib
import sys
import time
from dataclasses import dataclass

from benchmarks.simulation.mutations import MUTATIONS, applied
from benchmarks.simulation.shift import Shift
from benchmarks.simulation.world import Violation

FIND_S = 600.0
"""CPU seconds in which a mutation must be found."""
PROGRESS_S = 10.0
"""CPU seconds between two lines of progress."""


@dataclass
class Count:
    """What was simulated."""

    shifts: int = 0
    events: int = 0
    fleet_s: float = 0.0
    clock_s: float = 0.0
    cpu_s: float = 0.0

    def __str__(self) -> str:
        hours = self.cpu_s / 3600 or 1e-9
        return (
            f"{self.shifts} shifts, {self.fleet_s / 3600:.1f} fleet-hours ({self.clock_s / 3600:.2f} h on the "
            f"participants' clocks), {self.events} events in {self.cpu_s:.0f} s of one core: "
            f"{self.fleet_s / 3600 / hours:,.0f} fleet-hours per core hour ({self.clock_s / 3600 / hours:,.0f} on the "
            "clocks)"
        )


def run(seed: int, count: Count, *, trace: bool = False, mutation: str = "") -> str:
    """Simulate one seed, unless the mutation concerns no such fleet; return which rule was broken, or ""."""
    start_s, broken = time.process_time(), ""
    shift = Shift(seed, trace=trace)
    if mutation and MUTATIONS[mutation].alone not in (None, shift.alone):
        return ""
    try:
        with applied(mutation):
            shift.run()
    except Violation as violation:
        broken = str(violation)
    if shift.world.trace is not None:
        lines = "\n".join(shift.world.trace)
        print(f"{lines}\ndigest {hashlib.sha256(lines.encode()).hexdigest()[:16]}")
    count.shifts += 1
    count.events += shift.world.events
    count.clock_s += shift.world.now_s
    count.fleet_s += shift.world.now_s * shift.speed
    count.cpu_s += time.process_time() - start_s
    return broken


def campaign(first: int, seeds: int | None, hours: float | None) -> int:
    """Simulate seeds until stopped, or until one breaks a rule."""
    count, shown_s, end_s = Count(), 0.0, time.monotonic() + 3600 * hours if hours else None
    seed = first
    try:
        while (seeds is None or seed < first + seeds) and (end_s is None or time.monotonic() < end_s):
            if broken := run(seed, count):
                print(f"{count}\nSeed {seed}: {broken}\nRepeat it: make simulate SEED={seed}")
                return 1
            if count.cpu_s > shown_s + PROGRESS_S:
                shown_s = count.cpu_s
                print(f"to seed {seed}: {count}", flush=True)
            seed += 1
    except KeyboardInterrupt:
        pass
    print(f"No rule is broken. {count}")
    return 0


def find(names: list[str], first: int) -> int:
    """Break each rule, and simulate until it is found; print a table."""
    missed = 0
    print("| mutation | broken rule | found after, fleet-hours | CPU s | seed | as |\n|---|---|---|---|---|---|")
    for name in names:
        count, seed, broken = Count(), first, ""
        while not broken and count.cpu_s < FIND_S:
            broken = run(seed, count, mutation=name)
            seed += 1
        missed += not broken
        what = f"{count.fleet_s / 3600:.1f} | {count.cpu_s:.1f} | {seed - 1} | {broken or 'NOT FOUND'}"
        print(f"| `{name}` | {MUTATIONS[name].rule} | {what} |", flush=True)
    return 1 if missed else 0


def main() -> int:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, help="run one seed and print its trace")
    parser.add_argument("--seeds", type=int, help="number of seeds")
    parser.add_argument("--hours", type=float, help="real hours")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--mutations", nargs="?", const="all", help="break these rules on purpose: NAME,NAME or all")
    parser.add_argument("--mutation", default="", help="with --seed: break this rule")
    given = parser.parse_args()
    named: str = given.mutations or ""
    names = [*MUTATIONS] if named == "all" else named.split(",")
    unknown = [name for name in (*names, given.mutation) if name and name not in MUTATIONS]
    if unknown:
        parser.error(f"There is no mutation '{unknown[0]}'. Mutations: {', '.join(MUTATIONS)}.")
    if given.mutations:
        return find(names, given.first)
    if given.seed is not None:
        count = Count()
        broken = run(given.seed, count, trace=True, mutation=given.mutation)
        print(f"{count}\n{broken or 'No rule is broken.'}")
        return 1 if broken else 0
    return campaign(given.first, given.seeds, given.hours)


if __name__ == "__main__":
    sys.exit(main())
