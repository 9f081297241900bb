"""One shift of every policy, simulated and live: jobs finished and faults, and the list of policies.

    python benchmarks/bench_policies.py [quickstart] [--speed 240] [--seed 0] [--policies a,b]
    python benchmarks/bench_policies.py --list

Prints Markdown for docs/policies.md. A live shift is `thermofleet up` with a process for every participant; a shift of
2 h at speed 240 takes 30 s. Policies are blind: no twin is trained.
"""

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq

from agents.registry import RULES
from scenarios.load import load
from scenarios.policy_loader import label, scope_of
from scenarios.prepare.fleet import Fleet, prepare
from scenarios.run.shift import RunSpec, run

PROGRAM = (sys.executable, "-c", "from scenarios.cli.main import main; main()")
PATIENCE_S = 120.0


def simulated(fleet: Fleet, policy: str, seed: int) -> tuple[int, int]:
    """Jobs finished and faults of `thermofleet run`."""
    spec = RunSpec(policy=policy, seed=seed, bus="memory", difficulty="blind")
    metrics = run(fleet, spec, record=False).metrics
    return metrics.finished, metrics.faults


def live(scenario: str, policy: str, seed: int, speed: float, shift_s: float) -> tuple[int, int]:
    """Jobs finished and faults of `thermofleet up`, from its recording."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["--policy", policy, "--seed", str(seed), "--speed", f"{speed:g}", "--out", folder, "--port", "0"]
        command = [*PROGRAM, "up", scenario, "--difficulty", "blind", *options]
        subprocess.run(command, check=True, capture_output=True, timeout=shift_s / speed + PATIENCE_S)
        kinds: Counter[str] = Counter()
        for part in (Path(folder) / "recording").glob("events-*.parquet"):
            kinds.update(pq.read_table(part)["kind"].to_pylist())
    return kinds["finish"], kinds["fault"]


def listed() -> str:
    """Print the built-in policies as a Markdown table."""
    rows = [f"| `{name}` | {rule.scope} | {rule.cost} | {rule.source} |" for name, rule in RULES.items()]
    return "\n".join(["| policy | scope | minimises | source |", "|---|---|---|---|", *rows])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scenario", nargs="?", default="quickstart")
    parser.add_argument("--speed", type=float, default=240.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policies", default=",".join(RULES))
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    if options.list:
        print(listed())
        return
    scenario = load(options.scenario)
    fleet = prepare(scenario, difficulty="blind")
    print("| policy | scope | simulated: finished | faults | live: finished | faults |\n|---|---|---|---|---|---|")
    for policy in options.policies.split(","):
        finished, faults = simulated(fleet, policy, options.seed)
        done, lost = live(options.scenario, policy, options.seed, options.speed, scenario.horizon_s)
        row = (f"`{label(policy)}`", scope_of(policy), finished, faults, done, lost)
        print(f"| {' | '.join(map(str, row))} |", flush=True)


if __name__ == "__main__":
    main()
