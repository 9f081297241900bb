"""The record of a shift: settings, figures, readings, events, jobs and offers, and their files."""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, cached_property
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any  # values of run.json

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.bus.exchange.channel import PERFECT
from fleet.difficulty import DifficultyModel
from fleet.env.allocation_v2 import VERSION
from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import MODES, Telemetry
from scenarios.result_folder import ResultKind, disk_errors, folder_at
from scenarios.run.metrics import Metrics
from scenarios.run.records import JobRecord, Offer, ShiftLog
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import scenario_hash
from scenarios.spec.schema import Scenario

RUN_FORMAT = 6
"""Raised when run.json or the columns of the recordings change so that an earlier version cannot be read."""

_LIBRARIES = ("thermofleet", "numpy", "mujoco", "torch", "pettingzoo", "eclipse-zenoh", "pyarrow")

FILES = ("run.json", "telemetry.parquet", "events.parquet", "jobs.parquet", "offers.parquet", "report.html")
ROWS_AT_ONCE = 10_000
RUN = ResultKind(name="run", card="run.json", files=FILES)


@dataclass(frozen=True, eq=False, kw_only=True)
class RunLog(ShiftLog):
    """A recorded shift, from `run` or `open_run`; its card has no time of day, so equal seeds give equal files."""

    scenario: Scenario

    @property
    def finished(self) -> bool:
        """False if the shift was interrupted."""
        return self.card["status"] == "finished"

    @property
    def time_s(self) -> float:
        """Simulated time at the end."""
        return self.card["time_s"]

    @property
    def reward(self) -> float:
        """Sum of all rewards."""
        return self.card["reward"]

    @cached_property
    def metrics(self) -> Metrics:
        """Figures of the shift."""
        return Metrics(**self.card["metrics"])

    @cached_property
    def telemetry(self) -> pa.Table:
        """Readings as a table, a row for each arm and moment."""
        return telemetry_table(self.readings, list(self.arms))

    def cell_model(self, *, meshes: bool = False) -> dict[str, Any]:
        """The cell in three dimensions, as `fleet.arm.cell.cell_model`.

        Args:
            meshes: Kinova's shells instead of primitives.

        Raises:
            FleetError: the meshes are not available.
        """
        from fleet.arm.cell import cell_model

        robots = [arm.robot() for arm in self.scenario.arms]
        return cell_model(robots, self.scenario.places, self.scenario.fixtures, meshes=meshes)

    def page(self, *, meshes: bool = False) -> str:
        """The report as one HTML page; arguments and errors as those of `cell_model`."""
        from scenarios.show.run_page import report_html

        return report_html(self, self.cell_model(meshes=meshes))

    def write(self, folder: Path) -> None:
        """Write the files of the run to an existing folder.

        Raises:
            FleetError: the folder cannot be written.
        """
        with disk_errors(folder):
            card = json.dumps(self.card, indent=1, allow_nan=False) + "\n"
            (folder / "run.json").write_text(card, encoding="utf-8")
            pq.write_table(record_table(Event, self.events, **OF_EVENTS), folder / "events.parquet")
            pq.write_table(record_table(JobRecord, self.jobs), folder / "jobs.parquet")
            pq.write_table(record_table(Offer, self.offers), folder / "offers.parquet")
            if not len(self.readings.time_s):
                return
            _write_telemetry(self.readings, list(self.arms), folder / "telemetry.parquet")
            (folder / "report.html").write_text(self.page(), encoding="utf-8")

    def __repr__(self) -> str:
        of = f"{self.scenario.name}, {self.card['policy']}, seed {self.card['seed']}"
        return f"<RunLog of {of}: reward {self.reward:.1f}>"

    def _repr_html_(self) -> str:
        from scenarios.show.run_page import run_html

        return run_html(self)


def card_of(
    spec: RunSpec,
    scenario: Scenario,
    metrics: Metrics,
    twins: Mapping[str, Mapping[str, Any]],
    *,
    finished: bool,
    time_s: float,
    reward: float,
) -> dict[str, Any]:
    """The content of run.json.

    Args:
        twins: `provenance` of each arm's difficulty model.
        time_s: Simulated time at the end.
    """
    return {
        "format": RUN_FORMAT,
        "environment": VERSION,
        "status": "finished" if finished else "interrupted",
        "time_s": time_s,
        "scenario": asdict(scenario),
        "scenario_hash": scenario_hash(scenario),
        **asdict(replace(spec, channel=PERFECT)),
        "channel": scenario.channel(spec.channel).described(),
        "twins": twins,
        "versions": versions_of(_LIBRARIES),
        "code_hash": code_hash(),
        "reward": reward,
        "metrics": asdict(metrics),
    }


def open_run(folder: str | Path) -> RunLog:
    """Read the folder of a run.

    Raises:
        FleetError: it is no folder of a run, not of this version, or damaged.
    """
    folder = folder_at("folder", folder)
    try:
        card = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        known, found = f"{RUN_FORMAT} in {VERSION}", f"{card['format']} in {card.get('environment', 'allocation_v0')}"
        if found != known:
            raise FleetError(
                f"'{folder}' is a run of format {found}; this version reads {known}. Run the scenario again."
            )
        scenario = msgspec.convert(card["scenario"], Scenario)
        tables = {name: pq.read_table(folder / f"{name}.parquet") for name in ("telemetry", "events", "jobs", "offers")}
        stored = RunLog(
            card=card,
            scenario=scenario,
            arms=tuple(arm.name for arm in scenario.arms),
            limits=scenario.limits,
            readings=_readings(tables["telemetry"], len(scenario.arms)),
            events=tuple(Event(**row) for row in tables["events"].to_pylist()),
            jobs=tuple(JobRecord(**row) for row in tables["jobs"].to_pylist()),
            offers=tuple(Offer(**row) for row in tables["offers"].to_pylist()),
        )
        if not len(stored.readings.time_s):
            raise ValueError("telemetry.parquet has no rows")
        _ = stored.plan  # raises for events that contradict each other or the fleet
        return stored
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowInvalid) as error:
        raise FleetError(
            f"'{folder}' is no complete folder of `thermofleet run` ({type(error).__name__}: {error})."
        ) from error


def _readings(table: pa.Table, arms: int) -> Telemetry:
    samples = table.num_rows // arms
    readings = {name: joint_values(table, name) for name in UNITS}
    modes = table["mode"].combine_chunks()
    numbers = np.array([MODES.index(mode) for mode in modes.dictionary.to_pylist()])[modes.indices.to_numpy()]
    return Telemetry(
        time_s=table["time_s"].to_numpy()[::arms],
        mode=numbers.reshape(samples, arms),
        **{name: values.reshape(samples, arms, JOINTS) for name, values in readings.items()},
    )


def joint_values(table: pa.Table, name: str) -> np.ndarray:
    """The columns of a reading, [row, joint]; NaN for what is missing."""
    return np.stack([table[f"{name}_{j + 1}"].to_numpy(zero_copy_only=False) for j in range(JOINTS)], axis=-1)


def _write_telemetry(telemetry: Telemetry, arms: list[str], path: Path) -> None:
    """Some rows at a time, as a table of all takes as much memory as the readings."""

    def part(first: int) -> pa.Table:
        rows = slice(first, first + samples)
        return telemetry_table(Telemetry(**{name: values[rows] for name, values in vars(telemetry).items()}), arms)

    samples = max(1, ROWS_AT_ONCE // len(arms))
    with pq.ParquetWriter(path, part(0).schema) as writer:
        for first in range(0, len(telemetry.time_s), samples):
            writer.write_table(part(first))


UNITS = {"q": "rad", "qd": "rad/s", "tau": "N·m", "current_a": "A", "temp_c": "°C"}
"""Units of the readings of each joint, also in the metadata of the columns."""


def telemetry_table(telemetry: Telemetry, arms: list[str]) -> pa.Table:
    """One row per arm and moment: time_s, arm, mode, then the readings of `UNITS` for joints 1..7."""
    samples, count = telemetry.mode.shape
    columns: dict[str, Any] = {
        "time_s": np.repeat(telemetry.time_s, count),
        "arm": pa.array(arms * samples).dictionary_encode(),
        "mode": pa.DictionaryArray.from_arrays(pa.array(telemetry.mode.ravel(), pa.int8()), pa.array(MODES)),
    }
    units: dict[str, str] = {"time_s": "s"}
    for name, unit in UNITS.items():
        values = getattr(telemetry, name).reshape(samples * count, JOINTS).astype(np.float32)
        for joint in range(JOINTS):
            columns[f"{name}_{joint + 1}"] = values[:, joint]
            units[f"{name}_{joint + 1}"] = unit
    table = pa.table(columns)
    described = [
        field.with_metadata({"unit": units[field.name]}) if field.name in units else field for field in table.schema
    ]
    return table.cast(pa.schema(described))


OF_EVENTS = {"kind": pa.string(), "joint": pa.int8(), "env": None}
"""Columns of events that differ from the fields of `Event`."""


def record_table(kind: type, records: Sequence[object], /, **columns: pa.DataType | None) -> pa.Table:
    """One row per record: the fields of a dataclass of text, numbers and booleans.

    Args:
        columns: Types of fields that have another one than their annotation; None leaves a field out.
    """
    types = {"str": pa.string(), "bool": pa.bool_(), "int": pa.int64(), "float": pa.float64()}
    names = {each.name: getattr(each.type, "__name__", str(each.type)).removesuffix(" | None") for each in fields(kind)}
    chosen = {name: columns[name] if name in columns else types[of] for name, of in names.items()}
    return pa.table({name: pa.array([getattr(r, name) for r in records], of) for name, of in chosen.items() if of})


def provenance(model: DifficultyModel) -> dict[str, Any]:
    """Version of a difficulty model; for a twin also the hash of its training data, and its seed.

    The version is that in `thermofleet twin score`, in the checkpoint's `twin.json` and in the arm's messages.
    """
    twin = getattr(model, "twin", model)
    if not hasattr(twin, "data_hash"):
        return {"version": model.version}
    return {"version": model.version, "twin": {name: getattr(twin, name) for name in ("version", "data_hash", "seed")}}


def versions_of(libraries: Sequence[str]) -> dict[str, str | None]:
    """Versions of Python and of libraries; None for one that is not installed."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for library in libraries:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:
            versions[library] = None
    return versions


PACKAGES = ("fleet", "twin", "agents", "scenarios")


@cache
def code_hash() -> str:
    """Hash of the Python files of the project as they are installed: paths and contents."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        root = Path(str(resources.files(package)))
        for path in sorted(root.rglob("*.py")):
            content = path.read_bytes()
            digest.update(f"{package}/{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]
