"""Evolution strategy with antithetic samples (ranked fitness, followed by Adam), and length and log of a training.

Sources: Salimans et al., arXiv 1703.03864 (antithetic samples, ranked fitness, common random numbers); Kingma & Ba,
ICLR 2015 (Adam); Polyak & Juditsky, SIAM Journal on Control and Optimization 30, 1992 (average of the iterates).
"""

import json
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from fleet.errors import CheckpointError
from fleet.files import atomic_path

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class EvolutionConfig:
    """Hyperparameters."""

    samples: int = 32
    """Samples of an iteration, even: half of them mirror the others."""
    deviation: float = 0.1
    """Standard deviation of every parameter in a sample."""
    learning_rate: float = 0.02
    decay: int = 60
    """Iterations after which the learning rate is halved, then a third, and so on."""
    averaged: int = 8
    """Iterations in the running average, about."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 2 or self.samples % 2:
            raise ValueError(f"samples must be even and >= 2 (got {self.samples}).")
        for name in ("deviation", "learning_rate", "decay", "averaged"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be > 0 (got {getattr(self, name)}).")


class Evolution:
    """A search from a vector of parameters; its draws depend on the seed and the number of finished iterations."""

    def __init__(self, first: Array, config: EvolutionConfig) -> None:
        self.config, self.mean = config, np.array(first, dtype=float)
        self.average = self.mean.copy()
        """Running average of the mean, which has less noise: the result."""
        self.done = 0
        """Finished iterations."""
        self._first_moment, self._second_moment = np.zeros_like(self.mean), np.zeros_like(self.mean)

    def ask(self) -> Array:
        """Samples round the mean, [sample, parameter]; the second half mirrors the first."""
        return self.mean + self.config.deviation * self._noise()

    def tell(self, fitness: Array) -> None:
        """Move the mean by the fitness of the samples of `ask`, [sample]."""
        ranks = np.argsort(np.argsort(fitness)) / (len(fitness) - 1) - 0.5
        gradient = ranks @ self._noise() / (len(fitness) * self.config.deviation)
        self.done += 1
        self._first_moment += 0.1 * (gradient - self._first_moment)
        self._second_moment += 0.01 * (gradient**2 - self._second_moment)
        first = self._first_moment / (1.0 - 0.9**self.done)
        second = self._second_moment / (1.0 - 0.99**self.done)
        rate = self.config.learning_rate / (1.0 + self.done / self.config.decay)
        self.mean = self.mean + rate * first / (np.sqrt(second) + 1e-8)
        self.average += (self.mean - self.average) / min(self.done, self.config.averaged)

    def _noise(self) -> Array:
        rng = np.random.default_rng(np.random.SeedSequence([self.config.seed, 1, self.done]))
        half = rng.standard_normal((self.config.samples // 2, len(self.mean)))
        return np.concatenate([half, -half])

    def save(self, path: Path, **numbers: float) -> None:
        """Write the state of the search and some numbers atomically."""
        with atomic_path(path) as draft, draft.open("wb") as file:
            state = [self.mean, self.average, self._first_moment, self._second_moment]
            arrays: dict[str, Any] = {name: np.array(value) for name, value in numbers.items()}
            np.savez(file, state=np.array(state), done=np.array(self.done), **arrays)

    def load(self, path: Path) -> dict[str, float]:
        """Restore what `save` wrote, and return the numbers.

        Raises:
            CheckpointError: the file is damaged, or of another search.
        """
        try:
            with np.load(path, allow_pickle=False) as saved:
                found = {name: saved[name] for name in saved.files}
            state, done = found.pop("state"), int(found.pop("done"))
        except Exception as error:  # whatever it is, the file is damaged
            raise CheckpointError(f"{path}: the training cannot be resumed ({error}).") from error
        if state.shape != (4, len(self.mean)):
            raise CheckpointError(f"{path}: the training cannot be resumed: it has another number of parameters.")
        if not np.isfinite(state).all():
            raise CheckpointError(f"{path}: the training cannot be resumed: its state is not finite.")
        (self.mean, self.average, self._first_moment, self._second_moment), self.done = state, done
        return {name: float(value) for name, value in found.items()}


LOG, CURVE, BOARD = "progress.jsonl", "curve.png", "tensorboard"


class TrainingLog:
    """Rows of numbers in the folder of a training; a resumed training adds to them."""

    def __init__(self, folder: Path, done: int) -> None:
        """Prepare the log; rows of iterations after the number `done`, of a process that was killed, are removed."""
        self._path, self._board = folder / LOG, None
        rows = [row for row in read_log(folder) if row.get("number", row.get("iteration", 0)) <= done]
        with atomic_path(self._path) as draft:
            draft.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
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
    """The rows of a training, oldest first, without damaged lines, as a power cut leaves one; none without a file."""
    rows = list[dict[str, Any]]()
    path = folder / LOG
    for line in path.read_bytes().splitlines() if path.is_file() else ():
        with suppress(ValueError):
            row = json.loads(line)
            if isinstance(row, dict):
                rows.append(row)
    return rows
