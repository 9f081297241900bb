"""Rows of a study in a folder, as Parquet: a small file for every finished unit, one file at the end."""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.evaluate.rollout import FIGURES, Outcome
from scenarios.evaluate.study import CARD, Key, Row, columns
from scenarios.result_folder import disk_errors

RESULTS, PARTS = "results.parquet", "parts"
MOST_PARTS = 500
"""More are made one file at once."""
SCHEMA = pa.schema(
    [
        ("policy", pa.string()),
        ("instance", pa.string()),
        ("fleet", pa.int64()),
        ("training", pa.int64()),
        ("difficulty", pa.string()),
        ("seed", pa.int64()),
        *((figure, pa.float64()) for figure in FIGURES),
        ("illegal", pa.int64()),
        ("error", pa.string()),
        ("trace", pa.string()),
    ]
)
_NAMED = ("instances", "policies")
"""Fields of a card that another study of the same kind may add to."""


class Store:
    """The folder of one study; `opened` opens it."""

    def __init__(self, out: Path, card: Mapping[str, object], rows: dict[Key, Row]) -> None:
        self.out, self.rows = out, rows
        self._card, self._parts = card, 0

    def add(self, rows: Sequence[Row]) -> None:
        """Write the rows of a unit: whole, or not at all."""
        self.rows |= {row.key: row for row in rows}
        name = hashlib.sha256(repr([row.key for row in rows]).encode()).hexdigest()[:24]
        with disk_errors(self.out):
            _write(self.out / PARTS / f"{name}.parquet", rows)
            self._parts += 1
            if self._parts >= MOST_PARTS:
                self.compact()

    def compact(self) -> None:
        """Make one file of all rows, sorted by key, so that it does not depend on the order in which they came."""
        _write(self.out / RESULTS, [self.rows[key] for key in sorted(self.rows)])
        for part in _parts(self.out):
            part.unlink()
        self._parts = 0

    def finish(self) -> None:
        """Write the last state: one file of rows, and a card that says so."""
        with disk_errors(self.out):
            self.compact()
            (self.out / PARTS).rmdir()
            write_card(self.out, {**self._card, "status": "finished"})


@contextmanager
def opened(out: Path, card: Mapping[str, object]) -> Iterator[Store]:
    """The store of a study in a folder: new, or with the rows of an earlier study of the same kind.

    Raises:
        FleetError: the folder holds something else or another study, cannot be written, or another process writes it.
    """
    with disk_errors(out):
        if out.exists() and not out.is_dir():
            raise FleetError(f"Cannot write to '{out}': it is a file; --out needs a folder.")
        out.mkdir(parents=True, exist_ok=True)
        handle = os.open(out, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FleetError(f"Another process writes to '{out}'. Wait for it, or choose another --out.") from error
        with disk_errors(out):
            whole = _joined(out, json.loads(json.dumps(card)))  # as a file gives it
            rows = _read(out) if (out / CARD).exists() else {}
            (out / PARTS).mkdir(exist_ok=True)
            for draft in (out / PARTS).glob(".*"):  # of a process that was killed
                draft.unlink()
            write_card(out, {**whole, "status": "interrupted"})
        store = Store(out, whole, rows)
        yield store
        store.finish()
    finally:
        os.close(handle)


def write_card(out: Path, card: Mapping[str, object]) -> None:
    """Write the card of a study."""
    with atomic_path(out / CARD) as file:
        file.write_text(json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _joined(out: Path, card: Mapping[str, Any]) -> dict[str, Any]:
    """The card, with the instances and policies that the folder has already."""
    if not any(path.name != PARTS and not path.name.startswith(".") for path in out.iterdir()):
        return dict(card)
    try:
        known = json.loads((out / CARD).read_text(encoding="utf-8"))
        for name in _NAMED:
            dict(known[name])
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise FleetError(f"'{out}' holds other files; --out needs a new folder or that of an earlier study.") from error
    joined = dict(card)
    for name, value in card.items():
        if name in _NAMED:
            for each, digest in value.items():
                if each in known[name] and known[name][each] != digest:
                    raise FleetError(
                        f"'{out}' holds a study in which {name[:-1].replace('ie', 'y')} '{each}' was another one "
                        f"(hash {known[name][each] or 'none'}, now {digest or 'none'}); give another --out."
                    )
            joined[name] = {**known[name], **value}
        elif known.get(name) != value:
            raise FleetError(
                f"'{out}' holds a study with {name} {known.get(name)!r}, not {value!r}; give another --out."
            )
    return joined


def read_rows(out: str | Path) -> list[Row]:
    """The rows of a study's folder, finished or interrupted, sorted by key.

    Raises:
        FleetError: it is no such folder, or damaged.
    """
    out = Path(out)
    if not (out / CARD).is_file():
        raise FleetError(f"'{out}' holds no study of `thermofleet compare --out`.")
    with disk_errors(out):
        rows = _read(out)
    return [rows[key] for key in sorted(rows)]


def _parts(out: Path) -> list[Path]:
    return sorted((out / PARTS).glob("[!.]*.parquet"))


def _read(out: Path) -> dict[Key, Row]:
    rows: dict[Key, Row] = {}
    for path in [out / RESULTS, *_parts(out)]:
        if not path.exists():
            continue
        try:
            found = pq.read_table(path, schema=SCHEMA).to_pylist()
        except (pa.ArrowException, ValueError) as error:
            raise FleetError(f"'{path}' is damaged ({error}); remove it, and its shifts are run again.") from error
        for each in found:
            row = row_of(each)
            rows[row.key] = row
    return rows


def row_of(found: Mapping[str, Any]) -> Row:
    """The row of its columns."""
    failed = found["error"] is not None
    outcome = None if failed else Outcome(**{figure: found[figure] for figure in FIGURES})
    return Row(Key(*(found[name] for name in Key._fields)), outcome, found["illegal"], found["error"], found["trace"])


def _write(path: Path, rows: Sequence[Row]) -> None:
    with atomic_path(path) as file:
        pq.write_table(pa.Table.from_pylist([columns(row) for row in rows], SCHEMA), file)
