"""The frozen splits: instances with a manifest of hashes, which `benchmarks/freeze_suite.py` writes."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np

from fleet.errors import ScenarioError
from fleet.seeding import shift_seeds
from scenarios.spec.jobs import draw_jobs
from scenarios.spec.parse import choose, hash_of, scenario_hash
from scenarios.spec.schema import SPLITS, Scenario, SplitName
from scenarios.suite.instances import (
    CELLS,
    FAULTS,
    SURPRISE_EVERY,
    Axes,
    SuiteCell,
    draw_axes,
    scenario_of,
    surprises_in,
)

SUITE = 37
"""Seed of all draws of the suite."""
DIGITS = 3
"""Decimals of times in a hash of jobs, s: the last bits of a logarithm differ between platforms."""


@dataclass(frozen=True)
class Instance:
    """One shift of a split."""

    name: str
    """As `test/0017`."""
    scenario: Scenario
    seed: int
    """Of its jobs and its sensors' noise."""


@dataclass(frozen=True)
class ManifestLine:
    """One line of a manifest."""

    name: str
    cell: str
    axes: Axes
    seed: int
    scenario: str
    """Hash of the scenario, see `scenarios.spec.parse`."""
    jobs: str
    """Hash of the drawn jobs, see `jobs_content`."""
    count: int
    """Jobs of the shift."""


@lru_cache(maxsize=len(SPLITS))
def split(name: str) -> tuple[Instance, ...]:
    """The instances of a split: train, validation or test.

    Cells that several instances share have equal plans, space and twins. The first instances are of different cells.

    Raises:
        ScenarioError: there is no such split.
    """
    return tuple(instance_of(row) for row in manifest(name))


def instance(name: str) -> Instance:
    """The instance of a name, as `test/0017`.

    Raises:
        ScenarioError: there is no such instance.
    """
    rows = manifest(name.partition("/")[0])
    row = _line_of_instance(name)
    if row is None:
        raise ScenarioError(f"No instance '{name}' in the suite; they are {rows[0].name} to {rows[-1].name}.")
    return instance_of(row)


@lru_cache(maxsize=len(SPLITS))
def manifest(name: str) -> tuple[ManifestLine, ...]:
    """The frozen lines of a split.

    Raises:
        ScenarioError: there is no such split.
    """
    file = resources.files("scenarios").joinpath(f"suite/{choose('split', name, SplitName)}.jsonl")
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return tuple(ManifestLine(**{**line, "axes": Axes(**line["axes"])}) for line in lines)


def cell_of_instance(row: ManifestLine) -> SuiteCell:
    """The cell of a line of a manifest."""
    return next(cell for cell in CELLS if cell.name == row.cell)


def _line_of_instance(instance: str) -> ManifestLine | None:
    """The line of an instance by its name, as `test/0017`; None for another name."""
    split = instance.rpartition("/")[0]
    return next((row for row in (manifest(split) if split in SPLITS else ()) if row.name == instance), None)


def cell_name(instance: str) -> str:
    """The cell of an instance of a split by its name; of `SCENARIO/SEED`, the scenario."""
    row, (name, _, number) = _line_of_instance(instance), instance.rpartition("/")
    return row.cell if row else name or number


def heat_binds(instance: str) -> bool | None:
    """Whether a policy that ignores heat is expected to fault in an instance of a split; None for another name."""
    row = _line_of_instance(instance)
    return None if row is None else row.axes.heat != "cool"


def drawn_rows(name: SplitName) -> Iterator[ManifestLine]:
    """Sample the lines of a split again, in turns from each of its cells."""
    cells = [cell for cell in CELLS if cell.split == name]
    turns = range(max(cell.instances for cell in cells))
    levels = list(FAULTS)
    chosen = [(turn, cell) for turn in turns for cell in cells if turn < cell.instances]
    for number, (turn, cell) in enumerate(chosen):
        entropy = np.random.SeedSequence([SUITE, SPLITS.index(name), number])
        seed = int(entropy.generate_state(1)[0])
        heat = levels[0 if cell.asks == "light_work" else turn % len(levels)]
        surprised = (turn + cells.index(cell)) % SURPRISE_EVERY == 0
        surprises = surprises_in(cell) if surprised else ("nothing",)
        axes = draw_axes(np.random.default_rng(entropy.spawn(1)[0]), heat, surprises)
        row = ManifestLine(f"{name}/{number:04d}", cell.name, axes, seed, "", "", 0)
        made = instance_of(row)
        jobs = jobs_content(made)
        yield replace(row, scenario=scenario_hash(made.scenario), jobs=hash_of(jobs), count=len(jobs))


def line_of(row: ManifestLine) -> str:
    """The line of a manifest file."""
    return json.dumps(asdict(row))


def jobs_content(made: Instance) -> list[Any]:
    """The jobs of an instance's shift as JSON values, in order of release."""
    jobs = draw_jobs(made.scenario, shift_seeds(np.random.SeedSequence(made.seed))[0])
    return [
        [job.name, job.work.kind, [work.stations for work in job.works], job.work.payload_kg, job.repetitions,
         round(job.release_s, DIGITS), round(job.due_s, DIGITS), job.value, job.after, job.expires]
        for job in jobs
    ]  # fmt: skip


def instance_of(row: ManifestLine) -> Instance:
    """The instance of a line of a manifest."""
    name = row.name.replace("/", "-")
    return Instance(row.name, scenario_of(name, cell_of_instance(row), row.axes, row.seed), row.seed)
