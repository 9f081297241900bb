"""A twin's scores of a scenario's jobs or of a log, as a table, CSV or JSON."""

import csv
import io
import json
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from fleet.errors import FleetError
from fleet.files import cache_folder
from fleet.motion import Plan
from scenarios.job_stream import all_works
from scenarios.prepare.planned_arm import plan_arms
from scenarios.progress import Progress, quiet
from scenarios.schema import Scenario
from twin.logs.recording import Recording
from twin.logs.resampling import Stretch, stretches
from twin.vae.twin import Twin

Array = np.ndarray
Cell = str | float | None
Row = dict[str, Cell]
LOADED = 2
"""Joint 2 carries most of a standing arm's load and ranks jobs best, so a table shows its d."""
OMITTED = ("twin", "data", "log", "elbow", "end_s", *(f"d_{joint}" for joint in range(1, 8) if joint != LOADED))
"""Columns omitted from tables, which are 80 characters wide; CSV and JSON hold them all."""


def job_rows(twin: Twin, scenario: Scenario, progress: Progress = quiet) -> list[Row]:
    """One row per plan of the twin's arm for each work of a scenario.

    Raises:
        FleetError: the scenario has no arm of the twin's name.
    """
    (arm,) = plan_arms(scenario, [scenario.index_of(twin.arm)], all_works(scenario), cache_folder(), progress)
    return [_job_row(twin, plan, _repetitions(scenario, plan)) for plan in arm.all_plans]


def _repetitions(scenario: Scenario, plan: Plan) -> int:
    """Largest number of repetitions in the streams of this work."""
    names = tuple(place.name for place in plan.work.places)
    return max(s.repetitions[1] for s in scenario.jobs if s.kind == plan.work.kind and tuple(s.places) == names)


def _job_row(twin: Twin, plan: Plan, repetitions: int) -> Row:
    measures = twin.measure(plan, repetitions)
    calibrated = measures.calibrated
    return {
        "job": f"{plan.work.kind} {' → '.join(place.name for place in plan.work.places)}",
        "payload_kg": plan.work.payload_kg,
        "elbow": plan.elbow,
        "speed": plan.speed,
        "repetitions": repetitions,
        "d": float(measures.total),
        **{f"d_{j + 1}": float(d) for j, d in enumerate(measures.difficulty)},
        "d_cal": None if calibrated is None else float(calibrated.max()),
        "load": float(measures.load.sum()),
        "p_value": None if measures.p_value is None else float(measures.p_value),
        "why": measures.why(),
        "twin": twin.version,
        "data": twin.data_hash,
    }


def window_rows(twin: Twin, recording: Recording) -> list[Row]:
    """One row per window of a recording, without overlap, in order of time; gaps are left out.

    Raises:
        FleetError: the recording has another number of joints than the twin, or is shorter than one window.
    """
    if recording.joints != twin.joints:
        raise FleetError(f"'{recording.name}' has {recording.joints} joints, the twin of '{twin.arm}' {twin.joints}.")
    c = twin.config
    rows = [row for stretch in stretches(recording, c.rate_hz) for row in _stretch_rows(twin, stretch)]
    if not rows:
        raise FleetError(
            f"'{recording.name}' has no stretch of {c.window / c.rate_hz:g} s without a gap, which one window needs."
        )
    return rows


def _stretch_rows(twin: Twin, stretch: Stretch) -> list[Row]:
    c = twin.config
    first = np.arange(0, len(stretch.profile) - c.window + 1, c.window)
    if not len(first):
        return []
    inside = first[:, None] + np.arange(c.window)
    measures = twin.measures_of(twin.window_features(stretch.profile[inside].transpose(0, 1, 3, 2)))
    rows = []
    for number, i in enumerate(first.tolist()):
        one = measures.of_job(number)
        rows.append(
            {
                "log": stretch.recording,
                "start_s": float(stretch.time_s[i]),
                "end_s": float(stretch.time_s[i + c.window - 1]),
                "d": float(one.total),
                **{f"d_{j + 1}": float(d) for j, d in enumerate(one.difficulty)},
                "load": float(one.load.sum()),
                "hottest_c": None if stretch.temp_c is None else float(stretch.temp_c[i : i + c.window].max()),
                "why": one.why(),
                "twin": twin.version,
                "data": twin.data_hash,
            }
        )
    return rows


def render(rows: Sequence[Row], how: str, *, caption: str) -> str | Table:
    """Rows as a rich table, or as CSV or JSON text that ends with a line break."""
    if how == "json":
        return json.dumps({"twin": caption, "rows": list(rows)}, indent=1, allow_nan=False) + "\n"
    heads = list(rows[0]) if rows else []
    if how == "csv":
        held = io.StringIO()
        writer = csv.DictWriter(held, heads, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: _flat(value) for key, value in row.items()} for row in rows)
        return held.getvalue()
    caption = f"{caption}; --format csv or json for every joint"
    table = Table(box=None, pad_edge=False, caption=caption, caption_justify="left")
    for head in (head for head in heads if head not in OMITTED):
        text = isinstance(rows[0][head], str)
        table.add_column(SHORT.get(head, head), justify="left" if text else "right", no_wrap=not text)
    for row in rows:
        table.add_row(*(_cell(value) for head, value in row.items() if head not in OMITTED))
    return table


SHORT = {"payload_kg": "kg", "repetitions": "times", "p_value": "p", "hottest_c": "°C"}
"""Short column heads of tables."""


def _flat(value: Cell) -> Cell:
    return f"{value:.6g}" if isinstance(value, float) else "" if value is None else value


def _cell(value: Cell) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
