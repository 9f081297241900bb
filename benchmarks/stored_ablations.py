"""Policies with predictions from several sources, as docs/results keeps them.

All have the same fleets, trainings and seeds. A folder is that of `thermofleet compare --out`, or has `ablation.csv`
and `ablation.json`, which an earlier command wrote.
"""

import csv
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenarios.evaluate.rollout import KINDS
from scenarios.evaluate.statistics import Figure, figures_of

Array = np.ndarray
Shift = tuple[int, int, int]
"""Fleet, training and seed."""

FIGURES = ("faults", "value", "reward")


@dataclass(frozen=True)
class StoredAblation:
    """The shifts of a folder, by POLICY@SOURCE, or by SOURCE alone of the policy that all others have."""

    shifts: Mapping[str, Mapping[Shift, Mapping[str, float]]]
    """Figures by name."""
    shape: tuple[int, int, int]
    """Fleets, trainings and seeds."""
    first_seed: int

    def effects(self, first: str) -> dict[str, dict[str, Figure]]:
        """Figures by name of each policy and source, with differences to the first one."""
        names = (first, *(name for name in self.shifts if name != first))
        values = {name: {figure: self._values(name, figure) for figure in FIGURES} for name in names}
        return figures_of(values, first, KINDS)

    def _values(self, name: str, figure: str) -> Array:
        """[fleet, training, seed]; the same for every training if the source has none."""
        fleets, trainings, seeds = self.shape
        of = self.shifts[name]
        own = {training for _, training, _ in of}

        def value(fleet: int, training: int, seed: int) -> float:
            return of[fleet, training if training in own else 0, self.first_seed + seed][figure]

        return np.array(
            [[[value(f, t, s) for s in range(seeds)] for t in range(trainings)] for f in range(fleets)],
            dtype=float,
        )


def stored(folder: Path) -> StoredAblation:
    """The content of a folder."""
    if not (folder / "ablation.json").exists():
        return _of_study(folder)
    plan = json.loads((folder / "ablation.json").read_text(encoding="utf-8"))["plan"]
    with (folder / "ablation.csv").open(newline="", encoding="utf-8") as file:
        rows = [
            (row["scores"], (int(row["fleet"]), int(row["training"]), int(row["seed"])), row)
            for row in csv.DictReader(file)
        ]
    shifts = _by_name((name, shift, {each: float(row[each]) for each in FIGURES}) for name, shift, row in rows)
    return StoredAblation(
        {name: shifts[name] for name in plan["scores"]},
        (plan["fleets"], plan["trainings"], plan["seeds"]),
        plan["first_seed"],
    )


def _of_study(folder: Path) -> StoredAblation:
    from scenarios.evaluate.store import read_rows

    rows = read_rows(folder)
    policies = {row.key.policy for row in rows}
    shifts = _by_name(
        (
            key.difficulty if len(policies) == 1 else f"{key.policy}@{key.difficulty}",
            (key.fleet, key.training, key.seed),
            {name: getattr(row.outcome, name) for name in FIGURES},
        )
        for row in rows
        for key in [row.key]
    )
    fleets, trainings, seeds = (len({shift[k] for of in shifts.values() for shift in of}) for k in range(3))
    return StoredAblation(shifts, (fleets, trainings, seeds), min(row.key.seed for row in rows))


def _by_name(
    rows: Iterable[tuple[str, Shift, Mapping[str, float]]],
) -> dict[str, dict[Shift, Mapping[str, float]]]:
    found: dict[str, dict[Shift, Mapping[str, float]]] = {}
    for name, shift, figures in rows:
        found.setdefault(name, {})[shift] = figures
    return found
