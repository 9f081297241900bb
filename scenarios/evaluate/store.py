"""Rows of long work in a folder, as Parquet: a small file for every finished piece, one file at the end.

A card states what makes rows comparable, hashes and settings. The same work continues in its folder after an
interruption, and does not continue in one with another card.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar  # Any: values of columns and cards

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.result_folder import disk_errors

if TYPE_CHECKING:  # needs the extra `report`
    import pyarrow as pa

RESULTS, PARTS = "results.parquet", "parts"
MOST_PARTS = 500
"""More are made one file at once."""
Key = TypeVar("Key", bound=tuple[Any, ...])
Row = TypeVar("Row")


@dataclass(frozen=True, kw_only=True)
class RowKind(Generic[Key, Row]):
    """A kind of rows, and how a file holds them."""

    work: str
    """What the rows are of, in errors, as `study`."""
    command: str
    """That writes them."""
    card: str
    """Name of the file of the card."""
    columns: Mapping[str, type]
    """Type of each column: str, int, float or bool."""
    key: Callable[[Row], Key]
    """What a row is found and sorted by."""
    values: Callable[[Row], Mapping[str, object]]
    """The columns of a row; None for no value."""
    row: Callable[[Mapping[str, Any]], Row]
    """The row of its columns."""
    named: Mapping[str, str] = field(default_factory=dict)
    """Fields of a card, by name, that hold hashes by name and to which more work of the kind may add; with the word for
    one of them."""

    @property
    def schema(self) -> "pa.Schema":
        """Of the files."""
        import pyarrow as pa

        types = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
        return pa.schema([(name, types[kind]) for name, kind in self.columns.items()])


class Store(Generic[Key, Row]):
    """A folder of rows; `opened` opens it."""

    def __init__(self, out: Path, kind: RowKind[Key, Row], card: Mapping[str, object], rows: dict[Key, Row]) -> None:
        self.out, self.rows = out, rows
        self._kind, self._card, self._parts = kind, card, 0

    def add(self, rows: Sequence[Row]) -> None:
        """Write the rows of a piece of work: whole, or not at all."""
        added = {self._kind.key(row): row for row in rows}
        self.rows |= added
        name = hashlib.sha256(repr(list(added)).encode()).hexdigest()[:24]
        with disk_errors(self.out):
            self._write(self.out / PARTS / f"{name}.parquet", rows)
            self._parts += 1
            if self._parts >= MOST_PARTS:
                self.compact()

    def compact(self) -> None:
        """Make one file of all rows, sorted by key, so that it does not depend on the order in which they came."""
        self._write(self.out / RESULTS, [self.rows[key] for key in sorted(self.rows)])
        for part in _parts(self.out):
            part.unlink()
        self._parts = 0

    def finish(self) -> None:
        """Write the last state: one file of rows, and a card that says so."""
        with disk_errors(self.out):
            self.compact()
            (self.out / PARTS).rmdir()
            write_card(self.out / self._kind.card, {**self._card, "status": "finished"})

    def _write(self, path: Path, rows: Sequence[Row]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.Table.from_pylist([dict(self._kind.values(row)) for row in rows], self._kind.schema)
        with atomic_path(path) as file:
            pq.write_table(table, file)


@contextmanager
def opened(out: Path, kind: RowKind[Key, Row], card: Mapping[str, object]) -> Iterator[Store[Key, Row]]:
    """The store in a folder: new, or with the rows of earlier work with the same card.

    Raises:
        FleetError: the folder holds something else or other work, cannot be written, or another process writes it.
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
            whole = _joined(out, kind, json.loads(json.dumps(card)))  # as a file gives it
            rows = _read(out, kind) if (out / kind.card).exists() else {}
            (out / PARTS).mkdir(exist_ok=True)
            for draft in (out / PARTS).glob(".*"):  # of a process that was killed
                draft.unlink()
            write_card(out / kind.card, {**whole, "status": "interrupted"})
        store = Store(out, kind, whole, rows)
        yield store
        store.finish()
    finally:
        os.close(handle)


def write_card(path: Path, card: Mapping[str, object]) -> None:
    """Write a card."""
    with atomic_path(path) as file:
        file.write_text(json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _joined(out: Path, kind: RowKind[Key, Row], card: Mapping[str, Any]) -> dict[str, Any]:
    """The card, with what the folder has already in the fields of `kind.named`."""
    if not any(path.name != PARTS and not path.name.startswith(".") for path in out.iterdir()):
        return dict(card)
    try:
        known = json.loads((out / kind.card).read_text(encoding="utf-8"))
        for name in kind.named:
            dict(known[name])
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        raise FleetError(
            f"'{out}' holds other files; --out needs a new folder or that of an earlier {kind.work}."
        ) from error
    joined = dict(card)
    for name, value in card.items():
        if name in kind.named:
            for each, digest in value.items():
                if each in known[name] and known[name][each] != digest:
                    raise FleetError(
                        f"'{out}' holds a {kind.work} in which {kind.named[name]} '{each}' was another one "
                        f"(hash {known[name][each] or 'none'}, now {digest or 'none'}); give another --out."
                    )
            joined[name] = {**known[name], **value}
        elif known.get(name) != value:
            raise FleetError(
                f"'{out}' holds a {kind.work} with {name} {known.get(name)!r}, not {value!r}; give another --out."
            )
    return joined


def read_rows(out: str | Path, kind: RowKind[Key, Row]) -> list[Row]:
    """The rows of a folder, finished or interrupted, sorted by key.

    Raises:
        FleetError: it is no such folder, or damaged.
    """
    out = Path(out)
    if not (out / kind.card).is_file():
        raise FleetError(f"'{out}' holds no {kind.work} of `{kind.command}`.")
    with disk_errors(out):
        rows = _read(out, kind)
    return [rows[key] for key in sorted(rows)]


def read_card(out: Path, kind: RowKind[Any, Any]) -> dict[str, Any]:
    """Content of the card of a folder.

    Raises:
        FleetError: it holds no such rows.
    """
    try:
        card = json.loads((out / kind.card).read_text(encoding="utf-8"))
        if isinstance(card, dict):
            return card
        what = f"has a damaged {kind.card}, which holds no object"
    except ValueError as error:
        what = f"has a damaged {kind.card} ({error})"
    except OSError:
        what = f"holds no {kind.work} of `{kind.command}`" if out.is_dir() else "is no folder"
    raise FleetError(f"'{out}' {what}; give the folder of such a command.")


def _parts(out: Path) -> list[Path]:
    return sorted((out / PARTS).glob("[!.]*.parquet"))


def _read(out: Path, kind: RowKind[Key, Row]) -> dict[Key, Row]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: dict[Key, Row] = {}
    for path in [out / RESULTS, *_parts(out)]:
        if not path.exists():
            continue
        try:
            found = pq.read_table(path, schema=kind.schema).to_pylist()
        except (pa.ArrowException, ValueError) as error:
            raise FleetError(f"'{path}' is damaged ({error}); remove it, and its rows are computed again.") from error
        for each in found:
            row = kind.row(each)
            rows[kind.key(row)] = row
    return rows
