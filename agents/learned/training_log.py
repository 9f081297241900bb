"""The log of a training: JSON lines, and TensorBoard by TorchRL's logger where both are installed."""

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

LOG, BOARD = "progress.jsonl", "tensorboard"


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
