"""The telemetry.parquet of a run as one table of readings per arm."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import LogError
from twin.log_table import Damage, Table

Array = np.ndarray

ARM, MODE = "arm", "mode"
"""Columns of words: the name of the arm, and what it was doing."""


def read_arms(path: Path) -> dict[str, Table]:
    """The readings of every arm, in the order of their first rows; the line of a row is its number in the file.

    Raises:
        LogError: it is no whole parquet file, names no arms, or a column holds no numbers.
    """
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise LogError(str(path), None, f"is no whole parquet file ({str(error).splitlines()[0]}).") from error
    if ARM not in table.column_names or len(table.column_names) == 1:
        missing = "time_s" if ARM in table.column_names else ARM
        raise LogError(str(path), None, f"misses the column {missing} of a telemetry.parquet.")
    if not table.num_rows:
        raise LogError(str(path), None, "holds no rows.")
    names = tuple(name for name in table.column_names if name not in (ARM, MODE))
    values = np.column_stack([_numbers(path, name, table[name]) for name in names])
    arms = np.array(table[ARM].cast(pa.string()).to_pylist(), dtype=object)
    nameless = [row for row, arm in enumerate(arms.tolist()) if arm is None]
    if nameless:
        raise LogError(str(path), nameless[0] + 1, "names no arm.")
    return {str(arm): _of_rows(names, values, np.flatnonzero(arms == arm)) for arm in dict.fromkeys(arms.tolist())}


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> Array:
    try:
        return column.cast(pa.float64()).to_numpy()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LogError(str(path), None, f"the column {name} holds {column.type}, no numbers.") from error


def _of_rows(names: tuple[str, ...], values: Array, rows: Array) -> Table:
    finite = np.isfinite(values[rows])
    good = finite.all(axis=1)
    first = finite[~good].argmin(axis=1)
    damage = tuple(
        Damage(int(row) + 1, f"{names[column]} is missing or not a finite number")
        for row, column in zip(rows[~good], first, strict=True)
    )
    return Table(names, values[rows[good]], rows[good] + 1, damage)
