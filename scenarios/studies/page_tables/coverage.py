"""Tables of docs/results.md: share of 95 % intervals that contain the true mean."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from scenarios.doc_tables import table


def coverage_tables(path: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        path: Result of `benchmarks/statistics/interval_coverage.py`.
    """
    return {"coverage": lambda: _by_law(path), "coverage_clusters": lambda: _by_clusters(path)}


def _by_law(path: Path) -> str:
    measured = json.loads(path.read_text(encoding="utf-8"))
    rows = [(law, *_cells(shares)) for law, shares in measured["laws"].items()]
    return table(("values", *(f"n = {n}" for n in measured["seeds"])), rows)


def _by_clusters(path: Path) -> str:
    measured = json.loads(path.read_text(encoding="utf-8"))
    rows = [(size, *_cells(shares)) for size, shares in measured["sizes"].items()]
    rows.append(("200 instances of 9 unequal cells", *_cells(measured["cells"])))
    return table(("fleets × trainings × seeds", "normal effects", "exponential effects"), rows)


def _cells(shares: Iterable[float]) -> Iterable[str]:
    return (f"{share:.3f}" for share in shares)
