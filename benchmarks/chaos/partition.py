"""A cut between some arms and the router, and its healing: nothing goes through, and nobody is told.

Where root is, the arms live in network namespaces (`namespaces`) and their cables are pulled. Elsewhere they reach the
router through a line of ours. While it is cut nothing is read from either end: no end sees a reset, new connections are
taken up by the system and say nothing.
"""

import selectors
import socket
import threading
from contextlib import suppress
from dataclasses import replace
from typing import Self

from namespaces import Namespaces
from struck import Fleet

from fleet.live.supervisor import Part

CUT_S = 12.0
"""Longer than a lease: what the arms have in hand may be given to others."""
_LOOK_S = 0.05


class Line:
    """`with Line(port) as line:` hands everything that comes to `line.port` on to another port, until it is cut."""

    by = "line"

    def __init__(self, to_port: int) -> None:
        self._to, self._listener = ("127.0.0.1", to_port), socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._whole, self._end = threading.Event(), threading.Event()
        self._whole.set()
        self._other: dict[socket.socket, socket.socket] = {}
        self._ready = selectors.DefaultSelector()
        self._thread = threading.Thread(target=self._carry, name="line")

    def __enter__(self) -> Self:
        self._ready.register(self._listener, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._whole.set()
        self._thread.join(10.0)
        for end in (*self._other, self._listener):
            end.close()
        self._ready.close()

    def through(self, part: Part, _arm: str) -> Part:
        """The part, reaching the router through this line."""
        there, here = f"127.0.0.1:{self._to[1]}", f"127.0.0.1:{self.port}"
        return replace(part, argv=tuple(word.replace(there, here) for word in part.argv))

    def cut(self) -> None:
        """From now on nothing goes through."""
        self._whole.clear()

    def heal(self) -> None:
        """Go on; what waited goes through, where somebody still holds the other end."""
        self._whole.set()

    def _carry(self) -> None:
        while not self._end.is_set():
            self._whole.wait()
            for key, _ in self._ready.select(_LOOK_S):
                if not self._whole.is_set():
                    break
                end = key.fileobj
                assert isinstance(end, socket.socket)
                if end is self._listener:
                    self._accept()
                elif end in self._other:
                    self._hand_on(end)

    def _accept(self) -> None:
        caller, _ = self._listener.accept()
        try:
            called = socket.create_connection(self._to, timeout=1.0)
        except OSError:
            caller.close()
            return
        for one, other in ((caller, called), (called, caller)):
            one.settimeout(1.0)
            self._other[one] = other
            self._ready.register(one, selectors.EVENT_READ)

    def _hand_on(self, end: socket.socket) -> None:
        try:
            said = end.recv(65_536)
            if said:
                self._other[end].sendall(said)
                return
        except OSError:
            pass  # as good as an end
        other = self._other.pop(end)
        del self._other[other]
        for one in (end, other):
            with suppress(KeyError, ValueError):
                self._ready.unregister(one)
            one.close()


def cut_at_work(fleet: Fleet) -> tuple[Line | Namespaces, set[str], float]:
    """Cut arms off in the middle of a job: the line, who is behind it, and after how many seconds it shows."""
    line, away = fleet.line, set(fleet.away)
    assert isinstance(line, Line | Namespaces)
    fleet.until(lambda: any(fleet.states[arm][1].mode == "working" for arm in away), 20.0)
    line.cut()
    seen_s = fleet.until(lambda: all(map(fleet.unwell, away)), 10.0)
    return line, away, seen_s


def partition(fleet: Fleet) -> float:
    """Half of the arms are cut off for longer than a lease, in the middle of their jobs."""
    line, away, seen_s = cut_at_work(fleet)
    fleet.until(lambda: False, CUT_S)
    line.heal()
    healed_s = fleet.until(lambda: not any(map(fleet.unwell, away)), 30.0)
    how = (
        "each in a network namespace, its link down"
        if line.by == "netns"
        else "behind a line of ours that says nothing"
    )
    cut_s = CUT_S + min(seen_s, 10.0)
    fleet.note(f"{', '.join(sorted(away))} cut off for {cut_s:.0f} s, {how}; back {healed_s:.1f} s after it was healed")
    return seen_s
