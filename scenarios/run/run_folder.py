"""The files of a recorded run."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import MODES, Telemetry
from scenarios.report.run_page import report_html
from scenarios.result_folder import ResultKind, disk_errors
from scenarios.run.shift import RunResult, summary

FILES = ("run.json", "telemetry.parquet", "events.parquet", "report.html")


RUN = ResultKind(name="run", card="run.json", files=FILES)


def write(result: RunResult, folder: Path) -> None:
    """Lay down the files of a run in an existing folder.

    Raises:
        FleetError: the disk refuses.
    """
    run = summary(result)
    arms = [arm.name for arm in result.scenario.arms]
    with disk_errors(folder):
        (folder / "run.json").write_text(json.dumps(run, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        pq.write_table(event_table(result.events), folder / "events.parquet")
        if result.telemetry is None:
            return
        pq.write_table(telemetry_table(result.telemetry, arms), folder / "telemetry.parquet")
        limits = result.scenario.limits
        html = report_html(
            run, result.telemetry, result.events, arms, warning_c=limits.warning_c, error_c=limits.error_c
        )
        (folder / "report.html").write_text(html, encoding="utf-8")


UNITS = {"q": "rad", "qd": "rad/s", "tau": "N·m", "current_a": "A", "temp_c": "°C"}
"""Of the readings of each joint, also in the metadata of the columns."""


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
    """One row per event, the fields of `Event` but for the env."""
    rows: list[Mapping[str, Any]] = [{k: v for k, v in asdict(e).items() if k != "env"} for e in events]
    schema = pa.schema(
        [
            ("time_s", pa.float64()),
            ("kind", pa.string()),
            ("arm", pa.string()),
            ("job", pa.string()),
            ("joint", pa.int8()),
            ("value", pa.float64()),
            ("reason", pa.string()),
        ]
    )
    return pa.Table.from_pylist(rows, schema=schema)
