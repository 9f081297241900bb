"""A limit on the time that a policy may take for a decision."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

AGAIN_S = 1.0
"""An alarm is repeated, in case the policy catches the first one."""


class TooSlow(BaseException):
    """A decision took too long; no `Exception`, so that a policy does not catch it by accident."""


class DecisionLimit:
    """Ends decisions that take longer than `limit_s`, s of real time; None for no limit.

    In the main thread of a process an alarm interrupts Python code. Elsewhere, and in libraries that do not return, a
    decision is only found too slow when it ends.
    """

    def __init__(self, limit_s: float | None) -> None:
        self.limit_s = limit_s
        self._alarm = limit_s is not None and hasattr(signal, "setitimer")
        self._alarm = self._alarm and threading.current_thread() is threading.main_thread()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Take the alarm of the process until the end of the block."""
        if not self._alarm:
            yield
            return
        before = signal.signal(signal.SIGALRM, self._ring)
        try:
            yield
        finally:
            signal.signal(signal.SIGALRM, before)

    @contextmanager
    def decision(self) -> Iterator[None]:
        """Limit the block.

        Raises:
            TooSlow: it took too long.
        """
        if self.limit_s is None:
            yield
            return
        began_s = time.monotonic()
        if self._alarm:
            signal.setitimer(signal.ITIMER_REAL, self.limit_s, AGAIN_S)
        try:
            yield
        finally:
            if self._alarm:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
        if time.monotonic() - began_s > self.limit_s:
            self._ring()

    def _ring(self, *_: object) -> None:
        raise TooSlow(f"a decision took longer than {self.limit_s:g} s (--decision-limit)")
