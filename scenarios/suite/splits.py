"""The frozen splits: instances with a manifest of hashes, which `benchmarks/freeze_suite.py` writes."""

import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import resources

import msgspec

from fleet.errors import ScenarioError
from scenarios.spec.parse import choose
from scenarios.spec.schema import SPLITS, Scenario, SplitName
from scenarios.suite.instances import CELLS, Axes, SuiteCell, scenario_of


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
    """Hash of the jobs of the shift, see `benchmarks.freeze_suite.jobs_content`."""
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
    return tuple(msgspec.json.decode(line, type=ManifestLine) for line in file.read_bytes().splitlines())


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


def line_of(row: ManifestLine) -> str:
    """The line of a manifest file."""
    return json.dumps(asdict(row))


def instance_of(row: ManifestLine) -> Instance:
    """The instance of a line of a manifest."""
    name = row.name.replace("/", "-")
    return Instance(row.name, scenario_of(name, cell_of_instance(row), row.axes, row.seed), row.seed)
