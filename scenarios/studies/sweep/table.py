"""The rows of a sweep as one table: means over the subjects, and paired differences to our configuration."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from scenarios.evaluate.statistics import Interval, mean_by_group
from scenarios.json_rows import Row
from scenarios.studies.sweep.configurations import OURS, Configuration
from scenarios.studies.sweep.subjects import arm_of

COLUMNS: Mapping[str, tuple[str, ...]] = {
    "AUROC": ("hot_60", "carrier", "auroc"),
    "AUPRC": ("hot_60", "carrier", "auprc"),
    "Spearman": ("hot_60", "carrier", "spearman"),
    "AUROC, hot from 40 °C": ("hot_40", "carrier", "auroc"),
    "AUROC, 40–60 °C left out": ("no_band", "carrier", "auroc"),
    "any joint, Σ w d": ("hot_60", "weighted", "auroc"),
    "any joint, Σ d": ("hot_60", "sum", "auroc"),
    "Σ d of means": ("hot_60", "sum_of_means", "auroc"),
}
"""Path in a row of each measure that is compared with ours; the first five are of d of the carrying joint."""
PLAIN = ("active units", "KL, nat", "epochs", "CPU s")


@dataclass(frozen=True)
class Cell:
    """A measure of one configuration."""

    own: Interval
    """Of the mean over the arms."""
    lead: Interval | None = None
    """Of the mean difference to our configuration on the same subjects; None for ours."""

    def __str__(self) -> str:
        if self.lead is None:
            return _short(self.own.mean) + _margin(self.own)
        clear = "*" if abs(self.lead.mean) > self.lead.margin else ""
        sign = "−" if self.lead.mean < 0 else "+"
        return f"{_short(self.own.mean)} ({sign}{_short(abs(self.lead.mean))}{_margin(self.lead)}{clear})"


@dataclass(frozen=True)
class Line:
    """One configuration."""

    name: str
    configuration: Configuration
    subjects: int
    measures: Mapping[str, Cell]
    """By the names of `COLUMNS`."""
    plain: Mapping[str, float]
    """Means, by the names of `PLAIN`."""

    def cells(self, columns: Iterable[str]) -> list[str]:
        """The line as text: group, configuration, these measures, plain numbers and the number of subjects."""
        units, nats, epochs, cpu_s = (self.plain[name] for name in PLAIN)
        return [
            self.configuration.group,
            self.configuration.label,
            *(str(self.measures.get(column, "–")) for column in columns),
            f"{units:.1f}",
            f"{nats:.2f}",
            f"{epochs:.0f}",
            f"{cpu_s:.0f}",
            str(self.subjects),
        ]


def table_of(lines: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Heads and cells; columns that no line has are left out."""
    columns = [column for column in COLUMNS if any(column in line.measures for line in lines)]
    heads = ["group", "configuration", *columns, *PLAIN, "arms"]
    return heads, [line.cells(columns) for line in lines]


def lines_of(rows: Iterable[Row], configurations: Mapping[str, Configuration]) -> list[Line]:
    """A line for each configuration that has rows, in the order of the configurations."""
    by_name: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_name.setdefault(row["configuration"], {})[row["subject"]] = row
    ours = by_name.get(OURS, {})
    return [_line(name, configurations[name], by_name[name], ours) for name in configurations if name in by_name]


def _line(name: str, configuration: Configuration, rows: Mapping[str, Row], ours: Mapping[str, Row]) -> Line:
    shared = [] if name == OURS else [subject for subject in rows if subject in ours]
    measures: dict[str, Cell] = {}
    for column, path in COLUMNS.items():
        if any(path[1] not in row[path[0]] for row in rows.values()):
            continue  # of the carrying joint only
        own = mean_by_group((arm_of(subject), _at(row, path)) for subject, row in rows.items())
        leads = [(arm_of(subject), _at(rows[subject], path) - _at(ours[subject], path)) for subject in shared]
        measures[column] = Cell(own, mean_by_group(leads) if leads else None)
    columns = {
        "active units": [row["active_units"][0] for row in rows.values()],
        "KL, nat": [row["kl"][0] for row in rows.values()],
        "epochs": [row["epochs"] for row in rows.values()],
        "CPU s": [row["cpu_s"] for row in rows.values()],
    }
    return Line(name, configuration, len(rows), measures, {key: float(np.mean(v)) for key, v in columns.items()})


def _at(row: Row, path: Sequence[str]) -> float:
    return float(reduce(lambda part, key: part[key], path, row))  # pyright: ignore[reportArgumentType]


def _margin(mean: Interval) -> str:
    return "" if mean.note else f" ± {_short(mean.margin)}"


def _short(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]) + "\n"
