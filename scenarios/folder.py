"""Folders of results, whole or not there; and what lies in the folder of a run."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import FleetError
from fleet.events import Event
from fleet.robot import JOINTS
from fleet.telemetry import MODES, Telemetry
from scenarios.report import report_html
from scenarios.run import RunResult, summary

FILES = ("run.json", "telemetry.parquet", "events.parquet", "report.html")


@dataclass(frozen=True, kw_only=True)
class Kind:
    """How a folder of results is known again, so that only its like is replaced."""

    what: str
    """In words, after "a finished"."""
    card: str
    """A JSON file with a field `status`: finished or interrupted."""
    holds: tuple[str, ...]
    """Patterns of all that may lie in it."""


RUN = Kind(what="run", card="run.json", holds=FILES)


@contextmanager
def new_folder(out: Path, *, overwrite: bool = False, kind: Kind = RUN) -> Iterator[Path]:
    """A temporary folder that becomes `out` when the block ends well, and vanishes when it does not.

    Raises:
        FleetError: `out` cannot be written, or holds something that is not ours to replace.
    """
    check_free(out, overwrite=overwrite, kind=kind)
    place = Path(os.path.abspath(out))
    made = [parent for parent in place.parents if not parent.exists()]
    with _or_say(out):
        place.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
    try:
        yield work
        with _or_say(out):
            work.chmod(0o755)
            _swap(work, place)
    finally:
        if work.exists():
            shutil.rmtree(work)
            for parent in made:
                with suppress(OSError):  # somebody else has put something there in the meantime
                    parent.rmdir()


def _swap(work: Path, place: Path) -> None:
    """Let `work` take the place of what was there."""
    if not place.exists():
        work.rename(place)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{place.name}.old.", dir=place.parent))
    place.rename(old / place.name)
    work.rename(place)
    shutil.rmtree(old)


@contextmanager
def _or_say(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FleetError(f"Cannot write to '{out}': {error.strerror or error}.") from error


def check_free(out: Path, *, overwrite: bool, kind: Kind = RUN) -> None:
    """Refuse a place that is taken by anything but an earlier result of this kind that may be replaced.

    Raises:
        FleetError: what is there, and what would be allowed.
    """
    with _or_say(out):
        for parent in out.parents:
            if parent.exists() and not parent.is_dir():
                raise FleetError(f"Cannot write to '{out}': '{parent}' is a file, not a folder.")
        if not out.exists():
            return
        if not out.is_dir():
            raise FleetError(f"Cannot write to '{out}': it is a file; --out needs a folder.")
        held = sorted(p.name for p in out.iterdir())
    status = _status(out / kind.card)
    strangers = [name for name in held if not status or not any(fnmatchcase(name, known) for known in kind.holds)]
    if strangers:
        raise FleetError(
            f"'{out}' holds other things ('{strangers[0]}'); --out needs a new folder or an earlier {kind.what}."
        )
    if status == "finished" and not overwrite:
        raise FleetError(f"'{out}' holds a finished {kind.what}; give another --out, or --overwrite to replace it.")


def _status(card: Path) -> str | None:
    """What run.json, or its like, says; None where there is none, or not ours."""
    try:
        status = json.loads(card.read_text(encoding="utf-8"))["status"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return status if status in ("finished", "interrupted") else None


def write(result: RunResult, folder: Path) -> None:
    """Lay down the files of a run in an existing folder.

    Raises:
        FleetError: the disk refuses.
    """
    run = summary(result)
    arms = [arm.name for arm in result.scenario.arms]
    with _or_say(folder):
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
