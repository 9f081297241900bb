"""Run a study: here in the first seconds, then on many processes, with its rows in memory or in a folder."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Protocol

from joblib import cpu_count

from fleet.files import cache_folder
from scenarios.extras import require_extra
from scenarios.policy_loader import is_built_in
from scenarios.progress import Count, Progress, quiet
from scenarios.trials import run_unit as here
from scenarios.trials.fleets import warm
from scenarios.trials.plan import Key, Row, Study, Unit
from scenarios.trials.run_unit import Settings, run_unit
from scenarios.trials.workers import LocalWorker, Queue, Worker, run_units

HERE_S = 5.0
"""About the time that a worker process takes to start. This process does work that takes no longer, but runs no code of
users, which might end it."""


class Rows(Protocol):
    """Where rows go."""

    rows: dict[Key, Row]

    def add(self, rows: list[Row]) -> None:
        """Take the rows of a unit."""
        ...


class Memory:
    """Rows in memory."""

    def __init__(self) -> None:
        self.rows: dict[Key, Row] = {}

    def add(self, rows: list[Row]) -> None:
        """Take the rows of a unit."""
        self.rows |= {row.key: row for row in rows}


def run_study(
    study: Study,
    *,
    out: Path | None = None,
    cache_dir: Path | None = None,
    workers: int = -1,
    ray: str | None = None,
    progress: Progress = quiet,
    tell: Callable[[str], None] = lambda sentence: None,
) -> list[Row]:
    """The rows of a study, in the order of its keys.

    Args:
        out: Folder of the rows; those that are in it are not run again.
        workers: Processes, if there is work for more than some seconds; -1 for one per core. The rows do not depend
            on it.
        ray: Address of a Ray cluster to run on instead.
        tell: Called with a sentence about each process that dies.

    Raises:
        FleetError: a fleet cannot be prepared, the folder holds something else, or the cluster cannot be reached.
        MissingExtra: a library is not installed.
    """
    wanted = [key for unit in study.units(set()) for key in unit.keys]
    with _opened(study, out) as store:
        # The largest first, so that processes end together; what shares plans follows.
        units = sorted(study.units(set(store.rows)), key=lambda unit: (-unit.size, unit.cell))
        folder = cache_dir or cache_folder()  # here: a worker may have started with another one
        if ray is None or "twin" in study.difficulties:  # other machines may have caches of their own
            warm(units, study, folder, here.fleets, progress)
        settings = Settings.of(study, cache_dir if ray else folder)
        done = len(wanted) - sum(len(unit.case.seeds) for unit in units)
        for rows in _run(units, settings, workers, ray, tell):
            store.add(rows)
            done += len(rows)
            progress("comparing", Count(done, len(wanted)))
        return [store.rows[key] for key in wanted]


def _opened(study: Study, out: Path | None) -> AbstractContextManager[Rows]:
    if out is None:
        return nullcontext(Memory())
    require_extra("report")
    from scenarios.trials.store import opened

    return opened(out, study.card)


def _run(
    units: list[Unit], settings: Settings, workers: int, ray: str | None, tell: Callable[[str], None]
) -> Iterator[list[Row]]:
    """The rows of each unit."""
    began_s, todo, left_s = time.monotonic(), list(units), 0.0
    whole = left = sum(unit.size for unit in units)
    while todo and not ray and is_built_in(todo[0].played) and (workers == 1 or left_s < HERE_S):
        unit = todo.pop(0)
        yield run_unit(unit, settings)
        left -= unit.size
        left_s = (time.monotonic() - began_s) * left / (whole - left)
    if todo:
        yield from run_units(Queue(todo), _workers(workers, ray, settings, len(todo)), tell)


def _workers(count: int, ray: str | None, settings: Settings, most: int) -> list[Worker]:
    if ray is None:
        return [LocalWorker(settings) for _ in range(min(count if count > 0 else cpu_count(), most))]
    require_extra("ray")
    from scenarios.trials.ray_workers import ray_workers

    return list(ray_workers(ray, settings))
