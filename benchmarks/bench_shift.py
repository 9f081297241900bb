"""CPU time of a shift of eight hours on one core, from the first decision to the metrics.

    python -m benchmarks.bench_shift

The quickstart scenario over 8 h with its 4 arms, and with four such cells side by side; no twin, exchange in memory,
round robin. Planning is not timed. Recording keeps one sensor reading per second and arm. The arms follow their plans
exactly (profile plant); bench_plant.py measures the closed loop.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import statistics
import time
from dataclasses import replace
from typing import TypeVar

from fleet.job import Place
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.schema import ArmSpec, Scenario

HOURS = 8
RUNS = 3
CELL_M = 5.0
"""Distance between cells; no arm reaches into the next."""

Standing = TypeVar("Standing", Place, ArmSpec)


def side_by_side(base: Scenario, cells: int) -> Scenario:
    """Scenario with `cells` copies of a cell in a row, each with its own arms, places and jobs."""

    def moved(thing: Standing, cell: int) -> Standing:
        x, y, z = thing.position_m
        return replace(thing, name=f"{thing.name}_{cell}", position_m=(x + cell * CELL_M, y, z))

    return replace(
        base,
        arms=tuple(moved(arm, c) for c in range(cells) for arm in base.arms),
        places=tuple(moved(place, c) for c in range(cells) for place in base.places),
        jobs=tuple(
            replace(job, name=f"{job.name}_{c}", places=tuple(f"{name}_{c}" for name in job.places))
            for c in range(cells)
            for job in base.jobs
        ),
        slots=cells * base.slots,
    )


def measure(fleet: Fleet, *, record: bool) -> str:
    """One row of the table."""
    spec = RunSpec(policy="round_robin", bus="memory", difficulty="blind")
    cpu, wall, finished = [], [], 0
    for _ in range(RUNS):
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        finished = run(fleet, spec, record=record).metrics.finished
        wall.append(time.perf_counter() - start_s)
        cpu.append(time.process_time() - start_cpu_s)
    tick_ms = 1e3 * statistics.median(cpu) / fleet.scenario.ticks
    return (
        f"{len(fleet.arms):>5}{'yes' if record else 'no':>8}{finished:>8}"
        f"{statistics.median(cpu):>9.2f}{statistics.median(wall):>9.2f}{tick_ms:>10.2f}"
    )


def main() -> None:
    """Print the table."""
    print(f"{HOURS} h with the profile plant; medians of {RUNS} shifts")
    print(f"{'arms':>5}{'record':>8}{'jobs':>8}{'CPU s':>9}{'wall s':>9}{'ms/tick':>10}")
    base = replace(load("quickstart"), horizon_s=HOURS * 3600.0)
    for cells in (1, 4):
        fleet = prepare(side_by_side(base, cells), difficulty="blind")
        for record in (False, True):
            print(measure(fleet, record=record), flush=True)


if __name__ == "__main__":
    main()
