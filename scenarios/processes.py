"""Processes for independent pieces of work, which end soon after the one that began them, also when that is killed."""

import os
import threading

from joblib import Parallel

PARENT_CHECK_S = 1.0
"""Time between two checks of a process that its parent still runs."""


def worker_processes(count: int, *, in_order: bool = False) -> Parallel:
    """This many processes, or this one itself; results come as they are made, or in the order of the tasks."""
    how = "generator" if in_order else "generator_unordered"
    return Parallel(n_jobs=count, return_as=how, initializer=end_with, initargs=(os.getpid(),))


def end_with(parent: int) -> None:
    """End this process soon after its parent, also in the middle of its work."""
    pause = threading.Event()  # never set

    def watch() -> None:
        while os.getppid() == parent:
            pause.wait(PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
