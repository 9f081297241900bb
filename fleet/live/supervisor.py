"""Run the processes of a fleet: one log each, restarts with back-off, ordered shutdown."""

import ctypes
import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NoReturn

from fleet.bus.mailbox import Mailbox
from fleet.errors import FleetError

_LOG = logging.getLogger(__name__)

READY = "ready "
"""Start of the line that a participant prints once it has started."""
SUPERVISED = "THERMOFLEET_SUPERVISOR"
"""Environment variable of supervised processes: the process id of the supervisor."""
PROCESS_NAME = "THERMOFLEET_PROCESS_NAME"
"""Environment variable of supervised processes: the name of the part."""
WAITS = 75
"""Exit code of a process that waits for another, as a router: no failure (EX_TEMPFAIL of sysexits.h)."""
NOTICES, NOTICE_S = ("Waiting for a router.", "The certificate of '"), 60.0
"""Starts of log messages of a process that are also logged here: it is cut off, or its certificate expires soon, has
expired or was renewed. Real seconds before one is repeated."""
ENDS = "' ends on "
"""Part of the reminder that a certificate expires soon."""
LOG_S = 1.0
"""Real seconds to wait for the last output of an exited process."""


@dataclass(frozen=True, kw_only=True)
class Backoff:
    """Delays before an exited process is restarted."""

    first_s: float = 0.5
    factor: float = 2.0
    max_s: float = 2.0
    stable_s: float = 10.0
    """A process that ran longer than this starts with the first delay again."""

    def wait_s(self, failures: int) -> float:
        """Delay after a number of failures in a row, 1 or more."""
        return min(self.first_s * self.factor ** min(failures - 1, 100), self.max_s)  # a power beyond floats raises


@dataclass(frozen=True, kw_only=True)
class Part:
    """One process of a fleet."""

    name: str
    argv: tuple[str, ...]
    essential: bool = False
    """The fleet ends when it exits with code 0."""
    ready: str = READY
    """Start of the line that it prints once it has started."""
    env: Mapping[str, str] = field(default_factory=dict[str, str])
    rank: int = 0
    """Parts of a higher rank are stopped first, parts of one rank together."""


@dataclass(eq=False)
class _Running:
    part: Part
    process: subprocess.Popen[str] | None = None
    copier: threading.Thread | None = None
    """Copies its output to the log."""
    began_s: float = 0.0
    due_s: float = 0.0
    """When the next start is due."""
    failures: int = 0
    restarts: int = 0
    ready: threading.Event = field(default_factory=threading.Event)
    over: bool = False
    """It is not started again."""

    @property
    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None


class LogFile:
    """Appends lines to a file; on a full disk they are dropped and counted."""

    def __init__(self, path: Path) -> None:
        self._path, self._lost = path, 0

    def write(self, line: str) -> None:
        """Append a line, after one with the number of lost lines."""
        missing = f"[{self._lost} line(s) lost: the disk was full]\n" if self._lost else ""
        try:
            with self._path.open("ab", buffering=0) as file:
                file.write(f"{missing}{line}".encode())
            self._lost = 0
        except OSError as error:
            self._lost += 1
            if self._lost == 1:
                _LOG.error("Cannot write '%s' (%s); the output is dropped until it can.", self._path, error.strerror)


class Supervisor:
    """Starts processes and restarts them until the end of the `with` block.

    Attributes:
        folder: Folder of the logs, `NAME.log`.
    """

    def __init__(
        self,
        folder: Path,
        *,
        backoff: Backoff | None = None,
        patience_s: float = 10.0,
        program: Sequence[str] = (),
        main: Callable[[Sequence[str]], object] | None = None,
    ) -> None:
        """Prepare.

        Args:
            patience_s: Real seconds between SIGTERM and SIGKILL when a process is stopped.
            program: Start of the command lines that `main` runs, too.
            main: Runs the rest of such a command line in a fork of this process, so that all share the memory of the
                modules that it has imported. None, or where forks are not safe: every command line is executed.
        """
        self.folder = folder
        self._backoff, self._patience_s = backoff or Backoff(), patience_s
        self._program, self._main = tuple(program), main
        self._parts: dict[str, _Running] = {}
        self._noticed_s: dict[str, float] = {}
        """When each message of `NOTICES` was logged; many processes may wait for the same router."""
        self._ended: Mailbox[str] = Mailbox()

    def start(self, part: Part, *, ready_s: float | None = None) -> None:
        """Start a process and, if asked, wait until it is ready.

        Raises:
            FleetError: it cannot be started, exited, or was not ready in time; gives the last line of its log.
        """
        if part.name in self._parts:
            raise ValueError(f"Names of processes must be unique (got '{part.name}' twice).")
        running = self._parts[part.name] = _Running(part)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._launch(running)
        except OSError as error:
            raise FleetError(f"'{part.name}' cannot be started: {error.strerror or error}.") from error
        if ready_s is not None:
            self.await_ready(part.name, ready_s)

    def await_ready(self, name: str, ready_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Wait until a process is ready, or until `stopped`.

        Raises:
            FleetError: it exited, or was not ready in time; gives the last line of its log.
        """
        running = self._parts[name]
        deadline_s = time.monotonic() + ready_s
        while not running.ready.wait(0.05) and not stopped():
            if running.process is not None and not running.alive:
                assert running.copier is not None
                running.copier.join(LOG_S)
                raise FleetError(f"'{name}' exited at once: {self.last_log_line(name)}")
            if time.monotonic() > deadline_s:
                raise FleetError(f"'{name}' was not ready within {ready_s:g} s: {self.last_log_line(name)}")

    def ready(self, name: str) -> bool:
        """Whether a process is ready since its last start."""
        return self._parts[name].ready.is_set()

    def restarts(self) -> dict[str, int]:
        """Number of restarts of each process."""
        return {name: running.restarts for name, running in self._parts.items()}

    def pid(self, name: str) -> int | None:
        """Process id; None while it is not running."""
        process = self._parts[name].process
        return process.pid if process is not None and self._parts[name].alive else None

    def log(self, name: str) -> Path:
        """Path of its log."""
        return self.folder / f"{name}.log"

    def _log_lines(self, name: str) -> list[str]:
        path = self.log(name)
        return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []

    def last_log_line(self, name: str) -> str:
        """Last line of its log, or the path of the log if it is empty."""
        lines = self._log_lines(name)
        return lines[-1] if lines else f"no output (log: {self.log(name)})."

    def log_since_ready(self, name: str) -> str:
        """Its log since it was last ready; all of it, if it never was."""
        lines = self._log_lines(name)
        last = max((i for i, line in enumerate(lines) if line.startswith(self._parts[name].part.ready)), default=-1)
        return "\n".join(lines[last + 1 :])

    def run(self, stopped: Callable[[], bool], *, poll_s: float = 0.2) -> str:
        """Restart exited processes until `stopped`, or until an essential one exits with code 0.

        Returns:
            Name of the essential one; "" if it was stopped.
        """
        while not stopped():
            if ended := self.poll(poll_s):
                return ended
        return ""

    def poll(self, wait_s: float = 0.0) -> str:
        """Start what is due, and wait for an exit; return the name of an exited essential process (code 0), or ""."""
        now_s = time.monotonic()
        for running in self._parts.values():
            if running.process is None and not running.over and running.due_s <= now_s:
                self._launch_again(running)
        for name in self._ended.take(now_s + wait_s):
            if self._handle_exit(self._parts[name]):
                return name
        return ""

    def stop(self) -> None:
        """Stop all, rank after rank: by SIGTERM, and by SIGKILL after `patience_s`."""
        ranks: dict[int, dict[str, subprocess.Popen[str]]] = {}
        for name, running in self._parts.items():
            running.over = True
            if running.process is not None and running.alive:
                running.process.send_signal(signal.SIGCONT)  # a suspended process would not receive SIGTERM
                ranks.setdefault(running.part.rank, {})[name] = running.process
        for _, processes in sorted(ranks.items(), reverse=True):
            for process in processes.values():
                process.terminate()
            deadline_s = time.monotonic() + self._patience_s
            for name, process in processes.items():
                try:
                    process.wait(max(0.0, deadline_s - time.monotonic()))
                except subprocess.TimeoutExpired:
                    _LOG.warning("'%s' did not exit within %g s and was killed.", name, self._patience_s)
                    process.kill()
            for process in processes.values():
                process.wait(self._patience_s)

    def __enter__(self) -> "Supervisor":
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _launch(self, running: _Running) -> None:
        part = running.part
        running.ready.clear()
        running.began_s = time.monotonic()
        env = {**os.environ, "PYTHONUNBUFFERED": "1", SUPERVISED: str(os.getpid()), PROCESS_NAME: part.name}
        env |= part.env
        run, words = None, part.argv[len(self._program) :]
        if self._main is not None and part.argv == (*self._program, *words) and _may_fork():
            run = partial(_run_in_fork, self._main, words, env)
        process = subprocess.Popen(
            part.argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=env,
            start_new_session=True,  # Ctrl-C goes to the supervisor alone, which stops them in order
            preexec_fn=run,
        )
        running.process = process
        running.copier = threading.Thread(target=self._copy_log, args=(running, process), daemon=True)
        running.copier.start()
        threading.Thread(target=self._await_exit, args=(running, process), daemon=True).start()

    def _launch_again(self, running: _Running) -> None:
        """Start a process again; if the system cannot, later."""
        try:
            self._launch(running)
            running.restarts += 1
        except OSError as error:
            running.due_s = time.monotonic() + self._backoff.max_s
            _LOG.error(
                "'%s' cannot be started (%s); next attempt in %g s.", running.part.name, error, self._backoff.max_s
            )

    def _copy_log(self, running: _Running, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        log = LogFile(self.log(running.part.name))
        with process.stdout as output:
            for line in output:
                log.write(line)
                self._notice(running.part.name, line)
                if line.startswith(running.part.ready) and running.process is process:
                    running.ready.set()

    def _notice(self, name: str, line: str) -> None:
        message, now_s = line.partition(": ")[2].strip(), time.monotonic()
        # Certificates that were made together end together: the reminder of one process stands for all.
        kind, more = (ENDS, " See the logs of the other processes, too.") if ENDS in message else (message, "")
        if message.startswith(NOTICES) and now_s >= self._noticed_s.get(kind, -NOTICE_S) + NOTICE_S:
            self._noticed_s[kind] = now_s
            _LOG.warning("'%s': %s%s", name, message, more)

    def _await_exit(self, running: _Running, process: "subprocess.Popen[str]") -> None:
        """Note the exit of a process, also if one that it has started still holds its output open."""
        process.wait()
        assert running.copier is not None
        running.copier.join(LOG_S)
        self._ended.put(running.part.name)

    def _handle_exit(self, running: _Running) -> bool:
        """Return whether the fleet ends with this process; otherwise schedule its restart."""
        process, now_s, name = running.process, time.monotonic(), running.part.name
        if process is None or running.alive:
            return False
        if process.returncode == 0 and running.part.essential:
            running.over = True
            return True
        if process.returncode == WAITS:
            running.failures = 0
        running.failures = 1 if now_s - running.began_s > self._backoff.stable_s else running.failures + 1
        wait_s = self._backoff.wait_s(running.failures)
        running.process, running.due_s = None, now_s + wait_s
        how = f"signal {-process.returncode}" if process.returncode < 0 else f"code {process.returncode}"
        _LOG.warning("'%s' exited with %s; restart in %.1f s (log: %s).", name, how, wait_s, self.log(name))
        return False


def _may_fork() -> bool:
    """Whether a fork of this process can work: none but Python's own threads run in it."""
    sys.stdout.flush()  # or the fork would write it again
    sys.stderr.flush()
    return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == threading.active_count()


def _run_in_fork(main: Callable[[Sequence[str]], object], words: Sequence[str], env: Mapping[str, str]) -> NoReturn:
    """Run a command line in this fork of the supervisor, whose `Popen` would execute it after the return."""
    code: object = 1
    try:
        # Before the parent goes on, which then may send a signal.
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        for broken in (signal.SIGPIPE, signal.SIGXFSZ):  # errors, as in a new Python: `Popen` has set them to end it
            signal.signal(broken, signal.SIG_IGN)
        null = os.open(os.devnull, os.O_RDWR)
        for number in map(int, os.listdir("/proc/self/fd")):
            if number > 2 and number != null:  # not closed: no object of the supervisor can close a new file
                os.dup2(null, number, inheritable=False)
        os.environ.update(env)
        if (numpy := sys.modules.get("numpy")) is not None:
            numpy.random.seed()  # or a policy that uses it would draw the same numbers in every process
        logging.getLogger().handlers.clear()
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
        gc.enable()  # `Popen` disables it meanwhile
        main(words)
        code = 0
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))


def share_memory() -> None:
    """Prepare the memory of this process for forks: garbage collection in them leaves shared pages as they are."""
    return_memory()
    gc.freeze()


def return_memory() -> None:
    """Return freed memory to the system, after a step that needed much (Linux with glibc)."""
    gc.collect()
    if sys.platform == "linux":
        getattr(ctypes.CDLL(None), "malloc_trim", int)(0)


def name_process() -> None:
    """Give this process the name of its part, shown by `ps` and `top`; called by participants in their main thread.

    Only Linux can do so (prctl(2), PR_SET_NAME; 15 bytes); elsewhere, and without a supervisor, it does nothing.
    """
    name = os.environ.get(PROCESS_NAME)
    is_supervised = os.environ.get(SUPERVISED) == str(os.getppid())  # not a descendant that inherits the variables
    if name is not None and is_supervised and sys.platform == "linux":
        ctypes.CDLL(None).prctl(15, name.encode()[:15])


def exit_with_supervisor() -> None:
    """Have the kernel stop this process when its supervisor exits; called by participants.

    Only Linux can do so (prctl(2), PR_SET_PDEATHSIG); elsewhere, and without a supervisor, it does nothing.
    """
    supervisor = os.environ.get(SUPERVISED)
    if supervisor is None or sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != int(supervisor):  # it exited before the call
        os.kill(os.getpid(), signal.SIGTERM)
