"""Job tables: the jobs of a shift from a CSV, Parquet or XLSX file, one row a job.

Columns are those of `fleet.bus.protocol.auction.JobSpec`. `places` has `from > to`, with `|` between alternatives;
`after` has names, with `|` between them. Times are seconds or `h:mm[:ss]` from the begin of the shift, or dates. If the
begin of the shift is known as a date, `h:mm` is a time of day, and a date without a zone has that of the begin.
"""

import csv
import io
import logging
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, date, datetime, time, timedelta, tzinfo
from difflib import get_close_matches
from functools import cache, partial
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from itertools import chain, islice
from math import inf, isfinite, nextafter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from msgspec.structs import replace

from fleet.bus.protocol.auction import Admission, JobSpec, JobStatus
from fleet.errors import ScenarioError, check_names, nearest, printable
from fleet.files import decode_text
from fleet.job import (
    BOUNDS,
    DWELL_S,
    KINDS,
    check_alternatives,
    check_bounds,
    check_duration,
    check_dwell,
    check_force,
    check_hard_due,
)
from scenarios.spec.units import check_times, question

_LOG = logging.getLogger(__name__)
SUFFIXES = (".csv", ".tsv", ".parquet", ".xlsx")
"""Of job tables; other files of jobs are JSON."""
MOST_ROWS, MOST_BYTES = 10_000, 20_000_000
MOST_NUMBERS, MOST_ERRORS = 5, 100
"""Row numbers in one sentence, and sentences on one table."""
MOST_COLUMNS = 100
"""Of a sheet."""
DAY_S = 86_400.0
GRAMS, LIGHT_KG = 0.001, 0.02
"""A gram in kg, and the mass below which all payloads in grams are probably in kg."""
YEARS = (1970, 2200)
SHEET_ZERO = datetime(1899, 12, 30)
"""From which a spreadsheet counts days."""
MOST_SHEET_S = 7 * DAY_S
"""Of a shift without a known end: numbers of days further on are times in seconds."""
DATE = "a date with time and zone, as 2026-11-23T06:00+01:00"
_CLOCK = re.compile(r"(\d{1,4}):([0-5]\d)(?::([0-5]\d(?:[.,]\d+)?))?")
_ARROW, _SEPARATOR = re.compile(r"->|→|>"), re.compile("[;,]")
"""Between from and to; and what may be in a name, but is often written instead of `|`."""
_DOTTED_CLOCK = re.compile(r"([01]?\d|2[0-3])[.,]([0-5]\d)")
"""A time of day as it is written in German; seconds have one decimal or none, as a decision takes them."""
_HOURS = re.compile(r"(\d|1\d|2[0-3])(?:[.,](\d+))?")
"""A number that is a time of day, in hours or in German, if the other times of a table have minutes."""
_MILITARY_CLOCK = re.compile(r"(0\d)([0-5]\d)")
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(\.\d{3})+")
_GERMAN_DATE = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4}) +(\d{1,2}:\d{2}.*)")
_FLAGS = {
    **dict.fromkeys(("yes", "true", "1", "hard", "ja", "wahr"), True),
    **dict.fromkeys(("no", "false", "0", "soft", "nein", "falsch"), False),
}
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""First bytes of XLSX, ODS and ZIP, and of XLS."""
Answer = TypeVar("Answer", Admission, JobStatus)
Cell = Any
"""A text, number, date, list or None, according to the file."""
Rows = Iterator[tuple[int, Sequence[Cell]]]
"""Cells of each row with its number in the file, from 1; first those of the head."""


class Row(SimpleNamespace):
    """Values of one row by field of `JobSpec`; the default where a cell is empty or wrong.

    `texts` has the cells of its times as texts, by field.
    """


class _Dialect(NamedTuple):
    begin: datetime | None
    """Of the shift, with its zone; None for unknown."""
    decimal_comma: bool
    """Whether a comma in a number is the decimal point."""
    horizon_s: float
    """Length of the shift; inf for unknown."""
    day_fractions: bool
    """Whether a number below 1 may be a time of day, as in a sheet."""
    names: Collection[str] = ()
    """Of all jobs of the table."""
    plain: Collection[str] = ()
    """Columns of the table whose headings name no unit."""
    column: str = ""
    """Of the cell; "" outside of a table."""
    factor: float = 1.0
    """Of a plain number, to s or kg."""
    tell: Callable[[str], None] = _LOG.warning
    """Called with a sentence on a time that occurs twice."""


def _number(cell: Cell, dialect: _Dialect) -> float:
    if isinstance(cell, str) and dialect.decimal_comma:
        if _THOUSANDS.fullmatch(cell.strip()):
            plain = cell.strip().replace(".", "")
            raise ValueError(f"is this {plain}? Give numbers without separators of thousands (got {_shown(cell)})")
        cell = cell.replace(",", ".") if "." not in cell else cell
    with suppress(TypeError, ValueError, OverflowError):
        if not isinstance(cell, bool) and isfinite(number := float(cell)):
            return dialect.factor * number
    raise ValueError(f"expected a number (got {_shown(cell)})")


def _count(cell: Cell, dialect: _Dialect) -> int:
    if (number := _number(cell, dialect)) != int(number):
        raise ValueError(f"expected a whole number (got {_shown(cell)})")
    return int(number)


def _seconds(cell: Cell, dialect: _Dialect) -> float:
    """Time from the begin of the shift, s."""
    if isinstance(cell, timedelta):
        return cell.total_seconds()
    if dialect.day_fractions and isinstance(cell, float) and 0.0 < cell < 1.0:
        hours, minutes = divmod(round(cell * DAY_S) // 60, 60)
        clock_time = f"{hours:02d}:{minutes:02d}"
        raise ValueError(
            f"is this {clock_time}? Give its cell a format of time, or a number as a text (got {_shown(cell)})"
        )
    text, begin = _time_text(cell), dialect.begin
    if clock := _CLOCK.fullmatch(text):
        hours, minutes, seconds = (float((part or "0").replace(",", ".")) for part in clock.groups())
        given_s = 3600 * hours + 60 * minutes + seconds
        return given_s if begin is None else _clock_seconds(text, given_s, begin, dialect)
    asks = not dialect.column or dialect.column in dialect.plain
    if isinstance(cell, str) and asks and (dotted := _DOTTED_CLOCK.fullmatch(text)):
        raise ValueError(f"is this {dotted[1]}:{dotted[2]}? {_advice(dialect.column)} (got {_shown(cell)})")
    if isinstance(cell, str) and (clock := _MILITARY_CLOCK.fullmatch(text)):
        raise ValueError(f"is this {clock[1]}:{clock[2]}? Give times as h:mm, or a number as {int(text)}")
    try:
        number = _number(cell, dialect)
    except ValueError:
        return _date_seconds(text, cell, begin, dialect.tell)
    if begin is not None and (moment := _of_sheet(number, begin, dialect.horizon_s)):
        raise ValueError(
            f"is this {moment:%d %b %Y %H:%M}, in days as a spreadsheet counts? Give a date with time, as "
            f"{moment:%Y-%m-%dT%H:%M} (got {_shown(cell)})"
        )
    return number


def _advice(column: str) -> str:
    """How to give times so that no number may be hours; `column` is "" outside of a table."""
    return f"Give times as h:mm{f', or seconds in a column {column}_s' if column else ''}"


def _clock_seconds(text: str, given_s: float, begin: datetime, dialect: _Dialect) -> float:
    """From the begin of the shift to the next time of day, given in seconds by the clock since midnight, s."""
    if given_s > DAY_S:
        raise ValueError(f"with shift_begin, h:mm is a time of day, up to 24:00 (got '{text}')")
    midnight = begin.replace(hour=0, minute=0, second=0, microsecond=0)
    today, tomorrow = (midnight + timedelta(days=days, seconds=given_s) for days in (0, 1))
    moment = today if max(since(begin, today.replace(fold=fold)) for fold in (0, 1)) >= 0 else tomorrow
    if moment == tomorrow and since(begin, tomorrow) > dialect.horizon_s:
        end = (begin.astimezone(UTC) + timedelta(seconds=dialect.horizon_s)).astimezone(begin.tzinfo)
        next_day = " of the next day" if end.date() > begin.date() else ""
        raise ValueError(
            f"'{text}' is outside the shift, which begins at {_clock_text(begin)} and ends at "
            f"{_clock_text(end)}{next_day}"
        )
    return _local_seconds(moment, f"'{text}'", begin, dialect.tell)


def _clock_text(moment: datetime) -> str:
    """Time of day, with its seconds if there are any."""
    return f"{moment:%H:%M:%S}".removesuffix(":00")


def _date_seconds(text: str, cell: Cell, begin: datetime | None, tell: Callable[[str], None]) -> float:
    """From the begin of the shift to a date with time, s; without a zone it has that of the begin."""
    if german := _GERMAN_DATE.fullmatch(text):
        day, month, year, clock_time = german.groups()
        text = f"{year}-{month:0>2}-{day:0>2}T{clock_time:0>5}"
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(f"expected seconds, h:mm, h:mm:ss, or {DATE} (got {_shown(cell)})") from None
    if begin is None:
        raise ValueError(f"a date needs shift_begin, the begin of the shift, or --shift-begin (got {_shown(cell)})")
    if len(text) <= len("2026-11-23"):
        raise ValueError(f"a date needs a time, as {moment:%Y-%m-%d}T14:00 (got {_shown(cell)})")
    if not YEARS[0] <= moment.year <= YEARS[1]:
        raise ValueError(f"expected a year from {YEARS[0]} to {YEARS[1]} (got {moment.year})")
    if moment.tzinfo is None:
        return _local_seconds(moment.replace(tzinfo=begin.tzinfo), _shown(cell), begin, tell)
    return since(begin, moment)


def _local_seconds(moment: datetime, given: str, begin: datetime, tell: Callable[[str], None]) -> float:
    """From the begin of the shift to a time of the clock, s; if it occurs twice, to the first one in the shift."""
    check_exists(moment, given)
    if since(begin, moment) < 0:
        return since(begin, moment.replace(fold=1))
    if sentence := twice(moment):
        tell(f"{given} {sentence}")
    return since(begin, moment)


def _of_sheet(days: float, begin: datetime, horizon_s: float) -> datetime | None:
    """The date, to the second, that a spreadsheet stores as these days, if it is on a day of the shift or the next."""
    first = (begin.replace(tzinfo=None) - SHEET_ZERO).days
    if not first <= days < first + 2 + min(horizon_s, MOST_SHEET_S) // DAY_S:
        return None
    return SHEET_ZERO + timedelta(seconds=round(days * DAY_S))


def check_exists(moment: datetime, given: str) -> None:
    """Raise a ValueError for a time of day that a clock put forward for summer time leaves out."""
    if counts_as(moment) != moment.replace(tzinfo=None):
        raise ValueError(f"{given} does not exist: summer time leaves out this hour. Give another time")


def counts_as(moment: datetime) -> datetime:
    """The time of the clock at this moment, without a zone: another one if a clock put forward leaves it out."""
    return moment.astimezone(UTC).astimezone(moment.tzinfo).replace(tzinfo=None)


def twice(moment: datetime) -> str:
    """Which moment is taken of a time of day that occurs twice, as it follows its time; "" for others that exist."""
    first, second = (moment.replace(fold=fold).isoformat(timespec="minutes") for fold in (0, 1))
    return "" if first == second else f"occurs twice, as summer time ends: {first} is taken, not {second}"


def _job_time(cell: Cell, dialect: _Dialect) -> float:
    """As `_seconds`; with the begin of the shift as a date, not before it."""
    if (time_s := _seconds(cell, dialect)) < 0 and (begin := dialect.begin):
        moment = (begin.astimezone(UTC) + timedelta(seconds=time_s)).astimezone(begin.tzinfo)
        form = "%d %b %Y %H:%M"
        raise ValueError(f"{moment:{form}} is before the shift, which begins on {begin:{form}} (got {_shown(cell)})")
    return time_s


def since(begin: datetime, date: datetime) -> float:
    """Time from one date to another, s; within one zone, the difference of dates would ignore summer time."""
    return (date.astimezone(UTC) - begin.astimezone(UTC)).total_seconds()


def seconds_of(given: object, begin: datetime | None, horizon_s: float, tell: Callable[[str], None]) -> float:
    """Time from the begin of the shift, s, as a cell of a table may give it.

    Args:
        begin: Of the shift; None for unknown.
        horizon_s: Length of the shift.
        tell: Called with a sentence on a time that occurs twice.

    Raises:
        ValueError: it is no time.
    """
    return _seconds(given, _Dialect(begin, False, horizon_s, False, tell=tell))


def _names(cell: Cell, dialect: _Dialect) -> tuple[str, ...]:
    parts = cell if isinstance(cell, list) else _names_in(_text(cell), dialect.names)
    return tuple(_label(part) for part in parts if _text(part))


def _names_in(text: str, known: Collection[str]) -> list[str]:
    """Names with `|` between them; commas and semicolons separate, too, where that gives known names only."""
    names = list[str]()
    for part in [text] if text in known else text.split("|"):
        name, several = part.strip(), [each.strip() for each in _SEPARATOR.split(part) if each.strip()]
        names += several if name not in known and all(each in known for each in several) else [name]
    return names


def _label(cell: Cell, _: object = None) -> str:
    """A name; a spreadsheet makes dates of names such as 11/10."""
    if isinstance(cell, date | time):
        raise ValueError(f"is a date: give its cell the format of a text, and the name anew (got {_shown(cell)})")
    return _text(cell)


def _kind(cell: Cell, _: object) -> str:
    if (text := _text(cell)) not in KINDS:
        raise ValueError(f"'{printable(text, 60)}' is no kind of job{nearest(text[:60], KINDS)}")
    return text


def _places(cell: Cell, _: object) -> tuple[tuple[str, ...], ...]:
    """Places of each alternative."""
    if isinstance(cell, list):
        lists = cell if all(isinstance(each, list) for each in cell) else [cell]
        return tuple(tuple(map(_text, each)) for each in lists)
    if re.search("[,;]", _text(cell)):
        raise ValueError(
            f"give > between from and to, and | between alternatives, no comma or semicolon (got {_shown(cell)})"
        )
    return tuple(tuple(name.strip() for name in _ARROW.split(each)) for each in _text(cell).split("|"))


def _flag(cell: Cell, _: object) -> bool:
    if (text := _text(cell).lower()) not in _FLAGS:
        raise ValueError(f"expected yes or no (got {_shown(cell)})")
    return _FLAGS[text]


def _text(cell: Cell) -> str:
    return f"{cell:.15g}" if isinstance(cell, float) else str(cell).strip()


def _time_text(cell: Cell) -> str:
    return _text(cell.isoformat() if isinstance(cell, time | datetime) else cell)


def _shown(cell: Cell) -> str:
    return f"'{printable(str(cell), 60)}'"


def _is_empty(cell: Cell) -> bool:
    return cell is None or cell != cell or cell == [] or (isinstance(cell, str) and not cell.strip())  # also NaN


_COLUMNS: Mapping[str, tuple[str, Callable[[Cell, _Dialect], object], object]] = {
    "name": ("name", _label, ""),
    "kind": ("kind", _kind, ""),
    "places": ("every_places", _places, ()),
    "payload": ("payload_kg", _number, 0.0),
    "repetitions": ("repetitions", _count, 1),
    "release": ("release_s", _job_time, 0.0),
    "due": ("due_s", _job_time, None),
    "hard": ("expires", _flag, False),
    "value": ("value", _number, 1.0),
    "after": ("after", _names, ()),
    "dwell": ("dwell_s", _number, DWELL_S),
    "force": ("force_n", _number, 0.0),
}
"""Field of a row, its conversion and its default, by column."""
_NEEDED = ("name", "kind", "places")
_COLUMN_OF = {field: column for column, (field, _, _) in _COLUMNS.items()}
_SPELLINGS = {
    **{column: (column, 1.0) for column in _COLUMNS},
    **{"expires": ("hard", 1.0), "payload_kg": ("payload", 1.0), "payload_g": ("payload", GRAMS)},
    **{"force_n": ("force", 1.0), "dwell_s": ("dwell", 1.0)},
    **{f"{each}_{unit}": (each, s) for each in ("release", "due") for unit, s in (("s", 1.0), ("min", 60.0))},
}
"""Column and factor of a heading in lower case, without spaces and brackets."""
_UNIT = re.compile("ms|s|sec|mins?|minutes|h|hrs?|hours|d|days|mg|g|kg|t|oz|lbs?|n|kn|kp|kgf")
"""Of headings; a column has those in `_SPELLINGS` only, so that no numbers of another one are taken."""


class _Errors(dict[tuple[str, str], list[int]]):
    """Rows of each error, by column and sentence."""

    def add(self, row: int, column: str, sentence: str) -> None:
        self.setdefault((column, sentence.rstrip(".")), []).append(row)

    def lines(self) -> list[str]:
        """A sentence for each kind of error, with its rows and column."""
        lines = list[str]()
        for (column, sentence), rows in islice(self.items(), MOST_ERRORS):
            more = f" and {len(rows) - MOST_NUMBERS} more" if len(rows) > MOST_NUMBERS else ""
            numbers = f"row{'s' * (len(rows) > 1)} {', '.join(map(str, rows[:MOST_NUMBERS]))}{more}"
            lines.append(f"  {numbers}{f', column {column}' if column else ''}: {sentence}.")
        if len(self) > MOST_ERRORS:
            lines.append(f"  … and {len(self) - MOST_ERRORS} more kinds of errors.")
        return lines

    def raise_any(self, where: str) -> None:
        """Raise a ScenarioError with all errors, if there are any."""
        if not self:
            return
        total, lines = sum(map(len, self.values())), self.lines()
        raise ScenarioError("\n".join([f"{where} has {total} error{'s' * (total > 1)}:", *lines]))


def read_job_table(
    file: Path | bytes,
    where: str = "",
    *,
    begin: datetime | None = None,
    horizon_s: float = inf,
    places: Collection[str] | None = None,
    closed: bool = False,
) -> dict[int, JobSpec]:
    """The jobs of a table by the numbers of their rows, in order; times count from the begin of the shift.

    Args:
        file: Its path, or the content of a CSV file.
        where: Name of the table in errors; by default the path.
        begin: Of the shift, with its zone; needed for dates.
        horizon_s: Length of the shift; a time of day before its begin must be within it on the next day, and some job
            must be released in it.
        places: Of the cell; None: not checked.
        closed: Whether `after` must name rows of the table.

    Raises:
        ScenarioError: the file cannot be read, or rows are wrong: all errors, each with its row and column.
        MissingExtra: the library for an XLSX file is not installed.
    """
    where, errors, doubts, jobs = where or str(file), _Errors(), _Errors(), dict[int, JobSpec]()
    lines, decimal_comma = _rows(file, where)
    is_sheet = isinstance(file, Path) and file.suffix.lower() == ".xlsx"
    head_row, head = next(lines, (1, ()))
    if len(head) > MOST_COLUMNS:
        raise ScenarioError(f"{where} has {len(head)} columns; a job table has at most {MOST_COLUMNS}.")
    columns = _read_head(head_row, head, errors)
    errors.raise_any(where)
    body = list(islice(lines, MOST_ROWS + 1))
    if len(body) > MOST_ROWS:
        raise ScenarioError(f"{where} has too many rows; a job table has at most {MOST_ROWS}.")
    plain = {column for i, (column, _) in columns.items() if _key_of(head[i]) == column}
    dialect = _Dialect(begin, decimal_comma, horizon_s, is_sheet, names=_names_of(body, columns), plain=plain)
    no_place = _no_place(places or ())
    rows: dict[str, tuple[int, Row]] = {}
    for number, cells in body:
        if len(cells) > len(head) and not all(map(_is_empty, cells[len(head) :])):
            errors.add(number, "", f"{len(cells)} cells, but the head has {len(head)}; quote cells with separators")
            continue
        row, wrong = _read_row(number, cells, columns, dialect, errors, doubts)
        for field, sentence in _problems(row, wrong):
            errors.add(number, _COLUMN_OF[field], sentence)
            wrong.add(field)
        for name in dict.fromkeys(row.places) if places is not None and "every_places" not in wrong else ():
            if name not in places:
                errors.add(number, "places", no_place(name))
        if row.name and row.name in rows:
            errors.add(number, "name", f"'{row.name}' is the name of row {rows[row.name][0]}, too; names are unique")
        elif not wrong:
            fields = {**vars(row), "places": row.every_places[0], "alternatives": row.every_places[1:]}
            jobs[number] = JobSpec(**{name: fields[name] for name in fields if name not in ("every_places", "texts")})
        rows.setdefault(row.name, (number, row))
    _check_hours(rows.values(), dialect.plain, errors, doubts)
    heaviest_kg = max((row.payload_kg for _, row in rows.values()), default=0.0)
    if ("payload", GRAMS) in columns.values() and 0.0 < heaviest_kg < LIGHT_KG:
        errors.add(
            head_row, "payload_g", f"are these kg? The heaviest is {heaviest_kg / GRAMS:g}. Give kg in a column payload"
        )
    _check_after(rows, errors, closed=closed)
    errors.raise_any(where)
    _check_order({row.name: (number, row) for number, row in rows.values() if number in jobs}, doubts)
    for sentence in doubts.lines():
        _LOG.warning("%s,%s", where, sentence[1:])
    if not jobs:
        raise ScenarioError(f"{where} has no jobs; give a row of headings, then one row for each job.")
    if isfinite(horizon_s):
        times_s = {f"row {number}, '{job.name}',": job.release_s for number, job in jobs.items()}
        numbers_s = [row.release_s for _, row in rows.values() if ":" not in row.texts.get("release_s", "")]
        check_times([*times_s.values()], horizon_s, where, [*times_s], numbers_s)
    return jobs


def _names_of(body: Sequence[tuple[int, Sequence[Cell]]], columns: Mapping[int, tuple[str, float]]) -> frozenset[str]:
    """Names of all jobs of a table."""
    (index,) = (i for i, (column, _) in columns.items() if column == "name")
    return frozenset(_text(cells[index]) for _, cells in body if index < len(cells))


def check_places(jobs: Mapping[int, JobSpec], places: Collection[str], where: str) -> None:
    """Check the places of a table that was read without them; raises a ScenarioError with all errors.

    Args:
        jobs: By the numbers of their rows.
        where: As in `read_job_table`, as are `places`.
    """
    errors, no_place = _Errors(), _no_place(places)
    for number, job in jobs.items():
        for name in dict.fromkeys(chain.from_iterable(job.every_places)):
            if name not in places:
                errors.add(number, "places", no_place(name))
    errors.raise_any(where)


def _no_place(places: Collection[str]) -> Callable[[str], str]:
    """The error of a place that a cell does not have, by its name."""
    return cache(lambda name: f"no place '{printable(name)}'{nearest(name, places)}")


def _read_head(number: int, head: Sequence[Cell], errors: _Errors) -> dict[int, tuple[str, float]]:
    """Column and factor of its unit by index; a heading that begins with # is left out."""
    columns: dict[int, tuple[str, float]] = {}
    for i, heading in enumerate(head):
        text = "" if _is_empty(heading) else printable(str(heading).strip())
        if not text or text.startswith("#"):
            continue
        key = _key_of(heading)
        column, factor = _SPELLINGS.get(key, ("", 1.0))
        stem, _, unit = key.rpartition("_")
        if not column and stem in _COLUMNS and _UNIT.fullmatch(unit):
            known = [each for each, (of, _) in _SPELLINGS.items() if of == stem and each.startswith(stem)]
            errors.add(number, text, f"unknown unit of '{stem}'. Convert its numbers; allowed are {', '.join(known)}")
        elif not column:
            close = get_close_matches(key, _SPELLINGS, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else "."
            errors.add(number, text, f"unknown{hint} Allowed: {', '.join(_COLUMNS)}. Put # before it to ignore it")
        elif column in (known for known, _ in columns.values()):
            errors.add(number, text, f"there is another column '{column}'; keep one")
        else:
            columns[i] = column, factor
    if missing := [name for name in _NEEDED if name not in {column for column, _ in columns.values()}]:
        errors.add(number, "", f"no column {' and no column '.join(missing)}; every job needs {', '.join(_NEEDED)}")
    return columns


def _key_of(heading: Cell) -> str:
    """A heading in lower case, with an underscore for everything between its letters."""
    return re.sub(r"[^a-z]+", "_", str(heading).lower()).strip("_")


def _read_row(
    number: int,
    cells: Sequence[Cell],
    columns: Mapping[int, tuple[str, float]],
    dialect: _Dialect,
    errors: _Errors,
    doubts: _Errors,
) -> tuple[Row, set[str]]:
    """Values of a row, and the fields whose cells cannot be read."""
    row, wrong = Row(**{field: default for field, _, default in _COLUMNS.values()}, texts={}), set[str]()
    for i, (column, factor) in columns.items():
        cell = cells[i] if i < len(cells) else None
        field, convert, _ = _COLUMNS[column]
        try:
            if not _is_empty(cell):
                tell = partial(doubts.add, number, column)
                setattr(row, field, convert(cell, dialect._replace(column=column, factor=factor, tell=tell)))
                if convert is _job_time:
                    row.texts[field] = _time_text(cell)
            elif column in _NEEDED:
                raise ValueError("is empty; every job needs one")
        except ValueError as error:
            errors.add(number, column, str(error))
            wrong.add(field)
    row.places = tuple(name for names in row.every_places for name in names)
    return row, wrong


def _problems(row: Row, wrong: Collection[str]) -> Iterator[tuple[str, str]]:
    """Field and sentence of each error in the values of a row, at most one a field."""
    checks: list[tuple[str, Callable[[], None]]] = [
        *((field, lambda field=field: check_bounds(row, field)) for field in BOUNDS if hasattr(row, field)),
        *((field, lambda field=field: check_names(row, field, of_jobs=True)) for field in ("name", "after")),
        ("every_places", lambda: check_names(row, "places")),
        ("every_places", lambda: check_alternatives(row, row.kind, row.every_places) if row.kind else None),
        ("dwell_s", lambda: check_dwell(row, row.kind, row.dwell_s)),
        ("repetitions", lambda: check_duration(row, row.dwell_s, row.repetitions)),
        ("due_s", lambda: _check_due(row)),
        ("due_s", lambda: check_hard_due(row, row.expires, row.due_s)),
        ("force_n", lambda: check_force(row, row.kind, row.force_n) if row.kind else None),
    ]
    bad = set(wrong)
    for field, check in checks:
        try:
            if field not in bad:
                check()
        except ValueError as error:
            bad.add(field)
            asked = question(field, [row.payload_kg]) if field == "payload_kg" else ""
            yield field, re.sub(r"^Row\.\w+ ", "", str(error)).rstrip(".") + (asked and f"; {asked}")


def _check_due(row: Row) -> None:
    if row.due_s is not None and row.due_s < row.release_s:
        release, due = (_given_time(row, field) for field in ("release_s", "due_s"))
        raise ValueError(f"must not be before the release at {release} (got {due})")


def _given_time(row: Row, field: str) -> str:
    """A time of a row as it was given; a plain number in seconds."""
    text = row.texts.get(field, "")
    return printable(text, 60) if ":" in text else f"{getattr(row, field):.15g} s"


def with_cell(answer: Answer, jobs: Mapping[str, tuple[str, JobSpec]]) -> Answer:
    """A decision or status whose reason, if any, begins with the row of the job and the column that it quotes.

    Args:
        jobs: The jobs of a table by name, each after its row.
    """
    if not answer.reason or answer.job not in jobs:
        return answer
    row, job = jobs[answer.job]
    columns = {"places": chain.from_iterable(job.every_places), "after": job.after, "name": (job.name,)}
    quoted = (column for column, names in columns.items() if any(f"'{name}'" in answer.reason for name in names))
    place = ", column ".join([row, *islice(quoted, 1)])
    return replace(answer, reason=f"{place}: {answer.reason}")


def _check_hours(rows: Collection[tuple[int, Row]], columns: Collection[str], errors: _Errors, doubts: _Errors) -> None:
    """Check for numbers that are probably hours, in a table with other times as h:mm or dates.

    Args:
        columns: Those whose headings name no unit.
        errors, doubts: Get numbers with and without decimals.
    """
    if not any(":" in text for _, row in rows for text in row.texts.values()):
        return
    for number, row in rows:
        for field, text in row.texts.items():
            column, hours = _COLUMN_OF[field], _HOURS.fullmatch(text)
            if hours is None or column not in columns:
                continue
            if hours[2]:
                errors.add(
                    number, column, f"is this {_meant(hours[1], hours[2])}? {_advice(column)} (got {_shown(text)})"
                )
            elif hours[1] != "0":
                doubts.add(number, column, f"{_shown(text)} counts as {text} s; is this {text}:00? {_advice(column)}")


def _meant(hour: str, decimals: str) -> str:
    """Times of day that a number may mean: with a part of an hour, and with minutes after the point."""
    minute_of_day = round(60 * float(f"{hour}.{decimals}"))
    as_hours = f"{minute_of_day // 60}:{minute_of_day % 60:02d}"
    minutes = f"{decimals:0<2}"[:2]
    return " or ".join(dict.fromkeys([as_hours, *([f"{hour}:{minutes}"] if int(minutes) < 60 else [])]))


def _check_after(rows: Mapping[str, tuple[int, Row]], errors: _Errors, *, closed: bool) -> None:
    for number, row in rows.values() if closed else ():
        for name in row.after:
            if name not in rows:
                hint = "; give | between names" if _SEPARATOR.search(name) else ""
                errors.add(number, "after", f"there is no job '{printable(name)}' in this table{hint}")
    if cycle := cycle_of({name: row.after for name, (_, row) in rows.items()}):
        errors.add(rows[cycle[0]][0], "after", f"jobs wait for each other in a cycle: {' → '.join(cycle)}")


def _check_order(rows: Mapping[str, tuple[int, Row]], doubts: _Errors) -> None:
    """Ask about each due date before the jobs that must finish first can finish, by their releases and dwell times."""
    after = {name: [each for each in row.after if each in rows] for name, (_, row) in rows.items()}
    sentences = dict[int, str]()
    earliest_s, latest = dict[str, float](), dict[str, str]()  # finish, and the job whose release determines it
    for name in TopologicalSorter(after).static_order():
        number, row = rows[name]
        last = max(after[name], key=lambda each: earliest_s[each], default=name)
        waits_s = earliest_s.get(last, 0.0)
        latest[name] = latest[last] if waits_s > row.release_s else name
        earliest_s[name] = max(waits_s, row.release_s) + row.repetitions * row.dwell_s
        if row.due_s is not None and row.due_s < waits_s:
            first = rows[latest[last]][1]
            work_s = waits_s - first.release_s
            release, due = _given_time(first, "release_s"), _given_time(row, "due_s")
            sentences[number] = (
                f"before it, '{printable(first.name)}' must finish, which has its release at {release}; that takes at "
                f"least {work_s:.15g} s, so the job cannot be on time (got {due})"
            )
    for i, number in enumerate(sorted(sentences)):
        rest = "the jobs in column after cannot finish before it, either"
        doubts.add(number, "due", sentences[number] if i < MOST_NUMBERS else rest)


def cycle_of(after: Mapping[str, Sequence[str]]) -> list[str]:
    """Names that wait for each other in a cycle; empty if there is none."""
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        return error.args[1][::-1]
    return []


def _rows(file: Path | bytes, where: str) -> tuple[Rows, bool]:
    """Rows of a file that are not empty, and whether a comma in them may be a decimal point."""
    content = file if isinstance(file, bytes) else read_bytes(file, where)
    match "" if isinstance(file, bytes) else file.suffix.lower():
        case ".parquet":
            rows, decimal_comma = _parquet_rows(content, where), False
        case ".xlsx":
            rows, decimal_comma = _xlsx_rows(content, where), False
        case _:
            rows, decimal_comma = _csv_rows(content, where)
    return ((number, cells) for number, cells in rows if not all(map(_is_empty, cells))), decimal_comma


def _csv_rows(content: bytes, where: str) -> tuple[Rows, bool]:
    text, skipped, delimiter = text_of(content, where), 0, ""
    first, _, rest = text.partition("\n")
    if declared := re.fullmatch(r"sep=(.)", first.strip('"\r')):  # written by Excel
        text, skipped, delimiter = rest, 1, declared[1]
    head = re.sub(r'"[^"]*"', "", text.partition("\n")[0])
    delimiter = delimiter or max(",;\t|", key=head.count)

    def rows() -> Rows:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        number = skipped
        try:
            for number, cells in enumerate(reader, start=1 + skipped):
                yield number, cells
        except csv.Error as error:
            raise ScenarioError(
                f"{where}, after row {number}: not CSV ({error}). A quoted cell must end with a quote before the "
                "separator; a quote inside it is written twice."
            ) from error

    return rows(), delimiter != ","


def read_bytes(path: Path, where: str) -> bytes:
    """The content of a file; raises a ScenarioError if it cannot be read or is too large."""
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
    except FileNotFoundError as error:
        raise ScenarioError(f"{where}: there is no file '{path}'.") from error
    except OSError as error:
        raise ScenarioError(f"{where}: cannot read '{path}': {error.strerror}.") from error
    if len(content) > MOST_BYTES:
        raise ScenarioError(f"{where} has more than {MOST_BYTES} bytes.")
    return content


def text_of(content: bytes, where: str) -> str:
    """The text of a file, as `decode_text` reads it; raises a ScenarioError for other data."""
    if content.startswith(_WORKBOOKS):
        raise ScenarioError(f"{where} is a workbook or an archive. Save its sheet as CSV, or as XLSX with this ending.")
    if "\0" in (text := decode_text(content)):
        raise ScenarioError(f"{where} is not a text file in UTF-8: it has NUL bytes. Save it as UTF-8.")
    return text


def _parquet_rows(content: bytes, where: str) -> Rows:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        if (count := file.metadata.num_rows) > MOST_ROWS:
            raise ScenarioError(f"{where} has {count} rows; a job table has at most {MOST_ROWS}.")
        table = file.read()
    except (pa.ArrowException, OSError) as error:
        raise ScenarioError(f"{where} is not a Parquet file ({str(error).splitlines()[0]}).") from error
    yield 0, table.column_names
    yield from enumerate(zip(*(column.to_pylist() for column in table.columns), strict=True), start=1)


def _xlsx_rows(content: bytes, where: str) -> Rows:
    from scenarios.extras import require_extra

    require_extra("xlsx")
    openpyxl = import_module("openpyxl")
    try:
        values, written = (
            openpyxl.load_workbook(io.BytesIO(content), data_only=data_only) for data_only in (True, False)
        )
    except Exception as error:  # also those of zipfile and of an XML parser
        raise ScenarioError(f"{where} is not an XLSX file ({error}).") from error
    shown = [each for each in values.worksheets if each.sheet_state == "visible"]
    if not shown:
        raise ScenarioError(f"{where} has no sheet with cells.")
    sheet, formulas = shown[0], written[shown[0].title]
    if others := [each.title for each in shown[1:] if each.max_row > 1]:
        _LOG.warning("%s: the first sheet, '%s', is read, and not %s.", where, sheet.title, ", ".join(others))
    if sheet.max_row > MOST_ROWS + 1 or sheet.max_column > MOST_COLUMNS:
        raise ScenarioError(
            f"{where} has {sheet.max_row} rows and {sheet.max_column} columns; a job table has at most {MOST_ROWS} and "
            f"{MOST_COLUMNS}. Delete cells beside or below the table."
        )
    if sheet.merged_cells.ranges:
        raise ScenarioError(f"{where} has merged cells ({min(map(str, sheet.merged_cells.ranges))}): unmerge them.")
    hidden = [f"row {i}" for i, each in sheet.row_dimensions.items() if each.hidden]
    hidden += [f"column {name}" for name, each in sheet.column_dimensions.items() if each.hidden]
    if hidden:
        _LOG.warning("%s: hidden cells count, too: %s.", where, ", ".join(hidden[:MOST_NUMBERS]))
    for row in formulas.iter_rows():
        for cell in row:
            if cell.data_type == "f" and sheet[cell.coordinate].value is None:
                raise ScenarioError(
                    f"{where}, cell {cell.coordinate}: a formula without a stored value. Open and save the file in a "
                    "spreadsheet, or give the value."
                )
    yield from enumerate(([_as_shown(cell) for cell in row] for row in sheet.iter_rows()), start=1)


def _as_shown(cell: Any) -> Cell:
    """The value of a cell of a sheet; a whole number with leading zeros, such as 0012, and a duration as texts."""
    if isinstance(cell.value, timedelta):
        hours, rest = divmod(cell.value, timedelta(hours=1))
        return f"{hours}:{str(rest)[2:]}"
    if isinstance(cell.value, datetime) and "h" not in str(cell.number_format).lower():
        return cell.value.date()
    zeros = re.fullmatch("00+", str(cell.number_format)) and isinstance(cell.value, int)
    return f"{cell.value:0{len(cell.number_format)}d}" if zeros else cell.value


def stream_fields(job: JobSpec, horizon_s: float, row: str) -> dict[str, object]:
    """The job as fields of a `JobStream` with one arrival; without a due date it is due at the end of the shift.

    Args:
        row: File and row of the job, for errors.
    """
    gap_s = max(0.0, (horizon_s if job.due_s is None else job.due_s) - job.release_s)
    close = (gap_s, nextafter(gap_s, inf), nextafter(gap_s, 0.0))  # release + one of these is exactly the due date
    return {
        **{name: getattr(job, name) for name in ("name", "kind", "dwell_s", "force_n", "value", "after")},
        "places": job.every_places,
        "arrivals": {"kind": "trace", "times_s": [job.release_s]},
        "payload_kg": [job.payload_kg],
        "repetitions": [job.repetitions, job.repetitions],
        "due_s": next((each for each in close if job.release_s + each == job.due_s), gap_s),
        "due": "hard" if job.expires else "soft",
        "numbered": False,
        "row": row,
    }


def shift_begin(given: object, where: str, zone: tzinfo | None = None) -> datetime | None:
    """The begin of a shift from an ISO date with a zone; None without one.

    Args:
        zone: Of its times of day; by default that of the date.

    Raises:
        ScenarioError: it is no such date.
    """
    begin = given
    if isinstance(given, str) and given:
        with suppress(ValueError):
            begin = datetime.fromisoformat(given)
    if begin in (None, ""):
        return None
    if isinstance(begin, datetime) and (begin.tzinfo or zone) and YEARS[0] <= begin.year <= YEARS[1]:
        begin = begin.replace(tzinfo=begin.tzinfo or zone)
        try:
            check_exists(begin, f"{where} = {given}")
        except ValueError as error:
            raise ScenarioError(f"{error}.") from error
        if sentence := twice(begin):
            _LOG.warning("%s = %s %s.", where, given, sentence)
        return begin.astimezone(zone or begin.tzinfo)
    raise ScenarioError(f"{where} must be {DATE} (got {given}).")
