"""Buffers are reused only if nothing references them."""

import gc
import platform
import subprocess
import sys

import numpy as np
import pytest

from fleet.env.vector import Shelf


def test_referenced_arrays_are_never_reused() -> None:
    shelf = Shelf((3, 4), np.float32, keep=2)
    held = [shelf.take() for _ in range(5)]
    assert len({id(array) for array in held}) == 5
    assert all(array.shape == (3, 4) and array.dtype == np.float32 for array in held)
    for array in held:
        array[:] = 7.0
    part, raw = held[0][1, 2:], memoryview(held[1])
    held.clear()
    gc.collect()
    taken = [shelf.take() for _ in range(4)]
    for array in taken:
        array[:] = 0.0
    assert part.tolist() == [7.0, 7.0]
    assert raw[0, 0] == 7.0


def test_released_arrays_are_reused() -> None:
    shelf = Shelf((8,), np.int64)
    place = shelf.take().ctypes.data
    assert shelf.take().ctypes.data == place
    kept = shelf.take()
    assert shelf.take().ctypes.data != kept.ctypes.data


TURNOVER = """
import resource, sys
import numpy as np
from fleet.env.vector import keep_pages
if sys.argv[1] == "kept":
    assert keep_pages()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(20_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_keep_pages_reuses_memory() -> None:
    """Allocate 160 MB twice: the second time the process gets no new pages."""
    faults = {
        how: int(subprocess.run([sys.executable, "-c", TURNOVER, how], capture_output=True, check=True).stdout)
        for how in ("given back", "kept")
    }
    assert faults["kept"] < 100
    assert faults["given back"] > 3 * faults["kept"]
