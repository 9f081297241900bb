"""Reconstruction error against epochs: a separate training for each number of epochs and seed on a short record.

The paper's table (E. Guiffo Kaigom, arXiv 2509.12740): errors fall with epochs, not always, and velocity is hardest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, cpu_count, delayed

from twin.vae.model import TwinConfig
from twin.vae.train import train
from twin.vae.window import windows_of

Array = np.ndarray

EPOCHS = (20, 40, 60, 120, 240)
RECORDS = 5
"""Jobs of the record: so few that more epochs still help."""


@dataclass(frozen=True, eq=False)
class EpochStudy:
    """Mean absolute reconstruction errors in z units, from the posterior mean, averaged over windows."""

    epochs: tuple[int, ...]
    seeds: tuple[int, ...]
    windows: int
    """In the training record, of one seed on average."""
    known: Array
    """On the training record, [seed, epochs, joint, channel]."""
    held_out: Array
    """On other records of the same kind, [seed, epochs, joint, channel]."""

    def table(self, joint: int | None = None) -> tuple[Array, Array]:
        """Known and held-out errors [seed, epochs, channel]: of one joint (0-based), or the mean over all."""
        if joint is None:
            return self.known.mean(axis=2), self.held_out.mean(axis=2)
        return self.known[:, :, joint], self.held_out[:, :, joint]

    def rising(self, joint: int | None = None) -> Array:
        """Share of seeds whose error rises somewhere from one number of epochs to the next, [known/held, channel]."""
        return np.stack([(np.diff(errors, axis=1) > 0).any(axis=1).mean(axis=0) for errors in self.table(joint)])


def epoch_study(
    jobs: Sequence[Sequence[Array]],
    *,
    epochs: Sequence[int] = EPOCHS,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    config: TwinConfig | None = None,
    records: int = RECORDS,
    workers: int = -1,
    progress: Callable[[str, float], None] = lambda stage, share: None,
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
    tasks = [(seed, count) for seed in seeds for count in epochs]
    cells = []
    # Longest first, so that no core ends with a long training alone.
    order = sorted(range(len(tasks)), key=lambda i: -tasks[i][1])
    work = (delayed(_cell)(jobs, replace(base, epochs=tasks[i][1]), tasks[i][0], records) for i in order)
    total, done = sum(count for _, count in tasks), 0
    with Parallel(n_jobs=min(len(tasks), cpu_count()) if workers < 0 else workers, return_as="generator") as pool:
        for i, cell in zip(order, pool(work), strict=True):
            cells.append((i, cell))
            done += tasks[i][1]
            progress("epoch table", done / total)
    ordered = [cell for _, cell in sorted(cells, key=lambda pair: pair[0])]
    shape = (len(seeds), len(epochs))
    known, held = (np.stack([cell[k] for cell in ordered]).reshape(*shape, *ordered[0][k].shape) for k in range(2))
    windows = round(float(np.mean([cell[2] for cell in ordered])))
    return EpochStudy(tuple(epochs), tuple(seeds), windows, known, held)


def _cell(jobs: Sequence[Sequence[Array]], config: TwinConfig, seed: int, records: int) -> tuple[Array, Array, int]:
    """Errors on the training record and on other jobs, [joint, channel], and the windows trained on."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
    chosen = rng.permutation(len(jobs))
    taught = [phase for i in chosen[:records] for phase in jobs[i] if len(phase)]
    others = [phase for i in chosen[records : 5 * records] for phase in jobs[i] if len(phase)]
    twin = train(taught, config, np.random.SeedSequence(seed), arm="epochs")
    seen, new = (windows_of(part, config) for part in (taught, others))
    return twin.window_errors(seen).mean(axis=0), twin.window_errors(new).mean(axis=0), len(seen)
