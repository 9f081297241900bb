"""Read logs of real and simulated arms: Gen3 CSV, plain CSV (both plain or gzip), telemetry.parquet."""

import logging
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from fleet.errors import LogError
from twin.logs.csv_table import read_csv
from twin.logs.formats import PLAIN, channels, check_columns, format_of, implausible_readings
from twin.logs.parquet import read_arms
from twin.logs.recording import Recording
from twin.logs.table import Damage, Table, damage_summary, time_damage

Damaged = Literal["refuse", "skip"]
"""Treatment of a file that has unusable lines."""
SUFFIXES = (".csv.gz", ".csv", ".parquet")
NOT_LOGS = ("events.parquet",)
"""Other parquet files of a run folder."""

log = logging.getLogger(__name__)


def read(path: str | Path, *, damaged: Damaged = "refuse") -> list[Recording]:
    """The recordings of one file: one, or in a telemetry.parquet one per arm.

    Args:
        damaged: "refuse" raises on any unusable line; "skip" drops such lines, logs a warning, and lists them in
            `Recording.dropped`.

    Raises:
        LogError: file, line and reason.
        ValueError: another value of `damaged`.
    """
    if damaged not in get_args(Damaged):
        raise ValueError(f"damaged must be one of {', '.join(get_args(Damaged))} (got {damaged!r}).")
    path = Path(path)
    name = _name(path)
    if path.is_dir():
        raise LogError(str(path), None, "is a folder; a log is a file.")
    if path.suffix == ".parquet":
        return [_recording(path, f"{name}/{arm}", table, damaged) for arm, table in read_arms(path).items()]
    return [_recording(path, name, read_csv(path), damaged)]


def read_folder(path: str | Path, *, damaged: Damaged = "refuse") -> list[Recording]:
    """The recordings of all logs of a folder, by file name, without its subfolders.

    With damaged="skip" a file without any good line is skipped too, with a warning.

    Raises:
        LogError: as `read` for the first unusable file; or no log, no usable log, or two logs of one name.
    """
    path = Path(path)
    if not path.is_dir():
        raise LogError(str(path), None, "is not a folder." if path.exists() else "does not exist.")
    files = sorted(f for f in path.iterdir() if f.name.lower().endswith(SUFFIXES) and f.name not in NOT_LOGS)
    if not files:
        raise LogError(str(path), None, f"holds no log; a log ends in {', '.join(SUFFIXES)}.")
    by_name = {_name(f): f for f in files}
    for f in files:
        if by_name[_name(f)] != f:
            raise LogError(str(path), None, f"'{f.name}' and '{by_name[_name(f)].name}' are the same log; keep one.")
    recordings: list[Recording] = []
    for f in files:
        try:
            recordings += read(f, damaged=damaged)
        except LogError as error:
            if damaged == "refuse":
                raise
            log.warning("skipped %s", error)
    if not recordings:
        raise LogError(str(path), None, f"none of its {len(files)} logs is usable; see the warnings.")
    return recordings


def _name(path: Path) -> str:
    return next((path.name[: -len(s)] for s in SUFFIXES if path.name.lower().endswith(s)), path.name)


def _recording(path: Path, name: str, table: Table, damaged: Damaged) -> Recording:
    """A recording from the good rows of a table."""
    is_csv = path.suffix != ".parquet"
    try:
        layout = format_of(table.names) if is_csv else PLAIN
        groups, unknown = check_columns(layout, table.names)
    except ValueError as error:
        raise LogError(str(path), 1 if is_csv else None, str(error)) from error
    readings = channels(layout, groups, table)
    damage = [*table.damage, *implausible_readings(layout, readings, table.where)]
    good = ~np.isin(table.where, [d.line for d in damage])
    time_s = table.values[:, table.names.index(layout.time)]
    try:
        damage += time_damage(time_s[good], table.where[good])
    except ValueError as error:
        raise LogError(str(path), None, str(error)) from error
    broken = table.broken
    if unknown:
        broken = (*broken, f"its columns {', '.join(unknown)} are unknown to a {layout.name}")
    if damaged == "refuse" and (broken or damage):
        others = len(broken) + len(damage) - 1
        more = f", and {others} more damaged place{'s' * (others > 1)}" if others else ""
        first = min(damage, key=lambda d: d.line, default=Damage(0, ""))
        line, reason = (None, broken[0]) if broken else (first.line, first.reason)
        raise LogError(str(path), line, f'{reason}{more}. Use damaged="skip" to read the undamaged lines.')
    keep = ~np.isin(table.where, [d.line for d in damage])
    dropped = (*broken, *damage_summary(damage))
    for sentence in dropped:
        log.warning("%s: dropped: %s", path, sentence)
    if not keep.any():
        raise LogError(str(path), None, f"holds no good line of numbers{': ' if dropped else '.'}{'; '.join(dropped)}")
    kept = {channel: np.ascontiguousarray(values[keep]) for channel, values in readings.items()}
    return Recording(name=name, time_s=time_s[keep], **kept, dropped=dropped)
