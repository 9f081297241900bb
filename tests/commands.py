"""The command line in this process, and as a process forked from one that has imported it: that takes no seconds.

`start` and `run` serve tests of a command. What a start itself does (signals while it imports, variables that Python or
MuJoCo read, a terminal) is tested with `REAL`, which starts Python.
"""

import atexit
import gc
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
REAL = (sys.executable, "-c", "from scenarios.cli.main import main; main()")
"""Start of the command line by Python itself."""
ADDRESS = "THERMOFLEET_TEST_SERVER"
"""Variable with the address of the server, without its first zero byte; all workers of a run share one."""
IMPORTED = (
    *("scenarios.cli.main", "scenarios.cli.look", "scenarios.cli.run", "scenarios.cli.live", "scenarios.cli.jobs"),
    *("scenarios.run.shift", "scenarios.run.log", "scenarios.prepare.fleet"),
    *("scenarios.live.arm", "scenarios.live.auctioneer", "scenarios.live.requests", "scenarios.show.watch"),
    *("fleet.live.arm.node", "fleet.live.auction.node", "fleet.env.allocation_v2", "fleet.arm.planner"),
    *("fleet.bus.router", "pyarrow.parquet", "numba", "scipy.optimize"),
)
"""Modules that commands import."""
_LARGEST = 1 << 18
"""Bytes of a request."""


class CommandResult(NamedTuple):
    """Exit code and output of one call of the command line."""

    code: int
    out: str
    err: str

    def refused(self, sentence: str) -> bool:
        """Whether the command ended with exit code 2 and this sentence, which may be wrapped."""
        return self.code == 2 and sentence in " ".join(self.err.split())

    def succeeded(self) -> "CommandResult":
        """This result, of a command that must have ended with exit code 0."""
        assert self.code == 0, self.err
        return self


def call(*words: object) -> int:
    """Exit code of `thermofleet WORDS`, called in this process."""
    from scenarios.cli.main import main

    try:
        main([str(word) for word in words])
    except SystemExit as left:
        return int(left.code or 0)
    raise AssertionError("the command has not ended")


def start_server() -> None:
    """Start the process that forks commands; it ends when its standard input is closed, with this process at last."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind("")  # Linux chooses a name that is no file
        listener.listen()
        os.environ[ADDRESS] = listener.getsockname()[1:].decode()
        server = subprocess.Popen(
            [sys.executable, "-m", "tests.commands", str(listener.fileno())],
            cwd=ROOT, stdin=subprocess.PIPE, pass_fds=[listener.fileno()], env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    atexit.register(server.communicate)


class Forked(subprocess.Popen[str]):
    """A process that the server forks, with the methods of `Popen`; its options are files, pipes, `cwd` and `env`.

    It is no child of this process: the server sends its number, and its exit code when it ends.
    """

    def _execute_child(self, args: Any, *given: Any) -> None:
        cwd, env, *pipes = given[4], given[5], *given[9:15]
        stdin, _, _, stdout, _, stderr = pipes
        files = [number if file == -1 else file for number, file in enumerate((stdin, stdout, stderr))]
        request = {"words": [str(word) for word in args], "cwd": str(cwd or Path.cwd()), "env": dict(env or os.environ)}
        self._status = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._status.connect(b"\0" + os.environ[ADDRESS].encode())
        self._status.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LARGEST)
        socket.send_fds(self._status, [json.dumps(request).encode()], files)
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]
        self._child_created = True
        self.pid = int(self._status.recv(64))

    def _wait(self, timeout: float | None) -> int:
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(int(self._status.recv(64)))
            self._status.close()
        return self.returncode

    def _internal_poll(self, *_: Any, **__: Any) -> int | None:
        if self.returncode is None and select.select([self._status], [], [], 0.0)[0]:
            return self._wait(None)
        return self.returncode


def start(*words: object, **options: Any) -> subprocess.Popen[str]:
    """Start `thermofleet WORDS`, with pipes for its texts unless `options`, those of `Popen`, say otherwise."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options}
    if sys.platform != "linux":
        return subprocess.Popen([*REAL, *map(str, words)], **options)
    if ADDRESS not in os.environ:
        start_server()
    return Forked(words, **options)  # type: ignore[arg-type]


def run(*words: object, timeout_s: float = 300.0, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run `thermofleet WORDS` to its end; `options` are those of `Popen`."""
    with start(*words, **options) as process:
        try:
            out, err = process.communicate(timeout=timeout_s)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(words, process.returncode, out, err)


@contextmanager
def ready(*words: object, **options: Any) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command until the end of the block, and the line that it prints when it is ready."""
    with start(*words, **options) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def end(process: subprocess.Popen[str], number: int) -> tuple[int, str]:
    """Send a signal; return the exit code and the errors that were printed."""
    process.send_signal(number)
    _, errors = process.communicate(timeout=300.0)
    return process.returncode, errors


def _serve(listener: socket.socket) -> dict[str, Any]:
    """Fork a command for every request; return the request in the forked process."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the process that waits for a command
    while True:
        if sys.stdin in select.select([listener, sys.stdin], [], [])[0]:
            os._exit(0)  # the tests have ended
        status, _ = listener.accept()
        if os.fork():
            status.close()
            continue
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        listener.close()
        request, files, _, _ = socket.recv_fds(status, _LARGEST, 3)
        for number, file in enumerate(files):
            os.dup2(file, number)
            os.close(file)
        command = os.fork()
        if not command:
            status.close()
            return json.loads(request)
        os.closerange(0, 3)
        status.send(str(command).encode())
        status.send(str(os.waitpid(command, 0)[1]).encode())
        os._exit(0)


def _become(request: dict[str, Any]) -> None:
    """Give this process what Python gives a new one: variables, folder, Ctrl-C, chance, and open files."""
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    random.seed()
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout.reconfigure(write_through="PYTHONUNBUFFERED" in os.environ)
    sys.stderr = open(2, "w", 1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    sys.argv = ["thermofleet", *request["words"]]


if __name__ == "__main__":
    for _name in IMPORTED:
        import_module(_name)
    gc.collect()
    gc.freeze()  # commands do not look through these objects again
    _become(_serve(socket.socket(fileno=int(sys.argv[1]))))
    import_module("scenarios.cli.main").main()
