"""The table of docs/learning.md on sample efficiency: rewards in the course of trainings, here and in BenchMARL."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from scenarios.doc_tables import table
from scenarios.evaluate.statistics import Interval, interval
from scenarios.json_rows import Row, Rows

LABELS = {
    "random": "`random`",
    "rule": "the rule `{rule}`",
    "mappo_warm": "`--algo mappo --warm-start {warm_start}`",
    "mappo": "`--algo mappo`",
    "ippo": "`--algo ippo`",
    "benchmarl_mappo": "BenchMARL, MAPPO",
    "benchmarl_ippo": "BenchMARL, IPPO",
}
"""Methods in the order of the table; the values in braces are those of the configuration."""
SHARES = (0.0, 0.25, 0.5, 1.0)
"""Parts of the budget in the table."""
COSTS = {"hours": "simulated hours", "cpu_s": "CPU s"}
"""What a training used from its first to its last evaluation, and the heading."""


def efficiency_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of the table, by the name in its mark.

    Args:
        results: Folder with `sample_efficiency/heat_wave.jsonl` of `benchmarks/sample_efficiency.py`.
    """
    return {"sample_efficiency": lambda: efficiency_table(trainings(results / "sample_efficiency/heat_wave.jsonl"))}


def trainings(path: Path) -> dict[str, list[Row]]:
    """The trainings of every method, by its label, in the order of the table."""
    rows = Rows(path)
    by_method = {method: [row for row in rows.by_key.values() if row["method"] == method] for method in LABELS}
    return {LABELS[method].format(**own[0]["config"]): own for method, own in by_method.items() if own}


def course(own: Iterable[Row]) -> dict[int, Interval]:
    """Mean reward of a shift over trainings, by env steps."""
    by_steps = dict[int, list[float]]()
    for row in own:
        for point in row["points"]:
            by_steps.setdefault(round(point["env_steps"]), []).append(point["reward"])
    return {steps: interval(rewards) for steps, rewards in by_steps.items()}


def efficiency_table(found: dict[str, list[Row]]) -> str:
    """Rewards at parts of the budget with intervals over trainings, and what the trainings cost.

    Args:
        found: As `trainings`.
    """
    budget = max(steps for own in found.values() for steps in course(own))
    at = [round(share * budget) for share in SHARES]
    rows: list[tuple[str, ...]] = []
    for label, own in found.items():
        rewards = course(own)
        cost = [f"{np.mean([row['points'][-1][k] - row['points'][0][k] for row in own]):,.0f}" for k in COSTS]
        cells = (rewards[steps].text(1) if steps in rewards else "" for steps in at)
        rows.append((label, str(len(own)), *cells, *cost))
    return table(("", "seeds", *(f"{steps:,} env steps" for steps in at), *COSTS.values()), rows)
