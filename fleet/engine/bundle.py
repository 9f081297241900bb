"""All arrays of a simulation as one argument of a compiled kernel.

Unpacking 80 arrays takes longer than a step of one environment; a bundle is unpacked once. Its arrays stay shared with
the caller. Loads numba.
"""

# Numba ships no type stubs for its experimental part.
# pyright: reportArgumentType=false

from typing import Any

from numba import types
from numba.experimental import structref

from fleet.engine.tables import Simulation
from fleet.jit import compile_cached


@structref.register
class BundleType(types.StructRef):
    """The numba type of a bundle."""

    def preprocess_fields(self, fields: Any) -> Any:  # numba's types
        """Take literal types for the types of their values."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Bundle(structref.StructRefProxy):
    """A `Simulation` that compiled kernels take as one argument."""


structref.define_proxy(Bundle, BundleType, list(Simulation._fields))


def _make(
    tables, state, offers, events, trace, drive, infos, path_c, excess, assumed_c, moments, form, room, weights, script
):  # pyright: ignore
    return Bundle(
        tables,
        state,
        offers,
        events,
        trace,
        drive,
        infos,
        path_c,
        excess,
        assumed_c,
        moments,
        form,
        room,
        weights,
        script,
    )


_compiled_make = compile_cached(_make)


def bundle_of(simulation: Simulation) -> Any:  # an opaque object of numba's
    """The arrays of a simulation as one argument for compiled kernels."""
    return _compiled_make(*simulation)
