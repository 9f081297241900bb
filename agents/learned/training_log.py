"""Length and log of a training: JSON lines, and TensorBoard by TorchRL's logger where both are installed."""

import json
from dataclasses import dataclass, fields
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any

from fleet.errors import FleetError
from fleet.fields import check, option

LOG, CURVE, BOARD = "progress.jsonl", "curve.png", "tensorboard"


@dataclass(frozen=True, kw_only=True)
class TrainingLength:
    """Length of a training; subclasses add counts, which must be positive.

    Raises:
        FleetError: a number is not positive.
    """

    minutes: float = option(
        "Training time excluding the twins, min. With --resume: additional time; with --resume and --seeds: total of "
        "each training.",
        30.0,
        low=0,
        high=100_000,
        above=True,
    )
    iterations: int | None = option(
        "Maximum number of iterations in total, those before a resume included.", None, low=1, high=1_000_000
    )
    in_total: bool = False
    """Whether `minutes` include those before a resume, too, and a complete training is skipped."""

    def __post_init__(self) -> None:
        try:
            check(self)
        except ValueError as error:
            raise FleetError(str(error)) from error
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and field.name not in ("minutes", "iterations", "in_total") and value < 1:
                raise FleetError(f"{field.name} must be >= 1 (got {value}).")

    def share(self, iterations: int, seconds: float, before_s: float) -> float:
        """Finished share of a training; from 1 on it is complete.

        Args:
            iterations, seconds: Of all sessions.
            before_s: Time of the sessions before a resume.
        """
        spent_s = seconds - (0.0 if self.in_total else before_s)
        return max(spent_s / (60.0 * self.minutes), iterations / (self.iterations or inf))


class TrainingLog:
    """Rows of numbers in the folder of a training; a resumed training adds to them."""

    def __init__(self, folder: Path) -> None:
        self._path, self._board = folder / LOG, None
        if find_spec("tensorboard") and find_spec("torchrl"):
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            self._board = TensorboardLogger(BOARD, str(folder))

    def add(self, iteration: int, row: dict[str, Any]) -> None:
        """Append a row; its numbers become scalars of TensorBoard at this iteration."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        if self._board is not None:
            for name, value in row.items():
                if name not in ("iteration", "number") and isinstance(value, int | float):
                    self._board.log_scalar(name, float(value), step=iteration)


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The rows of a training, oldest first."""
    return [json.loads(line) for line in (folder / LOG).read_text(encoding="utf-8").splitlines()]
