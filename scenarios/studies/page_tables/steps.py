"""Table of docs/learning.md: steps of a shift from interval to interval, and from event to event."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from scenarios.doc_tables import table
from scenarios.studies.page_tables.cells import read_json

KINDS = ("interval", "events")
SHARES = (("env_choices", "env"), ("arm_choices", "arm"))
"""Steps with a choice, and all steps."""
HEADS = ("", "steps per shift: interval", "events", "times fewer", "env steps with a choice: interval", "events")


def steps_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of the table by the name in its mark.

    Args:
        results: With `steps.json` of `benchmarks/bench_policies.py --steps`.
    """
    return {"steps": lambda: steps_table(read_json(results / "steps.json"))}


def steps_table(measured: dict[str, Any]) -> str:
    """The range over all policies, for each scenario."""
    rows: list[tuple[str, ...]] = []
    for scenario in dict.fromkeys(row["scenario"] for row in measured["rows"]):
        own = [row for row in measured["rows"] if row["scenario"] == scenario]
        counts = (_range(row[kind]["env"] for row in own) for kind in KINDS)
        fewer = _range(row["interval"]["env"] / row["events"]["env"] for row in own)
        shares = [
            _range((100 * row[kind][part] / row[kind][whole] for row in own), digits, " %")
            for part, whole in SHARES
            for kind, digits in zip(KINDS, (1, 0), strict=True)
        ]
        rows.append((f"`{scenario}`", *counts, fewer, *shares))
    return table((*HEADS, "arm steps with a choice: interval", "events"), rows)


def _range(values: Iterable[float], digits: int = 0, unit: str = "") -> str:
    shown = [f"{value:.{digits}f}" for value in sorted(values)]
    return (shown[0] if shown[0] == shown[-1] else f"{shown[0]}–{shown[-1]}") + unit
