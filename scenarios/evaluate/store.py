"""Rows of a study, in memory or in a folder: JSON lines while it runs, one Parquet file at its end.

A card states what makes rows comparable, hashes and settings. The same study continues in its folder after an
interruption, and does not continue in one with another card.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any  # Any: values of columns and cards

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.evaluate.rollout import FIGURES
from scenarios.evaluate.study import CARD, Row, RowKey, columns, row_of
from scenarios.json_rows import Rows
from scenarios.result_folder import check_folder, disk_errors, lock_folder

if TYPE_CHECKING:  # needs the extra `report`
    import pyarrow as pa

RESULTS, UNFINISHED = "results.parquet", "rows.jsonl"
"""Files of the rows: of the last finished study, and of one that has not finished yet."""
COMMAND = "thermofleet compare --out"
"""That writes such a folder."""
COLUMNS: dict[str, type] = {
    **RowKey.__annotations__,
    **dict.fromkeys(FIGURES, float),
    "illegal": int,
    "error": str,
    "trace": str,
}
NAMED = {"instances": "instance", "policies": "policy"}
"""Fields of a card that hold hashes by name and to which a later study may add, with the word for one of them."""


class Store:
    """Rows by key; `opened` gives one that also keeps them in a folder."""

    def __init__(self, rows: Mapping[RowKey, Row] | None = None, file: Rows | None = None) -> None:
        self.rows = dict(rows or {})
        self._file = file

    def add(self, rows: Iterable[Row]) -> None:
        """Take the rows of a unit."""
        for row in rows:
            self.rows[row.key] = row
            if self._file is not None:
                self._file.append(" ".join(map(str, row.key)), columns(row))


@contextmanager
def opened(out: Path, card: Mapping[str, object]) -> Iterator[Store]:
    """The store in a folder: new, or with the rows of earlier studies with the same card.

    Raises:
        FleetError: the folder holds something else or another study, cannot be written, or another process writes it.
    """
    with disk_errors(out):
        check_folder(out)
        out.mkdir(parents=True, exist_ok=True)
    with lock_folder(out):
        with disk_errors(out):
            whole = _joined(out, json.loads(json.dumps(card)))  # as a file gives it
            file = Rows(out / UNFINISHED)
            store = Store(_read(out, file), file)
            _write_card(out, {**whole, "status": "interrupted"})
        yield store
        with disk_errors(out):
            _write_results(out, store.rows)
            (out / UNFINISHED).unlink(missing_ok=True)
            _write_card(out, {**whole, "status": "finished"})


def _joined(out: Path, card: Mapping[str, Any]) -> dict[str, Any]:
    """The card, with what the folder has already in the fields of `NAMED`."""
    if not any(not path.name.startswith(".") for path in out.iterdir()):
        return dict(card)
    try:
        known = json.loads((out / CARD).read_text(encoding="utf-8"))
        for name in NAMED:
            dict(known[name])
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        what = "holds other files"
        if not isinstance(error, FileNotFoundError):
            what = f"has a damaged {CARD}"
        elif (out / RESULTS).exists():
            what = f"has {RESULTS}, but no {CARD}"
        raise FleetError(f"'{out}' {what}; --out needs a new folder or that of an earlier study.") from error
    joined = dict(card)
    for name, value in card.items():
        if name in NAMED:
            for each, digest in value.items():
                if each in known[name] and known[name][each] != digest:
                    raise FleetError(
                        f"'{out}' holds a study in which {NAMED[name]} '{each}' was another one "
                        f"(hash {known[name][each] or 'none'}, now {digest or 'none'}); give another --out."
                    )
            joined[name] = {**known[name], **value}
        elif known.get(name) != value:
            raise FleetError(
                f"'{out}' holds a study with {name} {known.get(name)!r}, not {value!r}; give another --out."
            )
    return joined


def read_rows(out: str | Path) -> list[Row]:
    """The rows of a folder, finished or interrupted, sorted by key.

    Raises:
        FleetError: it is no such folder, or damaged.
    """
    out = Path(out)
    if not (out / CARD).is_file():
        raise FleetError(f"'{out}' holds no study of `{COMMAND}`.")
    with disk_errors(out):
        rows = _read(out, Rows(out / UNFINISHED))
    return [rows[key] for key in sorted(rows)]


def read_card(out: Path) -> dict[str, Any]:
    """Content of the card of a folder.

    Raises:
        FleetError: it holds no study.
    """
    try:
        card = json.loads((out / CARD).read_text(encoding="utf-8"))
        if isinstance(card, dict):
            return card
        what = f"has a damaged {CARD}, which holds no object"
    except ValueError as error:
        what = f"has a damaged {CARD} ({error})"
    except OSError:
        what = f"holds no study of `{COMMAND}`" if out.is_dir() else "is no folder"
    raise FleetError(f"'{out}' {what}; give the folder of such a command.")


def _write_card(out: Path, card: Mapping[str, object]) -> None:
    with atomic_path(out / CARD) as draft:
        draft.write_text(json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _schema() -> "pa.Schema":
    import pyarrow as pa

    types = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    return pa.schema([(name, types[kind]) for name, kind in COLUMNS.items()])


def _write_results(out: Path, rows: Mapping[RowKey, Row]) -> None:
    """One file of all rows, sorted by key, so that it does not depend on the order in which they came."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pylist([columns(rows[key]) for key in sorted(rows)], _schema())
    with atomic_path(out / RESULTS) as draft:
        pq.write_table(table, draft)


def _read(out: Path, unfinished: Rows) -> dict[RowKey, Row]:
    """All rows of a folder: the finished ones, and those of its unfinished study."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = out / RESULTS
    try:
        finished = pq.read_table(path, schema=_schema()).to_pylist() if path.exists() else []
    except (pa.ArrowException, ValueError) as error:
        raise FleetError(f"'{path}' is damaged ({error}); remove it, and its rows are computed again.") from error
    with unfinished.readable():
        rows = [row_of(each) for each in (*finished, *unfinished.by_key.values())]
    return {row.key: row for row in rows}
