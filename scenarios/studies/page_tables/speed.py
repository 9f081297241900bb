"""Tables of docs/performance.md and docs/scaling.md: speed-up by workers, halls of growing size, large fleets."""

import json
from collections.abc import Callable
from pathlib import Path

from scenarios.doc_tables import table


def speed_tables(folder: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        folder: With `workers.jsonl` of `benchmarks/bench_workers.py`, and `arms.jsonl` and `commands.json` of
            `benchmarks/scaling`.
    """
    return {
        "workers": lambda: _workers(folder / "workers.jsonl"),
        "growing_halls": lambda: _halls(folder / "arms.jsonl"),
        "large_fleet": lambda: _commands(folder),
    }


def _workers(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        took = (f"{one['median_s'][name]:.0f}" for name in ("one", "two"))
        rows.append((one["what"], str(one["shifts"]), *took, f"{one['speed_up']:.2f}", f"{one['limit']:.2f}"))
    return table(("workers", "shifts", "one, s", "two, s", "speed-up", "two loops that share nothing"), rows)


def _halls(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        hours = {"plans": 1.0, "conflicts": 1.0}  # once, not in each hour
        each = {name: 1000.0 * s / one["arms"] / hours.get(name, one["hours"]) for name, s in one["cpu_s"].items()}
        costs = (f"{each[name]:.3g}" for name in ("plans", "conflicts", "engine", "matching", "scores"))
        rows.append((str(one["arms"]), *costs, str(one["most_mb"])))
    hourly = ("engine", "matching", "twins")
    once = ("plans, ms per arm", "conflict table, ms per arm")
    return table(("arms", *once, *(f"{name}, ms per arm and hour" for name in hourly), "peak memory, MB"), rows)


def _commands(folder: Path) -> str:
    measured = json.loads((folder / "commands.json").read_text(encoding="utf-8"))
    rows = [
        (f"`{each['command']}`", f"{each['cpu_s']:.0f}", f"{each['wall_s']:.0f}", f"{each['most_mb'] / 1000:.2f}")
        for each in measured["commands"]
    ]
    return table(("command", "CPU s", "s", "memory, GB"), rows)
