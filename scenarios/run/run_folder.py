"""The files of a recorded run."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.arm.cell import cell_model
from fleet.env.allocation_v1 import VERSION
from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import MODES, Telemetry
from scenarios.result_folder import ResultKind, disk_errors
from scenarios.run.shift import RUN_FORMAT, RunResult, summary
from scenarios.shift_records import JobRecord, Offer
from scenarios.spec.schema import Scenario

FILES = ("run.json", "telemetry.parquet", "events.parquet", "jobs.parquet", "offers.parquet", "report.html")
ROWS_AT_ONCE = 10_000
RUN = ResultKind(name="run", card="run.json", files=FILES)


def write(result: RunResult, folder: Path) -> None:
    """Write the files of a run to an existing folder.

    Raises:
        FleetError: the folder cannot be written.
    """
    run = summary(result)
    with disk_errors(folder):
        (folder / "run.json").write_text(json.dumps(run, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        pq.write_table(event_table(result.events), folder / "events.parquet")
        pq.write_table(record_table(JobRecord, result.jobs), folder / "jobs.parquet")
        pq.write_table(record_table(Offer, result.offers), folder / "offers.parquet")
        if result.telemetry is None:
            return
        _write_telemetry(result.telemetry, [arm.name for arm in result.scenario.arms], folder / "telemetry.parquet")
        html = run_html(run, result.scenario, result.telemetry, result.events, result.jobs, result.offers)
        (folder / "report.html").write_text(html, encoding="utf-8")


def run_html(
    card: Mapping[str, Any],
    scenario: Scenario,
    telemetry: Telemetry,
    events: Sequence[Event],
    jobs: Sequence[JobRecord],
    offers: Sequence[Offer],
    *,
    meshes: bool = False,
) -> str:
    """The report of a run as one HTML page.

    Args:
        card: Content of run.json.
        meshes: Show Kinova's shells instead of primitives.

    Raises:
        FleetError: the meshes are not available.
    """
    from scenarios.show.run_page import report_html

    robots, limits = [arm.robot() for arm in scenario.arms], scenario.limits
    return report_html(
        card,
        telemetry,
        events,
        [robot.name for robot in robots],
        warning_c=limits.warning_c,
        error_c=limits.error_c,
        model=cell_model(robots, scenario.places, scenario.fixtures, meshes=meshes),
        payload_of={job.job: job.payload_kg for job in jobs},
        offers=offers,
    )


def _write_telemetry(telemetry: Telemetry, arms: list[str], path: Path) -> None:
    """Some rows at a time, as a table of all takes as much memory as the readings."""
    samples = max(1, ROWS_AT_ONCE // len(arms))
    first = telemetry_table(_part(telemetry, slice(0, samples)), arms)
    with pq.ParquetWriter(path, first.schema) as writer:
        writer.write_table(first)
        for i in range(samples, len(telemetry.time_s), samples):
            writer.write_table(telemetry_table(_part(telemetry, slice(i, i + samples)), arms))


def _part(telemetry: Telemetry, rows: slice) -> Telemetry:
    return Telemetry(**{name: values[rows] for name, values in vars(telemetry).items()})


def check_format(run: Mapping[str, Any], folder: Path) -> None:
    """Check that this version can read a run.

    Args:
        run: The content of its run.json.

    Raises:
        FleetError: it is of another format.
    """
    if run["format"] != RUN_FORMAT:
        raise FleetError(
            f"'{folder}' is a run of format {run['format']} in {run.get('environment', 'allocation_v0')}; this "
            f"version reads {RUN_FORMAT}, {VERSION}. Run the scenario again."
        )


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


def event_table(events: tuple[Event, ...]) -> pa.Table:
    """One row per event: the fields of `Event` without the env."""
    number, text = pa.float64(), pa.string()
    types = {
        "time_s": number,
        "kind": text,
        "arm": text,
        "job": text,
        "joint": pa.int8(),
        "value": number,
        "reason": text,
    }
    return pa.table({name: pa.array([getattr(e, name) for e in events], kind) for name, kind in types.items()})


def record_table(kind: type, records: Sequence[object]) -> pa.Table:
    """One row per record: the fields of a dataclass of text, numbers and booleans."""
    types = {
        "str": pa.string(),
        "bool": pa.bool_(),
        "int": pa.int64(),
        "int | None": pa.int64(),
        "float": pa.float64(),
        "float | None": pa.float64(),
    }
    names = {field.name: types[getattr(field.type, "__name__", str(field.type))] for field in fields(kind)}
    return pa.table({name: pa.array([getattr(r, name) for r in records], kind) for name, kind in names.items()})
