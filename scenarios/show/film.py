"""Films of a recorded shift: MuJoCo's renderer without a display, and ffmpeg's encoders through PyAV."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fleet.arm.cell import CellCamera, CellPlayer
from fleet.env.render.heat import heat_colour, heat_marks
from fleet.errors import FleetError, install, visible
from fleet.telemetry import FAULTED, MODES
from scenarios.run.log import RunLog
from scenarios.show.moments import motor_drums
from scenarios.show.words import clock
from scenarios.spec.options import Shot

Array = np.ndarray

INK, PAPER, FAULT = (34, 34, 34), (250, 250, 248), (204, 34, 34)
CODECS = {"mp4": "libx264", "webm": "libvpx"}
OPTIONS = {"libx264": {"preset": "veryfast", "crf": "27"}, "libvpx": {"deadline": "realtime", "cpu-used": "8"}}
MOST_LINES = 8
"""Arms whose hottest motor is written in the picture."""
MOST_NAMES, NAMES_FROM_PX = 24, 400
"""In a larger fleet, or a smaller picture, the names of the arms would cover it."""
TEXT_PX, SMALLEST_PX = 16, 11
"""Height of text in a picture of 1280 x 720 px, and in the smallest ones."""
POSTURES = 64
"""Postures of the film that the camera must hold."""


def times(run: RunLog, shot: Shot) -> Array:
    """Times of the frames, s.

    Raises:
        FleetError: the run has no readings between `begin_s` and `end_s`.
    """
    time_s = run.readings.time_s
    begin_s, end_s = max(shot.begin_s, float(time_s[0])), min(shot.end_s, float(time_s[-1]))
    if not begin_s <= end_s:
        raise FleetError(
            f"The run has readings from {time_s[0]:g} to {time_s[-1]:g} s (got {shot.begin_s:g} to {shot.end_s:g} s)."
        )
    return np.arange(begin_s, end_s + 1e-9, shot.speed / shot.fps)


class Film:
    """A recorded shift in a MuJoCo model of its cell.

    Raises:
        FleetError: the meshes are not available.
    """

    def __init__(self, run: RunLog, *, meshes: bool = False) -> None:
        scenario = run.scenario
        robots = [arm.robot() for arm in scenario.arms]
        self.player = CellPlayer(robots, scenario.places, scenario.fixtures, meshes=meshes)
        self._limits = scenario.limits
        self._load_kg, self._readings = run.load_kg, run.readings

    def show(self, time_s: float) -> tuple[Array, Array]:
        """Put the cell into its state at a time; returns the temperatures [arm, joint] and the modes [arm]."""
        readings = self._readings
        row = int(
            np.clip(
                np.searchsorted(readings.time_s, time_s), min(1, len(readings.time_s) - 1), len(readings.time_s) - 1
            )
        )
        before = max(row - 1, 0)
        length_s = readings.time_s[row] - readings.time_s[before]
        share = np.clip((time_s - readings.time_s[before]) / length_s, 0.0, 1.0) if length_s else 1.0
        q, temp_c = ((1 - share) * v[before] + share * v[row] for v in (readings.q, readings.temp_c))
        self.player.show(q, *motor_drums(temp_c, self._limits), self._load_kg[row])
        return temp_c, readings.mode[row]

    def postures(self, at_s: Array) -> Array:
        """Postures of the span of some times, [sample, arm, joint] in rad; at most `POSTURES`."""
        first, last = np.searchsorted(self._readings.time_s, (at_s[0], at_s[-1])).clip(0, len(self._readings.q) - 1)
        return self._readings.q[np.unique(np.linspace(first, last, POSTURES).astype(int))]


def frames(run: RunLog, shot: Shot, at_s: Array) -> Iterator[Array]:
    """Pictures of a shift, uint8 [height, width, 3].

    Raises:
        FleetError: OpenGL or the meshes are not available.
    """
    film, overlay = Film(run, meshes=shot.meshes), Overlay(run, shot)
    seen = film.player.extent(film.postures(at_s))
    free = {"top": overlay.top_px / shot.height, "bottom": overlay.bottom_px / shot.height}
    with CellCamera(film.player, shot.width, shot.height, seen, **free) as camera:
        labels = camera.pixels(film.player.labels_m)
        for time_s in at_s:
            temp_c, mode = film.show(time_s)
            yield overlay.draw(camera.picture(), float(time_s), temp_c, mode, labels)


class Overlay:
    """Clock, hottest motors, names of the arms and colour scale, written into a picture."""

    def __init__(self, run: RunLog, shot: Shot) -> None:
        self._arms, self._limits = [visible(arm) for arm in run.arms], run.scenario.limits
        text_px = max(SMALLEST_PX, round(TEXT_PX * min(shot.width / 1280, shot.height / 720)))
        self._font, self._small = _font(text_px), _font(max(SMALLEST_PX, round(0.75 * text_px)))
        self._line_px, self._edge_px = round(1.3 * text_px), max(6, text_px // 2)
        self._lines = min(MOST_LINES, len(self._arms), max(0, round(0.3 * shot.height / self._line_px) - 1))
        card = run.card
        self._title = visible(f"{run.scenario.name} · {card['policy']} · seed {card['seed']} · {shot.speed:g} ×")
        self._scale = self._colour_scale(min(20 * text_px, shot.width - 24))
        self.top_px = 2 * self._edge_px + (1 + self._lines) * self._line_px
        """Height of the text above the picture of the cell."""
        self.bottom_px = self._scale.height + 12
        """Height of the colour scale below it."""

    def draw(self, picture: Array, time_s: float, temp_c: Array, mode: Array, labels: Array) -> Array:
        """The picture with its text; modes [arm] index `fleet.telemetry.MODES`, names are at `labels` [arm, 2], px."""
        image = Image.fromarray(picture)
        pen = ImageDraw.Draw(image)
        if len(self._arms) <= MOST_NAMES and min(image.size) >= NAMES_FROM_PX:
            for arm, faulted, (x, y) in zip(self._arms, mode == FAULTED, labels, strict=True):
                name = self._fitting(f"{'✖ ' if faulted else ''}{arm}", image.width // 4, self._small)
                width = pen.textlength(name, font=self._small)
                x = float(np.clip(x - width / 2, 4, max(4, image.width - width - 4)))
                half = self._small.size / 2 + 3
                pen.rectangle((x - 4, y - half, x + width + 4, y + half), fill=FAULT if faulted else PAPER)
                pen.text((x, y - half + 1), name, font=self._small, fill=PAPER if faulted else INK)
        hottest = temp_c.max(axis=1)
        lines = [(f"{clock(time_s)}  {self._title}", INK)]
        for arm in np.argsort(-hottest)[: self._lines]:
            heat = f"{MODES[mode[arm]]}, joint {int(temp_c[arm].argmax()) + 1} at {hottest[arm]:.1f} °C"
            name = self._fitting(self._arms[arm], image.width - pen.textlength(f": {heat}", font=self._font) - 24)
            lines.append((f"{name}: {heat}", FAULT if mode[arm] == FAULTED else INK))
        lines = [(self._fitting(text, image.width - 24), colour) for text, colour in lines]
        width = max(pen.textlength(text, font=self._font) for text, _ in lines)
        pen.rectangle((6, 4, width + 18, self.top_px - self._edge_px + 2), fill=PAPER)
        for number, (text, colour) in enumerate(lines):
            pen.text((12, 6 + number * self._line_px), text, font=self._font, fill=colour)
        image.paste(self._scale, (12, image.height - self._scale.height - 6))
        return np.asarray(image)

    def _fitting(self, text: str, width_px: float, font: ImageFont.FreeTypeFont | None = None) -> str:
        """Text of at most this width, with … where its end is cut off."""
        font = font or self._font
        if font.getlength(text) <= width_px:
            return text
        while text and font.getlength(f"{text}…") > width_px:
            text = text[:-1]
        return f"{text}…"

    def _colour_scale(self, width: int) -> Image.Image:
        warning_c, error_c = self._limits.warning_c, self._limits.error_c
        marks, text_px = heat_marks(warning_c, error_c), self._small.size
        image = Image.new("RGB", (width, round(2.2 * text_px + 14)), PAPER)
        colours = heat_colour(np.linspace(marks[0], marks[-1], width - 16), warning_c, error_c)
        bar = np.rint(255 * np.tile(colours, (round(text_px), 1, 1))).astype(np.uint8)
        image.paste(Image.fromarray(bar), (8, 6))
        pen = ImageDraw.Draw(image)
        for mark, word in ((marks[0], f"{marks[0]:g} °C"), (warning_c, f"{warning_c:g}"), (error_c, f"{error_c:g}")):
            x = 8 + (width - 16) * (mark - marks[0]) / (marks[-1] - marks[0])
            pen.line((x, 4, x, text_px + 8), fill=INK)
            pen.text((max(2, x - (0 if mark == marks[0] else 8)), text_px + 9), word, font=self._small, fill=INK)
        return image


def _font(size_px: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans as it comes with matplotlib: Pillow's own font lacks signs like ×."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size_px)


def write_film(path: Path, kind: str, pictures: Iterator[Array], shot: Shot) -> int:
    """Write pictures as mp4 (H.264), webm (VP8) or gif, and return their number.

    Raises:
        FleetError: PyAV is not installed.
    """
    if kind == "gif":
        return _write_gif(path, pictures, shot.fps)
    try:
        import av
    except ModuleNotFoundError as error:
        raise FleetError(f"Films as MP4 or WebM need PyAV: {install('film')}. A GIF needs nothing.") from error
    codec = CODECS[kind]
    count = 0
    with av.open(str(path), "w", format=kind) as container:
        stream = container.add_stream(codec, rate=shot.fps, options=OPTIONS[codec])
        assert isinstance(stream, av.VideoStream)  # what the codecs above make
        stream.width, stream.height, stream.pix_fmt = shot.width, shot.height, "yuv420p"
        if codec == "libvpx":
            stream.bit_rate = 1_500_000
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
        container.mux(stream.encode())
    return count


def _write_gif(path: Path, pictures: Iterator[Array], fps: int) -> int:
    """All frames share the palette of the first and a hot one, so that colours do not flicker."""
    images = []
    palette: Image.Image | None = None
    for picture in pictures:
        image = Image.fromarray(picture)
        if palette is None:
            palette = image.quantize(256)
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    first, *rest = images
    first.save(path, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, optimize=True)
    return len(images)
