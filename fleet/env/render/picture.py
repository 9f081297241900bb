"""The fleet as a picture: the cell from above, each arm a ring of seven motors coloured by their temperature.

Frames are drawn on matplotlib's Agg canvas, so no display is needed. The unchanged parts of a cell are drawn once and
restored for every frame.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.path import Path
from matplotlib.transforms import IdentityTransform
from numpy.typing import ArrayLike

from fleet.env.render.floor_plan import NORMAL, FloorPlan, Pixel, floor_plan, shortened, text_path, text_width
from fleet.env.render.heat import heat_colour, heat_marks
from fleet.env.render.scene import MountKind, QueuedJob, Scene
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray

INK, FAINT, LINE, PAPER, GROUND, BOX = "#222222", "#666666", "#c9c9c9", "#ffffff", "#f6f6f4", "#e4e0d8"
WORK, FAULT = "#4477aa", "#cc2222"
PLATES = ("#ffffff", "#dfe9f3", "#f9d9d9")
"""Background of an idle, a working and a faulted arm."""
MOUNTS: dict[MountKind, str] = {"floor": "■", "wall": "▬", "ceiling": "○", "tilted": "◆"}
"""Symbol of the mount of an arm."""
MOST_MARKS = 12
"""With more arms, the queue counts those that can take a job instead of marking each."""


class Picture:
    """Draws scenes in one size.

    The artists of a cell are made once and updated for every scene. Coordinates are pixels from the upper left corner.
    """

    def __init__(self, size: Pixel = NORMAL) -> None:
        self.size = size
        self._key: object = None

    def frame(self, scene: Scene) -> Array:
        """The scene as uint8 [height, width, 3].

        Raises:
            ValueError: the size is too small to read or too large to draw.
        """
        key = (scene.cell, scene.warning_c, scene.error_c)
        if self._key != key:
            self._prepare(scene)
            self._key = key
        self.canvas.restore_region(self.background)
        self._draw_work(scene)
        self._draw_arms(scene)
        self._draw_header(scene)
        self._draw_queue(scene)
        self._draw_texts()
        return np.array(self.canvas.buffer_rgba())[..., :3]

    def _prepare(self, scene: Scene) -> None:
        """Make the artists of a cell, and draw its background."""
        self.plan = plan = floor_plan(scene.cell, self.size)
        wide, high = self.size
        figure = Figure(figsize=(wide / 72, high / 72), dpi=72, facecolor=PAPER)  # 1 pt = 1 px
        self.canvas = FigureCanvasAgg(figure)
        self.axes = figure.add_axes((0, 0, 1, 1), xlim=(0, wide), ylim=(high, 0))
        self.axes.set_axis_off()
        self.canvas.draw()
        self.texts = self.axes.add_collection(PathCollection([], offset_transform=self.axes.transData), autolim=False)
        self.texts.set(transform=IdentityTransform(), snap=False)
        self.written: list[tuple[Path, tuple[float, float], str]] = []
        self.rectangle = self.axes.add_patch(Rectangle((0, 0), 1, 1))
        self.lines = self.axes.add_collection(LineCollection([]), autolim=False)
        self.plates = self._discs(plan.centres, plan.reach)
        self.motors = self._discs(plan.motors.reshape(-1, 2), plan.motor)
        self.stroke = max(2, plan.reach // 14)
        self.names = _common_part_dropped(scene.cell.arms, plan)
        self._draw_background(scene)
        self.background = self.canvas.copy_from_bbox(figure.bbox)

    def _draw_background(self, scene: Scene) -> None:
        plan, text = self.plan, self.plan.text
        self._box(plan.floor, GROUND)
        self._draw_fixtures(scene)
        away = [(at, station) for _, at, station in plan.labels if abs(at[1] - station[1]) > 2 * text]
        self._draw_lines(away, "#9a9a9a", 1)
        for at in plan.stations:
            self._square(at, PAPER, FAINT)
        moved = np.hypot(*(plan.bases - plan.centres).T) > 0.5 * plan.reach  # drawn beside their true position
        self._draw_lines(np.stack([plan.bases, plan.centres], axis=1)[moved], "#9a9a9a", 1)
        marks, (begin, end), y = heat_marks(scene.warning_c, scene.error_c), legend_ends(plan), legend_row(plan)
        x, half = np.arange(begin, end + 1) + 0.5, max(3, text // 3)
        colours = heat_colour(np.linspace(marks[0], marks[-1], len(x)), scene.warning_c, scene.error_c)
        self._draw_lines([((i, y - half), (i, y + half + 1)) for i in x], colours, 2)
        for mark, i in zip(marks[:4], np.interp(marks[:4], marks[[0, -1]], [begin, end]), strict=True):
            self._draw_lines([((i, y + half), (i, y + half + 4))], INK, 1)
            self._write((i, y + half + 4 + text // 2), f"{mark:g} °C", INK, bold=mark >= scene.warning_c, ha="center")
        left, right = end + 2 * text, plan.floor[2]
        kinds = "  ".join(f"{mark} {kind}" for kind, mark in MOUNTS.items() if kind in scene.cell.kinds)
        self._write((left, y), shortened(kinds, text, right - left), FAINT)
        if plan.motor >= 8:
            hint = shortened("1–7: base to tool; inside: hottest, °C", text, right - left)
            self._write((left, y + round(1.5 * text)), hint, FAINT)
        self._draw_texts()

    def _draw_fixtures(self, scene: Scene) -> None:
        """Outlines and names of the fixtures, cut at the edges of the floor."""
        plan, text = self.plan, self.plan.text
        left, top, right, bottom = plan.floor
        for fixture, outline in zip(scene.cell.fixtures, plan.fixtures, strict=True):
            box = self.axes.add_patch(Polygon(outline, facecolor=BOX, edgecolor=FAINT))
            box.set_clip_path(Rectangle((left, top), right - left, bottom - top, transform=self.axes.transData))
            self.axes.draw_artist(box)
            low, high = (np.clip(end, (left, top), (right, bottom)) for end in (outline.min(0), outline.max(0)))
            name = shortened(fixture.name, text, high[0] - low[0] - text)
            if high[1] - low[1] > 2 * text:
                self._write((low + high) / 2, name, FAINT, ha="center")

    def _draw_work(self, scene: Scene) -> None:
        """Lines from the arms to the stations they occupy, and the names of all stations over them."""
        where = {name: at for (name, _), at in zip(scene.cell.stations, self.plan.stations, strict=True)}
        stops = [[where[name] for name in names if name in where] for names in scene.at]
        routes = [np.stack([self.plan.centres[a], *ends]) for a, ends in enumerate(stops) if ends]
        self._draw_lines(routes, WORK, self.stroke * 0.8)
        for at in (at for ends in stops for at in ends):
            self._square(at, WORK, INK)
        for name, at, _ in self.plan.labels:
            self._write(at, name, FAINT, ground=True)

    def _draw_arms(self, scene: Scene) -> None:
        plan, mode, temp_c = self.plan, np.array(scene.mode), scene.temp_c
        lost, hot = mode == FAULTED, temp_c.ravel() >= scene.warning_c
        self.plates.set(facecolor=[PLATES[m] for m in scene.mode], edgecolor=np.where(lost, FAULT, LINE))
        self.plates.set_linewidth(np.where(lost, self.stroke, 1).tolist())
        self.axes.draw_artist(self.plates)
        self._draw_lines(plan.motors, LINE, plan.motor / 2)
        working = [_arc(plan.centres[a], plan.reach, scene.progress[a]) for a in np.flatnonzero(mode == WORKING)]
        self._draw_lines(working, WORK, self.stroke)
        self.motors.set(facecolor=heat_colour(temp_c.ravel(), scene.warning_c, scene.error_c))
        self.motors.set(edgecolor=np.where(hot, INK, "#8a8a8a"), linewidth=np.where(hot, 1.6, 0.8))
        self.axes.draw_artist(self.motors)
        inner = round(0.91 * plan.reach) - 2 * plan.motor
        cross = 0.6 * inner * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
        self._draw_lines([at + line for at in plan.centres[lost] for line in cross], FAULT, 2 * self.stroke)
        foot = plan.centres[0, 1] - plan.motors[0, 3, 1]  # opposite of joint 4
        for a, (x, y) in enumerate(plan.centres.tolist()):
            self._write((x, y + foot), MOUNTS[scene.cell.kinds[a]], INK, size=plan.motor, ha="center")
            for j, at in enumerate(plan.motors[a] if plan.motor >= 8 else ()):
                ink = PAPER if temp_c[a, j] >= (scene.warning_c + scene.error_c) / 2 else INK
                self._write(at, str(j + 1), ink, size=round(1.1 * plan.motor), ha="center")
            size = min(inner, round(1.5 * plan.text))
            if size >= 9 and not lost[a]:
                self._write((x, y), f"{temp_c[a].max():.0f}", INK, size=size, bold=True, ha="center")
            y += plan.reach + plan.text // 2 + 4
            does, colour = ("fault", FAULT) if lost[a] else (scene.job[a], WORK) if scene.job[a] else ("idle", FAINT)
            name_colour = FAULT if lost[a] else INK
            self._write((x, y), self.names[a], name_colour, bold=bool(lost[a]), ha="center", ground=True)
            if plan.rows > 1:
                does = shortened(does, plan.text, plan.room[a])
                self._write((x, y + plan.text + 2), does, colour, ha="center", ground=True)

    def _draw_header(self, scene: Scene) -> None:
        wide, text, bottom = self.plan.size[0], self.plan.text, self.plan.floor[1]
        margin, first, x = text // 2 + 2, round(0.85 * text), text // 2 + 2
        time, whole = _clock(scene.time_s), f"of {_clock(scene.horizon_s)}"
        after = margin + text_width(time, text, True) + text // 2
        self._write((margin, first), time, INK, bold=True)
        self._write((after, first), whole, FAINT)
        room = wide - after - text_width(whole, text) - 2 * text
        self._write((wide - margin, first), shortened(scene.title, text, room), FAINT, ha="right")
        hottest_c = float(scene.temp_c.max())
        for part, bad in (
            (f"{scene.finished} finished", False),
            (f"{scene.waiting} waiting", False),
            (f"{scene.faults} fault{'' if scene.faults == 1 else 's'}", scene.faults > 0),
            (f"hottest {hottest_c:.1f} °C", hottest_c >= scene.warning_c),
        ):
            self._write((x, round(2.2 * text)), part, FAULT if bad else INK, bold=bad)
            x += text_width(part, text, bad) + round(1.6 * text)
        share = min(1.0, scene.time_s / scene.horizon_s) if scene.horizon_s > 0 else 1.0
        self._box((0, bottom - 3, wide, bottom), "#e6e6e6")
        self._box((0, bottom - 3, round(share * wide), bottom), FAINT)

    def _draw_queue(self, scene: Scene) -> None:
        """The jobs in the slots, oldest first, beside the cell; the last line counts those without room."""
        plan, text, line = self.plan, self.plan.text, round(1.35 * self.plan.text)
        x, right, y = plan.floor[2] + text // 2 + 2, plan.size[0] - text // 2 - 2, plan.floor[1] + text + 2
        self._write((x, y), "Queue" if scene.queue else "Queue: nothing on offer", INK, bold=True)
        y += round(1.7 * text)
        bottom, each = plan.size[1] - 2 * line, 3 * line + text // 2
        shown = max(0, min(len(scene.queue), (bottom - y) // each))
        for job in scene.queue[:shown]:
            self._write((x, y), shortened(job.job, text, right - x), INK)
            mass, late = f"{job.payload_kg:g} kg" if job.payload_kg else "no payload", job.due_in_s < 0
            self._write((x, y + line), mass, FAINT)
            due = shortened(time_left(job.due_in_s), text, right - x - text_width(mass, text) - text // 2, late)
            self._write((right, y + line), due, FAULT if late else FAINT, bold=late, ha="right")
            self._write((x, y + 2 * line), shortened(takers(job), text, right - x), WORK if any(job.free) else FAINT)
            y += each
        if scene.waiting > shown:
            self._write((x, y), f"+ {scene.waiting - shown} more", FAINT)
        if scene.queue and len(scene.cell.arms) <= MOST_MARKS:
            self._write((x, bottom + line), shortened("■ free  □ busy  – unable", text, right - x), FAINT)

    def _write(
        self,
        at: Sequence[float],
        text: str,
        colour: str,
        *,
        size: int | None = None,
        bold: bool = False,
        ha: str = "left",
        ground: bool = False,
    ) -> None:
        """Write one line of text, centred at `at`; drawn by `_draw_texts`. `ground` covers the background."""
        size = size or self.plan.text
        wide = text_width(text, size, bold)
        x = at[0] - {"left": 0.0, "center": wide / 2, "right": wide}[ha]
        if ground and text:
            self._box((x, at[1] - 0.5 * size, x + wide, at[1] + 0.6 * size), GROUND)
        self.written.append((text_path(text, size, bold), (x, at[1] + 0.36 * size), colour))

    def _draw_texts(self) -> None:
        paths, offsets, colours = zip(*self.written, strict=True)
        self.texts.set(paths=paths, offsets=offsets, facecolor=colours, linewidth=0)
        self.axes.draw_artist(self.texts)
        self.written.clear()

    def _box(self, box: tuple[float, float, float, float], colour: str, edge: str = "none") -> None:
        left, top, right, bottom = box
        self.rectangle.set(xy=(left, top), width=right - left, height=bottom - top, facecolor=colour, edgecolor=edge)
        self.axes.draw_artist(self.rectangle)

    def _square(self, at: Array, colour: str, edge: str) -> None:
        x, y = at.tolist()
        half = self.plan.station
        self._box((x - half, y - half, x + half, y + half), colour, edge)

    def _draw_lines(self, lines: Sequence[ArrayLike] | Array, colour: str | Array, width: float) -> None:
        self.lines.set(segments=list(lines), color=colour, linewidth=width)
        self.axes.draw_artist(self.lines)

    def _discs(self, centres: Array, radius: float) -> EllipseCollection:
        sides = np.full(len(centres), 2 * radius)
        data = self.axes.transData
        discs = EllipseCollection(sides, sides, 0 * sides, units="xy", offsets=centres, offset_transform=data)
        self.axes.add_collection(discs, autolim=False)
        return discs


def legend_ends(plan: FloorPlan) -> Pixel:
    """First and last column of the colour scale."""
    return 2 * plan.text, round(0.62 * plan.floor[2])


def legend_row(plan: FloorPlan) -> int:
    """Middle row of the colour scale."""
    return plan.floor[3] + round(0.95 * plan.text)


def takers(job: QueuedJob) -> str:
    """A mark per arm: ■ may claim the job now, □ could but is busy or its station is, – has no plan for it."""
    if len(job.able) > MOST_MARKS:
        return f"{sum(job.free)} free of {sum(job.able)} able"
    return " ".join("■" if free else "□" if able else "–" for able, free in zip(job.able, job.free, strict=True))


def time_left(due_in_s: float) -> str:
    """Time until a job is due, such as `12 min left` or `2.5 h late`."""
    minutes = abs(due_in_s) / 60
    amount = f"{minutes / 60:.1f} h" if minutes >= 100 else f"{minutes:.0f} min"
    return f"{amount} late" if due_in_s < 0 else f"{amount} left"


def _clock(time_s: float) -> str:
    """h:mm:ss."""
    minutes, seconds = divmod(round(time_s), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def _arc(centre: Array, radius: float, share: float) -> Array:
    """Part of a circle, clockwise from the top, [point, 2]."""
    angle = np.linspace(0.0, 2 * np.pi * share, 61)
    return centre + radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1)


def _common_part_dropped(names: tuple[str, ...], plan: FloorPlan) -> list[str]:
    """Names of arms that fit below them; if some do not, all lose their common prefix."""
    room = plan.room.tolist()
    if any(text_width(name, plan.text) > wide for name, wide in zip(names, room, strict=True)):
        same = next((i for i, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1), 0)
        names = tuple(name[same:] for name in names)
    return [shortened(name, plan.text, wide) for name, wide in zip(names, room, strict=True)]
