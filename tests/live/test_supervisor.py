"""Exited processes are restarted after growing delays; no process outlives its supervisor."""

import os
import signal
import sys
import threading
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fleet.errors import FleetError
from fleet.live.supervisor import WAITS, Backoff, LogFile, Part, Supervisor
from tests.waiting import PATIENCE_S

WAIT = "import signal; print('ready x', flush=True); signal.pause()"
IGNORES_SIGTERM = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {WAIT}; signal.pause()"
SUPERVISED = f"from fleet.live.supervisor import exit_with_supervisor; exit_with_supervisor(); {WAIT}"


EXIT_TOGETHER = """
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
"""Program that exits once others were stopped as well."""


def part(name, code, **options):
    return Part(name=name, argv=(sys.executable, "-c", code), **options)


def exited(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def until(condition):
    deadline_s = time.monotonic() + PATIENCE_S

    def stopped():
        assert time.monotonic() < deadline_s, "the condition was never met"
        return condition()

    return stopped


@example(2000, 0.5, 2.0, 2.0)  # an hour of failures
@given(st.integers(1, 60), st.floats(0.1, 2.0), st.floats(1.0, 4.0), st.floats(2.0, 60.0))
def test_delays_grow_up_to_a_limit(failures, first_s, factor, max_s):
    backoff = Backoff(first_s=first_s, factor=factor, max_s=max_s)
    waits = [backoff.wait_s(n) for n in range(1, failures + 2)]
    assert waits == sorted(waits)
    assert waits[0] == pytest.approx(min(first_s, max_s))
    assert waits[-1] <= max_s


def test_a_killed_process_is_restarted_while_its_child_holds_the_output_open(tmp_path):
    code = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {WAIT!r}]); {WAIT}"
    with Supervisor(tmp_path, backoff=Backoff(first_s=0.05)) as supervisor:
        supervisor.start(part("a", code), ready_s=PATIENCE_S)
        first = supervisor.pid("a")
        try:
            os.kill(first, signal.SIGKILL)
            supervisor.run(until(lambda: supervisor.restarts()["a"] == 1), poll_s=0.05)
            assert supervisor.pid("a") not in (None, first)
        finally:
            os.killpg(first, signal.SIGKILL)
            os.killpg(supervisor.pid("a"), signal.SIGKILL)


@pytest.mark.parametrize(
    ("code", "backoff", "least_s"),
    [(3, Backoff(first_s=0.1, factor=2.0), 0.1 + 0.2 + 0.4), (WAITS, Backoff(first_s=0.1, factor=1e3, max_s=1e2), 0.3)],
    ids=["that always fails", "without a router"],
)
def test_a_process_is_restarted_with_growing_delays_unless_it_waits_for_a_router(tmp_path, code, backoff, least_s):
    start_s = time.monotonic()
    with Supervisor(tmp_path, backoff=backoff) as supervisor:
        supervisor.start(part("a", f"raise SystemExit({code})"))
        supervisor.run(until(lambda: supervisor.restarts()["a"] == 3), poll_s=0.02)
    assert time.monotonic() - start_s >= least_s


def test_a_full_log_disk_ends_neither_the_process_nor_its_supervision(tmp_path):
    """A folder in place of the log refuses lines, as a full disk does."""
    log = tmp_path / "a.log"
    log.mkdir()
    with Supervisor(tmp_path, backoff=Backoff(first_s=0.05)) as supervisor:
        supervisor.start(part("a", WAIT), ready_s=PATIENCE_S)
        for times in (1, 2):
            os.kill(supervisor.pid("a"), signal.SIGKILL)
            supervisor.run(until(lambda n=times: supervisor.restarts()["a"] == n and supervisor.ready("a")))
            if times == 1:
                log.rmdir()
    assert log.read_text() == "ready x\n"


def test_lost_lines_of_a_log_are_counted(tmp_path):
    path = tmp_path / "a.log"
    log = LogFile(path)
    path.mkdir()
    log.write("one\n")
    log.write("two\n")
    path.rmdir()
    log.write("three\n")
    assert path.read_text() == "[2 line(s) lost: the disk was full]\nthree\n"


def test_a_system_that_cannot_start_a_process_does_not_end_supervision(tmp_path, monkeypatch):
    def refuse(*_arguments, **_options):
        raise OSError(12, "Cannot allocate memory")

    with Supervisor(tmp_path, backoff=Backoff(first_s=0.01, max_s=0.05)) as supervisor:
        supervisor.start(part("a", WAIT), ready_s=PATIENCE_S)
        with monkeypatch.context() as full:
            full.setattr("subprocess.Popen", refuse)
            os.kill(supervisor.pid("a"), signal.SIGKILL)
            for _ in range(20):
                assert supervisor.poll(0.02) == ""
        supervisor.run(until(lambda: supervisor.ready("a")), poll_s=0.02)


def test_a_process_that_is_cut_off_is_reported_once(tmp_path, caplog):
    waiting = "fleet.bus.router: Waiting for a router. No router answered at tcp/127.0.0.1:1."
    expired = "fleet.bus.client: The certificate of 'arm_0' expired on 2026-11-30 07:28 UTC."
    lines = f"WARNING  {waiting}\nERROR    {expired}\nWARNING  fleet.bus.client: Dropped 1 message(s)."
    with Supervisor(tmp_path) as supervisor:
        for name in ("arm-a", "arm-b"):
            supervisor.start(part(name, f"print({lines!r}); {WAIT}"), ready_s=PATIENCE_S)
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [f"'arm-a': {line.partition(': ')[2]}" for line in (waiting, expired)]


def test_certificates_that_end_soon_are_reported_once_for_all_processes(tmp_path, caplog):
    reminder = "The certificate of 'arm:{}' ends on 2026-12-05 07:28 UTC; thermofleet bus keys --add renews it."
    with Supervisor(tmp_path) as supervisor:
        for name in ("a", "b"):
            line = f"WARNING  fleet.bus.security.tls: {reminder.format(name)}"
            supervisor.start(part(f"arm-{name}", f"print({line!r}); {WAIT}"), ready_s=PATIENCE_S)
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [f"'arm-a': {reminder.format('a')} See the logs of the other processes, too."]


def test_the_fleet_ends_when_an_essential_process_exits_with_code_0(tmp_path):
    with Supervisor(tmp_path) as supervisor:
        supervisor.start(part("stays", WAIT), ready_s=PATIENCE_S)
        stays = supervisor.pid("stays")
        supervisor.start(part("done", "print('finished')", essential=True))
        assert supervisor.run(until(lambda: False)) == "done"
    assert exited(stays)
    assert supervisor.last_log_line("done") == supervisor.log_since_ready("done") == "finished"
    assert supervisor.log_since_ready("stays") == ""


def test_processes_that_ignore_sigterm_or_are_suspended_are_stopped(tmp_path):
    with Supervisor(tmp_path, patience_s=0.3) as supervisor:
        supervisor.start(part("stubborn", IGNORES_SIGTERM), ready_s=PATIENCE_S)
        supervisor.start(part("still", WAIT), ready_s=PATIENCE_S)
        pids = [supervisor.pid("stubborn"), supervisor.pid("still")]
        os.kill(pids[1], signal.SIGSTOP)
    assert all(exited(pid) for pid in pids)


def test_processes_of_one_rank_are_stopped_together_and_lower_ranks_after_them(tmp_path):
    """Two wait for each other; the one of the lower rank is stopped only after both have exited."""
    with Supervisor(tmp_path / "logs") as supervisor:
        for name, others, rank in (("one", ["two"], 1), ("low", [], 0), ("two", ["one"], 1)):
            code = EXIT_TOGETHER.format(folder=str(tmp_path), mine=name, others=others)
            supervisor.start(part(name, code, rank=rank), ready_s=PATIENCE_S)
    first, second, third = (tmp_path / "order").read_text().split()
    assert ({first, second}, third) == ({"one", "two"}, "low")


def test_a_process_that_cannot_start_gives_the_reason(tmp_path):
    with Supervisor(tmp_path) as supervisor:
        with pytest.raises(FleetError, match="'a' exited at once: no such port"):
            supervisor.start(part("a", "raise SystemExit('no such port')"), ready_s=PATIENCE_S)
        with pytest.raises(FleetError, match=r"'b' was not ready within 0\.2 s: no output"):
            supervisor.start(part("b", "import signal; signal.pause()"), ready_s=0.2)
        with pytest.raises(FleetError, match="'c' cannot be started"):
            supervisor.start(Part(name="c", argv=("/no/such/program",)))


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl(2) of Linux")
def test_no_process_outlives_a_killed_supervisor(tmp_path):
    """A supervisor in a separate process is killed; the kernel stops its child."""
    code = f"""
import sys, threading
from pathlib import Path
from fleet.live.supervisor import Part, Supervisor
supervisor = Supervisor(Path({str(tmp_path)!r}))
supervisor.start(Part(name="a", argv=(sys.executable, "-c", {SUPERVISED!r})), ready_s=120)
print(supervisor.pid("a"), flush=True)
threading.Event().wait(60)
"""
    import subprocess

    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        child = int(process.stdout.readline())
        process.kill()
    deadline_s = time.monotonic() + PATIENCE_S
    while not exited(child) and time.monotonic() < deadline_s:
        threading.Event().wait(0.02)
    assert exited(child)


FORKS = """
import os, signal, sys
from pathlib import Path
from fleet.live.supervisor import Backoff, Part, Supervisor, exit_with_supervisor, name_process, share_memory
BALLAST = [object() for _ in range(100_000)]
def main(words):
    exit_with_supervisor()
    name_process()
    ignores = signal.getsignal(signal.SIGPIPE) == signal.SIG_IGN  # a client that hangs up is no end of a process
    comm = Path("/proc/self/comm").read_text().strip()
    print("ready", *words, comm, os.environ["GIVEN"], len(BALLAST), os.getsid(0) == os.getpid() and ignores, flush=True)
    if words == ["exits"]:
        sys.exit(3)
    signal.pause()
share_memory()
print("not written twice", end="")
with Supervisor(Path({folder!r}), program=("own",), main=lambda words: main(list(words))) as supervisor:
    for name, argv in (("a", ("own", "stays")), ("b", ("own", "exits")), ("c", (sys.executable, "-c", {wait!r}))):
        supervisor.start(Part(name=name, argv=argv, env={{"GIVEN": name}}), ready_s=60)
    supervisor.run(lambda: supervisor.restarts()["b"] > 0 and supervisor.ready("b"), poll_s=0.05)
    rollup = Path(f"/proc/{{supervisor.pid('a')}}/smaps_rollup").read_text().splitlines()
    sizes_kb = [line.split()[1] for line in rollup if line.startswith(("Rss", "Pss:"))]
    print("\\n", supervisor.pid("a"), *sizes_kb, flush=True)
    {end}
"""
"""Three processes: a fork that stays, one that exits with code 3 and is restarted, and an executed program."""


@pytest.mark.skipif(sys.platform != "linux", reason="forks are for Linux")
@pytest.mark.parametrize(("end", "code"), [("", 0), ("os.kill(os.getpid(), signal.SIGKILL)", -9)])
def test_command_lines_of_the_program_are_forks_that_share_its_memory(tmp_path, end, code):
    import subprocess

    script = FORKS.format(folder=str(tmp_path), wait=SUPERVISED, end=end)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.returncode, done.stdout.count("not written twice")) == (code, 1), done.stderr
    child, rss_kb, pss_kb = map(int, done.stdout.splitlines()[-1].split())
    assert pss_kb < 0.7 * rss_kb
    deadline_s = time.monotonic() + PATIENCE_S
    while not exited(child) and time.monotonic() < deadline_s:
        threading.Event().wait(0.02)
    assert exited(child)
    assert (tmp_path / "a.log").read_text() == "ready stays a a 100000 True\n"
    assert (tmp_path / "b.log").read_text().count("ready exits b b 100000 True\n") >= 2
    assert "'b' exited with code 3" in done.stderr
