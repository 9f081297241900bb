"""Compare sources of predictions: one policy with difficulty, P(saturation) and predicted peak from each source.

Every source runs on the same fleets, trainings and seeds; intervals count all three (`scenarios.statistics.means`).
"""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from fleet.errors import FleetError, nearest
from fleet.files import atomic_path, cache_folder
from scenarios.policy_loader import label, policy_of
from scenarios.progress import COUNTED, Count, Progress, quiet
from scenarios.result_folder import disk_errors
from scenarios.run.evaluate import COUNTS, POSSIBLE, outcomes
from scenarios.scenario_hash import scenario_hash
from scenarios.schema import Scenario
from scenarios.show.table import Table
from scenarios.statistics.means import unit
from scenarios.statistics.tables import HEAD, LEGEND, Figure, figure_rows, figures_of, remarks
from scenarios.studies.score_sources import ALL_SOURCES, SOURCES, DrawnFleet
from scenarios.trials.cells import drawn

Array = np.ndarray

FIGURES = ("faults", "value", "reward")
ROWS, CARD = "ablation.csv", "ablation.json"
FIRST_SEED = 10_000
"""Seeds from this one on were not used for tuning."""


@dataclass(frozen=True, kw_only=True)
class AblationPlan:
    """Policy, sources and numbers of runs of an ablation."""

    policy: str = "least_difficulty"
    scores: tuple[str, ...] = tuple(SOURCES)
    """Names of sources, or POLICY@SOURCE for another policy; differences refer to the first one."""
    fleets: int = 3
    """Draws of the arms: `spread.seed` of the scenario, and the following ones."""
    trainings: int = 2
    seeds: int = 20
    first_seed: int = FIRST_SEED

    def __post_init__(self) -> None:
        for i, name in enumerate(self.scores):
            policy, source = self.parts(name)
            if source not in ALL_SOURCES:
                raise FleetError(f"No source of predictions '{source}'{nearest(source, ALL_SOURCES)}")
            if name in self.scores[:i]:
                raise FleetError(f"The source '{name}' is given twice; names must be unique.")
            policy_of(policy)

    def parts(self, name: str) -> tuple[str, str]:
        """Policy and source of one of `scores`."""
        policy, _, source = name.rpartition("@")
        return policy or self.policy, source

    def label(self, name: str) -> str:
        """Name of one of `scores` in a table."""
        policy, source = self.parts(name)
        return ("" if policy == self.policy else f"{label(policy)}, ") + ALL_SOURCES[source].label


class Row(NamedTuple):
    """Results of one shift."""

    scores: str
    fleet: int
    training: int
    seed: int
    faults: float
    value: float
    reward: float


@dataclass(frozen=True)
class Ablation:
    """Result of an ablation."""

    scenario: str
    plan: AblationPlan
    effects: dict[str, dict[str, Figure]]
    """[scores][figure]."""


def ablate(scenario: Scenario, plan: AblationPlan, out: Path, *, progress: Progress = quiet) -> Ablation:
    """Run the policy with every source, and write `ROWS` and `CARD` into a folder; skip shifts that are in it already.

    Raises:
        FleetError: the folder contains another ablation or other files, or cannot be written.
    """
    card = {"scenario": scenario.name, "scenario_hash": scenario_hash(scenario), "policy": plan.policy}
    rows = _earlier_rows(out, card)
    draws = [
        (name, fleet, training)
        for fleet in range(plan.fleets)
        for name in plan.scores
        for training in range(plan.trainings if ALL_SOURCES[plan.parts(name)[1]].trained else 1)
    ]
    seeds, drawn_fleet, drawn_index = range(plan.first_seed, plan.first_seed + plan.seeds), None, -1
    for n, (name, fleet, training) in enumerate(draws):
        missing = [seed for seed in seeds if (name, fleet, training, seed) not in rows]
        if not missing:
            continue
        policy, source = plan.parts(name)
        progress(f"{COUNTED}fleet {fleet + 1}, training {training + 1}: {plan.label(name)}", Count(n, len(draws)))
        if drawn_fleet is None or drawn_index != fleet:
            drawn_fleet, drawn_index = DrawnFleet(drawn(scenario, fleet), cache_folder(), quiet), fleet
        results = outcomes(ALL_SOURCES[source].make(drawn_fleet, training), policy, missing)
        made = [
            Row(name, fleet, training, seed, *(float(getattr(result, figure)) for figure in FIGURES))
            for seed, result in zip(missing, results, strict=True)
        ]
        rows |= {row[:4]: row for row in made}
        _append(out, made)
    result = Ablation(scenario.name, plan, _effects(plan, rows))
    _write_card(out, {**card, "status": "finished", "plan": asdict(plan), "effects": result.effects})
    return result


def _earlier_rows(out: Path, card: dict[str, str]) -> dict[tuple[str, int, int, int], Row]:
    """Finished shifts in the folder, by source, fleet, training and seed; creates the folder if it does not exist.

    Raises:
        FleetError: the folder contains something else.
    """
    with disk_errors(out):
        if not out.exists() or not any(out.iterdir()):
            out.mkdir(parents=True, exist_ok=True)
            _write_card(out, {**card, "status": "interrupted"})
            return {}
        try:
            known = json.loads((out / CARD).read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError) as error:
            raise FleetError(
                f"'{out}' holds other files; --out needs a new folder or that of an earlier ablation."
            ) from error
        for name, value in card.items():
            held = known.get(name) if isinstance(known, dict) else None
            if held != value:
                raise FleetError(f"'{out}' holds an ablation with {name} {held!r}, not {value!r}; give another --out.")
    return _read_rows(out)


def _read_rows(folder: Path) -> dict[tuple[str, int, int, int], Row]:
    """Finished shifts in a folder, by source, fleet, training and seed; an unfinished last line is removed.

    Raises:
        FleetError: a line is damaged.
    """
    with disk_errors(folder):
        if not (folder / ROWS).exists():
            return {}
        written = (folder / ROWS).read_bytes()
        whole = written[: written.rfind(b"\n") + 1]  # a row without its end may have a shorter number
        if whole != written:
            with atomic_path(folder / ROWS) as file:
                file.write_bytes(whole)
    try:
        kept = list(csv.DictReader(io.StringIO(whole.decode("utf-8"), newline="")))
        rows = [Row(r["scores"], *(int(r[n]) for n in Row._fields[1:4]), *(float(r[n]) for n in FIGURES)) for r in kept]
    except (KeyError, TypeError, ValueError) as error:
        raise FleetError(f"'{folder / ROWS}' is damaged ({error}); give another --out.") from error
    return {row[:4]: row for row in rows}


def stored(folder: Path, first: str) -> Ablation:
    """A finished ablation, with differences to one of its sources.

    Args:
        folder: `--out` of the ablation.
        first: Name of the source.

    Raises:
        FleetError: as `ablate`.
    """
    scenario, plan = stored_plan(folder)
    plan = replace(plan, scores=(first, *(name for name in plan.scores if name != first)))
    return Ablation(scenario, plan, _effects(plan, _read_rows(folder)))


def stored_plan(folder: Path) -> tuple[str, AblationPlan]:
    """Scenario and plan of a finished ablation."""
    card = json.loads((folder / CARD).read_text(encoding="utf-8"))
    return card["scenario"], msgspec.convert(card["plan"], AblationPlan)


def _append(out: Path, rows: Sequence[Row]) -> None:
    with disk_errors(out), (out / ROWS).open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        if not file.tell():
            writer.writerow(Row._fields)
        writer.writerows(rows)


def _write_card(out: Path, card: object) -> None:
    with disk_errors(out), atomic_path(out / CARD) as file:
        file.write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=1) + b"\n")  # NaN as null


def _effects(plan: AblationPlan, rows: dict[tuple[str, int, int, int], Row]) -> dict[str, dict[str, Figure]]:
    values = {name: {figure: _values(plan, rows, name, figure) for figure in FIGURES} for name in plan.scores}
    return figures_of(values, plan.scores[0], counts=COUNTS, possible=POSSIBLE)


def _values(plan: AblationPlan, rows: dict[tuple[str, int, int, int], Row], name: str, figure: str) -> Array:
    """A figure of one source, [fleet, training, seed]; the same for every training if the source has none."""
    trained = ALL_SOURCES[plan.parts(name)[1]].trained
    return np.array(
        [
            [
                [
                    getattr(rows[name, fleet, training * trained, plan.first_seed + seed], figure)
                    for seed in range(plan.seeds)
                ]
                for training in range(plan.trainings)
            ]
            for fleet in range(plan.fleets)
        ]
    )


def ablation_table(result: Ablation) -> Table:
    """Table with a group per figure: mean and difference to the first source of each source, with intervals."""
    plan = result.plan
    title = (
        f"{result.scenario}, {label(plan.policy)}, {unit((plan.fleets, plan.trainings, plan.seeds))}: mean, paired "
        f"difference to {plan.label(plan.scores[0])}, {LEGEND}"
    )
    groups = {
        name: figure_rows(
            {scores: e[name] for scores, e in result.effects.items()}, plan.scores[0], plan.label, least_digits=2
        )
        for name in FIGURES
    }
    return Table.grouped(HEAD, groups, caption=title, notes=(*remarks(result.effects, min(plan.fleets, plan.seeds)),))
