"""Compiling the inner loop: numba, with code that is kept from process to process.

What is compiled is plain Python over arrays: with NUMBA_DISABLE_JIT=1 in the environment it runs uncompiled, slowly
and to the same result.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import config, njit

from fleet.cache import users_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_HERE = Path(__file__).parents[1]
_SOURCES = (
    "sim/jit.py", "sim/noise.py", "sim/tables.py", "sim/boiling.py", "sim/rows.py", "env/fields.py",
    "robot.py", "telemetry.py", "thermal.py", "sim/faults.py", "sim/kernel.py", "sim/state.py", "env/observation.py",
)  # fmt: skip
"""All that is compiled together, and whose constants are: numba itself looks at the file of a function only."""


def inner(function: Function) -> Function:
    """Compile a function that only compiled functions call."""
    return cast(Function, njit(function, error_model="numpy"))


@inner
def natural(index: Any) -> Any:
    """The same index, of which the compiler then knows that it is not negative: it need not count from the end."""
    return index & 0x7FFFFFFF


def entry(function: Function) -> Function:
    """Compile a function that Python calls, and keep its code in the user's cache folder, by all it is made of."""
    digest = hashlib.sha256(numba.__version__.encode())
    for name in _SOURCES:
        digest.update((_HERE / name).read_bytes())
    options: Any = config  # numba sets them by name
    before, options.CACHE_DIR = options.CACHE_DIR, str(users_folder() / "compiled" / digest.hexdigest()[:16])
    try:
        return cast(Function, njit(function, error_model="numpy", cache=True, nogil=True))
    finally:
        options.CACHE_DIR = before
