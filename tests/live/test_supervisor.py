"""Processes that end are started again, later and later; the end of the whole leaves none behind."""

import os
import signal
import sys
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.errors import FleetError
from fleet.live.supervisor import Backoff, Part, Supervisor

PATIENCE_S = 20.0
STAY = "import signal; print('ready x', flush=True); signal.pause()"
STUBBORN = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {STAY}; signal.pause()"
LOYAL = f"from fleet.live.supervisor import exit_with_supervisor; exit_with_supervisor(); {STAY}"


AFTER = """
import pathlib, signal, threading
folder, mine, others = pathlib.Path({folder!r}), {mine!r}, {others!r}
def end(*_):
    (folder / mine).touch()
    for _ in range(1000):
        if all((folder / other).exists() for other in others):
            threading.Event().wait(0.2 * len(others))
            (folder / "order").open("a").write(mine + "\\n")
            raise SystemExit(0)
        threading.Event().wait(0.01)
signal.signal(signal.SIGTERM, end)
print("ready x", flush=True)
signal.pause()
"""
"""Ends when others were told to end as well."""


def part(name, code, **options):
    return Part(name=name, argv=(sys.executable, "-c", code), **options)


def gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def until(condition):
    deadline_s = time.monotonic() + PATIENCE_S

    def stopped():
        assert time.monotonic() < deadline_s, "waited in vain"
        return condition()

    return stopped


@given(st.integers(1, 60), st.floats(0.1, 2.0), st.floats(1.0, 4.0), st.floats(2.0, 60.0))
def test_each_wait_is_as_long_or_longer_and_bounded(failures, first_s, factor, max_s):
    backoff = Backoff(first_s=first_s, factor=factor, max_s=max_s)
    waits = [backoff.wait_s(n) for n in range(1, failures + 2)]
    assert waits == sorted(waits)
    assert waits[0] == pytest.approx(min(first_s, max_s))
    assert waits[-1] <= max_s


def test_a_process_that_is_killed_comes_again(tmp_path):
    with Supervisor(tmp_path, backoff=Backoff(first_s=0.05)) as supervisor:
        supervisor.start(part("a", STAY), ready_s=PATIENCE_S)
        first = supervisor.pid("a")
        os.kill(first, signal.SIGKILL)
        supervisor.run(until(lambda: supervisor.restarts()["a"] == 1 and supervisor.ready("a")), poll_s=0.02)
        second = supervisor.pid("a")
        assert second not in (None, first)
    assert gone(second)
    assert supervisor.log("a").read_text() == "ready x\nready x\n"


def test_one_that_always_fails_is_not_started_all_the_time(tmp_path):
    begun_s = time.monotonic()
    with Supervisor(tmp_path, backoff=Backoff(first_s=0.2, factor=2.0)) as supervisor:
        supervisor.start(part("a", "raise SystemExit(3)"))
        supervisor.run(until(lambda: supervisor.restarts()["a"] == 3), poll_s=0.02)
    assert time.monotonic() - begun_s >= 0.2 + 0.4 + 0.8


def test_the_good_end_of_an_essential_part_is_the_end(tmp_path):
    with Supervisor(tmp_path) as supervisor:
        supervisor.start(part("stays", STAY), ready_s=PATIENCE_S)
        stays = supervisor.pid("stays")
        supervisor.start(part("done", "print('finished')", essential=True))
        assert supervisor.run(until(lambda: False)) == "done"
    assert gone(stays)
    assert supervisor.last_log_line("done") == supervisor.log_since_ready("done") == "finished"
    assert supervisor.log_since_ready("stays") == ""


def test_what_does_not_heed_or_stands_still_is_ended_all_the_same(tmp_path):
    with Supervisor(tmp_path, patience_s=0.3) as supervisor:
        supervisor.start(part("stubborn", STUBBORN), ready_s=PATIENCE_S)
        supervisor.start(part("still", STAY), ready_s=PATIENCE_S)
        pids = [supervisor.pid("stubborn"), supervisor.pid("still")]
        os.kill(pids[1], signal.SIGSTOP)
    assert all(gone(pid) for pid in pids)


def test_those_of_one_rank_end_together_and_lower_ranks_after_them(tmp_path):
    """Two wait for each other's end; the low one may be told only when both have ended."""
    with Supervisor(tmp_path / "logs") as supervisor:
        for name, others, rank in (("one", ["two"], 1), ("low", [], 0), ("two", ["one"], 1)):
            code = AFTER.format(folder=str(tmp_path), mine=name, others=others)
            supervisor.start(part(name, code, rank=rank), ready_s=PATIENCE_S)
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < PATIENCE_S / 4
    first, second, third = (tmp_path / "order").read_text().split()
    assert ({first, second}, third) == ({"one", "two"}, "low")


def test_many_that_do_not_heed_take_no_longer_than_one(tmp_path):
    with Supervisor(tmp_path, patience_s=0.5) as supervisor:
        for number in range(4):
            supervisor.start(part(f"stubborn {number}", STUBBORN), ready_s=PATIENCE_S)
        pids = [supervisor.pid(f"stubborn {number}") for number in range(4)]
        begun_s = time.monotonic()
    assert all(gone(pid) for pid in pids)
    assert time.monotonic() - begun_s < 1.5


def test_one_that_cannot_begin_says_why(tmp_path):
    with Supervisor(tmp_path) as supervisor:
        with pytest.raises(FleetError, match="'a' exited at once: no such port"):
            supervisor.start(part("a", "raise SystemExit('no such port')"), ready_s=PATIENCE_S)
        with pytest.raises(FleetError, match=r"'b' was not ready within 0\.2 s: no output"):
            supervisor.start(part("b", "import signal; signal.pause()"), ready_s=0.2)
        with pytest.raises(FleetError, match="'c' cannot be started"):
            supervisor.start(Part(name="c", argv=("/no/such/program",)))


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's help is Linux's")
def test_nobody_outlives_a_supervisor_that_is_killed(tmp_path):
    """A supervisor in a process of its own is killed; its child's end closes the pipe that it holds."""
    code = f"""
import sys, threading
from pathlib import Path
from fleet.live.supervisor import Part, Supervisor
supervisor = Supervisor(Path({str(tmp_path)!r}))
supervisor.start(Part(name="a", argv=(sys.executable, "-c", {LOYAL!r})), ready_s=20)
print(supervisor.pid("a"), flush=True)
threading.Event().wait(60)
"""
    import subprocess

    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        process.kill()
    deadline_s = time.monotonic() + PATIENCE_S
    while not gone(child) and time.monotonic() < deadline_s:
        threading.Event().wait(0.02)
    assert gone(child)
