"""Performance of a fleet when messages between its arms are late, lost or restricted.

    python -m benchmarks.bench_channel [SCENARIO] [--seeds 5] [--first-seed 100] [--policies least_difficulty,consensus]
        [--out docs/results/channels/SCENARIO.json]

Writes the figures of every shift, and prints them as the table of docs/exchange.md that `docs/tables.py` makes of the
file. `received`: share of messages delivered, over all pairs of arms. `lost`: claims for a job or station that another
arm won. Policies that use no peer messages (round_robin) are equal on every channel. In memory, with the profile plant
and the arms' twins, on all cores. The defaults are 130 shifts: some eight minutes of CPU time, half of that on two idle
cores, and a few minutes more if the twins are not cached. `heat_wave` takes three times as long.
"""

import json
import os

os.environ["OMP_NUM_THREADS"] = "1"

import time
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from benchmarks.harness import options, write_text
from benchmarks.result_tables import channel_table
from fleet.bus.exchange.channel import Channel, Partition
from fleet.files import cache_folder
from scenarios.prepare.fleet import prepare
from scenarios.run.shift import run
from scenarios.spec.load import load
from scenarios.spec.options import RunSpec
from scenarios.spec.schema import Scenario

FIGURES = ("value", "on_time", "faults", "above_warning_min", "lost", "received")


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
        messages = arms * (arms - 1) * (round(result.time_s / scenario.decision_interval_s) + 1)
        lost = sum(event.kind == "lost" for event in result.events)
        rows.append([m.value, m.on_time, m.faults, m.above_warning_min, lost, m.messages / messages])
    return np.array(rows)


def main() -> None:
    """Print the table."""
    policies = "least_difficulty,consensus"
    given = options(__doc__, "scenario", scenario="quickstart", seeds=5, first_seed=100, policies=policies, out=Path)
    scenario, cache = load(given.scenario), cache_folder()
    start_s = time.perf_counter()
    prepare(scenario, cache=cache)  # into the cache, for all workers
    policies, between = given.policies.split(","), channels(scenario)
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    cells = [(policy, name) for policy in policies for name in between]
    found: Any = Parallel(n_jobs=-1)(
        delayed(shifts)(scenario, cache, policy, between[name], seeds) for policy, name in cells
    )
    result = {
        "scenario": scenario.name,
        "seeds": list(seeds),
        "figures": FIGURES,
        "rows": [
            {"policy": policy, "channel": name, "values": np.round(values, 4).tolist()}
            for (policy, name), values in zip(cells, found, strict=True)
        ],
    }
    out = given.out or Path(f"docs/results/channels/{scenario.name}.json")
    write_text(out, json.dumps(result) + "\n")
    print(channel_table(result))
    print(f"\n{len(cells) * len(seeds)} shifts in {time.perf_counter() - start_s:.0f} s on {os.cpu_count()} cores.")


if __name__ == "__main__":
    main()
