"""The fleet as a picture: the cell from above, each arm a ring of seven motors coloured by their temperature.

Frames are drawn on matplotlib's Agg canvas, so no display is needed. Coordinates are pixels from the upper left corner.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from os.path import commonprefix
from typing import Any  # options of matplotlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle
from scipy.spatial import ConvexHull

from fleet.env.render.heat import heat_colour, heat_marks
from fleet.env.render.scene import CellMap, MountKind, QueuedJob, Scene
from fleet.errors import visible
from fleet.job import Fixture
from fleet.robot import JOINTS, rotation
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray

WIDTH, HEIGHT = 960, 640
FLOOR = (0, 44, 690, 596)
"""Left, top, right and bottom of the map."""
TEXT, LINE, LETTER = 13, 18, 7.7
"""Height of letters and of a line, and width that a letter takes at most on average."""
MOST_REACH = 60
"""Outer radius of an arm that has enough room."""
STATION = 6
"""Half the side of a station's square."""
SCALE = (24, 430, 608, 618)
"""Left, right, top and bottom of the colour scale."""
ROUNDS = 150
"""Iterations of moving overlapping arms apart."""
MOST_ACTIVITIES = 16
"""Larger fleets have no room for what each arm does."""
MOST_MARKS = 12
"""With more arms, the queue counts those that can take a job instead of marking each."""
SMALLEST_TEXT = 9
"""Height of the temperature inside an arm, from which it is written."""
LINES, PLATE, LINKS, MOTORS, ABOVE = 2, 3, 4, 5, 6
"""Order in which artists cover each other."""

INK, FAINT, EDGE, PAPER, GROUND, BOX = "#222222", "#666666", "#c9c9c9", "#ffffff", "#f6f6f4", "#e4e0d8"
WORK, FAULT = "#4477aa", "#cc2222"
PLATES = ("#ffffff", "#dfe9f3", "#f9d9d9")
"""Background of an idle, a working and a faulted arm."""
MOUNTS: dict[MountKind, str] = {"floor": "■", "wall": "▬", "ceiling": "○", "tilted": "◆"}
"""Symbol of the mount of an arm."""


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Layout of one cell in the picture."""

    reach: int
    """Outer radius of an arm."""
    bases: Array
    """Position of each arm, [arm, 2]."""
    centres: Array
    """Position of the drawing of each arm, moved where arms overlap, [arm, 2]."""
    stations: Array
    """[station, 2]."""
    labels: tuple[tuple[str, float, float], ...]
    """Station names with enough room: text, left end of its middle line."""
    fixtures: tuple[tuple[Array, ...], ...]
    """Outlines of each fixture from above, see `outlines`; they may reach beyond the floor."""

    @property
    def motor(self) -> int:
        """Radius of a motor."""
        return max(2, round(0.23 * self.reach))

    @property
    def motors(self) -> Array:
        """Centres of the motors, base to tool clockwise with a gap at the bottom, [arm, joint, 2]."""
        angle = 2 * np.pi * np.arange(1, JOINTS + 1) / (JOINTS + 1)
        ring = 0.91 * self.reach - self.motor
        return self.centres[:, None] + ring * np.stack([-np.sin(angle), np.cos(angle)], axis=1)


@lru_cache(maxsize=32)
def floor_plan(cell: CellMap) -> FloorPlan:
    """Layout of a cell: a map, x to the right and y up, as large as the floor allows."""
    arms = len(cell.arms)
    left, top, right, bottom = FLOOR
    below = LINE * (2 if arms <= MOST_ACTIVITIES else 1)
    reach = round(max(9.0, min(MOST_REACH, 0.38 * np.sqrt((right - left) * (bottom - top) / arms) - below / 2)))
    points = np.array([p[:2] for p in cell.mounts_m] + [p[:2] for _, p in cell.stations])
    low, high = points.min(axis=0), points.max(axis=0)
    corner = np.array([left + reach + 8, top + reach + 8])
    other = np.array([right - reach - 8, bottom - reach - 8 - below])
    px_per_m = np.min((other - corner) / np.maximum(high - low, 0.2))

    def on_floor(points_m: Array) -> Array:
        return (corner + other) / 2 + (points_m - (low + high) / 2) * px_per_m * [1.0, -1.0]

    bases, stations = np.split(on_floor(points), [arms])
    centres = _spread_apart(bases, stations, (corner, other), reach, below)
    labels = _place_labels([name for name, _ in cell.stations], centres, stations, reach, below)
    fixtures = tuple(tuple(map(on_floor, outlines(fixture))) for fixture in cell.fixtures)
    return FloorPlan(reach, bases, centres, stations, labels, fixtures)


def outlines(fixture: Fixture) -> list[Array]:
    """Corners of the shadow of each convex part of a fixture on the floor, m, [corner, 2]."""
    turn = rotation(fixture.tilt_deg)
    shadows = [(corners @ turn.T + fixture.position_m)[:, :2] for corners in fixture.parts_m]
    return [shadow[ConvexHull(shadow).vertices] for shadow in shadows]


def _spread_apart(bases: Array, stations: Array, corners: tuple[Array, Array], reach: int, below: int) -> Array:
    """Positions near the bases at which arms cover neither each other nor, where possible, a station, [arm, 2]."""
    turn = 2.399963 * np.arange(len(bases))  # arms at one position move apart in different directions
    at = home = bases + 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    for i in range(ROUNDS):
        at = at + 0.08 * (1 - i / ROUNDS) * (home - at)
        for others, shift, clear, norm, share in (  # a station overlaps no text either: nearly a rectangle
            (stations, below / 2, [reach + 14.0, reach + below / 2 + 14.0], 4, 0.4),
            (at, 0.0, [2.0 * reach + 4, 2.0 * reach + below + 2], 2, 0.5),
        ):
            gap = at[:, None] + [0.0, shift] - others  # [arm, other, 2]
            near = np.linalg.norm(gap / clear, ord=norm, axis=-1, keepdims=True)
            away = np.where((near < 1) & (near > 0), gap / np.maximum(near, 1e-6) * (1 - near), 0.0)
            at = at + share * np.clip(away, -np.array(clear), clear).sum(axis=1)
        at = np.clip(at, *corners)
    return at


def _place_labels(
    names: Sequence[str], centres: Array, stations: Array, reach: int, below: int
) -> tuple[tuple[str, float, float], ...]:
    """Names of stations, each on the first free side of its square; a name without one is left out."""
    half, labels = TEXT / 2 + 1, list[tuple[str, float, float]]()
    taken = [(x - reach, y - reach, x + reach, y + reach + below) for x, y in centres.tolist()]
    taken += [(x - STATION, y - STATION, x + STATION, y + STATION) for x, y in stations.tolist()]
    for name, (x, y) in zip(names, stations.tolist(), strict=True):
        text = shorten(name, FLOOR[2])
        wide, aside, above = LETTER * len(text), STATION + 3, STATION + TEXT / 2 + 3
        for left, middle in (
            (x + aside, y),
            (x - aside - wide, y),
            (x - wide / 2, y - above),
            (x - wide / 2, y + above),
        ):
            box = (left - 1, middle - half, left + wide + 1, middle + half)
            inside = FLOOR[0] < box[0] and FLOOR[1] < box[1] and box[2] < FLOOR[2] and box[3] < FLOOR[3]
            if inside and all(box[2] <= a or c <= box[0] or box[3] <= b or d <= box[1] for a, b, c, d in taken):
                labels.append((text, left, middle))
                taken.append(box)
                break
    return tuple(labels)


def shorten(text: str, room_px: float) -> str:
    """The text on one line, with … in the middle if it is too wide."""
    line, most = visible(text), int(room_px / LETTER)
    if len(line) <= most:
        return line
    return f"{line[: (most - 1) // 2]}…{line[len(line) - most // 2 :]}" if most > 1 else ""


def draw(scene: Scene) -> Array:
    """The scene as uint8 [height, width, 3]."""
    figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72), dpi=72, facecolor=PAPER)  # 1 pt = 1 px
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.set_axis_off()
    plan = floor_plan(scene.cell)
    _draw_cell(axes, scene, plan)
    _draw_arms(axes, scene, plan)
    _draw_header(axes, scene)
    _draw_queue(axes, scene)
    _draw_scale(axes, scene)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph .* missing")  # matplotlib draws a box
        canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _write(
    axes: Axes,
    x: float,
    y: float,
    text: str,
    colour: str = INK,
    *,
    size: float = TEXT,
    ha: str = "left",
    bold: bool = False,
    ground: bool = False,
) -> None:
    """Write one line of text whose middle is at y; `ground` covers lines, and arms cover it."""
    style: dict[str, Any] = {"color": colour, "fontsize": size, "family": "DejaVu Sans", "zorder": ABOVE}
    if bold:
        style["fontweight"] = "bold"
    if ground:
        style |= {"zorder": LINES + 0.5, "bbox": {"facecolor": GROUND, "edgecolor": "none", "pad": 0.5}}
    axes.text(x, y, text, ha=ha, va="center_baseline", parse_math=False, **style)


def _draw_cell(axes: Axes, scene: Scene, plan: FloorPlan) -> None:
    """Fixtures, stations, and lines from the arms to the stations they occupy."""
    left, top, right, bottom = FLOOR
    floor = axes.add_patch(Rectangle((left, top), right - left, bottom - top, facecolor=GROUND))
    for fixture, parts in zip(scene.cell.fixtures, plan.fixtures, strict=True):
        for outline in parts:
            axes.add_patch(Polygon(outline, facecolor=BOX, edgecolor=FAINT)).set_clip_path(floor)
        points = np.concatenate(parts)
        low, high = (np.clip(end, (left, top), (right, bottom)) for end in (points.min(axis=0), points.max(axis=0)))
        if high[1] - low[1] > 2 * TEXT:
            x, y = (low + high) / 2
            _write(axes, x, y, shorten(fixture.name, high[0] - low[0] - TEXT), FAINT, ha="center")
    moved = np.hypot(*(plan.bases - plan.centres).T) > 0.5 * plan.reach  # drawn beside their true position
    axes.add_collection(
        LineCollection([*np.stack([plan.bases, plan.centres], axis=1)[moved]], color="#9a9a9a", zorder=LINES)
    )
    where = {name: at for (name, _), at in zip(scene.cell.stations, plan.stations, strict=True)}
    stops = [[where[name] for name in names if name in where] for names in scene.at]
    routes = [np.stack([plan.centres[a], *ends]) for a, ends in enumerate(stops) if ends]
    axes.add_collection(LineCollection(routes, color=WORK, linewidth=3, zorder=LINES))
    used = {tuple(at) for ends in stops for at in ends}
    for x, y in plan.stations:
        square = Rectangle((x - STATION, y - STATION), 2 * STATION, 2 * STATION, zorder=PLATE)
        square.set(facecolor=WORK if (x, y) in used else PAPER, edgecolor=INK if (x, y) in used else FAINT)
        axes.add_patch(square)
    for text, x, y in plan.labels:
        _write(axes, x, y, text, FAINT, ground=True)


def _draw_arms(axes: Axes, scene: Scene, plan: FloorPlan) -> None:
    mode, temp_c, temps = np.array(scene.mode), scene.temp_c, scene.temp_c.ravel()
    faulted, hot = mode == FAULTED, temps >= scene.warning_c
    _add_discs(axes, plan.centres, plan.reach, [PLATES[m] for m in scene.mode], np.where(faulted, FAULT, EDGE), PLATE)
    axes.add_collection(LineCollection([*plan.motors], color=EDGE, linewidth=plan.motor / 2, zorder=LINKS))
    for (x, y), share in zip(plan.centres[mode == WORKING], np.array(scene.progress)[mode == WORKING], strict=True):
        style = {"angle": -90, "theta1": 0, "theta2": 360 * share, "edgecolor": WORK, "linewidth": 4, "zorder": LINKS}
        axes.add_patch(Arc((x, y), 2 * plan.reach, 2 * plan.reach, **style))
    colours = heat_colour(temps, scene.warning_c, scene.error_c)
    _add_discs(axes, plan.motors.reshape(-1, 2), plan.motor, colours, np.where(hot, INK, "#8a8a8a"), MOTORS)
    inner = 0.91 * plan.reach - 2 * plan.motor
    cross = 0.6 * inner * np.array([[[-1, -1], [1, 1]], [[-1, 1], [1, -1]]])
    lines = [at + line for at in plan.centres[faulted] for line in cross]
    axes.add_collection(LineCollection(lines, color=FAULT, linewidth=8, zorder=ABOVE))
    names, kinds = scene.cell.arms, scene.cell.kinds
    if LETTER * max(map(len, names)) > 2 * plan.reach:
        names = [name.removeprefix(commonprefix(names)) or name for name in names]  # noqa: RUF071  # no paths
    if len(set(kinds)) > 1:
        names = [f"{MOUNTS[kind]} {name}" for kind, name in zip(kinds, names, strict=True)]
    for a, (x, y) in enumerate(plan.centres):
        if inner >= SMALLEST_TEXT and not faulted[a]:
            _write(axes, x, y, f"{temp_c[a].max():.0f}", size=min(inner, 1.5 * TEXT), ha="center", bold=True)
        name, y = shorten(names[a], 2 * plan.reach), y + plan.reach + LINE / 2 + 2
        _write(axes, x, y, name, FAULT if faulted[a] else INK, ha="center", bold=bool(faulted[a]), ground=True)
        if len(mode) <= MOST_ACTIVITIES:
            activity = "fault" if faulted[a] else shorten(scene.job[a], 2 * plan.reach) or "idle"
            colour = FAULT if faulted[a] else WORK if scene.job[a] else FAINT
            _write(axes, x, y + LINE, activity, colour, ha="center", ground=True)


def _add_discs(axes: Axes, centres: Array, radius: float, face: Sequence[str] | Array, edge: Array, order: int) -> None:
    size = np.full(len(centres), 2 * radius)
    place = {"units": "xy", "offsets": centres, "offset_transform": axes.transData, "zorder": order}
    axes.add_collection(EllipseCollection(size, size, 0 * size, facecolor=face, edgecolor=edge, linewidth=1.2, **place))


def _draw_header(axes: Axes, scene: Scene) -> None:
    top, share = FLOOR[1], min(1.0, scene.time_s / scene.horizon_s) if scene.horizon_s > 0 else 1.0
    _write(axes, 8, 11, _clock(scene.time_s), bold=True)
    _write(axes, 75, 11, f"of {_clock(scene.horizon_s)}", FAINT)
    _write(axes, WIDTH - 8, 11, shorten(scene.title, WIDTH - 200), FAINT, ha="right")
    hottest_c = float(scene.temp_c.max())
    for x, text, bad in (
        (8, f"{scene.finished} finished", False),
        (150, f"{scene.waiting} waiting", False),
        (290, f"{scene.faults} fault{'' if scene.faults == 1 else 's'}", scene.faults > 0),
        (420, f"hottest {hottest_c:.1f} °C", hottest_c >= scene.warning_c),
    ):
        _write(axes, x, 29, text, FAULT if bad else INK, bold=bad)
    for width, colour in ((WIDTH, "#e6e6e6"), (share * WIDTH, FAINT)):
        axes.add_patch(Rectangle((0, top - 3), width, 3, facecolor=colour))


def _draw_queue(axes: Axes, scene: Scene) -> None:
    """The jobs in the slots, oldest first, beside the cell; the last line counts those without room."""
    x, right, y, bottom = FLOOR[2] + 8, WIDTH - 8, FLOOR[1] + 15, HEIGHT - 2 * LINE
    _write(axes, x, y, "Queue" if scene.queue else "Queue: nothing on offer", bold=True)
    y, each = y + 24, 3 * LINE + 6
    shown = (bottom - y) // each
    for job in scene.queue[:shown]:
        late = job.due_in_s < 0
        _write(axes, x, y, shorten(job.job, right - x))
        _write(axes, x, y + LINE, f"{job.payload_kg:g} kg" if job.payload_kg else "no payload", FAINT)
        _write(axes, right, y + LINE, time_left(job.due_in_s), FAULT if late else FAINT, ha="right", bold=late)
        _write(axes, x, y + 2 * LINE, _describe_takers(job), WORK if any(job.free) else FAINT)
        y += each
    if scene.waiting > shown:
        _write(axes, x, y, f"+ {scene.waiting - shown} more", FAINT)
    if scene.queue and len(scene.cell.arms) <= MOST_MARKS:
        _write(axes, x, bottom + LINE, "■ free  □ busy  – unable", FAINT)


def _draw_scale(axes: Axes, scene: Scene) -> None:
    """The colour scale of the motors, and what else needs a legend."""
    left, right, top, bottom = SCALE
    marks = heat_marks(scene.warning_c, scene.error_c)
    colours = heat_colour(np.linspace(marks[0], marks[-1], right - left), scene.warning_c, scene.error_c)
    axes.imshow(colours[None], extent=(left, right, bottom, top), aspect="auto", interpolation="nearest")
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    for mark, x in zip(marks[:4], np.interp(marks[:4], marks[[0, -1]], [left, right]), strict=True):
        axes.add_patch(Rectangle((x - 0.5, bottom), 1, 4, facecolor=INK))
        _write(axes, x, bottom + 12, f"{mark:g} °C", ha="center", bold=mark >= scene.warning_c)
    used = [f"{mark} {kind}" for kind, mark in MOUNTS.items() if kind in scene.cell.kinds]
    if len(used) > 1:
        _write(axes, right + 30, (top + bottom) / 2, "  ".join(used), FAINT)
    _write(axes, right + 30, bottom + 12, "clockwise from base to tool; hottest, °C", FAINT, size=11)


def _describe_takers(job: QueuedJob) -> str:
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
