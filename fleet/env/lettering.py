"""Letters in a picture: one typeface that every install has, measured, cut to the room, kept once drawn."""

import importlib.util
from functools import lru_cache
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from PIL.ImageFont import FreeTypeFont

ELLIPSIS = "…"

Colour = str | tuple[int, int, int]


@lru_cache(maxsize=64)
def font(size_px: int, *, bold: bool = False) -> FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib; laid out by Pillow itself, so alike on every machine."""
    package = importlib.util.find_spec("matplotlib")  # located, not loaded
    assert package is not None
    assert package.origin is not None
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(package.origin).parent / "mpl-data" / "fonts" / "ttf" / name
    return ImageFont.truetype(str(path), size_px, layout_engine=ImageFont.Layout.BASIC)


@lru_cache(maxsize=4096)
def width(text: str, size_px: int, *, bold: bool = False) -> int:
    """Of a line of text, px."""
    return round(font(size_px, bold=bold).getlength(text) + 0.5)


@lru_cache(maxsize=4096)
def fitted(text: str, size_px: int, room_px: int, *, bold: bool = False) -> str:
    """The text on one line, without its middle where that is too long (names differ at their ends); may be empty."""
    line = "".join(c if c.isprintable() else " " for c in text)
    if width(line, size_px, bold=bold) <= room_px:
        return line
    for kept in range(min(len(line) - 1, 200), 1, -1):
        head = kept // 2
        short = line[:head] + ELLIPSIS + line[len(line) - (kept - head) :]
        if width(short, size_px, bold=bold) <= room_px:
            return short
    return ""


def write(
    image: Image.Image,
    at: tuple[int, int],
    text: str,
    colour: Colour,
    size_px: int,
    *,
    bold: bool = False,
    anchor: str = "lm",
    halo: Colour | None = None,
) -> None:
    """Put a line of text into a picture.

    Args:
        anchor: Which point of the text `at` is, in Pillow's letters: l, m, r across, a (top), m down.
        halo: Colour around the letters, where they may stand on lines.
    """
    if not text:
        return
    if halo is not None:
        around, (dx, dy) = _stamp(text, size_px, bold, anchor, max(1, size_px // 7))
        image.paste(halo, (at[0] + dx, at[1] + dy), around)
    letters, (dx, dy) = _stamp(text, size_px, bold, anchor, 0)
    image.paste(colour, (at[0] + dx, at[1] + dy), letters)


@lru_cache(maxsize=2048)
def _stamp(text: str, size_px: int, bold: bool, anchor: str, stroke_px: int) -> tuple[Image.Image, tuple[int, int]]:
    """The letters as a mask, and where its corner lies from the anchor."""
    face = font(size_px, bold=bold)
    left, top, right, bottom = (round(v) for v in face.getbbox(text, anchor=anchor, stroke_width=stroke_px))
    mask = Image.new("L", (max(1, right - left), max(1, bottom - top)))
    ImageDraw.Draw(mask).text((-left, -top), text, 255, face, anchor=anchor, stroke_width=stroke_px)
    return mask, (left, top)
