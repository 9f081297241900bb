"""Compile loops with numba, lazily; every function also runs uncompiled, to the same result.

Decorated functions are plain Python over arrays and scalars. Numba is imported, and a kernel compiled, when
`Kernel.compiled` is first asked for. Compiled code is cached in the user's cache folder from process to process.
"""

import hashlib
import logging
import os
import platform
import sys
from collections.abc import Callable
from functools import cache, cached_property, wraps
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from fleet.files import user_cache_folder

log = logging.getLogger(__name__)

Real = Any
"""A number of any type of floats, which compiled functions take alike."""
Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
_OPTIONS: dict[str, Any] = {"error_model": "numpy"}
_WITHIN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Of a function that only compiled functions call: without these entries the engine compiles in 5/6 of the time."""
_inlined: list[Callable[..., Any]] = []
_called: list[Callable[..., Any]] = []


def jit_inline(function: Function) -> Function:
    """Compile a function into its compiled callers: passing arrays costs more than most loops."""
    _inlined.append(function)
    return function


def jit(function: Function) -> Function:
    """Compile a function that compiled functions seldom call."""
    _called.append(function)
    return function


def jit_lean(function: Function) -> Function:
    """As `jit`, for the loops of a kernel, without counting references to arrays, which takes longer than most steps.

    Such a function and all that it calls allocate nothing: the caller gives them room.
    """
    vars(function)["options"] = {"_nrt": False}
    _called.append(function)
    return function


def fused(function: Function) -> Function:
    """Let the compiler fuse products with sums: faster, and rounded otherwise than uncompiled. Innermost decorator."""
    vars(function)["options"] = {"fastmath": {"contract"}}
    return function


@jit_inline
def nonnegative(index: Any) -> Any:  # any integer type
    """Return the same index; the compiler then omits the check for negative indices."""
    return int(index) & 0x7FFFFFFF


class Kernel:
    """A function that Python calls, compiled or not.

    Args:
        function: Its arguments are arrays, scalars, named tuples of them, and bundles (`fleet.engine.tables`).
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.__doc__, self.__name__ = function.__doc__, function.__name__

    @cached_property
    def compiled(self) -> Callable[..., Any]:
        """The compiled function; the first call in a process loads it, the first on a machine compiles it."""
        return compile_cached(self.function)

    @cached_property
    def interpreted(self) -> Callable[..., Any]:
        """The same in plain Python, without numba."""

        def call(*arguments: Any) -> Any:  # as the function
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # as compiled: integers wrap around
                return self.function(*arguments)

        return call

    def chosen(self, compile_it: bool | None = None) -> Callable[..., Any]:
        """Return `compiled`, or `interpreted` where compiling is not wanted or switched off (NUMBA_DISABLE_JIT=1)."""
        wanted = os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0") if compile_it is None else compile_it
        return self.compiled if wanted else self.interpreted


def kernel(function: Callable[..., Any]) -> Kernel:
    """Make a function one that Python calls, compiled or not."""
    return Kernel(function)


def compiled_sources() -> tuple[Path, ...]:
    """Files whose functions are compiled, or whose constants are compiled into functions."""
    names = (
        "jit",
        "arrivals",
        "seeding",
        "heat/motor",
        "difficulty",
        "robot",
        "telemetry",
        "heat/thermal",
        "observation",
        "job",
    )
    return (*(_PACKAGE / f"{name}.py" for name in names), *sorted((_PACKAGE / "engine").glob("*.py")))


@cache
def cache_of_this_code() -> Path:
    """Cache folder for the present source of all that is compiled together: numba itself looks at one file only."""
    import numba

    digest = hashlib.sha256(numba.__version__.encode())
    for path in compiled_sources():
        digest.update(path.read_bytes())
    return user_cache_folder() / "compiled" / digest.hexdigest()[:16]


def _note_of(function: Callable[..., Any]) -> Path:
    """The empty file that is there once a kernel is compiled; numba compiles anew where any of these parts differs."""
    source = Path(function.__code__.co_filename)
    parts = (sys.implementation.cache_tag, platform.machine(), source, source.stat().st_mtime_ns)
    key = hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()[:16]
    return cache_of_this_code() / f"{function.__name__}-{key}"


@cache
def _announce(folder: Path) -> None:
    log.warning(
        "Compiling functions (once: half a minute of one core for the simulation engine, some seconds for others); "
        "cached in %s.",
        folder,
    )


def compile_cached(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, which logs a line, and keep its code in the user's cache folder."""
    from numba import config, njit
    from numba.extending import register_jitable

    while _inlined:
        inlined = _inlined.pop()
        register_jitable(forceinline=True, **_WITHIN, **_options_of(inlined))(inlined)
    while _called:
        called = _called.pop()
        register_jitable(**_WITHIN, **_options_of(called))(called)
    options: Any = config  # numba sets its options by name
    note = _note_of(function)
    note.parent.mkdir(parents=True, exist_ok=True)
    before, options.CACHE_DIR = options.CACHE_DIR, str(note.parent)
    try:
        compiled = njit(function, cache=True, nogil=True, **_options_of(function))
    finally:
        options.CACHE_DIR = before
    if note.exists():
        return compiled
    once, ready = Lock(), False

    @wraps(function)
    def compile_first(*arguments: Any) -> Any:  # as the function
        nonlocal ready
        if ready:
            return compiled(*arguments)
        with once:
            if not note.exists():
                _announce(note.parent)
            result = compiled(*arguments)
            note.touch()
            ready = True
            return result

    return compile_first


def _options_of(function: Callable[..., Any]) -> dict[str, Any]:
    return _OPTIONS | vars(function).get("options", {})
