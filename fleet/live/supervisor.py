"""Keeps the processes of a fleet running: one log each, started again with back-off, ended in order."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty
from typing import IO

from fleet.bus.mailbox import Mailbox
from fleet.errors import FleetError

_LOG = logging.getLogger(__name__)

READY = "ready "
"""So begins the line with which a participant says that it is there."""
SUPERVISED = "THERMOFLEET_SUPERVISOR"
"""In the environment of what is supervised: the process of the supervisor."""


@dataclass(frozen=True, kw_only=True)
class Backoff:
    """How long to wait before a process that ended is started again."""

    first_s: float = 0.5
    factor: float = 2.0
    most_s: float = 30.0
    calm_s: float = 30.0
    """One that ran so long began well: it waits as if for the first time."""

    def wait_s(self, failures: int) -> float:
        """Before the start after so many failures in a row, 1 or more."""
        return min(self.first_s * self.factor ** (failures - 1), self.most_s)


@dataclass(frozen=True, kw_only=True)
class Part:
    """One process of a fleet."""

    name: str
    argv: tuple[str, ...]
    essential: bool = False
    """Its good end is the end of the fleet."""
    ready: str = READY
    """How the line begins with which it says that it is there."""
    env: Mapping[str, str] = field(default_factory=dict)
    rank: int = 0
    """Parts of a higher rank are ended before those of a lower one, parts of one rank at the same time."""


@dataclass(eq=False)
class _Running:
    part: Part
    process: subprocess.Popen[str] | None = None
    began_s: float = 0.0
    due_s: float = 0.0
    """When it is to be started (again)."""
    failures: int = 0
    restarts: int = 0
    ready: threading.Event = field(default_factory=threading.Event)
    over: bool = False


class Supervisor:
    """Starts parts and keeps them running until the end of the `with` block.

    Attributes:
        folder: Where the logs are, `NAME.log`.
    """

    def __init__(self, folder: Path, *, backoff: Backoff | None = None, patience_s: float = 10.0) -> None:
        """Prepare a supervisor.

        Args:
            folder: For the logs.
            patience_s: Real seconds that a process has to end in order before it is killed.
        """
        self.folder = folder
        self._backoff, self._patience_s = backoff or Backoff(), patience_s
        self._parts: dict[str, _Running] = {}
        self._ended: Mailbox[str] = Mailbox()

    def start(self, part: Part, *, ready_s: float | None = None) -> None:
        """Start a part and, if asked, wait until it says that it is ready.

        Raises:
            FleetError: it cannot be started, ended at once, or was not ready in time; what it said last is told.
        """
        if part.name in self._parts:
            raise ValueError(f"There is a process '{part.name}' already.")
        running = self._parts[part.name] = _Running(part)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._launch(running)
        except OSError as error:
            raise FleetError(f"'{part.name}' cannot be started: {error.strerror or error}.") from error
        if ready_s is not None:
            self.await_ready(part.name, ready_s)

    def await_ready(self, name: str, ready_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Wait until a part that was started says that it is ready, or until told to stop.

        Raises:
            FleetError: it ended, or was not ready in time; what it said last is told.
        """
        running = self._parts[name]
        deadline_s = time.monotonic() + ready_s
        while not running.ready.wait(0.05) and not stopped():
            if running.process is not None and running.process.poll() is not None:
                raise FleetError(f"'{name}' ended at once: {self.last_words(name)}")
            if time.monotonic() > deadline_s:
                raise FleetError(f"'{name}' was not ready within {ready_s:g} s: {self.last_words(name)}")

    def ready(self, name: str) -> bool:
        """Whether a part has said so since its last start."""
        return self._parts[name].ready.is_set()

    def restarts(self) -> dict[str, int]:
        """How often each was started again."""
        return {name: running.restarts for name, running in self._parts.items()}

    def pid(self, name: str) -> int | None:
        """Of a part that runs."""
        process = self._parts[name].process
        return process.pid if process is not None and process.poll() is None else None

    def log(self, name: str) -> Path:
        """The file with all that a part has said."""
        return self.folder / f"{name}.log"

    def last_words(self, name: str) -> str:
        """The last line of its log; where it is, if there is none."""
        lines = (
            self.log(name).read_text(encoding="utf-8", errors="replace").splitlines() if self.log(name).exists() else []
        )
        return lines[-1] if lines else f"it said nothing (see {self.log(name)})."

    def since_ready(self, name: str) -> str:
        """What a part has said since it last was ready; all of it, if it never was."""
        lines = self.log(name).read_text(encoding="utf-8", errors="replace").splitlines()
        last = max((i for i, line in enumerate(lines) if line.startswith(self._parts[name].part.ready)), default=-1)
        return "\n".join(lines[last + 1 :])

    def run(self, stopped: Callable[[], bool], *, look_s: float = 0.2) -> str:
        """Keep all running until told to stop, or until an essential part has ended well; returns the name of that one.

        Returns "" if it was told to stop.
        """
        while not stopped():
            if ended := self.look(look_s):
                return ended
        return ""

    def look(self, wait_s: float = 0.0) -> str:
        """Start what is due, and wait so long for an end; the name of an essential part that has ended well, or ""."""
        now_s = time.monotonic()
        for running in self._parts.values():
            if running.process is None and not running.over and running.due_s <= now_s:
                self._launch(running)
                running.restarts += 1
        try:
            name = self._ended.get(now_s + wait_s)
        except Empty:
            return ""
        return name if self._note_end(self._parts[name]) else ""

    def stop(self) -> None:
        """End all, rank after rank: SIGTERM, and SIGKILL for what does not heed it."""
        alive: dict[int, list[_Running]] = {}
        for running in self._parts.values():
            running.over = True
            if running.process is not None and running.process.poll() is None:
                running.process.send_signal(
                    signal.SIGCONT
                )  # one that stands still hears nothing, and others wait for it
                alive.setdefault(running.part.rank, []).append(running)
        for rank in sorted(alive, reverse=True):
            self._end(alive[rank])

    def _end(self, together: list[_Running]) -> None:
        processes = [(running.part.name, running.process) for running in together if running.process is not None]
        for _, process in processes:
            process.terminate()
        deadline_s = time.monotonic() + self._patience_s
        for name, process in processes:
            try:
                process.wait(max(0.0, deadline_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                _LOG.warning("'%s' did not end within %g s and was killed.", name, self._patience_s)
                process.kill()
        for _, process in processes:
            process.wait(self._patience_s)

    def __enter__(self) -> "Supervisor":
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _launch(self, running: _Running) -> None:
        part = running.part
        running.ready.clear()
        running.began_s = time.monotonic()
        process = subprocess.Popen(
            part.argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={**os.environ, "PYTHONUNBUFFERED": "1", SUPERVISED: str(os.getpid()), **part.env},
            start_new_session=True,  # Ctrl-C is for the supervisor, which ends them in order
        )
        running.process = process
        assert process.stdout is not None
        threading.Thread(target=self._listen, args=(running, process, process.stdout), daemon=True).start()

    def _listen(self, running: _Running, process: "subprocess.Popen[str]", said: IO[str]) -> None:
        with said, self.log(running.part.name).open("a", encoding="utf-8") as log:
            for line in said:
                log.write(line)
                log.flush()
                if line.startswith(running.part.ready):
                    running.ready.set()
        process.wait()
        self._ended.put(running.part.name)

    def _note_end(self, running: _Running) -> bool:
        """Whether the end of a process is that of the fleet; otherwise it is due again after a while."""
        process, now_s = running.process, time.monotonic()
        if process is None or process.poll() is None:
            return False
        if process.returncode == 0 and running.part.essential:
            running.over = True
            return True
        running.failures = 1 if now_s - running.began_s > self._backoff.calm_s else running.failures + 1
        wait_s = self._backoff.wait_s(running.failures)
        running.process, running.due_s = None, now_s + wait_s
        how = f"signal {-process.returncode}" if process.returncode < 0 else f"code {process.returncode}"
        _LOG.warning(
            "'%s' ended with %s; started again in %.1f s (log: %s).",
            running.part.name,
            how,
            wait_s,
            self.log(running.part.name),
        )
        return False


def end_with_supervisor() -> None:
    """Have the kernel end this process when its supervisor does, however that ends; for participants to call.

    Linux alone can do so (prctl(2), PR_SET_PDEATHSIG); elsewhere, and without a supervisor, nothing happens.
    """
    supervisor = os.environ.get(SUPERVISED)
    if supervisor is None or sys.platform != "linux":
        return
    import ctypes

    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != int(supervisor):  # it ended before the kernel knew
        os.kill(os.getpid(), signal.SIGTERM)
