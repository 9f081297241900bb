"""Ends of participants that run until they are told to stop: Ctrl-C or SIGTERM."""

import select
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from fleet.live.supervisor import end_with_supervisor
from scenarios.terminal import Interrupted

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """What was asked: an end, and by which signal.

    Zenoh has threads of its own, and a signal that one of them takes wakes no lock or queue that the main thread waits
    on: seen in every second try. A socket that the signal itself writes into always does.
    """

    def __init__(self, woken: socket.socket) -> None:
        self._woken = woken
        self._number = 0

    def is_set(self) -> bool:
        """Whether an end was asked for."""
        return self.wait(0.0)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until an end is asked for; whether it was."""
        while not self._number and self._woken.fileno() >= 0:  # it is closed after the block
            ready, _, _ = select.select([self._woken], [], [], timeout_s)
            if not ready:
                return False
            self._number = next((number for number in self._woken.recv(64) if number in NUMBERS), 0)
        return self._number > 0

    def leave(self, sentence: str) -> None:
        """After everything is in order: the sentence and exit code 130 for Ctrl-C, nothing for SIGTERM.

        Raises:
            Interrupted: it was Ctrl-C.
        """
        if self.is_set() and self._number == signal.SIGINT:
            raise Interrupted(sentence)


@contextmanager
def until_stopped() -> Iterator[Stop]:
    """Ctrl-C and SIGTERM ask for an end instead of breaking off; in the main thread only."""
    end_with_supervisor()
    woken, waker = socket.socketpair()
    with woken, waker:
        waker.setblocking(False)
        before_fd = signal.set_wakeup_fd(waker.fileno(), warn_on_full_buffer=False)
        before = [signal.signal(number, lambda *_: None) for number in NUMBERS]
        stop = Stop(woken)
        try:
            yield stop
        finally:
            stop.is_set()
            for number, handler in zip(NUMBERS, before, strict=True):
                signal.signal(number, handler)
            signal.set_wakeup_fd(before_fd)
