"""Means over seeds with intervals, and the result files of the studies."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy import stats

from fleet.files import atomic_path
from scenarios.result_folder import disk_errors

Array = np.ndarray


def mean_interval(values: Sequence[float] | Array, level: float = 0.95) -> tuple[float, float, float]:
    """Mean of independent values, [seed], with its t interval; the bounds are NaN for fewer than two values."""
    finite = np.asarray(values, dtype=float)
    mean = float(finite.mean()) if len(finite) else float("nan")
    if len(finite) < 2:
        return mean, float("nan"), float("nan")
    half = float(stats.t.ppf(0.5 + level / 2.0, len(finite) - 1) * finite.std(ddof=1) / np.sqrt(len(finite)))
    return mean, mean - half, mean + half


def in_words(values: Sequence[float] | Array, digits: int = 2) -> str:
    """`0.41 [0.35, 0.47]`, the mean and its interval over the seeds; the mean alone for one seed."""
    mean, low, high = mean_interval(values)
    return f"{mean:.{digits}f}" + (f" [{low:.{digits}f}, {high:.{digits}f}]" if np.isfinite(low) else "")


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
