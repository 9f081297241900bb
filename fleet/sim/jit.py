"""Compiling the inner loop: numba, with code that is kept from process to process.

What is compiled is plain Python over arrays: with NUMBA_DISABLE_JIT=1 in the environment it runs uncompiled, slowly
and to the same result.
"""

import hashlib
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import config, njit

from fleet.cache import users_folder

log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])

_HERE = Path(__file__).parents[1]
_SOURCES = (
    "sim/jit.py", "sim/noise.py", "sim/tables.py", "sim/boiling.py", "sim/rows.py", "sim/beginning.py", "env/fields.py",
    "robot.py", "telemetry.py", "thermal.py", "sim/faults.py", "sim/kernel.py", "sim/state.py", "env/observation.py",
)  # fmt: skip
"""All that is compiled together, and whose constants are: numba itself looks at the file of a function only."""


def inner(function: Function) -> Function:
    """Compile a function into those that call it: handing over arrays costs more than most loops."""
    return cast(Function, njit(function, error_model="numpy", forceinline=True))


def rare(function: Function) -> Function:
    """Compile a function that compiled functions seldom call."""
    return cast(Function, njit(function, error_model="numpy"))


@inner
def natural(index: Any) -> Any:
    """The same index, of which the compiler then knows that it is not negative: it need not count from the end."""
    return index & 0x7FFFFFFF


@cache
def _announce(folder: Path) -> None:
    """Say once that the first step takes long: a warning, for that is shown where nobody set up logging."""
    log.warning("The first step compiles the engine: some 20 s of one core, once, kept in %s.", folder)


def entry(function: Function) -> Function:
    """Compile a function that Python calls, and keep its code in the user's cache folder, by all it is made of."""
    digest = hashlib.sha256(numba.__version__.encode())
    for name in _SOURCES:
        digest.update((_HERE / name).read_bytes())
    folder = users_folder() / "compiled" / digest.hexdigest()[:16]
    options: Any = config  # numba sets them by name
    if not (folder.exists() or options.DISABLE_JIT):
        _announce(folder)
    before, options.CACHE_DIR = options.CACHE_DIR, str(folder)
    try:
        return cast(Function, njit(function, error_model="numpy", cache=True, nogil=True))
    finally:
        options.CACHE_DIR = before
