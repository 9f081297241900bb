"""Arrays that are given out again once nobody holds them any more.

A large array that is new at every step costs more in pages the system must first clear than in what is written to it.
"""

import ctypes
import sys

import numpy as np

Array = np.ndarray


def _references(arrays: list[Array], place: int) -> int:
    """References to an array of a list, as this function sees them."""
    array = arrays[place]
    return sys.getrefcount(array)


_ALONE = _references([np.empty(0)], 0)
"""Of an array that only the list knows: measured, for interpreters count differently. Whoever looks at an array, or at
a part of it, holds one more."""


class Shelf:
    """Hands out arrays of one shape and type with anything in them.

    Args:
        keep: At most so many are kept for another time.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type, *, keep: int = 4) -> None:
        self._shape, self._dtype, self._keep = shape, dtype, keep
        self._arrays: list[Array] = []

    def take(self) -> Array:
        """An array that nobody else has."""
        for place in range(len(self._arrays)):
            if _references(self._arrays, place) == _ALONE:
                return self._arrays[place]
        array = np.empty(self._shape, self._dtype)
        if len(self._arrays) < self._keep:
            self._arrays.append(array)
        return array

    def __getstate__(self) -> dict[str, object]:
        """Without the arrays, which those that hold them take along themselves."""
        return {**vars(self), "_arrays": []}


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of `mallopt` in glibc's malloc.h."""
_MOST = 2**31 - 1


def keep_pages() -> bool:
    """Have this process keep the memory of arrays that are gone, for those that come.

    For trainers that stack every rollout into new arrays of some hundred megabytes: glibc gives such arrays back to the
    system when they are freed, which clears their pages anew for the next ones, and that costs as much as the steps.
    It holds for the whole process, which then stays as large as it once was.

    Returns:
        Whether it does now: False where the C library is not glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    return mallopt is not None and all(mallopt(which, _MOST) == 1 for which in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))
