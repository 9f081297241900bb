"""Arrays that are given out again once nobody holds them any more.

A large array that is new at every step costs more in pages the system must first clear than in what is written to it.
"""

import sys

import numpy as np

Array = np.ndarray

_ALONE = 3
"""References to an array that only the shelf knows, as seen from inside its search: the shelf's, the name's, the
call's. Whoever looks at an array, or at a part of it, holds one more."""


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
        for array in self._arrays:
            if sys.getrefcount(array) == _ALONE:
                return array
        array = np.empty(self._shape, self._dtype)
        if len(self._arrays) < self._keep:
            self._arrays.append(array)
        return array

    def __getstate__(self) -> dict[str, object]:
        """Without the arrays, which those that hold them take along themselves."""
        return {**vars(self), "_arrays": []}
