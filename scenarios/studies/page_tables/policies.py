"""Tables of docs/policies.md: policies and wrappers from their registry, and measured results from files."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.registry import RULES, WRAPPERS
from scenarios.doc_tables import table
from scenarios.run.compare import HEADINGS
from scenarios.statistics.means import LEVEL

SOURCES = {"oracle": "true state", "twin": "identified network"}
"""Score sources of the measured table, by the end of the file's name."""


def policy_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        results: Folder with `ladder/SCENARIO_SOURCE.json` and `rules.json` of `thermofleet compare --json`, and
            `ladder/decisions.json` of `benchmarks/bench_decisions.py`.
    """
    return {
        "policies": _policies,
        "wrappers": _wrappers,
        "ladder": lambda: _ladder(results / "ladder"),
        "decisions": lambda: _decisions(_read(results / "ladder/decisions.json")),
        "rules": lambda: _rules(_read(results / "rules.json")),
    }


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _policies() -> str:
    rows = [(f"`{name}`", rule.scope, rule.cost, rule.source) for name, rule in RULES.items()]
    return table(("policy", "scope", "minimises", "source"), rows)


def _wrappers() -> str:
    rows = [(f"`{name}:POLICY`", wrapper.effect, wrapper.source) for name, wrapper in WRAPPERS.items()]
    return table(("wrapper", "effect", "source"), rows)


def _ladder(results: Path) -> str:
    """Rewards and their differences to the baseline, a column for each file, the best mean of the first file first."""
    files = {path.stem: _read(path) for path in sorted(results.glob("*_*.json"))}
    head = ["policy"]
    for stem, one in files.items():
        scores = SOURCES[stem.removeprefix(f"{one['scenario']}_")]
        head.append(f"`{one['scenario']}`, {scores}")
    first = next(iter(files.values()))["figures"]
    order = sorted(first, key=lambda policy: -first[policy]["reward"]["mean"])
    rows = [(f"`{name}`", *(_cell(one, name) for one in files.values())) for name in order]
    return table(tuple(head), rows)


def _cell(comparison: dict[str, Any], policy: str) -> str:
    figures = comparison["figures"][policy]
    reward, faults = figures["reward"], figures["faults"]["mean"]
    some = f"; {faults:.2f} faults" if faults else ""
    if policy == comparison["baseline"]:
        return f"{reward['mean']:.1f}{some}"
    low, high = reward["difference_low"], reward["difference_high"]
    text = f"{reward['difference']:+.1f} ({low:+.1f} … {high:+.1f})".replace("-", "−")
    return (f"**{text}**" if low > 0 or high < 0 else text) + some


FIGURES = {"faults": 1, "value": 1, "on_time": 1, "reward": 1, "hot_surface_min": 1}
"""Decimals of the figures of the table of rules; a figure that is 0 everywhere is left out."""


def _rules(comparisons: list[dict[str, Any]]) -> str:
    """Means and starred differences to the baseline: a column for each policy, rows for each scenario and figure."""
    policies = list(comparisons[0]["figures"])
    rows: list[tuple[str, ...]] = []
    for one in comparisons:
        for name, digits in FIGURES.items():
            figures = [one["figures"][policy][name] for policy in policies]
            if any(figure["mean"] for figure in figures):
                cells = (
                    _starred(figure, digits, p == one["baseline"]) for p, figure in zip(policies, figures, strict=True)
                )
                rows.append((f"`{one['scenario']}`: {HEADINGS[name]}", *cells))
    return table(("", *(f"`{policy}`" for policy in policies)), rows)


def _starred(figure: dict[str, Any], digits: int, is_baseline: bool) -> str:
    mean = f"{figure['mean']:.{digits}f}"
    if is_baseline:
        return mean
    low, high = figure["difference_low"], figure["difference_high"]
    excludes = low is not None and (low > 0 or high < 0)
    stars = "\\*" * (excludes + (excludes and figure["p_holm"] < 1 - LEVEL))
    return f"{mean} ({figure['difference']:+z.{digits}f}{stars})".replace("-", "−")


def _decisions(measured: dict[str, Any]) -> str:
    rows = [(f"`{row['policy']}`", row["scope"], f"{row['median_ms']:.2f}") for row in measured["rows"]]
    return table(("policy", "scope", "median, ms of CPU time"), rows)
