"""Waiting with a deadline for other threads and processes, and serving bus clients on a thread."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar

PATIENCE_S = 120.0
"""Seconds until a wait fails; long enough for a slow, busy machine."""
PAUSE = threading.Event()
"""Never set: `PAUSE.wait(seconds)` passes time."""
T = TypeVar("T")


class Served(Protocol):
    """A `BusClient`, or what is served as one."""

    def serve(self, until_s: float) -> object: ...


def wait_until(
    condition: Callable[[], T], meanwhile: Callable[[], object] = lambda: None, *, patience_s: float = PATIENCE_S
) -> T:
    """Return the first true value of a condition; call `meanwhile` and pause for 20 ms before every other look.

    Raises:
        AssertionError: it is not true within `patience_s`.
    """
    deadline_s = time.monotonic() + patience_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "waited in vain"
        meanwhile()
        PAUSE.wait(0.02)
    return value


def serve_until(condition: Callable[[], T], *links: Served, patience_s: float = PATIENCE_S) -> T:
    """Serve all links until a condition is true; return its value.

    Raises:
        AssertionError: it is not true within `patience_s`.
    """

    def serve() -> None:
        for link in links:
            link.serve(time.monotonic() + 0.02)

    return wait_until(condition, serve, patience_s=patience_s)


@contextmanager
def serving(*links: Served, meanwhile: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Serve links on a thread until the end of the block; call `meanwhile` before each turn."""
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            meanwhile()
            for link in links:
                link.serve(time.monotonic() + 0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
