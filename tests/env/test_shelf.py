"""An array comes back only when nobody can see it any more."""

import gc

import numpy as np

from fleet.env.shelf import Shelf


def test_what_somebody_holds_is_never_given_out_again() -> None:
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


def test_what_nobody_holds_comes_back() -> None:
    shelf = Shelf((8,), np.int64)
    place = shelf.take().ctypes.data
    assert shelf.take().ctypes.data == place
    kept = shelf.take()
    assert shelf.take().ctypes.data != kept.ctypes.data
