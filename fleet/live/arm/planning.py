"""Planning of quotes on a thread of its own, so that no job delays the arm's messages."""

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence

from fleet.bus.protocol.auction import JobSpec
from fleet.live.arm.estimator import Estimator

PLANNING_S, POLL_S = 0.3, 0.05
"""Real seconds that one reply may wait for plans, as long as waiting takes less than half of all time; and between two
looks at what else is due."""
MAX_QUEUED = 256
"""Jobs that wait to be planned; the oldest of a queue that is full is dropped, and has to be requested again."""
IDLE_S = 5.0
"""Real seconds without work after which the thread ends, until there is work again."""
Key = tuple[JobSpec, int]


class PlanningThread:
    """Plans and scores jobs, those of an auction before those of dry runs.

    A plan has bounded size and time: `fleet.job.BOUNDS` and `check_dwell` limit the samples, `Estimator` the time and
    the memory of what it keeps. Only this thread calls `Estimator.prepare`.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._queues: tuple[OrderedDict[Key, None], OrderedDict[Key, None]] = (OrderedDict(), OrderedDict())
        """Jobs and their cycles that are done, oldest first: of auctions, and of dry runs."""
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._waits_from_s = -math.inf
        """Real second from which `plan` may wait again."""

    def plan(self, jobs: Sequence[Key], step: Callable[[], None], *, dry_run: bool = False) -> None:
        """Plan jobs, each with the number of its cycles that are done: now if it is quick, else after the return.

        Args:
            step: Called at least every `POLL_S` while this waits for the plans.
        """
        self._request(jobs, dry_run=dry_run)
        start_s = time.monotonic()
        until_s = start_s + PLANNING_S if start_s >= self._waits_from_s else start_s
        self._waits_from_s = max(self._waits_from_s, until_s)  # also for what `step` plans
        while (now_s := time.monotonic()) < until_s and not all(self._estimator.is_prepared(*job) for job in jobs):
            with self._changed:
                self._changed.wait(min(until_s - now_s, POLL_S))
            step()
        if until_s > start_s:
            self._waits_from_s = 2.0 * time.monotonic() - start_s

    def _request(self, jobs: Iterable[Key], *, dry_run: bool) -> None:
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
