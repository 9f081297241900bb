"""Stopping processes on Ctrl-C or SIGTERM."""

import select
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from fleet.errors import StoppedWaiting
from fleet.live.supervisor import exit_with_supervisor
from scenarios.terminal import Interrupted

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether a stop was requested, and by which signal.

    A signal that one of Zenoh's threads receives often does not wake a lock or queue on which the main thread waits.
    A socket into which the signal is written always does.
    """

    def __init__(self, receiver: socket.socket) -> None:
        self._receiver = receiver
        self._number = 0

    def is_set(self) -> bool:
        """Whether a stop was requested."""
        return self.wait(0.0)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a stop request; return whether there is one."""
        while not self._number and self._receiver.fileno() >= 0:  # closed after the block
            ready, _, _ = select.select([self._receiver], [], [], timeout_s)
            if not ready:
                return False
            self._number = next((number for number in self._receiver.recv(64) if number in NUMBERS), 0)
        return self._number > 0

    def leave(self, sentence: str) -> None:
        """After the cleanup, raise `Interrupted` with the sentence if the signal was Ctrl-C, and not SIGTERM."""
        if self.is_set() and self._number == signal.SIGINT:
            raise Interrupted(sentence)


@contextmanager
def until_stopped() -> Iterator[StopRequest]:
    """Turn Ctrl-C and SIGTERM into stop requests. Call it in the main thread.

    Raises:
        Interrupted: Ctrl-C while the block waited for a router or a fleet; SIGTERM then ends the process with code 0.
    """
    exit_with_supervisor()
    receiver, sender = socket.socketpair()
    with receiver, sender:
        sender.setblocking(False)
        before_fd = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        before = [signal.signal(number, lambda *_: None) for number in NUMBERS]
        stop = StopRequest(receiver)
        try:
            yield stop
        except StoppedWaiting as error:
            stop.leave(str(error))
            raise SystemExit(0) from error
        finally:
            stop.is_set()
            for number, handler in zip(NUMBERS, before, strict=True):
                signal.signal(number, handler)
            signal.set_wakeup_fd(before_fd)
