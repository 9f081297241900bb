"""Reconstruction error against epochs: a separate training for each number of epochs and seed on a short record.

The paper's table (E. Guiffo Kaigom, arXiv 2509.12740): errors fall with epochs, not always, and velocity is hardest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from joblib import cpu_count, delayed

from scenarios.processes import worker_processes
from scenarios.progress import Progress, quiet
from twin.vae.config import TwinConfig
from twin.vae.train import train
from twin.vae.window import windows_of

Array = np.ndarray

EPOCHS = (20, 40, 60, 120, 240)
RECORDS = 5
"""Jobs of the record: few enough that more epochs still help."""


@dataclass(frozen=True, eq=False)
class EpochStudy:
    """Mean absolute reconstruction errors in z units, from the posterior mean, averaged over windows."""

    epochs: tuple[int, ...]
    windows: int
    """In the training record, of one seed on average."""
    trained_on: Array
    """On the training record, [seed, epochs, joint, channel]."""
    held_out: Array
    """On other records of the same kind, [seed, epochs, joint, channel]."""

    def rising(self, joint: int) -> Array:
        """Share of seeds whose error rises somewhere with more epochs, [trained on/held out, channel]."""
        errors = np.stack([self.trained_on[:, :, joint], self.held_out[:, :, joint]])
        return (np.diff(errors, axis=2) > 0).any(axis=2).mean(axis=1)


def epoch_study(
    jobs: Sequence[Sequence[Array]],
    *,
    epochs: Sequence[int] = EPOCHS,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    config: TwinConfig | None = None,
    records: int = RECORDS,
    workers: int = -1,
    progress: Progress = quiet,
) -> EpochStudy:
    """Train a new twin for every number of epochs and seed; each seed draws the jobs of its record.

    Args:
        jobs: Profiles [time, 3, joint] of the phases of each job, all cool; at least twice `records` of them.
        records: Jobs that make up a record.
        config: Of the twins; by default one restart, because the paper has none. A collapse is a result too.
        workers: Processes, -1 for one per core; the result does not depend on it.

    Raises:
        ValueError: too few jobs, or no epochs or seeds.
    """
    if records < 1 or len(jobs) < 2 * records:
        raise ValueError(f"The epoch table needs {2 * max(records, 1)} cool jobs or more (got {len(jobs)}).")
    if not epochs or not seeds or min(epochs) < 1:
        raise ValueError(f"The epoch table needs seeds, and epochs >= 1 (got {seeds!r}, {epochs!r}).")
    base = replace(config or TwinConfig(restarts=1), allow_collapse=True)
    # Longest first, so that no core ends with a long training alone.
    tasks = sorted(product(range(len(seeds)), range(len(epochs))), key=lambda task: -epochs[task[1]])
    cells = (delayed(_cell)(jobs, replace(base, epochs=epochs[e]), seeds[s], records) for s, e in tasks)
    total, done, results = len(seeds) * sum(epochs), 0, []
    with worker_processes(min(len(tasks), cpu_count()) if workers < 0 else workers, in_order=True) as pool:
        for (_, e), result in zip(tasks, pool(cells), strict=True):
            results.append(result)
            done += epochs[e]
            progress("epoch table", done / total)
    errors = np.empty((2, len(seeds), len(epochs), *results[0][0].shape[1:]))
    for (s, e), (cell, _) in zip(tasks, results, strict=True):
        errors[:, s, e] = cell
    windows = round(float(np.mean([count for _, count in results])))
    return EpochStudy(tuple(epochs), windows, errors[0], errors[1])


def _cell(jobs: Sequence[Sequence[Array]], config: TwinConfig, seed: int, records: int) -> tuple[Array, int]:
    """Errors [trained on/held out, joint, channel], and the number of windows trained on."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    chosen = rng.permutation(len(jobs))
    record, others = (
        [phase for i in some for phase in jobs[i] if len(phase)]
        for some in (chosen[:records], chosen[records : 5 * records])
    )
    twin = train(record, config, np.random.SeedSequence(seed), arm="epochs")
    windows = [windows_of(part, config) for part in (record, others)]
    return np.stack([twin.window_errors(part).mean(axis=0) for part in windows]), len(windows[0])
