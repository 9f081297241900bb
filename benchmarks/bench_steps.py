"""Steps of a shift with `decisions="interval"` and `"events"`, and how many of them have a choice.

    python -m benchmarks.bench_steps [SCENARIO] [--difficulty oracle] [--policies a,b] [--seed 0] [--out FILE]

For every scenario of the library and every policy; also the steps with a job in every slot. Prints the table of
docs/learning.md that `docs/tables.py` makes of docs/results/steps.json. Exits with an error if the two kinds of steps
give different results.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.registry import RULES
from benchmarks.harness import options, write_text
from benchmarks.result_tables import steps_table
from fleet.env.validation import Decisions
from scenarios.policy_loader import label, policy_at
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.spec.load import library, load
from scenarios.spec.options import DifficultyName
from scenarios.spec.parse import choose


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


def main() -> None:
    """Measure, write and print."""
    given = options(
        __doc__,
        "scenario",
        scenario=("", "default: all of the library"),
        seed=0,
        policies=",".join(RULES),
        difficulty="blind",
        out=(Path, "JSON file of the figures"),
    )
    scenarios = [given.scenario] if given.scenario else list(library())
    difficulty = choose("difficulty", given.difficulty, DifficultyName)
    measured = measure_steps(scenarios, given.policies.split(","), given.seed, difficulty)
    print(steps_table(measured))
    if given.out:
        write_text(given.out, json.dumps(measured, indent=1) + "\n")


if __name__ == "__main__":
    main()
