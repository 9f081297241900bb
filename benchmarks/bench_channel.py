"""Performance of a fleet when messages between its arms are late, lost or restricted.

    python benchmarks/bench_channel.py [SCENARIO] [--seeds 5] [--first-seed 100] [--policies least_difficulty,consensus]

Means over the seeds; in brackets the mean paired difference to the same policy and seed on a perfect channel, with *
if its 95 % interval excludes zero. `heard`: share of messages delivered, over all pairs of arms. `lost`: claims for a
job or station that another arm won. Policies that use no peer messages (round_robin) are equal on every channel. In
memory, with the profile plant and the arms' twins, on all cores. The defaults are 130 shifts: some eight minutes of CPU
time, half of that on two idle cores, and a few minutes more if the twins are not cached. `heat_wave` takes three times
as long.
"""

import argparse
import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from fleet.bus.exchange.channel import Channel, Partition
from fleet.files import cache_folder
from scenarios.load import load
from scenarios.prepare.fleet import prepare
from scenarios.run.shift import RunSpec, run
from scenarios.schema import Scenario
from scenarios.statistics.means import interval

FIGURES = ("value", "on_time", "faults", "above_warning_min", "lost", "heard")
DIGITS = {"value": 1, "on_time": 1, "faults": 2, "above_warning_min": 0, "lost": 1}


def channels(scenario: Scenario) -> dict[str, Channel]:
    """Compared channels by name; the first is perfect."""
    arms = [arm.name for arm in scenario.arms]
    half, third_s = len(arms) // 2, scenario.horizon_s / 3
    cut = Partition(third_s, 2 * third_s, (tuple(arms[:half]), tuple(arms[half:])))
    named = [
        Channel(),
        Channel(topology="star"),
        Channel(topology="ring"),
        Channel(topology="line"),
        Channel(delay_s=10),
        Channel(delay_s=30),
        Channel(delay_s=120),
        Channel(delay_s=20, jitter_s=40),
        Channel(loss=0.2),
        Channel(loss=0.5),
        Channel(partitions=(cut,)),
        Channel(topology="ring", delay_s=30, jitter_s=5, loss=0.2, partitions=(cut,)),
        Channel(loss=1.0),
    ]
    return {channel.text: channel for channel in named}


def shifts(scenario: Scenario, cache: Path, policy: str, channel: Channel, seeds: range) -> np.ndarray:
    """`FIGURES` of the shift of every seed, [seed, figure]."""
    fleet, arms = prepare(scenario, cache=cache), len(scenario.arms)
    rows = []
    for seed in seeds:
        result = run(fleet, RunSpec(policy=policy, seed=seed, bus="memory", channel=channel), record=False)
        m = result.metrics
        words = arms * (arms - 1) * (round(result.time_s / scenario.decision_interval_s) + 1)
        lost = sum(event.kind == "lost" for event in result.events)
        rows.append([m.value, m.on_time, m.faults, m.above_warning_min, lost, m.messages / words])
    return np.array(rows)


def row(values: np.ndarray, base: np.ndarray) -> str:
    """One line of the table: figures [seed, figure] beside those of the perfect channel."""
    cells = []
    for i, (name, digits) in enumerate(DIGITS.items()):
        gap = values[:, i] - base[:, i]
        star = "*" if interval(gap).excludes_zero else ""
        more = f" ({gap.mean():+.{digits}f}{star})" if gap.any() else ""
        cells.append(f"{values[:, i].mean():.{digits}f}{more} | ")
        assert FIGURES[i] == name
    return "".join(cells) + f"{100 * values[:, -1].mean():.0f} %"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", nargs="?", default="quickstart")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--policies", default="least_difficulty,consensus")
    options = parser.parse_args()
    scenario, cache = load(options.scenario), cache_folder()
    start_s = time.perf_counter()
    prepare(scenario, cache=cache)  # into the cache, for all workers
    policies, between = options.policies.split(","), channels(scenario)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    cells = [(policy, name) for policy in policies for name in between]
    found: Any = Parallel(n_jobs=-1)(
        delayed(shifts)(scenario, cache, policy, between[name], seeds) for policy, name in cells
    )
    figures = dict(zip(cells, found, strict=True))
    print(f"{scenario.name}, seeds {seeds[0]} to {seeds[-1]}\n")
    print("| policy | channel | value | on time | faults | min above warning | lost | heard |\n|" + "---|" * 8)
    for policy in policies:
        base = figures[policy, next(iter(between))]
        for name in between:
            print(f"| {policy} | {name} | {row(figures[policy, name], base)} |")
    print(f"\n{len(cells) * len(seeds)} shifts in {time.perf_counter() - start_s:.0f} s on {os.cpu_count()} cores.")


if __name__ == "__main__":
    main()
