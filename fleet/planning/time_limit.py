"""A limit on the time that one plan may take, checked between the pieces of the work; each thread has its own.

It counts processor time of the thread: a process that was stopped, or had to wait for others, loses none of it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import thread_time


class PlanningTimeout(Exception):
    """A plan took longer than `time_limit` allows."""


_limit: ContextVar[tuple[float, float] | None] = ContextVar("planning_limit", default=None)
"""Length, s, and end in processor time of the thread, s."""


@contextmanager
def time_limit(limit_s: float) -> Iterator[None]:
    """Have `check_time` raise in this thread once the block has taken this long, seconds of processor time."""
    token = _limit.set((limit_s, thread_time() + limit_s))
    try:
        yield
    finally:
        _limit.reset(token)


def check_time() -> None:
    """Go on if there is time left, or no limit.

    Raises:
        PlanningTimeout: the limit has passed.
    """
    if (limit := _limit.get()) is not None and thread_time() > limit[1]:
        raise PlanningTimeout(f"planning took more than {limit[0]:g} s of processor time")
