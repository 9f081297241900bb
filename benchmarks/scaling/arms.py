"""Cost per arm-hour as a hall grows: engine, matching, twin scores and conflict table, and the memory.

    python -m benchmarks.scaling.arms run [--arms 4 16 64 256 1000] [--out docs/results/scaling/arms.jsonl]
    python -m benchmarks.scaling.arms plot [--out docs/results/scaling/arms.jsonl]

Each size is a process of its own with an empty cache of plans. Costs are CPU seconds of one thread, so other work on
the machine matters little; the load average is in the file. Arms observe their eight nearest peers, in 64 slots.

- plans: planning every work for every arm that reaches it, from nothing.
- conflicts: which plans of two arms exclude each other, from nothing.
- engine: a simulated shift of an hour, steps only; no two arms share stations or space.
- matching: its decisions.
- scores: the twins score two plans of each of the eight jobs that an arm gets in an hour; the four twins of quickstart
  stand for all.

Arms beyond `--hall` are several equal halls. Their plans and conflicts are those of one, multiplied; in the other costs
the arms of all halls share one shift, all jobs and one matching.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import process_time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.harness import machine

COSTS = {"plans": "plans", "conflicts": "conflict table", "engine": "engine", "matching": "matching", "scores": "twins"}
ONCE = ("plans", "conflicts")
"""Costs of a cell, not of each hour."""
OUT = Path("docs/results/scaling/arms.jsonl")
PICTURE = Path("docs/pictures/scaling_arms.png")
HOURS, JOBS, PEERS = 1.0, 8, 8
SHIFTS = 3
"""Engine and matching: the median of these."""


def measure(arms: int, most_in_hall: int) -> dict[str, object]:
    """The costs of a hall of a number of arms, CPU s in all, and the most memory, MB."""
    import numpy as np

    from agents.registry import make_policy
    from benchmarks.scaling.hall import hall, repeated
    from fleet.arm.space import space_table
    from fleet.env.vector import BatchEnv
    from scenarios.prepare.batch import library_of
    from scenarios.prepare.fleet import Randomisation, prepare
    from scenarios.spec.load import load

    halls = -(-arms // most_in_hall)
    own_arms, costs = arms // halls, dict[str, float]()
    scenario = hall(own_arms, hours=HOURS, jobs=JOBS * own_arms * HOURS)
    randomise = Randomisation(arrivals=(halls, halls))
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as empty:
        began = process_time()
        fleet = prepare(scenario, difficulty="blind", cache=folder, randomise=randomise)
        plans = [plan for arm in fleet.arms for variants in arm.plans.values() for plan in variants]
        prepared = process_time() - began
        began = process_time()
        space_table([arm.robot for arm in fleet.arms], plans, scenario.clearance_m, Path(empty))
        conflicts = process_time() - began
        costs["conflicts"], costs["plans"] = halls * conflicts, halls * (prepared - conflicts)

    library = repeated(library_of(fleet), halls, min(PEERS, arms - 1))
    env, policy = BatchEnv(library, 1, seed=[0], autoreset=False), make_policy("matching")
    env.reset()
    env.step(np.zeros((1, arms), int))  # compiled now
    shifts = [_shift(env, policy, seed) for seed in range(SHIFTS)]
    costs["engine"], costs["matching"] = map(float, np.median(shifts, axis=0))

    twins = prepare(load("quickstart"), difficulty="twin").arms
    own = [[plan for variants in arm.plans.values() for plan in variants] for arm in twins]
    for arm, plans_of_arm in zip(twins, own, strict=True):
        arm.model.score(plans_of_arm[0], 10)
    began = process_time()
    for a in range(arms):
        for n in range(2 * JOBS):
            twins[a % len(twins)].model.score(own[a % len(own)][n % len(own[a % len(own)])], 10)
    costs["scores"] = process_time() - began
    most_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    shift = {"arms": arms, "halls": halls, "hours": HOURS, "jobs": JOBS * arms, "plans_in_all": halls * len(plans)}
    return {**shift, "cpu_s": {name: round(costs[name], 4) for name in COSTS}, "most_mb": round(most_mb)}


def _shift(env: Any, policy: Any, seed: int) -> tuple[float, float]:  # modules that `plot` does not load
    """CPU seconds of the steps and of the decisions of a shift."""
    import numpy as np

    from agents.policy import only_choices
    from fleet.env.validation import actions_of

    obs, _ = env.reset(seed=[seed])
    over, engine_s, matching_s, lazy = False, 0.0, 0.0, only_choices(policy)
    while not over:
        shared, own, mask = (obs[key][0] for key in ("shared", "own", "action_mask"))
        began = process_time()
        actions = np.zeros((1, len(env.agents)), int)
        if mask[:, 1:-1].any() or not lazy:
            actions[0] = actions_of(env.agents, policy.act(env.layout.read_each(env.agents, shared, own, mask)))
        decided = process_time()
        obs, _, finished, cut, _ = env.step(actions)
        engine_s, matching_s = engine_s + process_time() - decided, matching_s + decided - began
        over = bool(finished[0] or cut[0])
    return engine_s, matching_s


def run(sizes: list[int], most_in_hall: int, out: Path) -> None:
    """Measure each size, and add a line for it to the file in place of an earlier one."""
    out.parent.mkdir(parents=True, exist_ok=True)
    for arms in sizes:
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "benchmarks.scaling.arms",
                "measure",
                "--arms",
                str(arms),
                "--hall",
                str(most_in_hall),
            ],
            stdout=-1,
            check=True,
        )
        rows = [json.loads(line) for line in out.read_text("utf-8").splitlines()] if out.exists() else []
        rows = [*(row for row in rows if row["arms"] != arms), json.loads(done.stdout) | machine()]
        lines = [json.dumps(row) for row in sorted(rows, key=lambda row: row["arms"])]
        out.write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(json.loads(done.stdout), flush=True)


def plot(out: Path) -> None:
    """Print the table, and draw the costs per arm-hour; plans and conflicts per arm."""
    from matplotlib.figure import Figure

    from benchmarks.result_tables import halls_table

    rows = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, label in COSTS.items():
        values = [1e3 * row["cpu_s"][name] / row["arms"] / row["hours"] for row in rows]
        unit = "per arm, once" if name in ONCE else "per arm-hour"
        style = "--" if name in ONCE else "-"
        axes.plot([row["arms"] for row in rows], values, style, marker="o", label=f"{label}, {unit}")
    axes.set(xscale="log", yscale="log", xlabel="arms", ylabel="CPU time, ms")
    axes.set_xticks([row["arms"] for row in rows], [str(row["arms"]) for row in rows])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(PICTURE, dpi=130)
    print(halls_table(out))


def main() -> None:
    """Measure or plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "measure", "plot"))
    parser.add_argument("--arms", type=int, nargs="+", default=[4, 16, 64, 256, 1000])
    parser.add_argument("--hall", type=int, default=128, help="most arms in a hall, which is at most 20 m wide")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    if arguments.what == "measure":
        print(json.dumps(measure(arguments.arms[0], arguments.hall)))
    elif arguments.what == "run":
        run(arguments.arms, arguments.hall, arguments.out)
    else:
        plot(arguments.out)


if __name__ == "__main__":
    main()
