"""Tables of docs/policies.md and docs/results.md: policies and wrappers from their registry, and results from files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.registry import RULES, WRAPPERS
from scenarios.doc_tables import table
from scenarios.evaluate.comparison import HEADINGS
from scenarios.studies.page_tables.cells import bold_if, difference, read_json, signed

NAMED = ("faults", "value", "on_time", "reward", "hot_surface_min")
"""Figures of the table of named scenarios; those that are 0 everywhere are left out."""
SOURCES = {"oracle": "true state", "twin": "identified network"}
"""Score sources of the measured table, by the end of the file's name."""


def policy_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        results: Folder with `ladder/SCENARIO_SOURCE.json` and `named/SCENARIO.json` of `thermofleet compare --json`,
            `ladder/decisions.json` of `benchmarks/bench_decisions.py`, and `live_policies.json` of
            `benchmarks/bench_policies.py`.
    """
    return {
        "policies": _policies,
        "wrappers": _wrappers,
        "ladder": lambda: _ladder(results / "ladder"),
        "named_scenarios": lambda: _named(results / "named"),
        "decisions": lambda: _decisions(read_json(results / "ladder/decisions.json")),
        "live_policies": lambda: live_table(read_json(results / "live_policies.json")),
    }


def _policies() -> str:
    rows = [(f"`{name}`", rule.scope, rule.cost, rule.source) for name, rule in RULES.items()]
    return table(("policy", "scope", "allocates by", "source"), rows)


def _wrappers() -> str:
    rows = [(f"`{name}:POLICY`", wrapper.effect, wrapper.source) for name, wrapper in WRAPPERS.items()]
    return table(("wrapper", "effect", "source"), rows)


def _ladder(results: Path) -> str:
    """Rewards and their differences to the baseline, a column for each file, the best mean of the first file first."""
    files = {path.stem: read_json(path) for path in sorted(results.glob("*_*.json"))}
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
    return difference(*(reward[name] for name in ("difference", "difference_low", "difference_high"))) + some


def _named(results: Path) -> str:
    """Mean and difference of several figures, a column for each policy."""
    files = [read_json(path) for path in sorted(results.glob("*.json"))]
    rows: list[tuple[str, ...]] = []
    for one in files:
        figures = one["figures"]
        for figure in NAMED:
            own = {policy: figures[policy][figure] for policy in figures}
            if any(each["mean"] for each in own.values()):
                base = one["baseline"]
                cells = [_mean_cell(each, is_base=policy == base) for policy, each in own.items()]
                rows.append((f"`{one['scenario']}`: {HEADINGS[figure]}", *cells))
    return table(("", *(f"`{policy}`" for policy in files[0]["figures"])), rows)


def _mean_cell(figure: dict[str, Any], *, is_base: bool) -> str:
    text = f"{figure['mean']:.1f}"
    if is_base:
        return text
    low, high = figure["difference_low"], figure["difference_high"]
    differs = low is not None and (low > 0 or high < 0)
    text += f" ({signed(figure['difference'])})"
    return bold_if(differs, text)


def _decisions(measured: dict[str, Any]) -> str:
    rows = [(f"`{row['policy']}`", row["scope"], f"{row['median_ms']:.2f}") for row in measured["rows"]]
    return table(("policy", "scope", "median, ms of CPU time"), rows)


def live_table(measured: dict[str, Any]) -> str:
    """Jobs finished and faults of each policy, simulated and live.

    Args:
        measured: A result of `benchmarks/bench_policies.py`.
    """
    rows = [
        (f"`{row['policy']}`", row["scope"], *(str(n) for kind in ("simulated", "live") for n in row[kind].values()))
        for row in measured["rows"]
    ]
    return table(("policy", "scope", "simulated: finished", "faults", "live: finished", "faults"), rows)
