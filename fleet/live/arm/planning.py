"""Planning of quotes on a thread of its own, so that no job delays the arm's messages."""

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable

from fleet.bus.protocol.auction import JobSpec
from fleet.live.arm.estimator import Estimator

MAX_QUEUED = 256
"""Jobs that wait to be planned; the oldest of a queue that is full is dropped, and has to be requested again."""
IDLE_S = 5.0
"""Real seconds without work after which the thread ends, until there is work again."""
Key = tuple[JobSpec, int]


class PlanningThread:
    """Plans and scores jobs, those of an auction before those of dry runs.

    Nothing can interrupt a plan, but its size is bounded: `fleet.job.BOUNDS` and `check_dwell` limit the samples, and
    `Estimator` the memory of what it keeps. Only this thread calls `Estimator.prepare`.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._queues: tuple[OrderedDict[Key, None], OrderedDict[Key, None]] = (OrderedDict(), OrderedDict())
        """Jobs and their cycles that are done, oldest first: of auctions, and of dry runs."""
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def request(self, jobs: Iterable[Key], *, dry_run: bool = False) -> None:
        """Plan jobs soon, each with the number of its cycles that are done."""
        with self._changed:
            queue = self._queues[dry_run]
            for key in jobs:
                queue[key] = None
                if len(queue) > MAX_QUEUED:
                    queue.popitem(last=False)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="planning", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def wait(self, until_s: float) -> bool:
        """Whether a job is planned, or all are, before `time.monotonic()` is `until_s`."""
        with self._changed:
            return self._changed.wait(max(0.0, until_s - time.monotonic()))

    def _run(self) -> None:
        while True:
            with self._changed:
                queue = next(filter(None, self._queues), None)
                if queue is None:
                    if self._changed.wait(IDLE_S) or any(self._queues):
                        continue
                    self._thread = None
                    return
                job, done = next(iter(queue))
            self._estimator.prepare(job, done)
            with self._changed:
                queue.pop((job, done), None)
                self._changed.notify_all()
