"""Run units on several processes, here or on a Ray cluster; those of a process that dies are run again."""

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import replace
from typing import Protocol

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.backend import get_context
from joblib.externals.loky.process_executor import BrokenProcessPool

from fleet.errors import FleetError
from scenarios.processes import end_with
from scenarios.trials.plan import Row, Unit
from scenarios.trials.run_unit import Settings, died, run_unit

MOST_DEATHS = 3
"""Processes that may exit during a unit before its shifts have failed."""


IDLE_S = 120.0
"""A process without work ends after this time."""


class Worker(Protocol):
    """One process that runs a unit at a time."""

    def submit(self, unit: Unit) -> "Future[list[Row]]":
        """Begin a unit."""
        ...

    def died(self, error: BaseException) -> bool:
        """Whether an error of a unit says that the process died."""
        ...

    def renew(self) -> bool:
        """Replace a process that died; False if there is no place for another."""
        ...

    def close(self) -> None:
        """End the process."""
        ...


class LocalWorker:
    """A process of this machine."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        how = {"context": get_context("loky"), "env": {"OMP_NUM_THREADS": "1"}, "timeout": IDLE_S}
        return ProcessPoolExecutor(1, initializer=end_with, initargs=(os.getpid(),), **how)

    def submit(self, unit: Unit) -> "Future[list[Row]]":
        """Begin a unit."""
        return self._pool.submit(run_unit, unit, self._settings)

    def died(self, error: BaseException) -> bool:
        """Whether an error of a unit says that the process died."""
        return isinstance(error, BrokenProcessPool)

    def renew(self) -> bool:
        """Replace a process that died."""
        self.close()
        self._pool = self._new()
        return True

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=True, kill_workers=True)


class Queue:
    """Units that wait, in groups that share a fleet: a worker stays with its group while there is work in it."""

    def __init__(self, units: Sequence[Unit]) -> None:
        self._groups: dict[object, deque[Unit]] = {}
        for unit in units:
            self._groups.setdefault(unit.group, deque()).append(unit)
        self._untouched = deque(self._groups)

    def __bool__(self) -> bool:
        return bool(self._groups)

    def take(self, group: object = None) -> Unit:
        """The next unit for a worker that has the fleet of this group: of this group, of one that no worker has begun,
        or of the one with most left."""
        if group not in self._groups:
            group = next((each for each in self._untouched if each in self._groups), None)
            group = group or max(self._groups, key=lambda each: len(self._groups[each]))
        if group in self._untouched:
            self._untouched.remove(group)
        unit = self._groups[group].popleft()
        if not self._groups[group]:
            del self._groups[group]
        return unit

    def put_back(self, unit: Unit) -> None:
        """Run it next, shift by shift: its process died, and it may be of one shift only."""
        parts = [replace(unit, case=replace(unit.case, seeds=(seed,))) for seed in unit.case.seeds]
        self._groups.setdefault(unit.group, deque()).extendleft(reversed(parts))


def run_units(queue: Queue, workers: Sequence[Worker], tell: Callable[[str], None]) -> Iterator[list[Row]]:
    """The rows of every unit, in the order in which they end.

    Args:
        workers: Closed at the end.
        tell: Called with a sentence about each process that dies.

    Raises:
        FleetError: as `run_unit`, or no worker is left.
    """
    idle, groups = list(workers), {}
    running: dict[Future[list[Row]], tuple[Worker, Unit]] = {}
    try:
        while queue or running:
            while queue and idle:
                worker = idle.pop(0)
                unit = queue.take(groups.get(id(worker)))
                groups[id(worker)] = unit.group
                running[worker.submit(unit)] = worker, unit
            if not running:
                raise FleetError("No process is left to run the shifts: all of them died.")
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                worker, unit = running.pop(future)
                error = future.exception()
                if error is None:
                    idle.append(worker)
                    yield future.result()
                elif not worker.died(error):
                    raise getattr(error, "cause", None) or error
                else:
                    unit = replace(unit, deaths=unit.deaths + 1)
                    again = unit.deaths < MOST_DEATHS
                    if worker.renew():
                        idle.append(worker)
                    where = f"'{unit.policy}' on {unit.case.name}, seed {unit.case.seeds[0]}"
                    tell(f"A process died that ran {where}: {'run again' if again else 'given up'}.")
                    if again:
                        queue.put_back(unit)
                    else:
                        yield died(unit)
    finally:
        for worker in workers:
            worker.close()
