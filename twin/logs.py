"""Logs of real and simulated arms as recordings: Gen3 CSV, plain CSV, telemetry.parquet; plain or gzip."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from fleet.errors import LogError
from twin.log_formats import PLAIN, Format, channels, check_columns, format_of, unbelievable
from twin.log_lines import read_lines
from twin.log_parquet import read_arms
from twin.log_table import Damage, Table, backwards, table_of, told
from twin.recording import Recording

Damaged = Literal["refuse", "skip"]
"""What to do with a file of which some lines cannot be used."""
SUFFIXES = (".csv.gz", ".csv", ".parquet")
NOT_LOGS = ("events.parquet",)
"""What lies beside the telemetry in a run folder."""

log = logging.getLogger(__name__)


def read(path: str | Path, *, damaged: Damaged = "refuse") -> list[Recording]:
    """The recordings of one file: one, or in a telemetry.parquet one per arm.

    Args:
        damaged: "refuse" makes any line that cannot be used an error; "skip" reads the rest, says through logging
            what was left out, and keeps those words in `Recording.dropped`.

    Raises:
        LogError: file, line and reason.
        ValueError: `damaged` is neither.
    """
    if damaged not in get_args(Damaged):
        raise ValueError(f"damaged must be one of {', '.join(get_args(Damaged))} (got {damaged!r}).")
    path = Path(path)
    name = _name(path)
    if path.is_dir():
        raise LogError(str(path), None, "is a folder; a log is a file.")
    if path.suffix == ".parquet":
        return [_recording(path, f"{name}/{arm}", PLAIN, table, (), damaged) for arm, table in read_arms(path).items()]
    lines = read_lines(path)
    try:
        table = table_of(lines)
        known = format_of(table.names)
    except ValueError as error:
        raise LogError(str(path), 1, str(error)) from error
    return [_recording(path, name, known, table, (lines.broken,) if lines.broken else (), damaged)]


def read_folder(path: str | Path, *, damaged: Damaged = "refuse") -> list[Recording]:
    """The recordings of all logs of a folder, by file name; folders in it are not entered.

    With damaged="skip" a file without any good line is left out, too, and logging says so.

    Raises:
        LogError: of the first file that is refused; or there is no log, or no good one; or two have one name.
    """
    path = Path(path)
    if not path.is_dir():
        raise LogError(str(path), None, "is no folder." if path.exists() else "there is no such folder.")
    files = sorted(f for f in path.iterdir() if f.name.lower().endswith(SUFFIXES) and f.name not in NOT_LOGS)
    if not files:
        raise LogError(str(path), None, f"holds no log; a log ends in {', '.join(SUFFIXES)}.")
    by_name = {_name(f): f for f in files}
    for f in files:
        if by_name[_name(f)] != f:
            raise LogError(str(path), None, f"'{f.name}' and '{by_name[_name(f)].name}' are one log; keep one.")
    recordings: list[Recording] = []
    for f in files:
        try:
            recordings += read(f, damaged=damaged)
        except LogError as error:
            if damaged == "refuse":
                raise
            log.warning("left out %s", error)
    if not recordings:
        raise LogError(str(path), None, f"none of its {len(files)} logs can be read; see the warnings.")
    return recordings


def _name(path: Path) -> str:
    return next((path.name[: -len(s)] for s in SUFFIXES if path.name.lower().endswith(s)), path.name)


def _recording(
    path: Path, name: str, known: Format, table: Table, broken: Sequence[str], damaged: Damaged
) -> Recording:
    """A recording from the good rows of a table; `broken` is what is wrong with the file as a whole."""
    try:
        groups, strangers = check_columns(known, table.names)
    except ValueError as error:
        raise LogError(str(path), None if path.suffix == ".parquet" else 1, str(error)) from error
    found = channels(known, groups, table)
    damage = [*table.damage, *unbelievable(known, found, table.where)]
    good = ~np.isin(table.where, [d.line for d in damage])
    time_s = table.values[:, table.names.index(known.time)]
    try:
        damage += backwards(time_s[good], table.where[good])
    except ValueError as error:
        raise LogError(str(path), None, str(error)) from error
    if strangers:
        broken = (*broken, f"its columns {', '.join(strangers)} are none of a {known.name}")
    if damaged == "refuse":
        _refuse(path, broken, damage)
    keep = ~np.isin(table.where, [d.line for d in damage])
    dropped = (*broken, *told(damage))
    for sentence in dropped:
        log.warning("%s: left out: %s", path, sentence)
    if not keep.any():
        raise LogError(str(path), None, f"holds no good line of numbers{': ' if dropped else '.'}{'; '.join(dropped)}")
    kept = {channel: np.ascontiguousarray(values[keep]) for channel, values in found.items()}
    return Recording(name=name, time_s=time_s[keep], **kept, dropped=dropped)


def _refuse(path: Path, broken: Sequence[str], damage: Sequence[Damage]) -> None:
    """Raise what is wrong first, if anything is."""
    others = len(broken) + len(damage) - 1
    if others < 0:
        return
    more = f", and {others} more damaged place{'s' * (others > 1)}" if others else ""
    ask = f'{more}. The good rest can be read with damaged="skip".'
    if broken:
        raise LogError(str(path), None, f"{broken[0]}{ask}")
    first = min(damage, key=lambda d: d.line)
    raise LogError(str(path), first.line, f"{first.reason}{ask}")
