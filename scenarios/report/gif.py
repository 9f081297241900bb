"""Write frames as a GIF. All frames share one palette, so the file stays small and colours do not flicker."""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image
from scipy.spatial import KDTree

from fleet.env.render import heat, picture

Array = np.ndarray

TICK_S = 0.01
"""Time unit of the GIF format."""
SHORTEST_S = 0.02
"""Shortest frame; viewers slow down what is shorter."""
HOLD_S = 1.0
"""How much longer the last frame stays."""
BITS = 6
"""Bits per channel that select the palette colour."""


def write_gif(path: Path, frames: Iterable[Array], seconds: float) -> tuple[int, float]:
    """Write frames, uint8 [height, width, 3], that together play for `seconds`; the last is held `HOLD_S` longer.

    Returns:
        Number of frames and length of the animation, s.
    """
    first, *rest = [_indexed(frame) for frame in frames]
    each_s = max(SHORTEST_S, TICK_S * round(seconds / (1 + len(rest)) / TICK_S))
    durations_ms = [round(1000 * each_s)] * (1 + len(rest))
    durations_ms[-1] += round(1000 * HOLD_S)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=durations_ms, loop=0, optimize=True)
    return len(durations_ms), sum(durations_ms) / 1000


def _indexed(frame: Array) -> Image.Image:
    palette, nearest = _palette()
    image = Image.fromarray(nearest[_cell(frame)])
    image.putpalette(palette.tobytes())
    return image


@lru_cache(maxsize=1)
def _palette() -> tuple[Array, Array]:
    """Colours uint8 [256, 3] of every picture, and the index of the nearest one by the high bits of a colour."""
    named = (*picture.PLATES, picture.GROUND, picture.LINE, picture.WORK, picture.FAULT, picture.INK, picture.FAINT)
    flat = np.array([to_rgb(colour) for colour in (*named, "#8a8a8a", "#e6e6e6")])
    scale = heat.heat_colour(np.linspace(0.0, heat.BEYOND_K + 41.0, 120), 40.0, 41.0)
    edges = [flat + (flat[3] - flat) * share for share in np.linspace(0.0, 1.0, 9)[1:-1]]
    colours = np.rint(255 * np.concatenate([flat, *edges, scale, 0.6 * scale[::3]])).astype(np.uint8)
    cells = np.indices((1 << BITS,) * 3).reshape(3, -1).T * (256 >> BITS) + (128 >> BITS)
    nearest = np.asarray(KDTree(colours).query(cells)[1], dtype=np.uint8)
    nearest[_cell(colours[: len(flat)])] = np.arange(len(flat))  # large areas keep their colour exactly
    return colours, nearest


def _cell(colours: Array) -> Array:
    """Index by the high bits of colours uint8 [..., 3]."""
    high = (colours >> (8 - BITS)).astype(np.int32)
    return high[..., 0] << 2 * BITS | high[..., 1] << BITS | high[..., 2]
