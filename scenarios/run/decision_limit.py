"""A limit on the time that a policy may take for a decision."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

DECISION_LIMIT_S = 60.0
"""Longest time of a decision by default."""
AGAIN_S = 1.0
"""An alarm is repeated, in case the policy catches the first one."""
MOST_CAUGHT = 5
"""Alarms of one decision that a policy may catch; at the next one the process ends."""


class TooSlow(BaseException):
    """A decision took too long; no `Exception`, so that a policy does not catch it by accident."""


class DecisionLimit:
    """Ends decisions that take longer than `limit_s`, s of real time; None for no limit.

    In the main thread of a process an alarm interrupts Python code. Elsewhere, and in libraries that do not return, a
    decision is only found too slow when it ends. A policy that catches every alarm can be ended only with its process.
    """

    def __init__(self, limit_s: float | None) -> None:
        self.limit_s = limit_s
        self._rung = 0
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
        began_s, self._rung = time.monotonic(), 0
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
        self._rung += 1
        if self._rung > MOST_CAUGHT:
            text = f"A decision took longer than {self.limit_s:g} s, and the policy catches what should end it; "
            os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{text}its process ends.\n".encode())
            os._exit(1)
        raise TooSlow(f"a decision took longer than {self.limit_s:g} s (--decision-limit)")


UNLIMITED = DecisionLimit(None)
