"""Processes for independent units of work, on this machine or a Ray cluster; units of a process that dies are rerun.

The processes end soon after the one that started them, also if that is killed.
"""

import os
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

from joblib import cpu_count
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.backend import get_context
from joblib.externals.loky.process_executor import BrokenProcessPool

from fleet.errors import FleetError

PARENT_CHECK_S = 1.0
"""Seconds between two checks of a worker that its parent still runs."""
MOST_DEATHS = 3
"""Number of processes that may exit during a unit before it is abandoned."""
IDLE_S = 120.0
"""Seconds after which an idle process ends."""
Result = TypeVar("Result", covariant=True)  # of protocols and of frozen values


@dataclass(frozen=True, eq=False)
class WorkUnit(Generic[Result]):
    """Base of a piece of work for one process."""

    deaths: int = field(default=0, kw_only=True)
    """Number of processes that died during it."""

    @property
    def name(self) -> str:
        """Name in a sentence about a process that died."""
        raise NotImplementedError

    @property
    def group(self) -> object:
        """Units of one group share what a process caches, such as a prepared fleet, and start in their order."""
        return "all"

    def __call__(self) -> Result:
        """Compute the result, in any process."""
        raise NotImplementedError

    def after_death(self) -> "Sequence[WorkUnit[Result]]":
        """The same work, perhaps in smaller units, each with one death more."""
        return [replace(self, deaths=self.deaths + 1)]

    def given_up(self) -> Result:
        """Result after `MOST_DEATHS`."""
        raise FleetError(f"The process that ran {self.name} died {MOST_DEATHS} times.")


class Worker(Protocol):
    """A process that runs one unit at a time."""

    def submit(self, work: WorkUnit[Result]) -> "Future[Result]":
        """Start a unit."""
        ...

    def died(self, error: BaseException) -> bool:
        """Whether an error of a unit means that the process died."""
        ...

    def renew(self) -> bool:
        """Replace a process that died; False if there is no resource for another."""
        ...

    def close(self) -> None:
        """End the process."""
        ...


class LocalWorker:
    """A process on this machine.

    Args:
        threads: Number of threads of its numerical libraries.
    """

    def __init__(self, threads: int = 1) -> None:
        self._threads = threads
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        how = {"context": get_context("loky"), "env": {"OMP_NUM_THREADS": str(self._threads)}, "timeout": IDLE_S}
        return ProcessPoolExecutor(1, initializer=_begin, initargs=(os.getpid(),), **how)

    def submit(self, work: WorkUnit[Result]) -> "Future[Result]":
        # A process that was idle, or has grown, may end just as it gets the work. loky starts another and warns on its
        # own thread, which would end where warnings are errors.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
        return self._pool.submit(work)

    def died(self, error: BaseException) -> bool:
        return isinstance(error, BrokenProcessPool)

    def renew(self) -> bool:
        self.close()
        self._pool = self._new()
        return True

    def close(self) -> None:
        self._pool.shutdown(wait=True, kill_workers=True)


class Queue(Generic[Result]):
    """Waiting units by group: a worker stays with its group until that is empty."""

    def __init__(self, works: Iterable[WorkUnit[Result]]) -> None:
        self._groups: dict[object, deque[WorkUnit[Result]]] = {}
        for work in works:
            self._groups.setdefault(work.group, deque()).append(work)
        self._untouched = deque(self._groups)

    def __bool__(self) -> bool:
        return bool(self._groups)

    def take(self, group: object = None) -> WorkUnit[Result]:
        """The next unit for a worker of this group: of this group, else of one that no worker has started, else of the
        largest."""
        if group not in self._groups:
            group = next((each for each in self._untouched if each in self._groups), None)
            group = group or max(self._groups, key=lambda each: len(self._groups[each]))
        if group in self._untouched:
            self._untouched.remove(group)
        work = self._groups[group].popleft()
        if not self._groups[group]:
            del self._groups[group]
        return work

    def put_back(self, works: Sequence[WorkUnit[Result]]) -> None:
        """Put units at the head of their groups."""
        for work in reversed(works):
            self._groups.setdefault(work.group, deque()).appendleft(work)


def run_all(
    queue: Queue[Result], workers: Sequence[Worker], tell: Callable[[str], None] = lambda sentence: None
) -> Iterator[tuple[WorkUnit[Result], Result]]:
    """Every unit with its result, in the order of completion.

    Args:
        workers: Closed by the caller.
        tell: Receives a sentence about each process that dies.

    Raises:
        FleetError: no worker is left.
        Exception: raised by a unit.
    """
    idle, groups = list(workers), {}
    running: dict[Future[Result], tuple[Worker, WorkUnit[Result]]] = {}
    while queue or running:
        while queue and idle:
            worker = idle.pop(0)
            work = queue.take(groups.get(id(worker)))
            groups[id(worker)] = work.group
            running[worker.submit(work)] = worker, work
        if not running:
            raise FleetError("No process is left to run the shifts: all of them died.")
        ended, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in ended:
            worker, work = running.pop(future)
            error = future.exception()
            if error is None:
                idle.append(worker)
                yield work, future.result()
            elif not worker.died(error):
                raise getattr(error, "cause", None) or error
            else:
                if worker.renew():
                    idle.append(worker)
                again = work.deaths + 1 < MOST_DEATHS
                tell(f"A process died that ran {work.name}: {'run again' if again else 'given up'}.")
                if again:
                    queue.put_back(work.after_death())
                else:
                    yield work, work.given_up()


@dataclass(frozen=True, eq=False)
class Call(WorkUnit[Result]):
    """A call of a function as a unit of work."""

    number: int
    """Index among the calls."""
    function: Callable[..., Result]
    arguments: Sequence[Any]
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return getattr(self.function, "__qualname__", repr(self.function))

    def __call__(self) -> Result:
        return self.function(*self.arguments, **self.options)


Delayed = tuple[Callable[..., Any], Sequence[Any], dict[str, Any]]
"""A call as `joblib.delayed(function)(…)` returns it (Any: of any signature)."""
_kept: dict[int, list[LocalWorker]] = {}
"""Idle processes, by their number of threads."""
_is_worker = False


@contextmanager
def worker_processes(count: int, *, in_order: bool = False) -> Iterator[Callable[[Iterable[Delayed]], Iterator[Any]]]:
    """A function that runs calls on `count` processes and yields their results, as they complete or in order.

    Processes stay idle for some time, for the next use. Inside a worker, calls run in that worker.
    """

    def pool(calls: Iterable[Delayed]) -> Iterator[Any]:
        if count == 1 or _is_worker:
            for function, arguments, options in calls:
                yield function(*arguments, **options)
            return
        works = [Call(n, *each) for n, each in enumerate(calls)]
        threads = max(1, cpu_count() // count)
        kept = _kept.setdefault(threads, [])
        workers = [kept.pop() if kept else LocalWorker(threads) for _ in range(min(count, len(works)))]
        results = run_all(Queue(works), workers)
        try:
            yield from _in_order(results) if in_order else (result for _, result in results)
        except BaseException:  # an interruption, or a caller that stops early
            for worker in workers:
                worker.close()
            raise
        kept.extend(workers)

    yield pool


def _in_order(results: Iterator[tuple[WorkUnit[Any], Any]]) -> Iterator[Any]:
    """Results of calls, in the order of their numbers."""
    ready: dict[int, Any] = {}
    coming = 0
    for call, result in results:
        assert isinstance(call, Call)
        ready[call.number] = result
        while coming in ready:
            yield ready.pop(coming)
            coming += 1


def _begin(parent: int) -> None:
    """Mark this process as a worker that ends with its parent."""
    global _is_worker
    _is_worker = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the parent, which ends its workers
    end_with(parent)


def end_with(parent: int) -> None:
    """End this process soon after its parent, also in the middle of a unit."""
    pause = threading.Event()  # never set

    def watch() -> None:
        while os.getppid() == parent:
            pause.wait(PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
