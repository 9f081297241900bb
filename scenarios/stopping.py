"""Ends of participants that run until they are told to stop: Ctrl-C or SIGTERM."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue

from fleet.live.supervisor import end_with_supervisor
from scenarios.terminal import Interrupted


class Stop:
    """What was asked: an end, and by which signal."""

    def __init__(self) -> None:
        self._asked: SimpleQueue[int] = SimpleQueue()  # the one thing that a signal handler may safely put into

    def is_set(self) -> bool:
        """Whether an end was asked for."""
        return not self._asked.empty()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until an end is asked for; whether it was."""
        try:
            self._asked.put(self._asked.get(timeout=timeout_s))
        except Empty:
            return False
        return True

    def leave(self, sentence: str) -> None:
        """After everything is in order: the sentence and exit code 130 for Ctrl-C, nothing for SIGTERM.

        Raises:
            Interrupted: it was Ctrl-C.
        """
        if self.is_set() and self._asked.get() == signal.SIGINT:
            raise Interrupted(sentence)

    def note(self, number: int) -> None:
        """Ask for an end, as the signal of this number."""
        self._asked.put(number)


@contextmanager
def until_stopped() -> Iterator[Stop]:
    """Ctrl-C and SIGTERM ask for an end instead of breaking off; in the main thread only."""
    end_with_supervisor()
    stop = Stop()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda which, _frame: stop.note(which)) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
