"""Colour scale of motor temperatures, shared by pictures and pages."""

from typing import Any  # plain values of JSON

import numpy as np

Array = np.ndarray

HEAT = ("#aef2a6", "#ecd070", "#e08a00", "#cc2222", "#4d0a2a")
"""Cool, halfway to the warning limit, warning, error, beyond: green to red and always darker, so that they differ
without colour vision."""
COOL_C, BEYOND_K = 20.0, 10.0
"""The scale begins at `COOL_C` and ends `BEYOND_K` above the error limit."""


def heat_marks(warning_c: float, error_c: float) -> Array:
    """Temperatures of the colours in `HEAT`, °C, rising."""
    cool_c = min(COOL_C, warning_c - COOL_C)
    return np.array([cool_c, (cool_c + warning_c) / 2, warning_c, error_c, error_c + BEYOND_K])


def heat_colour(temp_c: Array, warning_c: float, error_c: float) -> Array:
    """RGB from 0 to 1, [..., 3], of motor temperatures [...], °C; constant outside the scale."""
    marks = heat_marks(warning_c, error_c)
    rgb = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in HEAT])
    return np.stack([np.interp(temp_c, marks, rgb[:, i]) for i in range(3)], axis=-1)


def heat_scale(warning_c: float, error_c: float) -> dict[str, Any]:
    """The scale as plain values, for a page."""
    marks = [round(float(mark), 2) for mark in heat_marks(warning_c, error_c)]
    return {"colours": list(HEAT), "marks_c": marks, "warning_c": warning_c, "error_c": error_c}
