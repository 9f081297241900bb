"""Tables of docs/performance.md and docs/scaling.md: speed-up by workers, and commands for a large fleet."""

import json
from collections.abc import Callable
from pathlib import Path

from scenarios.doc_tables import table


def speed_tables(folder: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        folder: With `workers.jsonl` of `benchmarks/bench_workers.py` and `commands.json` of
            `benchmarks/scaling/commands.py`.
    """
    return {"workers": lambda: _workers(folder / "workers.jsonl"), "large_fleet": lambda: _commands(folder)}


def _workers(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        one = json.loads(line)
        took = (f"{one['median_s'][name]:.0f}" for name in ("one", "two"))
        rows.append((one["what"], str(one["shifts"]), *took, f"{one['speed_up']:.2f}", f"{one['limit']:.2f}"))
    return table(("workers", "shifts", "one, s", "two, s", "speed-up", "two loops that share nothing"), rows)


def _commands(folder: Path) -> str:
    measured = json.loads((folder / "commands.json").read_text(encoding="utf-8"))
    rows = [
        (f"`{each['command']}`", f"{each['cpu_s']:.0f}", f"{each['wall_s']:.0f}", f"{each['most_mb'] / 1000:.2f}")
        for each in measured["commands"]
    ]
    return table(("command", "CPU s", "s", "memory, GB"), rows)
