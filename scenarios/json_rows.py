"""Results of a long study as JSON lines: each row is appended when it is known, so a stopped study goes on."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any  # JSON values

from fleet.errors import FleetError

Row = dict[str, Any]
KEY = "key"


class Rows:
    """The rows of a file, by key; a later row replaces an earlier one.

    Raises:
        FleetError: the file has a complete line that is no row.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.by_key: dict[str, Row] = {}
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        *lines, unfinished = text.split("\n")
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                self.by_key[row[KEY]] = row
            except (ValueError, KeyError, TypeError):
                raise FleetError(
                    f"{path}, line {number}: not a row of this study; remove the line, or write to another file."
                ) from None
        if unfinished:  # of a process that was stopped while it wrote
            path.write_text(text[: len(text) - len(unfinished)], encoding="utf-8")

    def __contains__(self, key: str) -> bool:
        return key in self.by_key

    def some(self, keys: Iterable[str]) -> list[Row]:
        """The rows of these keys that are there."""
        return [self.by_key[key] for key in keys if key in self.by_key]

    def append(self, key: str, row: Mapping[str, Any]) -> None:
        """Add a row to the file."""
        whole = {KEY: key, **row}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(whole, ensure_ascii=False) + "\n")
        self.by_key[key] = whole
