"""The tables of docs/exchange.md: figures of shifts on several channels, beside those on a perfect one."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenarios.doc_tables import table
from scenarios.evaluate.statistics import paired, paired_counts
from scenarios.studies.page_tables.cells import bold_if

COLUMNS = {
    "value": ("value", 1),
    "on_time": ("on time", 1),
    "faults": ("faults", 2),
    "above_warning_min": ("minutes above the warning limit", 0),
    "lost": ("rejected", 1),
}
"""Heading and decimals of a figure."""


def channel_tables(folder: Path) -> dict[str, Callable[[], str]]:
    """Text of the table of every result in a folder, by `channels_SCENARIO`."""
    return {
        f"channels_{path.stem}": partial(channel_table, json.loads(path.read_text(encoding="utf-8")))
        for path in folder.glob("*.json")
    }


def channel_table(measured: Mapping[str, Any]) -> str:
    """Means, and paired differences to the first channel with 95 % intervals, of each policy and channel.

    Args:
        measured: A result of `benchmarks/bench_channel.py`.
    """
    names: list[str] = list(measured["figures"])
    values = {(row["policy"], row["channel"]): np.array(row["values"]) for row in measured["rows"]}
    policies = dict.fromkeys(policy for policy, _ in values)
    rows: list[tuple[str, ...]] = []
    for (policy, channel), x in values.items():
        base = next(each for (other, _), each in values.items() if other == policy)
        cells = [_cell(name, x[:, names.index(name)], base[:, names.index(name)]) for name in COLUMNS]
        who = (f"`{policy}`",) if len(policies) > 1 else ()
        rows.append((*who, channel, *cells, f"{100 * x[:, names.index('heard')].mean():.0f} %"))
    who = ("policy",) if len(policies) > 1 else ()
    return table((*who, "channel", *(heading for heading, _ in COLUMNS.values()), "received"), rows)


def _cell(name: str, x: np.ndarray, base: np.ndarray) -> str:
    digits = COLUMNS[name][1]
    mean = f"{x.mean():.{digits}f}"
    if np.array_equal(x, base):
        return mean
    d = (paired_counts if name == "faults" else paired)(x, base)
    text = d.text(digits, "+")
    return f"{mean} ({bold_if(d.excludes_zero, text)})"
