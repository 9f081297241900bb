"""The telemetry.parquet of a run as one table per arm."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet.errors import LogError
from twin.logs.table import Damage, Table

Array = np.ndarray

ARM, MODE = "arm", "mode"
"""Text columns: the arm's name and its mode."""


def read_arms(path: Path) -> dict[str, Table]:
    """The readings of every arm, in the order of their first rows; the line of a row is its number in the file.

    Raises:
        LogError: the file is not a complete parquet file, a row names no arm, or a column is not numeric.
    """
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise LogError(str(path), None, f"is not a complete parquet file ({str(error).splitlines()[0]}).") from error
    if ARM not in table.column_names or len(table.column_names) == 1:
        missing = "time_s" if ARM in table.column_names else ARM
        raise LogError(str(path), None, f"lacks the column {missing} of a telemetry.parquet.")
    if not table.num_rows:
        raise LogError(str(path), None, "holds no rows.")
    names = tuple(name for name in table.column_names if name not in (ARM, MODE))
    values = np.column_stack([_numbers(path, name, table[name]) for name in names])
    arms = np.array(table[ARM].cast(pa.string()).to_pylist(), dtype=object)
    if None in arms:
        raise LogError(str(path), arms.tolist().index(None) + 1, "names no arm.")
    finite = np.isfinite(values)
    good = finite.all(axis=1)

    def of_arm(arm: str) -> Table:
        rows, bad = np.flatnonzero((arms == arm) & good), np.flatnonzero((arms == arm) & ~good)
        damage = [Damage(int(i) + 1, f"{names[finite[i].argmin()]} is missing or not a finite number") for i in bad]
        return Table(names, values[rows], rows + 1, tuple(damage))

    return {arm: of_arm(arm) for arm in dict.fromkeys(arms.tolist())}


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> Array:
    try:
        return column.cast(pa.float64()).to_numpy()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LogError(str(path), None, f"the column {name} holds {column.type}, not numbers.") from error
