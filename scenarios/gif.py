"""Frames as a GIF: one palette for all of them, so that the file stays small and colours hold still."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.Image import Quantize
from scipy.spatial import KDTree

from fleet.env.floor_plan import Pixel
from fleet.env.heat_colours import marks_c
from fleet.env.picture import picture
from fleet.env.scene import Offer, Scene
from fleet.errors import FleetError
from fleet.telemetry import FAULTED, MODES, WORKING

Array = np.ndarray

TICK_S = 0.01
"""A GIF counts in these."""
SHORTEST_S = 0.02
"""Of a frame; viewers slow down what is shorter."""
HOLD_S = 1.0
"""How much longer the last frame stands."""
COLOURS = 256
FREQUENT = 32
"""Colours of large areas, which are kept exactly."""
BITS = 6
"""Per channel, of what two colours must differ in to be told apart."""


@contextmanager
def new_gif(out: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file that becomes `out` when the block ends well, and vanishes when it does not.

    Raises:
        FleetError: `out` is no .gif, is there already, or cannot be written.
    """
    if out.suffix.lower() != ".gif":
        raise FleetError(f"--out must end in .gif (got '{out}').")
    if out.is_dir():
        raise FleetError(f"Cannot write to '{out}': it is a folder.")
    if out.exists() and not overwrite:
        raise FleetError(f"'{out}' is there already; give another --out, or --overwrite to replace it.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
    except OSError as error:
        raise FleetError(f"Cannot write to '{out}': {error.strerror or error}.") from error
    os.close(handle)
    work = Path(name)
    try:
        yield work
        work.chmod(0o644)
        work.replace(out)
    finally:
        work.unlink(missing_ok=True)


class Palette:
    """Colours for every picture of a cell: what is common exactly, the rest as near as `COLOURS` allow."""

    def __init__(self, scene: Scene, size: Pixel) -> None:
        seen = np.concatenate([_numbered(picture(each, size)).ravel() for each in _specimens(scene)])
        numbers, counts = np.unique(seen, return_counts=True)
        colours = np.stack([numbers >> 16, numbers >> 8 & 255, numbers & 255], axis=1).astype(np.uint8)
        exact = colours[np.argsort(-counts, kind="stable")[:FREQUENT]]
        spread = Image.fromarray(colours[None]).quantize(COLOURS - len(exact), method=Quantize.MEDIANCUT)
        rest = np.array(spread.getpalette(), dtype=np.uint8).reshape(-1, 3)
        self._table = np.concatenate([exact, rest])[:COLOURS]
        # Pillow's own search takes a neighbour now and then, even for a colour that is in the palette.
        cells = np.indices((1 << BITS,) * 3).reshape(3, -1).T * (256 >> BITS) + (128 >> BITS)
        self._nearest: Array = np.asarray(KDTree(self._table).query(cells)[1], dtype=np.uint8)
        for i in reversed(range(len(exact))):
            self._nearest[_cell_of(exact[i])] = i

    def indexed(self, frame: Array) -> Image.Image:
        """A picture in these colours."""
        image = Image.fromarray(self._nearest[_cell_of(frame)])
        image.putpalette(self._table.tobytes())
        return image


def _numbered(colours: Array) -> Array:
    """One number per colour [..., 3], so that finding the different ones is fast."""
    wide = colours.astype(np.int32)
    return wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]


def _cell_of(colours: Array) -> Array:
    """Which of the cells of `BITS` per channel colours [..., 3] lie in."""
    high = (colours >> (8 - BITS)).astype(np.int32)
    return (high[..., 0] << 2 * BITS) | (high[..., 1] << BITS) | high[..., 2]


def write_gif(path: Path, frames: Sequence[Image.Image], seconds: float) -> float:
    """Write frames that together last so long, and the last one a little longer; how long it is in all, s."""
    each_s = max(SHORTEST_S, TICK_S * round(seconds / len(frames) / TICK_S))
    durations_ms = [round(1000 * each_s)] * len(frames)
    durations_ms[-1] += round(1000 * HOLD_S)
    first, *rest = frames
    first.save(path, "GIF", save_all=True, append_images=rest, duration=durations_ms, loop=0, optimize=True)
    return sum(durations_ms) / 1000


def _specimens(scene: Scene) -> Iterator[Scene]:
    """Scenes of the same cell in which every colour occurs: all modes, all temperatures, work in time and late."""
    shape = scene.temp_c.shape
    low, *_, high = marks_c(scene.warning_c, scene.error_c)
    ramp = np.linspace(low, high, scene.temp_c.size).reshape(shape)
    names = [name for name, _ in scene.cell.stations][:1]
    arms = shape[0]
    offer = Offer(job="job", payload_kg=1.0, due_in_s=60.0, able=(True,) * arms, free=(False,) + (True,) * (arms - 1))
    for shift in range(len(MODES)):
        mode = tuple((a + shift) % len(MODES) for a in range(arms))
        yield replace(
            scene,
            temp_c=np.roll(ramp, shift * 3),
            mode=mode,
            job=tuple("job" if m == WORKING else "" for m in mode),
            share=(0.6,) * arms,
            at=tuple(tuple(names) if m == WORKING else () for m in mode),
            offers=(offer, replace(offer, due_in_s=-60.0)),
            faults=int(FAULTED in mode),
        )
