"""Tables of docs/twin.md, docs/twin_studies.md and docs/paper.md, from stored studies of the twin."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any  # JSON values

import msgspec

from scenarios.doc_tables import table
from scenarios.evaluate.statistics import Interval
from scenarios.json_rows import Rows
from scenarios.studies.page_tables.cells import read_json

READING_HEADS = ("AUROC", "AUPRC", "Spearman", "overheating jobs found", "false alarms, new work", "before")
PAYLOADS = {"own": "as the source", "common": "2 kg for all"}


def twin_tables(results: Path) -> dict[str, Callable[[], str]]:
    """Text of each table by the name in its mark.

    Args:
        results: docs/results, with the files of `thermofleet twin readings`, `sides`, `questions`, `sweep` and
            `parsimony`, and of `thermofleet study` in `twin_studies`.
    """
    readings, studies = results / "twin_readings.json", results / "twin_studies"
    return {
        "readings_any": lambda: _readings(readings, "any", "score, for: does any joint overheat?"),
        "readings_joint": lambda: _readings(
            readings, "joint", "score of the joint with the largest w_k, for: does it overheat?"
        ),
        "sides": lambda: _sides(results / "twin_sides.json"),
        "questions_25s": lambda: _questions(results / "twin_questions_25s.json"),
        "questions_6s": lambda: _questions(results / "twin_questions_6s.json"),
        "sweep": lambda: _sweep(results / "twin_sweep.jsonl"),
        "parsimony": lambda: _parsimony(results / "twin_parsimony.jsonl"),
        **{
            f"{name}_{part}": partial(_study, studies / f"{name}.json", place)
            for name, parts in STUDY_TABLES.items()
            for place, part in enumerate(parts)
        },
    }


STUDY_TABLES = {
    "transfer": ("errors", "savings"),
    "features": ("r2",),
    "augmentation": ("errors",),
    "drift": ("delays", "costs"),
}
"""Names of the tables of each study, in the order of `scenarios.studies.lifetime.tables`."""


def _readings(path: Path, question: str, title: str) -> str:
    from scenarios.studies.verdict.readings import summary

    rows: list[tuple[str, ...]] = []
    for reading, measured in summary(read_json(path), question):
        shown = [measured[name] for name in ("auroc", "auprc", "spearman", "hits", "false_work", "false_before")]
        with_bounds = {"auroc": shown[0], "false_work": shown[4]}.values()
        rows.append((reading, *(each.text(3) if each in with_bounds else f"{each.mean:.3f}" for each in shown)))
    return table((title, *READING_HEADS), rows)


def _sides(path: Path) -> str:
    measured = read_json(path)
    rows = [
        (
            f"{text}, {side} side",
            Interval(*share["warm"]).text(),
            Interval(*share["critical"]).text(),
            f"{share['peak_c']:.0f} °C",
        )
        for name, text in PAYLOADS.items()
        for side, share in measured[name].items()
    ]
    return table(("payload, side", "above 40 °C", "60 °C or more", "median of the hottest motor"), rows)


def _questions(path: Path) -> str:
    rows: list[tuple[str, ...]] = []
    for question, answer in read_json(path)["0"].items():
        auroc = [Interval(*each).text() for each in answer["auroc"].values()]
        windows = f"{answer['events']} of {answer['windows']} ({answer['files_with']})"
        leads = [Interval(*each).text(sign="+") for each in answer["lead"].values()]
        rows.append((question, windows, *auroc, *leads))
    heads = ("question", "windows (files with)", "d", "load", "latent", "RMS torque")
    return table((*heads, "difference: d", "load", "latent"), rows)


def _sweep(path: Path) -> str:
    from scenarios.studies.sweep.configurations import CONFIGURATIONS
    from scenarios.studies.sweep.table import lines_of, table_of

    rows = [row for row in Rows(path).by_key.values() if row["configuration"] in CONFIGURATIONS]
    heads, cells = table_of(lines_of(rows, CONFIGURATIONS))
    return table(tuple(heads), cells)


def _parsimony(path: Path) -> str:
    from scenarios.studies.sweep.parsimony import HEADS, summary

    return table(HEADS, summary([*Rows(path).by_key.values()]))


def _study(path: Path, place: int) -> str:
    """One of the tables that `thermofleet study` prints."""
    from scenarios.studies.lifetime import tables
    from scenarios.studies.lifetime.arm_transfer import Cell
    from scenarios.studies.lifetime.augmentation import Fitted
    from scenarios.studies.lifetime.drift import DriftSize, Life
    from scenarios.studies.lifetime.latent_features import Estimate

    stored = _with_nan(read_json(path))
    rows = stored["rows"]
    made = {
        "transfer": lambda: tables.transfer_tables(msgspec.convert(rows, list[Cell])),
        "features": lambda: tables.feature_tables(msgspec.convert(rows, list[Estimate])),
        "augmentation": lambda: tables.augmentation_tables(msgspec.convert(rows, list[Fitted])),
        "drift": lambda: tables.drift_tables(
            msgspec.convert(rows, list[Life]), msgspec.convert(stored["size"], DriftSize)
        ),
    }[stored["study"]]()[place]
    return table(made.head, made.rows)


def _with_nan(value: Any) -> Any:
    """JSON values with NaN in place of null, which stands for a number that is not finite."""
    if isinstance(value, dict):
        return {key: _with_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_with_nan(each) for each in value]
    return math.nan if value is None else value
