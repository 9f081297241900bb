"""What a twin says of a scenario's jobs and of a log, row by row, as a table, CSV or JSON."""

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from fleet.errors import FleetError
from fleet.motion import Plan
from scenarios.build import Progress, body_of, cache_folder, plan_works, quiet
from scenarios.jobs import all_works
from scenarios.scenario import Scenario
from twin.recording import Recording
from twin.score import Twin
from twin.stretches import Stretch, stretches

Array = np.ndarray
Row = dict[str, Any]
LOADED = 2
"""The joint that carries most of a standing arm's load: a table shows its d, which ranks best."""
TRACE = ("twin", "data")
"""What leads from a score to the twin's version, and from there to the hash of its training data."""
LEFT_OUT = (*TRACE, "log", "elbow", "end_s", *(f"d_{joint}" for joint in range(1, 8) if joint != LOADED))
"""Columns that a table has no room for in 80 characters; CSV and JSON hold them all."""


def job_rows(twin: Twin, scenario: Scenario, progress: Progress = quiet) -> list[Row]:
    """One row per way in which the twin's arm may do each work of a scenario.

    Raises:
        FleetError: the scenario has no arm of the twin's name.
    """
    robot, _, _ = body_of(scenario, scenario.index_of(twin.arm))
    plans, _ = plan_works(
        robot, all_works(scenario), scenario, cache_folder(), lambda share: progress("planning", share)
    )
    every = [plan for variants in plans.values() for plan in variants]
    return [_job_row(twin, plan, _repetitions(scenario, plan)) for plan in every]


def _repetitions(scenario: Scenario, plan: Plan) -> int:
    """The most that the stream of this work asks for."""
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
    for head in (head for head in heads if head not in LEFT_OUT):
        words = isinstance(rows[0][head], str)
        table.add_column(SHORT.get(head, head), justify="left" if words else "right", no_wrap=not words)
    for row in rows:
        table.add_row(*(_cell(value) for head, value in row.items() if head not in LEFT_OUT))
    return table


SHORT = {"payload_kg": "kg", "repetitions": "times", "p_value": "p", "hottest_c": "°C"}
"""Of heads, in a table."""


def _flat(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else "" if value is None else value


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
