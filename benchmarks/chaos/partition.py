"""Cut the connection between some arms and the router without closing it, and restore it.

The arms reach the router through a proxy. While it is cut, it reads from neither side: neither sees a reset, and the
system accepts new connections, which receive nothing.
"""

import selectors
import socket
import threading
from contextlib import suppress
from dataclasses import replace
from typing import Self

from benchmarks.chaos.fleet_under_test import Fleet
from fleet.live.supervisor import Part

CUT_S = 12.0
"""Longer than a lease, so that other arms may get the jobs."""
_LOOK_S = 0.05


class Proxy:
    """`with Proxy(port) as proxy:` forwards connections from `proxy.port` to `port`, until it is cut."""

    def __init__(self, to_port: int) -> None:
        self._to, self._listener = ("127.0.0.1", to_port), socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._whole, self._end = threading.Event(), threading.Event()
        self._whole.set()
        self._other: dict[socket.socket, socket.socket] = {}
        self._ready = selectors.DefaultSelector()
        self._thread = threading.Thread(target=self._run, name="proxy")

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

    def through(self, part: Part) -> Part:
        """Return the part with the address of this proxy in place of the router's."""
        there, here = f"127.0.0.1:{self._to[1]}", f"127.0.0.1:{self.port}"
        return replace(part, argv=tuple(word.replace(there, here) for word in part.argv))

    def cut(self) -> None:
        """Stop forwarding."""
        self._whole.clear()

    def heal(self) -> None:
        """Forward again, also what has arrived meanwhile on connections that are still open."""
        self._whole.set()

    def _run(self) -> None:
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
                    self._forward(end)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        try:
            server = socket.create_connection(self._to, timeout=1.0)
        except OSError:
            client.close()
            return
        for one, other in ((client, server), (server, client)):
            one.settimeout(1.0)
            self._other[one] = other
            self._ready.register(one, selectors.EVENT_READ)

    def _forward(self, end: socket.socket) -> None:
        try:
            data = end.recv(65_536)
            if data:
                self._other[end].sendall(data)
                return
        except OSError:
            pass  # treated as the end of the connection
        other = self._other.pop(end)
        del self._other[other]
        for one in (end, other):
            with suppress(KeyError, ValueError):
                self._ready.unregister(one)
            one.close()


def cut_at_work(fleet: Fleet) -> tuple[Proxy, set[str], float]:
    """Cut off arms during a job; return the cut, its arms, and the seconds until the bus shows it."""
    cut, cut_arms = fleet.cut, set(fleet.cut_arms)
    assert isinstance(cut, Proxy)
    fleet.wait_until(lambda: any(fleet.states[arm][1].mode == "working" for arm in cut_arms), 20.0)
    cut.cut()
    seen_s = fleet.wait_until(lambda: all(map(fleet.is_absent, cut_arms)), 10.0)
    return cut, cut_arms, seen_s


def partition(fleet: Fleet) -> float:
    """Cut off half of the arms during their jobs, for longer than a lease."""
    cut, cut_arms, seen_s = cut_at_work(fleet)
    fleet.wait_until(lambda: False, CUT_S)
    cut.heal()
    healed_s = fleet.wait_until(lambda: not any(map(fleet.is_absent, cut_arms)), 30.0)
    cut_s = CUT_S + min(seen_s, 10.0)
    fleet.note(
        f"{', '.join(sorted(cut_arms))} cut off for {cut_s:.0f} s; present again {healed_s:.1f} s after the cut ended"
    )
    return seen_s


LEASE_S = 8.0
"""Real seconds after which no job continues without a majority: a lease, its margins, and a last cycle."""


def cut_off_half(fleet: Fleet) -> float:
    """Cut off half of the arms during their jobs: neither half may begin a job."""
    return _cut(fleet, may_work=False)


def cut_off_one(fleet: Fleet) -> float:
    """Cut off one arm during a job: the others are a majority and must continue.

    They have to finish more than their current jobs. Jobs whose space the absent arm takes have to wait.
    """
    return _cut(fleet, may_work=True)


def _cut(fleet: Fleet, *, may_work: bool) -> float:
    cut, cut_arms, seen_s = cut_at_work(fleet)
    at_cut = _ended(fleet)
    fleet.wait_until(lambda: False, LEASE_S)
    before = _ended(fleet)
    fleet.wait_until(lambda: False, CUT_S - LEASE_S)
    after = _ended(fleet)
    if after - before and not may_work:
        fleet.violations.append(f"{', '.join(sorted(after - before))} done without a majority")
    waiting = any(job.state == "waiting" for job in fleet.status().values())
    if may_work and waiting and len(after - at_cut) <= len(fleet.arms) - len(cut_arms):
        fleet.violations.append(f"a majority finished only {len(after - at_cut)} jobs")
    cut.heal()
    healed_s = fleet.wait_until(lambda: not any(map(fleet.is_absent, cut_arms)), 30.0)
    fleet.note(
        f"{', '.join(sorted(cut_arms))} cut off for {CUT_S + min(seen_s, 10.0):.0f} s; {len(after - at_cut)} jobs were "
        f"finished since its detection, {len(after - before)} of them in its last {CUT_S - LEASE_S:.0f} s; present "
        f"again {healed_s:.1f} s after the cut ended"
    )
    return seen_s


def _ended(fleet: Fleet) -> set[str]:
    """Return the finished jobs, by the journals of all arms."""
    return set(fleet.journals.count_finished())
