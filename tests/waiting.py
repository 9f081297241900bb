"""Waiting with a deadline for what other threads and processes bring about."""

import threading
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

PATIENCE_S = 120.0
"""Seconds until a wait fails: so many that a slow, busy machine passes."""
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
    deadline_s = time.monotonic() + patience_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "waited in vain"
        for link in links:
            link.serve(time.monotonic() + 0.02)
    return value
