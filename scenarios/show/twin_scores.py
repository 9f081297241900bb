"""A twin's scores of a scenario's jobs or of a log, as a table, CSV or JSON."""

import json
import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from fleet.files import cache_folder
from fleet.motion import Plan
from scenarios.prepare.arms import plan_arms
from scenarios.progress import Progress, quiet
from scenarios.spec.jobs import all_works
from scenarios.spec.schema import Scenario
from scenarios.table import Column, Table
from twin.log_windows import LogWindows, TooShort, log_windows
from twin.logs.recording import Recording
from twin.vae.measures import Features, Measures
from twin.vae.twin import Twin
from twin.verdict import LogStretches, Rule, word

_LOG = logging.getLogger(__name__)
Array = np.ndarray
T = TypeVar("T")
ScoreRow = dict[str, str | float | int | None]
LOADED = 2
"""Joint 2 carries most of a standing arm's load and ranks jobs best, so a table shows its d."""
OMITTED = ("twin", "data", "log", "end_s", "hottest_joint", *(f"d_{joint}" for joint in range(1, 8) if joint != LOADED))
P_NAMES = {"d": "novelty"}
"""Names of readings in columns of p-values, where they differ."""
OMITTED_WITH_VERDICT = (f"d_{LOADED}", "latent", "d_cal")
"""Columns omitted from tables, which are 80 characters wide; CSV and JSON hold them all."""


def jobs_of_arm(twin: Twin, scenario: Scenario, progress: Progress = quiet) -> list[tuple[Plan, int]]:
    """The plans of the twin's arm for each work of a scenario, with their repetitions.

    Raises:
        FleetError: the scenario has no arm of the twin's name.
    """
    (arm,) = plan_arms(scenario, [scenario.index_of(twin.arm)], all_works(scenario), cache_folder(), progress)
    return [(plan, _repetitions(scenario, plan)) for plan in arm.all_plans]


def job_rows(twin: Twin, jobs: Sequence[tuple[Plan, int]]) -> list[ScoreRow]:
    """One row of scores per job."""
    rows = list[ScoreRow]()
    for plan, repetitions in jobs:
        measures = twin.measure(plan, repetitions)
        begins: ScoreRow = {
            "job": f"{plan.work.kind} {' → '.join(place.name for place in plan.work.places)}",
            "payload_kg": plan.work.payload_kg,
            "elbow": plan.elbow,
            "speed": plan.speed,
            "repetitions": repetitions,
        }
        d_cal = None if measures.calibrated is None else measures.calibrated.max()
        rows.append(begins | _scores(twin, measures, d_cal=d_cal, p_value=measures.p_value))
    return rows


def log_rows(rule: Rule, recordings: Sequence[Recording]) -> tuple[list[ScoreRow], Features]:
    """One row of scores per recording, those of its worst stretches, and the features that are judged, [row, joint].

    Raises:
        FleetError: as `of_each`.
    """
    rows, judged, twin = list[ScoreRow](), list[Array](), rule.twin
    for recording, log in of_each(recordings, partial(LogStretches.of, twin)):
        features = log.worst(twin.joint_weight)
        judged.append(features.packed)
        measures, share = twin.measures_of(features), log.share(rule.anomalous(log.stretches))
        hottest_c = None if recording.temp_c is None else recording.temp_c.max()
        begins: ScoreRow = {"recording": recording.name, "minutes": recording.duration_s / 60}
        rows.append(begins | _scores(twin, measures, hottest_c=hottest_c, anomalous_share=share))
    return rows, Features(np.stack(judged))


def of_each(recordings: Sequence[Recording], score: Callable[[Recording], T]) -> list[tuple[Recording, T]]:
    """The recordings with their scores; one that is shorter than a window is left out with a warning.

    Raises:
        FleetError: as `twin.log_windows.log_windows`, TooShort only if no recording is left.
    """
    scored, short = list[tuple[Recording, T]](), list[TooShort]()
    for recording in recordings:
        try:
            scored.append((recording, score(recording)))
        except TooShort as error:
            short.append(error)
    if short and not scored:
        raise short[0]
    for error in short:
        _LOG.warning("%s It is left out.", error)
    return scored


def with_verdicts(rows: Sequence[ScoreRow], rule: Rule, features: Features) -> list[ScoreRow]:
    """The rows with p-values and the verdict of a rule on their features [row, joint] before the reasons."""
    by = {name: f"p_{P_NAMES.get(name, name)}" for name in ("load", "d", rule.reading)}
    p_values = {name: rule.p_value(features, name).tolist() for name in by}
    judged = list[ScoreRow]()
    for i, row in enumerate(rows):
        ends = {name: row[name] for name in ("why", "twin", "data")}
        begins = {name: value for name, value in row.items() if name not in (*ends, "p_value")}
        each = {column: p_values[name][i] for name, column in by.items()}
        judged.append({**begins, **each, "verdict": word(p_values[rule.reading][i] <= rule.alpha), **ends})
    return judged


def _repetitions(scenario: Scenario, plan: Plan) -> int:
    """Largest number of repetitions in the streams of this work."""
    names = tuple(place.name for place in plan.work.places)
    return max(s.repetitions[1] for s in scenario.jobs if s.kind == plan.work.kind and names in s.alternatives)


def window_rows(twin: Twin, recording: Recording) -> list[ScoreRow]:
    """One row per window of a recording, without overlap, in order of time; gaps are left out.

    Raises:
        FleetError: the recording has another number of joints than the twin, or is shorter than one window.
    """
    return score_windows(twin, log_windows(twin, recording))


def score_windows(twin: Twin, parts: LogWindows) -> list[ScoreRow]:
    """One row per window."""
    window, rows = twin.config.window, list[ScoreRow]()
    for stretch, first, features in parts:
        measures = twin.measures_of(features)
        for number, i in enumerate(first.tolist()):
            start_s, end_s = stretch.time_s[[i, i + window - 1]].tolist()
            begins: ScoreRow = {"log": stretch.recording, "start_s": start_s, "end_s": end_s}
            each_c = None if stretch.temp_c is None else stretch.temp_c[i : i + window].max(axis=0)
            hottest_c, joint = (None, None) if each_c is None else (each_c.max(), int(each_c.argmax()) + 1)
            rows.append(begins | _scores(twin, measures.of_job(number), hottest_c=hottest_c, hottest_joint=joint))
    return rows


def window_text(row: ScoreRow, how: str) -> str:
    """One window as a line of text, of JSON, or of CSV under the names of its columns."""
    if how == "json":
        return json.dumps(row, allow_nan=False)
    if how == "csv":
        return Table(head=tuple(row), rows=(tuple(map(_csv_text, row.values())),)).csv().rstrip("\r\n")
    hot = "" if row["hottest_c"] is None else f"  joint {row['hottest_joint']} {row['hottest_c']:.1f} °C"
    return f"{row['end_s']:.1f} s  d {row['d']:.2f}  load {row['load']:.2f}{hot}  {row['why']}"


def _scores(twin: Twin, measures: Measures, **more: float | Array | int | None) -> ScoreRow:
    """The scores of one job or window, further figures, and their origin."""
    figures = {"d": measures.total, **{f"d_{j + 1}": d for j, d in enumerate(measures.difficulty)}}
    figures |= {"load": measures.total_load, "latent": measures.total_latent, **more}
    plain: ScoreRow = {name: v if v is None or isinstance(v, int) else float(v) for name, v in figures.items()}
    return plain | {"why": measures.why(), "twin": twin.version, "data": twin.data_hash}


def render(rows: Sequence[ScoreRow], how: str, *, caption: str) -> str | Table:
    """Rows as a table, or as CSV or JSON text that ends with a line break."""
    if how == "json":
        return json.dumps({"twin": caption, "rows": list(rows)}, indent=1, allow_nan=False) + "\n"
    heads = list(rows[0]) if rows else []
    if how == "csv":
        texts = (tuple(map(_csv_text, row.values())) for row in rows)
        return Table(head=tuple(heads), rows=tuple(texts)).csv()
    omitted = {*OMITTED, *(OMITTED_WITH_VERDICT if "verdict" in heads else ())}
    if len({row.get("log") for row in rows}) > 1:
        omitted.remove("log")
    shown = [head for head in heads if head not in omitted]
    return Table(
        head=tuple(Column(SHORT.get(head, head), words=isinstance(rows[0][head], str)) for head in shown),
        rows=tuple(tuple(_cell(row[head]) for head in shown) for row in rows),
        notes=(f"{caption}; --format csv or --json for every column",),
    )


SHORT = {"payload_kg": "kg", "repetitions": "times", "p_value": "p", "hottest_c": "°C", "anomalous_share": "share"}
"""Short column heads of tables."""


def _csv_text(value: str | float | int | None) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "" if value is None else str(value)


def _cell(value: str | float | int | None) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else str(value)
