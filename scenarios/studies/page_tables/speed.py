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
        "growing_halls": lambda: halls_table(folder / "arms.jsonl"),
        "large_fleet": lambda: _commands(folder),
    }


def _workers(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        took = (f"{one['median_s'][name]:.0f}" for name in ("one", "two"))
        rows.append((one["what"], str(one["shifts"]), *took, f"{one['speed_up']:.2f}", f"{one['limit']:.2f}"))
    return table(("workers", "shifts", "one, s", "two, s", "speed-up", "two loops that share nothing"), rows)


def halls_table(path: Path) -> str:
    """The costs of halls of every size, from the rows of `benchmarks/scaling/arms.py`."""
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        per_arm = {name: 1000.0 * seconds / one["arms"] for name, seconds in one["cpu_s"].items()}
        once = (per_arm[name] for name in ("plans", "conflicts"))
        hourly = (per_arm[name] / one["hours"] for name in ("engine", "matching", "scores"))
        sizes = (str(one[name]) for name in ("arms", "halls"))
        rows.append((*sizes, *(f"{cost:.3g}" for cost in (*once, *hourly)), str(one["most_mb"])))
    heads = ("plans, ms per arm", "conflict table, ms per arm")
    heads += tuple(f"{name}, ms per arm and hour" for name in ("engine", "matching", "twins"))
    return table(("arms", "halls", *heads, "peak memory, MB"), rows)


def _commands(folder: Path) -> str:
    measured = json.loads((folder / "commands.json").read_text(encoding="utf-8"))
    rows = [
        (f"`{each['command']}`", f"{each['cpu_s']:.0f}", f"{each['wall_s']:.0f}", f"{each['most_mb'] / 1000:.2f}")
        for each in measured["commands"]
    ]
    return table(("command", "CPU s", "s", "memory, GB"), rows)
