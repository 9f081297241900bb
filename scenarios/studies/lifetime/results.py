"""Result files of the studies."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from fleet.files import atomic_path
from scenarios.result_folder import disk_errors


def study_result(name: str, seeds: Sequence[int], size: Any, rows: Sequence[Any], command: str) -> dict[str, Any]:
    """The JSON of a result file: what was measured, how, and every row (Any: values of JSON)."""
    return {"study": name, "command": command, "seeds": [*seeds], "size": asdict(size), "rows": [*map(asdict, rows)]}


def write_result(result: object, file: Path) -> None:
    """Write a result as JSON; numbers that are not finite become null.

    Raises:
        FleetError: the file cannot be written.
    """
    text = json.dumps(msgspec.json.decode(msgspec.json.encode(result)), indent=1, allow_nan=False)
    with disk_errors(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(file) as draft:
            draft.write_text(text + "\n", encoding="utf-8")
