"""Results of a long study as JSON lines: each row is appended when it is known, so a stopped study goes on."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any  # JSON values

from fleet.errors import FleetError
from fleet.files import atomic_path
from scenarios.result_folder import disk_errors

Row = dict[str, Any]
KEY = "key"
_BEGIN = f'{{"{KEY}": '.encode()
"""Every row begins with this."""


class Rows:
    """The rows of a file, by key; a later row replaces an earlier one. Reading leaves the file as it is.

    Raises:
        FleetError: the file cannot be read, or has a line that is no row.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.by_key: dict[str, Row] = {}
        with disk_errors(path):
            data = path.read_bytes() if path.exists() else b""
        *lines, unfinished = data.split(b"\n")
        self._size, self._unfinished = len(data), len(unfinished)
        """Bytes of the file, and those of its last line if a process was stopped while it wrote."""
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                self.by_key[row[KEY]] = row
            except (ValueError, KeyError, TypeError):
                raise self._refusal(number) from None
        if unfinished[: len(_BEGIN)] != _BEGIN[: len(unfinished)]:
            raise self._refusal(len(lines) + 1)

    def _refusal(self, line: int) -> FleetError:
        return FleetError(
            f"{self.path}, line {line}: not a row of this study; name another file, or remove a damaged line."
        )

    def __contains__(self, key: str) -> bool:
        return key in self.by_key

    def some(self, keys: Iterable[str]) -> list[Row]:
        """The rows of these keys that are there."""
        return [self.by_key[key] for key in keys if key in self.by_key]

    def append(self, key: str, row: Mapping[str, Any]) -> None:
        """Add a row to the file; an unfinished line at its end is removed."""
        whole = {KEY: key, **row}
        self._write(_line(whole))
        self.by_key[key] = whole

    def check_writable(self) -> None:
        """Raise a FleetError if rows cannot be appended."""
        self._write("")

    def sort(self, by: Callable[[Row], Any]) -> None:
        """Write the file anew, in order and without replaced rows, unless it is so already (Any: what can be sorted).

        Raises:
            FleetError: as `check_writable`.
        """
        self.by_key = dict(sorted(self.by_key.items(), key=lambda item: by(item[1])))
        data = "".join(map(_line, self.by_key.values())).encode()
        with disk_errors(self.path):
            if data and data != self.path.read_bytes():
                with atomic_path(self.path) as draft:
                    draft.write_bytes(data)
                self._size, self._unfinished = len(data), 0

    def _write(self, text: str) -> None:
        with disk_errors(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                if self._unfinished and file.tell() == self._size:  # else another process continued the file
                    file.truncate(self._size - self._unfinished)
                self._unfinished = 0
                file.write(text.encode())

    @contextmanager
    def readable(self) -> Iterator[None]:
        """Turn the error of a row with missing or odd values into a FleetError that names the file."""
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise FleetError(
                f"A row of '{self.path}' has a missing or odd value ({type(error).__name__}: {error}); remove the row."
            ) from error


def _line(row: Row) -> str:
    return json.dumps(row, ensure_ascii=False) + "\n"
