"""Tables of docs/policies.md and docs/paper.md: policies with scores from several sources."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from scenarios.doc_tables import table
from scenarios.evaluate.comparison import HEADINGS
from scenarios.evaluate.statistics import unit
from scenarios.studies.page_tables.cells import difference
from scenarios.studies.page_tables.stored_ablations import FIGURES, stored

SCENARIOS = ("heat_wave", "active_waiting")
WRAPPED = {"wspt": "wspt@blind", "wsept": "wsept@rc", "least_difficulty": "least_difficulty@blind"}
"""Policies of the table of wrappers, with their sources."""
DIGITS = {"faults": 2}
"""Decimals of a figure; 1 for others."""
MPC_PARTS = "benchmarks/mpc_parts.py"


def ablation_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        results: With the folders `ablations/sources_SCENARIO`, `ablations/mpc_SCENARIO` and `twin_windows/SCENARIO` of
            `thermofleet compare --out`, for one or more of `SCENARIOS`.
    """
    sources, parts, windows = (
        {name: path for name in SCENARIOS if (path := results / each.format(name)).is_dir()}
        for each in ("ablations/sources_{}", "ablations/mpc_{}", "twin_windows/{}")
    )
    return {
        "wrappers_measured": lambda: _wrappers(sources),
        "score_sources": lambda: _table(
            sources,
            {
                "wsept@rc": "`wsept`, identified network",
                "wsept@blind": "blind",
                "wsept@oracle": "oracle",
                "thermometer@blind": "`thermometer`, blind",
                "limited:wspt@blind": "`limited:wspt`, blind",
                "fuzzy:wspt@blind": "`fuzzy:wspt`, blind",
            },
        ),
        "mpc_parts": lambda: _table(
            parts,
            {
                "mpc@rc": "`mpc`, identified network",
                "mpc@oracle": "true network",
                "mpc@rc-nominal": "nominal network",
                f"{MPC_PARTS}:WithoutHeat@rc": "without heat",
                f"{MPC_PARTS}:WithoutDiscount@rc": "without discount",
                f"{MPC_PARTS}:WithoutSearch@rc": "without search",
                "wsept@rc": "`wsept`",
            },
        ),
        "twin_windows": lambda: _table(
            windows,
            {
                "trained-4s-32": "4 s, 32 units",
                "trained-1s-16": "1 s, 16 units",
                "untrained": "1 s, 16 units, untrained",
                "blind": "blind",
            },
        ),
    }


def _wrappers(folders: Mapping[str, Path]) -> str:
    rows: list[tuple[str, ...]] = []
    for policy, bare in WRAPPED.items():
        for name, folder in folders.items():
            scores = (bare, f"limited:{bare}", f"fuzzy:{bare}")
            rows += [(f"`{policy}`, `{name}`: {figure}", *cells) for figure, cells in _rows(folder, scores)]
    return table(("policy, scenario", "bare", "`limited:`", "`fuzzy:`"), rows) + _sizes(folders)


def _table(folders: Mapping[str, Path], columns: Mapping[str, str]) -> str:
    """Mean of the first column and differences to it; `–` for a source that a scenario was not measured with."""
    rows = [
        (f"`{name}`: {figure}", *cells)
        for name, folder in folders.items()
        for figure, cells in _rows(folder, tuple(columns))
    ]
    return table(("", *columns.values()), rows) + _sizes(folders)


def _sizes(folders: Mapping[str, Path]) -> str:
    """A line on the numbers of fleets, trainings and seeds."""
    sizes = {name: unit(stored(folder).shape) for name, folder in folders.items()}
    return "\n\n" + "; ".join(f"`{name}`: {size}" for name, size in sizes.items()) + "."


def _rows(folder: Path, scores: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
    """Heading and cells of every figure."""
    effects = stored(folder).effects(scores[0])
    for name in FIGURES:
        digits = DIGITS.get(name, 1)
        cells = [f"{effects[scores[0]][name].mean:.{digits}f}"]
        for each in scores[1:]:
            f = effects[each][name] if each in effects else None
            cells.append(difference(f.difference, f.difference_low, f.difference_high, digits) if f else "–")
        yield HEADINGS[name], cells
