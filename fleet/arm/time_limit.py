"""A limit on the processor time that one plan may take, checked between the pieces of the work.

Each thread has its own. A process that was stopped, or had to wait for others, loses none of it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import thread_time


class PlanningTimeout(Exception):
    """A plan exceeded `time_limit`."""


_limit: ContextVar[tuple[float, float] | None] = ContextVar("planning_limit", default=None)
"""Length, s, and end in processor time of the thread, s."""


@contextmanager
def time_limit(limit_s: float) -> Iterator[None]:
    """Limit the processor time of the block in this thread, s: afterwards `check_time` raises."""
    token = _limit.set((limit_s, thread_time() + limit_s))
    try:
        yield
    finally:
        _limit.reset(token)


def check_time() -> None:
    """Check the time limit of this thread, if there is one.

    Raises:
        PlanningTimeout: the limit has passed.
    """
    if (limit := _limit.get()) is not None and thread_time() > limit[1]:
        raise PlanningTimeout(f"planning took more than {limit[0]:g} s of processor time")
