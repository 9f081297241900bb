"""One shift of every policy, simulated and live: jobs finished and faults.

    python -m benchmarks.bench_policies [quickstart] [--speed 240] [--seed 0] [--policies a,b] [--out FILE]
    python -m benchmarks.bench_policies --steps [--difficulty oracle] [--policies a,b] [--out FILE]

Writes the figures, and prints them as the tables of docs/policies.md and docs/learning.md that `docs/tables.py`
makes of docs/results/live_policies.json and docs/results/steps.json. A live shift is `thermofleet up` with a process
for every participant; a shift of 2 h at speed 240 takes 30 s. Policies are blind: no twin is trained.

With --steps: the number of steps of a shift with `decisions="interval"` and `"events"`, and how many of them have a
choice and a job in every slot, for every scenario of the library and every policy. Exits with an error if the two kinds
of steps give different results.
"""

import json
import subprocess
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq

from agents.registry import RULES
from benchmarks.harness import options, write_text
from benchmarks.result_tables import live_table, steps_table
from fleet.env.validation import Decisions
from scenarios.live.fleet_processes import PROGRAM
from scenarios.policy_loader import label, policy_at, scope_of
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.run.shift import run
from scenarios.spec.load import library, load
from scenarios.spec.options import DifficultyName, RunSpec
from scenarios.spec.parse import choose

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


class Steps(NamedTuple):
    """Steps of a shift, and its result."""

    env: int
    env_choices: int
    """Env steps in which an arm may claim a job."""
    arm: int
    arm_choices: int
    """Arm steps in which the arm may claim a job."""
    full: int
    """Env steps with a job in every slot."""
    reward: float
    finished_s: bytes
    """Finish of every job, for comparison."""


def steps_of(fleet: Fleet, policy: str, seed: int, decisions: Decisions) -> Steps:
    """Play a shift with one length of steps."""
    env, chooser = env_of(fleet, decisions=decisions, ahead_s=np.inf, bids=True), policy_at(policy, seed)
    env.reset(seed=seed)
    choices, full, reward = [], 0, 0.0
    while env.agents:
        seen = env.knowledge()
        choices.append([each.action_mask[1:-1].any() for each in seen.values()])
        full += bool(next(iter(seen.values())).offered.all())
        _, rewards, *_ = env.step(chooser.act(seen))
        reward += next(iter(rewards.values()))
    may = np.array(choices)
    counts = len(may), int(may.any(axis=1).sum()), may.size, int(may.sum())
    return Steps(*counts, full, reward, env.truth.finished_s.tobytes())


def measure_steps(scenarios: list[str], policies: list[str], seed: int, difficulty: DifficultyName) -> dict[str, Any]:
    """The steps of a shift, as `steps_table` takes them.

    Raises:
        SystemExit: the two kinds of steps give different results.
    """
    rows: list[dict[str, Any]] = []
    for name in scenarios:
        fleet = prepare(load(name), difficulty=difficulty)
        for policy in policies:
            every, some = (steps_of(fleet, policy, seed, decisions) for decisions in ("interval", "events"))
            if every.finished_s != some.finished_s or not np.isclose(every.reward, some.reward, rtol=1e-9):
                raise SystemExit(f"{name}, {policy}: events and interval give different results.")
            counts = {
                decisions: {field: getattr(steps, field) for field in Steps._fields[:5]}
                for decisions, steps in (("interval", every), ("events", some))
            }
            rows.append({"scenario": name, "policy": label(policy), **counts})
    return {"seed": seed, "difficulty": difficulty, "rows": rows}


def measure_live(scenario: str, policies: list[str], seed: int, speed: float) -> dict[str, Any]:
    """Simulated and live shifts, as `live_table` takes them."""
    fleet, rows = prepare(load(scenario), difficulty="blind"), list[dict[str, Any]]()
    for policy in policies:
        finished, faults = simulated(fleet, policy, seed)
        done, lost = live(scenario, policy, seed, speed, fleet.scenario.horizon_s)
        rows.append(
            {
                "policy": label(policy),
                "scope": scope_of(policy),
                "simulated": {"finished": finished, "faults": faults},
                "live": {"finished": done, "faults": lost},
            }
        )
    return {"scenario": scenario, "seed": seed, "speed": speed, "rows": rows}


def main() -> None:
    """Measure, write and print."""
    given = options(
        __doc__,
        "scenario",
        scenario=(str, "default: quickstart, with --steps all of the library"),
        speed=240.0,
        seed=0,
        policies=",".join(RULES),
        steps=False,
        difficulty=("blind", "with --steps"),
        out=(Path, "JSON file of the figures"),
    )
    policies = given.policies.split(",")
    if given.steps:
        scenarios = [given.scenario] if given.scenario else list(library())
        measured = measure_steps(
            scenarios, policies, given.seed, choose("difficulty", given.difficulty, DifficultyName)
        )
        print(steps_table(measured))
    else:
        measured = measure_live(given.scenario or "quickstart", policies, given.seed, given.speed)
        print(live_table(measured))
    if given.out:
        write_text(given.out, json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
