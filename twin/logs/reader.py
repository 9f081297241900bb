"""Read logs of real and simulated arms: Gen3 CSV, plain CSV (both plain or gzip), telemetry.parquet."""

import gzip
import hashlib
import logging
import os
import re
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from math import isfinite
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple, Self, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import LogError, nearest
from fleet.files import decode_text
from fleet.readings import clock_step, judge, judge_plan, mounts_differ, repeats
from fleet.robot import JOINTS, half_turn
from twin.logs.recording import GAP_S, READINGS, Recording

Array = np.ndarray

MOST_SENTENCES = 20
"""Most sentences about one file; further ones are counted."""
EPOCH_S = 1e8
"""Times from here on are since 1970, s, and are counted from the first."""
DAY_S, CLOCK_S = 86_400.0, 60.0
"""A day, and the most by which a step of the clock differs from an hour or a day, s."""
STRAY_ROWS = 3
"""Longest run of rows with wrong times; a longer one is a clock that was reset."""


@dataclass(frozen=True)
class Damage:
    """An unusable line, or row of a parquet file."""

    line: int
    """From 1."""
    reason: str
    remedy: str = ""
    """Sentences; may be empty."""


@dataclass(frozen=True, eq=False)
class LogTable:
    """The numbers of one arm's log as written."""

    names: tuple[str, ...]
    """Column names."""
    values: Array
    """Finite, [row, column]."""
    where: Array
    """Line in the file of each row, from 1, [row]."""
    damage: tuple[Damage, ...]
    """Unusable lines."""
    broken: tuple[str, ...] = ()
    """Damage of the whole file."""


def time_damage(time_s: Array, where: Array) -> list[Damage]:
    """The fewest rows to drop so that time increases strictly.

    Args:
        time_s: [row].
        where: Line of each row, [row].

    Raises:
        ValueError: the clock was reset, so the file holds several recordings.
    """
    if (np.diff(time_s) > 0).all():
        return []
    keep = _longest_increasing(time_s)
    damage: list[Damage] = []
    for kept, group in groupby(range(len(time_s)), key=keep.__getitem__):
        rows = [] if kept else list(group)
        if len(rows) > STRAY_ROWS:
            if np.ptp(time_s) == 0:
                raise ValueError(f"time is always {time_s[0]:.10g} s: had the recorder no clock?")
            if np.mean(np.diff(time_s) < 0) > 0.5:
                raise ValueError("time runs backwards: is the newest line the first? Sort the lines by time.")
            raise ValueError(_restart(time_s, where))
        damage += [Damage(int(where[row]), _time_reason(time_s, row)) for row in rows]
    return damage


def _restart(time_s: Array, where: Array) -> str:
    """Sentence on the first time that does not increase, and its probable cause."""
    row = int(np.diff(time_s).argmin()) + 1
    before_s, now_s = time_s[row - 1 : row + 1].tolist()
    if before_s == now_s:
        return f"time stands at {now_s:.10g} s from line {where[row]} on: has it too few digits?"
    cause = "the file holds several recordings; split it."
    if now_s >= EPOCH_S and abs(before_s - now_s - 3600.0) < CLOCK_S:
        cause = "was the clock set back for winter time? Give times in UTC, or with their zone."
    elif abs(before_s - now_s - DAY_S) < CLOCK_S:
        cause = "is this midnight? Add 86400 s to the times of each further day."
    return f"time starts again at line {where[row]} ({before_s:.10g} s, then {now_s:.10g} s): {cause}"


def _time_reason(time_s: Array, row: int) -> str:
    beside = time_s[row - 1] if row else time_s[1]
    how = "repeats" if time_s[row] == beside else "runs backwards" if row and time_s[row] < beside else "jumps ahead"
    return f"time {how}: {time_s[row]:.10g} s beside {beside:.10g} s"


def _longest_increasing(values: Array) -> Array:
    """Mask of a longest strictly increasing subsequence (patience sorting); of several, the first."""
    tops: list[float] = []
    at: list[int] = []
    previous = np.full(len(values), -1)
    # The algorithm finds the last of several, so it runs on the reversed values.
    for i, value in enumerate((-values[::-1]).tolist()):
        pile = bisect_left(tops, value)
        previous[i] = at[pile - 1] if pile else -1
        tops[pile : pile + 1], at[pile : pile + 1] = [value], [i]
    keep = np.zeros(len(values), dtype=bool)
    i = at[-1]
    while i >= 0:
        keep[i] = True
        i = previous[i]
    return keep[::-1]


def damage_summary(damage: Sequence[Damage]) -> tuple[str, ...]:
    """One sentence per run of lines with the same reason, `line 40: …` or `lines 40 to 52: …`."""
    ordered = sorted(damage, key=lambda d: d.line)
    sentences: list[str] = []
    for _, group in groupby(enumerate(ordered), key=lambda pair: (pair[1].line - pair[0], _kind(pair[1].reason))):
        some = [d for _, d in group]
        lines = f"line {some[0].line}" if len(some) == 1 else f"lines {some[0].line} to {some[-1].line}"
        sentences.append(f"{lines}: {some[0].reason}")
    if len(sentences) > MOST_SENTENCES:
        more = len(sentences) - MOST_SENTENCES
        sentences[MOST_SENTENCES:] = [f"and {more} more damaged place{'s' * (more > 1)}"]
    return tuple(sentences)


def _kind(reason: str) -> str:
    return "".join(c for c in reason.partition(":")[0] if not c.isdigit())


_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
_PACKED = (b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf")
"""First bytes of bzip2, xz, Zstandard and 7z."""


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """The open file; raises a LogError if it cannot be opened or read."""
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise LogError(str(path), None, f"cannot be read: {error.strerror or error}.") from error


def read_csv(path: Path) -> LogTable:
    """The numbers of all good lines after the header; blank lines are ignored.

    Raises:
        LogError: the file cannot be opened, is empty, ends in .gz without gzip data, or has no header.
    """
    with _opened(path) as file:
        data = file.read()
    broken = None
    if data.startswith(_ZIP):
        raise LogError(str(path), None, "is a ZIP archive or an XLSX workbook. Unpack it, or save the sheet as CSV.")
    if data.startswith(_PACKED):
        raise LogError(str(path), None, "is compressed, and not with gzip. Unpack it.")
    if data.startswith(_GZIP):
        data, broken = _decompress(data)
    elif data and path.suffix == ".gz":
        raise LogError(str(path), None, "ends in .gz but holds no gzip data; was it unpacked or downloaded as a page?")
    if not data.strip():
        raise LogError(str(path), None, f"holds no text ({broken})." if broken else "is empty.")
    text = decode_text(data)
    lines = (text if "\n" in text else text.replace("\r", "\n")).split("\n")
    first = next((i for i, raw in enumerate(lines) if not _IGNORED.fullmatch(raw)), 0)
    columns = _header(path, first + 1, lines[first])
    values, where, damage = _rows(lines[first + 1 : -1], columns, first=first + 2)
    if len(lines) > first + 1 and not _IGNORED.fullmatch(lines[-1]):
        # The last number may have lost digits even if all fields are present.
        cut = f"the {'gzip data end' if broken else 'file ends'} in the middle of this line"
        damage.append(Damage(len(lines), _NUL_BYTES if "\0" in lines[-1] else cut))
    return LogTable(columns.named, values, where, tuple(damage), (broken,) if broken else ())


_NUL_BYTES = "holds NUL bytes, as after a power failure"
_IGNORED = re.compile(r"\s*(#[^\0]*|sep=.\s*)?")
"""Blank lines, comments, and the line with the separator for Excel; also before the header."""


class _Columns(NamedTuple):
    """The header of a CSV file."""

    names: tuple[str, ...]
    """Of all columns; "" for one without a name."""
    separator: str

    @property
    def named(self) -> tuple[str, ...]:
        """Names of columns that have one: not of an index column, also with the name that pandas gives it."""
        return tuple(name for name in self.names if name and not name.startswith("Unnamed: "))


def _rows(lines: Sequence[str], columns: _Columns, *, first: int) -> tuple[Array, Array, list[Damage]]:
    """Numbers of the good lines, [row, named column], the line of each, [row], and the others.

    Args:
        first: Number of the first line in the file.
    """
    numbers = array("d")  # a fifth of the memory of lists
    where: list[int] = []
    damage: list[Damage] = []
    for line, raw in enumerate(lines, start=first):
        if _IGNORED.fullmatch(raw):
            continue
        try:
            if "\0" in raw:
                raise ValueError(_NUL_BYTES)
            numbers.extend(_numbers(raw, columns.names, columns.separator))
            where.append(line)
        except ValueError as error:
            damage.append(Damage(line, str(error)))
    values = np.array(numbers).reshape(-1, len(columns.names))
    named = columns.named
    kept = [i for i, name in enumerate(columns.names) if name in named]
    return values[:, kept], np.array(where, dtype=int), damage


def _decompress(data: bytes) -> tuple[bytes, str | None]:
    """Content of a gzip file up to its first damage, and the damage."""
    try:
        return gzip.decompress(data), None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        reason = "cut off" if isinstance(error, EOFError) else f"damaged: {error}"
    stream, parts = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16), list[bytes]()
    with suppress(zlib.error):
        # Byte by byte, because a damaged piece returns nothing, not even what precedes the damage.
        for i in range(len(data)):
            parts.append(stream.decompress(data[i : i + 1]))
    return b"".join(parts), f"the gzip data are {reason}"


def _header(path: Path, line: int, text: str) -> _Columns:
    if "\0" in text:
        raise LogError(str(path), line, "holds NUL bytes; is it UTF-16? Save it as CSV in UTF-8.")
    separator = "\t" if "\t" in text else ","
    names = tuple(name.strip().strip('"') for name in text.split(separator))
    if double := sorted({name for name in names if name and names.count(name) > 1}):
        raise LogError(str(path), line, f"names the column '{double[0]}' twice.")
    return _Columns(names, separator)


def _numbers(line: str, names: Sequence[str], separator: str) -> list[float]:
    """The numbers of a line, any in columns without a name; a date is in seconds since 1970.

    Raises:
        ValueError: the line has no such numbers; the reason.
    """
    cells = line.replace('"', "").split(separator)
    if len(cells) != len(names):
        comma = " (a comma in a number?)" if separator == "," and len(cells) > len(names) else ""
        fields = f"{len(cells)} field{'s' * (len(cells) > 1)}"
        raise ValueError(f"{fields} where the header has {len(names)}{comma}")
    with suppress(ValueError):
        numbers = list(map(float, cells))
        if all(map(isfinite, numbers)):
            return numbers
    if tuple(cell.strip() for cell in cells) == tuple(names):
        raise ValueError("repeats the header")
    numbers = list[float]()  # cell by cell: a date, a text without a name, or what is wrong
    for column, (cell, name) in enumerate(zip(cells, names, strict=True), start=1):
        try:
            numbers.append(float(cell) if name else 0.0)
        except ValueError:
            if name not in (GEN3.time, PLAIN.time) or "," in cell:
                hint = ", as it has a decimal comma" if "," in cell else ""
                raise ValueError(f"field {column}, '{cell.strip()[:24]}', is not a number{hint}") from None
            numbers.append(_seconds(column, cell.strip()))
        if not isfinite(numbers[-1]):
            raise ValueError(f"field {column} is {cell.strip()}, not a finite number")
    return numbers


def _seconds(column: int, text: str) -> float:
    """Seconds since 1970 of a date with time in ISO 8601; without a zone it is UTC."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(
            f"field {column}, '{text[:24]}', is not a number; time is in seconds, or as 2026-01-05T06:00:00.5+00:00"
        ) from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


@dataclass(frozen=True, kw_only=True)
class Format:
    """Column names and units of a CSV format."""

    name: str
    time: str
    """Column of the time, s."""
    groups: tuple[str, ...]
    """Prefix of the column names of each of `READINGS`."""
    factors: tuple[float, ...]
    """Factor of each group to SI and our signs."""
    turns: bool
    """Whether angles run from 0° to 360°, so that −0.1° reads 359.9°."""
    first_joint: int
    required: int
    """Number of required groups; of the others, all joints or none."""

    def columns(self, group: str, joints: int = JOINTS) -> list[str]:
        """Column names of a group, joint by joint."""
        return [f"{group}_{self.first_joint + j}" for j in range(joints)]


GEN3 = Format(
    name="Gen3 log",
    time="Time (s)",
    groups=("Pos", "Velocity", "Torque", "Current", "Temp"),
    # The drive reports the torque that the joint feels: against gravity_torque of the model its slope is −1 over the
    # 34 logs (docs/logs.md), while the current has the sign of the torque that the motor makes.
    factors=(np.pi / 180, np.pi / 180, -1.0, 1.0, 1.0),
    turns=True,
    first_joint=0,
    required=5,
)
PLAIN = Format(
    name="plain log",
    time="time_s",
    groups=READINGS,
    factors=(1.0,) * len(READINGS),
    turns=False,
    first_joint=1,
    required=3,
)


OTHER_FORMATS = (
    (r"(actual|target)_(q|qd|current|TCP_pose)|joint_temperatures", "a log of a Universal Robots arm (RTDE)"),
    (r"\$(AXIS|TORQUE|VEL|CURR|MOT)_|AIPos|AxisActual|MotorTemp", "a log of a KUKA arm"),
    (r"%time|field\.|header\.stamp|/joint_states|(position|effort)\[?\d*\]?$", "a list of ROS messages"),
    (r"O_T_EE|tau_J|dq?_d_", "a log of a Franka arm"),
    (r"actuators", "feedback of the Kortex API"),
)
"""Column names by which formats of other programs are recognised."""
WANTED = "Write columns time_s, q_1 … q_7 (rad), qd_k (rad/s), tau_k (N·m) of a Gen3; docs/logs.md has the formats."


def format_of(names: Sequence[str]) -> Format:
    """The format with this time column.

    Raises:
        ValueError: there is no time column of a known format; the format or the names that were recognised.
    """
    for layout in (GEN3, PLAIN):
        if layout.time in names:
            return layout
    for layout in (GEN3, PLAIN):
        if misnamed := _misnamed(layout, names):
            raise ValueError(misnamed)
    for pattern, what in OTHER_FORMATS:
        if named := next((name for name in names if re.match(pattern, name)), None):
            raise ValueError(f"looks like {what}, by its column '{named}'. {WANTED}")
    hint = (
        " Columns are separated by commas, numbers have a decimal point."
        if any(";" in n or GEN3.time in n or PLAIN.time in n for n in names)
        else ""
    )
    raise ValueError(
        f"is not a log: its first line begins with '{','.join(names)[:40]}', where a Gen3 log has '{GEN3.time}' "
        f"and a plain one '{PLAIN.time}'.{hint}"
    )


def _misnamed(layout: Format, names: Sequence[str]) -> str:
    """Sentence on columns that are those of a format but for units, case, or the number of the first joint."""
    required = layout.groups[: layout.required]
    wanted = [layout.time, *(column for group in required for column in layout.columns(group))]
    if set(wanted) <= set(names):
        return ""
    for shift, how in ((0, "with units or in another spelling"), (1, "counted from 1"), (-1, "counted from 0")):
        plain = {_plain(name, shift): name for name in names}
        known = [(plain[_plain(column)], column) for column in wanted if _plain(column) in plain]
        other = next(((name, column) for name, column in known if name != column), None)
        if other and len(known) > 0.9 * len(wanted):
            return f"has the columns of a {layout.name}, but {how}: rename '{other[0]}' to '{other[1]}', and so on."
    return ""


def _plain(name: str, shift: int = 0) -> str:
    """A column name in lower case without its unit, and with the number of its joint reduced by `shift`."""
    name = re.sub(r"[^a-z0-9]+", "_", re.sub(r"[\[(].*?[\])]", "", name).lower()).strip("_")
    stem, _, joint = name.rpartition("_")
    return f"{stem}_{int(joint) - shift}" if stem and joint.isdecimal() else name


def check_columns(layout: Format, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The groups of a format that a log has, and its columns that belong to no group.

    Raises:
        ValueError: columns are missing, or the arm has another number of joints.
    """
    of_group = [name.rpartition("_")[0] for name in names if name.rpartition("_")[2].isdigit()]
    counts = {group: of_group.count(group) for group in layout.groups}
    groups = [g for i, g in enumerate(layout.groups) if i < layout.required or counts[g]]
    joints = {counts[g] if set(layout.columns(g, counts[g])) <= set(names) else 0 for g in groups}
    if misnamed := _misnamed(layout, names):
        raise ValueError(misnamed)
    if len(joints) == 1 and joints not in ({JOINTS}, {0}):
        raise ValueError(f"has {joints.pop()} joints; only logs of a Gen3, which has {JOINTS}, can be read.")
    wanted = [layout.time, *(column for g in groups for column in layout.columns(g))]
    missing = [column for column in wanted if column not in names]
    if missing:
        raise ValueError(f"lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)} of a {layout.name}.")
    return groups, [name for name in names if name not in wanted]


def channels(layout: Format, groups: Sequence[str], table: LogTable) -> dict[str, Array]:
    """The groups of a table in SI with our signs, each [row, joint]; a Gen3's angles within half a turn of zero."""
    readings: dict[str, Array] = {}
    for channel, group, factor in zip(READINGS, layout.groups, layout.factors, strict=True):
        if group in groups:
            columns = [table.names.index(column) for column in layout.columns(group)]
            readings[channel] = table.values[:, columns] * factor
    if layout.turns:
        readings["q"] = half_turn(readings["q"])
    return readings


ARM, UNREAD = "arm", ("mode", "phase", "payload_kg")
"""The column of the arm, and those beside the readings that telemetry and generated motions have."""


def read_arms(path: Path) -> dict[str, LogTable]:
    """The readings of every arm, in the order of their first rows; the line of a row is its number in the file.

    Raises:
        LogError: the file cannot be opened or is not a complete parquet file, a row names no arm, or a column is not
            numeric.
    """
    with _opened(path) as file:
        try:
            table = pq.read_table(file)
        except (OSError, pa.ArrowInvalid) as error:
            reason = str(error).splitlines()[0]
            raise LogError(str(path), None, f"is not a complete parquet file ({reason}).") from error
    if "tick" in table.column_names:
        reason = "is part of the recording of a fleet. A recording is a folder: publish it again with"
        raise LogError(str(path), None, f"{reason} `thermofleet bus replay`, or look at it with `thermofleet report`.")
    if ARM not in table.column_names or len(table.column_names) == 1:
        missing = "time_s" if ARM in table.column_names else ARM
        raise LogError(
            str(path), None, f"lacks the column {missing} of a telemetry.parquet. Save the log of a real arm as CSV."
        )
    if not table.num_rows:
        raise LogError(str(path), None, "holds no rows.")
    names = tuple(name for name in table.column_names if name not in (ARM, *UNREAD))
    values = np.column_stack([_parquet_numbers(path, name, table[name]) for name in names])
    arms = np.array(table[ARM].cast(pa.string()).to_pylist(), dtype=object)
    if None in arms:
        raise LogError(str(path), arms.tolist().index(None) + 1, "names no arm.")
    finite, tables = np.isfinite(values), dict[str, LogTable]()
    good = finite.all(axis=1)
    for arm in dict.fromkeys(arms.tolist()):
        rows, bad = np.flatnonzero((arms == arm) & good), np.flatnonzero((arms == arm) & ~good)
        damage = [Damage(int(i) + 1, f"{names[finite[i].argmin()]} is missing or not a finite number") for i in bad]
        tables[arm] = LogTable(names, values[rows], rows + 1, tuple(damage))
    return tables


def _parquet_numbers(path: Path, name: str, column: pa.ChunkedArray) -> Array:
    try:
        return column.cast(pa.float64()).to_numpy()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LogError(str(path), None, f"the column {name} holds {column.type}, not numbers.") from error


Damaged = Literal["refuse", "skip"]
"""Treatment of a file that has unusable lines."""
SUFFIXES = (".csv.gz", ".csv", ".parquet")
NOT_LOGS = ("events.parquet",)
"""Other parquet files of a run folder."""

log = logging.getLogger(__name__)


def read(path: str | Path, *, damaged: Damaged = "refuse", measured: bool = True) -> list[Recording]:
    """The recordings of one file: one, or in a telemetry.parquet one per arm.

    Args:
        damaged: "refuse" raises on any unusable line; "skip" drops such lines, logs a warning, and lists them in
            `Recording.dropped`.
        measured: Whether sensors made a CSV log; of a planned motion only units, ranges and gravity are judged.

    Raises:
        LogError: file, line and reason.
        ValueError: another value of `damaged`.
    """
    path = Path(path)
    found = _read(path, damaged, measured)
    if measured:
        _warn_of_repeats(path, {path: found})
    return found


def _read(path: Path, damaged: Damaged, measured: bool) -> list[Recording]:
    """As `read`, without the warning of a slow logger."""
    if damaged not in get_args(Damaged):
        raise ValueError(f"damaged must be one of {', '.join(get_args(Damaged))} (got {damaged!r}).")
    name = _name(path)
    if path.is_dir():
        raise LogError(str(path), None, "is a folder; a log is a file.")
    if path.suffix == ".parquet":
        name = f"{Path(os.path.abspath(path)).parent.name}/{name}"  # the files of all runs have one name
        return [_recording(path, f"{name}/{arm}", table, damaged) for arm, table in read_arms(path).items()]
    return [_recording(path, name, read_csv(path), damaged, measured=measured)]


def _warn_of_repeats(where: Path, by_file: Mapping[Path, Sequence[Recording]]) -> None:
    """Log once if lines of CSV logs repeat the ones before for long."""
    recordings = [each for file, found in by_file.items() if file.suffix != ".parquet" for each in found]
    percent = sorted(share for each in recordings if (share := _repeated_percent(each)) > 0)
    if percent:
        many = f"in {len(percent)} of its {len(recordings)} logs " if len(recordings) > 1 else ""
        log.warning(
            "%s: %s%s %% of the lines repeat the one before, for more than %g s, as those of a slow logger. They are "
            "used; motion between them is unknown.",
            *(where, many, " to ".join(dict.fromkeys(f"{each:.0f}" for each in (percent[0], percent[-1]))), GAP_S),
        )


def _repeated_percent(recording: Recording) -> float:
    """How many of the lines repeat the one before for long, %."""
    readings = {name: values for name in READINGS if (values := getattr(recording, name)) is not None}
    held = repeats(recording.time_s, readings, GAP_S)
    return 100 * sum(end - start for start, end in held) / max(len(recording.time_s), 1)


def read_folder(path: str | Path, *, damaged: Damaged = "refuse") -> list[Recording]:
    """The recordings of all logs of a folder, by file name, without its subfolders and hidden files.

    With damaged="skip" a file without any good line, or with readings of another one, is skipped with a warning.

    Raises:
        LogError: as `read` for the first unusable file; or no log, no usable log, or two logs of one name or
            of the same readings.
    """
    path = Path(path)
    if not path.is_dir():
        raise LogError(str(path), None, "is not a folder." if path.exists() else "does not exist.")
    named = sorted(f for f in path.iterdir() if f.name.lower().endswith(SUFFIXES) and f.name not in NOT_LOGS)
    files = [f for f in named if not f.name.startswith(".")]
    if not files:
        raise LogError(str(path), None, f"holds no log; a log ends in {', '.join(SUFFIXES)}.")
    if others := sorted(f.name for f in path.iterdir() if ".csv" in f.name.lower() and f not in named):
        log.warning("%s: not read, as a log ends in %s: %s", path, ", ".join(SUFFIXES), ", ".join(others))
    by_name = {_name(f): f for f in files}
    for f in files:
        if by_name[_name(f)] != f:
            raise LogError(str(path), None, f"'{f.name}' and '{by_name[_name(f)].name}' are the same log; keep one.")
    by_file: dict[Path, list[Recording]] = {}
    by_content: dict[bytes, Path] = {}
    for f in files:
        try:
            if f.exists() and not (f.is_file() or f.is_dir()):
                raise LogError(str(f), None, "is a pipe or a device; a log is a file.")
            found = _read(f, damaged, measured=True)
            content = b"".join(each.time_s.tobytes() + each.q.tobytes() + each.tau.tobytes() for each in found)
            if (first := by_content.setdefault(hashlib.sha256(content).digest(), f)) != f:
                raise LogError(str(f), None, f"has the readings of '{first.name}', which would count twice; keep one.")
            by_file[f] = found
        except LogError as error:
            if damaged == "refuse":
                raise
            log.warning("skipped %s", error)
    if not by_file:
        raise LogError(str(path), None, f"none of its {len(files)} logs is usable; see the warnings.")
    _warn_of_repeats(path, by_file)
    return [recording for found in by_file.values() for recording in found]


def of_arm(recordings: Sequence[Recording], arm: str | None, path: Path) -> list[Recording]:
    """The recordings of one arm: those of its name in files of several arms; all, if no file names an arm.

    Raises:
        LogError: there are several arms and none is named, or none of this name.
    """
    names = dict.fromkeys(each.name.rpartition("/")[2] for each in recordings if "/" in each.name)
    if arm is None and len(names) > 1:
        raise LogError(str(path), None, f"holds several arms: choose one with --arm ({', '.join(names)}).")
    if arm is not None and names and arm not in names:
        raise LogError(str(path), None, f"has no arm '{arm}'{nearest(arm, names)}")
    own = [each for each in recordings if arm is None or not names or each.name.rpartition("/")[2] == arm]
    _warn_of_mounts(path, own)
    return own


def _warn_of_mounts(where: Path, recordings: Sequence[Recording]) -> None:
    """Log if no mount explains the torques of all logs, and the log without which one does."""
    logs = [vars(each) for each in recordings]
    if len(logs) > 1 and mounts_differ(*logs):
        odd = next((i for i in range(len(logs)) if not mounts_differ(*logs[:i], *logs[i + 1 :])), None)
        but = "" if odd is None or len(logs) == 2 else f" Without '{recordings[odd].name}', one does."
        log.warning(
            "%s: no mount of one arm explains the torques of all its %d logs.%s Has one of them torques of the other "
            "sign, or is it of another arm? Leave it out.",
            *(where, len(logs), but),
        )


def _name(path: Path) -> str:
    return next((path.name[: -len(s)] for s in SUFFIXES if path.name.lower().endswith(s)), path.name)


def _recording(
    path: Path, name: str, table: LogTable, damaged: Damaged, *, measured: bool = True, warned: set[str] | None = None
) -> Recording:
    """A recording from the good rows of a table.

    Args:
        measured: As in `read`.
        warned: Of a part of a growing log: what was dropped from earlier parts, which is not said again. With
            damaged="skip", most rows of a part may be wrong.
    """
    part = warned is not None
    is_csv = path.suffix != ".parquet"
    try:
        layout = format_of(table.names) if is_csv else PLAIN
        groups, unknown = check_columns(layout, table.names)
    except ValueError as error:
        raise LogError(str(path), 1 if is_csv else None, str(error)) from error
    readings = channels(layout, groups, table)
    time_s, damage = table.values[:, table.names.index(layout.time)], list(table.damage)
    try:
        damage += time_damage(time_s, table.where)
    except ValueError as error:
        raise LogError(str(path), None, str(error)) from error
    rows = np.flatnonzero(~np.isin(table.where, [d.line for d in damage]))
    good = {channel: values[rows] for channel, values in readings.items()}
    dropped_lines = {d.line for d in damage}
    if is_csv and not measured:
        bad = judge_plan(time_s[rows], good, degrees=layout.turns)
    else:
        bad = judge(time_s[rows], good, degrees=layout.turns, measured=is_csv)
    if part and damaged == "skip":
        bad = [replace(found, most=False) for found in bad]
    for found in sorted(bad, key=lambda found: not found.whole):
        lines = table.where[rows[found.rows]].tolist()
        if found.whole:
            raise LogError(str(path), lines[0] if lines else None, f"{found.what}. {found.remedy}".strip())
        damage += [Damage(line, found.what, found.remedy) for line in lines if line not in dropped_lines]
        dropped_lines.update(lines)
    broken = table.broken
    if unknown:
        broken = (*broken, f"its columns {', '.join(unknown)} are unknown to a {layout.name}")
    keep = ~np.isin(table.where, [d.line for d in damage])
    dropped = (*broken, *damage_summary(damage))
    if not keep.any() and not (part and damaged == "skip"):
        raise LogError(str(path), None, f"holds no good line of numbers{': ' if dropped else '.'}{'; '.join(dropped)}")
    if damaged == "refuse" and dropped:
        others = len(broken) + len(damage) - 1
        more = f", and {others} more damaged place{'s' * (others > 1)}" if others else ""
        first = min(damage, key=lambda d: d.line, default=Damage(0, ""))
        line, reason = (None, broken[0]) if broken else (first.line, first.reason)
        remedy = "" if broken or not first.remedy else f"{first.remedy} "
        raise LogError(str(path), line, f'{reason}{more}. {remedy}Use damaged="skip" to read the undamaged lines.')
    for sentence in dropped:
        what = _kind(re.sub(r"^lines? [\d to]+: ", "", sentence))
        if warned is None or what not in warned:
            log.warning("%s: dropped: %s%s", path, sentence, " (said once)" if part else "")
        if warned is not None:
            warned.add(what)
    kept = {channel: np.ascontiguousarray(values[keep]) for channel, values in readings.items()}
    time_s = time_s[keep]
    if is_csv and measured and "temp_c" in kept and (row := clock_step(time_s, kept["temp_c"])):
        log.warning(
            "%s, line %d: time steps by %.0f s, but no motor temperature changes. Was the clock put forward for "
            "summer time? Then subtract an hour from the times that follow; else an hour without load is assumed.",
            *(path, table.where[keep][row], time_s[row] - time_s[row - 1]),
        )
    if len(time_s) and time_s[0] >= EPOCH_S:
        time_s = time_s - time_s[0]
    return Recording(name=name, time_s=time_s, **kept, dropped=dropped)


BLOCK_BYTES = 1 << 20
"""Most bytes that are read at a time, and most of one line."""
MAX_ROWS = 20_000
"""Rows after which a growing log is checked even if its time does not advance."""


class GrowingLog:
    """Recordings of a CSV log while another process appends to it, in a `with` block; incomplete lines have to wait.

    Args:
        first_s: Length of the first recording.
        damaged: As in `read`, for the lines of each recording.

    Raises:
        LogError: the file cannot be opened, or does not end in .csv.
    """

    def __init__(self, path: Path, *, first_s: float = 0.0, damaged: Damaged = "refuse") -> None:
        if not path.name.lower().endswith(".csv"):
            raise LogError(str(path), None, "cannot be followed: only a file that ends in .csv grows line by line.")
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise LogError(str(path), None, f"cannot be read: {error.strerror or error}.") from error
        self._path, self._first_s, self._begun = path, first_s, b""
        self._damaged: Damaged = damaged
        self._warned = set[str]()
        self._lines = 0
        """Complete lines so far."""
        self._columns: _Columns | None = None
        self._origin_s = 0.0
        """First time of a log whose times are seconds since 1970, which are given from 0."""
        self._table: LogTable | None = None
        """Rows since the last recording, after its last row."""
        self._time, self._last_s = 0, -np.inf
        """Column of the time, and the time of that row."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, until_s: float) -> Recording | None:
        """The readings since the last call that returned some; None before the log has reached a time.

        Raises:
            LogError: as `read`; or the file was removed, replaced or truncated, or its time starts again.
        """
        while not self._is_due(until_s):
            block = self._file.read(BLOCK_BYTES)
            if not block:
                self._check_unchanged()
                return None
            self._append(block)
        assert self._table is not None
        recording = _recording(self._path, _name(self._path), self._table, self._damaged, warned=self._warned)
        if not len(recording.time_s):
            empty = np.zeros(0, int)
            self._table = LogTable(self._table.names, self._table.values[empty], empty, ())
            return None
        begins = 0
        if self._last_s > -np.inf:
            if recording.time_s[0] < self._last_s:
                reason = f"time starts again at {recording.time_s[0]:.10g} s; it was {self._last_s:.10g} s before"
                raise LogError(str(self._path), None, f"{reason}. Follow a new file for each recording.")
            begins = int(recording.time_s[0] == self._last_s)
        self._last_s = float(recording.time_s[-1])
        last = self._table.values[:, self._time] == self._last_s
        self._table = LogTable(self._table.names, self._table.values[last][-1:], self._table.where[last][-1:], ())
        return recording.part(slice(begins, None)) if len(recording.time_s) > begins else None

    def _is_due(self, until_s: float) -> bool:
        table = self._table
        if table is None or len(table.values) + len(table.damage) >= MAX_ROWS:
            return table is not None
        time_s = table.values[:, self._time]
        back = np.count_nonzero(time_s[1:] <= np.maximum.accumulate(time_s)[:-1])
        if back > STRAY_ROWS or (self._damaged == "refuse" and (back or table.damage)):
            return True
        if self._last_s == -np.inf and len(time_s):
            until_s = time_s[0] + self._first_s
        return len(time_s) > (self._last_s > -np.inf) and bool(time_s[-1] >= until_s)

    def _append(self, block: bytes) -> None:
        *complete, self._begun = (self._begun + block).split(b"\n")
        lines = [decode_text(line) for line in complete]
        if len(self._begun) > BLOCK_BYTES:
            raise LogError(str(self._path), self._lines + 1, f"has a line of more than {BLOCK_BYTES:,} bytes.")
        while self._columns is None and lines:
            self._lines += 1
            raw = lines.pop(0)
            if not _IGNORED.fullmatch(raw):
                self._columns = _header(self._path, self._lines, raw)
                names = self._columns.named
                try:
                    self._time = names.index(format_of(names).time)
                except ValueError as error:
                    raise LogError(str(self._path), self._lines, str(error)) from error
                self._table = LogTable(names, np.zeros((0, len(names))), np.zeros(0, int), ())
        if self._columns is not None and self._table is not None:
            before = self._table
            rows, where, damage = _rows(lines, self._columns, first=self._lines + 1)
            if not self._origin_s and len(rows) and rows[0, self._time] >= EPOCH_S:
                self._origin_s = float(rows[0, self._time])
            rows[:, self._time] -= self._origin_s
            values, where = np.concatenate([before.values, rows]), np.concatenate([before.where, where])
            self._table = LogTable(before.names, values, where, (*before.damage, *damage))
            self._lines += len(lines)

    def _check_unchanged(self) -> None:
        """Raise a LogError if the file is another one now, or has lost bytes that were read."""
        try:
            now, ours = self._path.stat(), os.fstat(self._file.fileno())
        except OSError:
            raise LogError(str(self._path), None, "was removed while it was followed.") from None
        replaced = (now.st_dev, now.st_ino) != (ours.st_dev, ours.st_ino)
        if replaced or now.st_size < self._file.tell():
            what = "replaced by another file" if replaced else "truncated"
            raise LogError(
                str(self._path), None, f"was {what} while it was followed. Start again to follow the new one."
            )
