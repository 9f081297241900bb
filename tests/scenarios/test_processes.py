"""Processes that do independent work, and what becomes of them when the one that began them is killed."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from joblib import delayed

from fleet.errors import FleetError
from scenarios.processes import worker_processes


def nested(n: int) -> list[int]:
    with worker_processes(2, in_order=True) as pool:
        return list(pool(delayed(abs)(-k) for k in range(n)))


@pytest.mark.parametrize("count", [1, 2])
def test_work_inside_work_is_done(count):
    with worker_processes(count, in_order=True) as pool:
        assert list(pool(delayed(nested)(n) for n in range(4))) == [list(range(n)) for n in range(4)]


def test_processes_end_with_the_one_that_began_them(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent("""
            import os, signal, threading
            from joblib import delayed
            from scenarios.processes import worker_processes

            def work(first):
                if first:
                    os.kill(os.getppid(), signal.SIGKILL)
                threading.Event().wait(600)

            if __name__ == "__main__":
                with worker_processes(2) as pool:
                    list(pool(delayed(work)(first) for first in (True, False)))
        """)
    )
    # Returns when no process has its output open.
    killed = subprocess.run([sys.executable, str(script)], capture_output=True, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL


def die_once(marker: Path) -> str:
    """Ends its process the first time."""
    if not marker.exists():
        marker.touch()
        os._exit(1)
    return "done"


def test_work_of_a_process_that_died_is_done_again(tmp_path):
    with worker_processes(2, in_order=True) as pool:
        calls = [delayed(die_once)(tmp_path / "died"), delayed(abs)(-1), delayed(abs)(-2)]
        assert list(pool(calls)) == ["done", 1, 2]
        with pytest.raises(FleetError, match=r"The process that ran _exit died 3 times\."):
            list(pool([delayed(os._exit)(1), delayed(abs)(-1)]))
