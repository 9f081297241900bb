"""The fleet as a picture: the cell from above, each arm a ring of seven motors in the colour of their temperature.

Drawn with Pillow alone, so no display is needed; the same scene gives the same pixels. What stays for a cell (frame,
legend, stations) is drawn once and copied.
"""

from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw
from PIL.Image import Resampling

from fleet.env.floor_plan import NORMAL, FloorPlan, Pixel, floor_plan
from fleet.env.heat_colours import heat_colour, marks_c
from fleet.env.lettering import fitted, width, write
from fleet.env.queue_column import draw_queue
from fleet.env.scene import Cell, MountKind, Scene, scene_of
from fleet.sim.claims import Board
from fleet.sim.state import State, World
from fleet.telemetry import FAULTED, WORKING

Array = np.ndarray

INK, FAINT, LINE, PAPER, GROUND = "#222222", "#666666", "#c9c9c9", "#ffffff", "#f6f6f4"
WORK, FAULT = "#4477aa", "#cc2222"
PLATES = ("#ffffff", "#dfe9f3", "#f9d9d9")
"""Behind the motors of an idle, working, faulted arm."""
FINE = 4
"""Round things are drawn so many times larger and then reduced."""
ARC_STEPS = 60
ICONS: tuple[MountKind, ...] = ("floor", "wall", "ceiling", "tilted")


def picture(scene: Scene, size: Pixel = NORMAL) -> Array:
    """The scene as uint8 [height, width, 3].

    Args:
        size: Width and height, px.

    Raises:
        ValueError: a size too small to read or too large to draw.
    """
    plan = floor_plan(scene.cell, size)
    image = _background(scene.cell, size, scene.warning_c, scene.error_c).copy()
    draw = ImageDraw.Draw(image)
    _draw_work(image, draw, scene, plan)
    colours = heat_colour(scene.temp_c, scene.warning_c, scene.error_c)
    for a in range(len(scene.cell.arms)):
        _draw_arm(image, scene, plan, a, colours[a])
    for a in range(len(scene.cell.arms)):
        _name_arm(image, scene, plan, a)
    _draw_header(image, draw, scene, plan)
    draw_queue(image, draw, scene, plan)
    return np.array(image)


def draw(
    world: World,
    state: State,
    cell: Cell | None = None,
    size: Pixel = NORMAL,
    *,
    env: int = 0,
    board: Board | None = None,
    title: str = "",
) -> Array:
    """The simulator's truth about one env as a picture: `scene_of` and `picture` in one."""
    return picture(scene_of(world, state, cell, env=env, board=board, title=title), size)


@lru_cache(maxsize=16)
def _background(cell: Cell, size: Pixel, warning_c: float, error_c: float) -> Image.Image:
    plan = floor_plan(cell, size)
    image = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle(plan.floor, fill=GROUND)
    _draw_legend(image, draw, cell, plan, warning_c, error_c)
    for label in plan.labels:
        if label.tail is not None:
            draw.line((plan.stations[label.station], label.tail), "#9a9a9a", 1)
    for x, y in plan.stations:
        half = plan.station
        draw.rectangle((x - half, y - half, x + half, y + half), fill=PAPER, outline=FAINT)
    for base, ring in zip(plan.bases, plan.rings, strict=True):
        if np.hypot(base[0] - ring[0], base[1] - ring[1]) > 0.5 * plan.reach:
            draw.line((base, ring), LINE, 1)
            draw.ellipse((base[0] - 2, base[1] - 2, base[0] + 2, base[1] + 2), FAINT)
    return image


def legend_x(plan: FloorPlan, temp_c: float, warning_c: float, error_c: float) -> int:
    """Column of the legend that has the colour of a temperature."""
    left, right = _legend_ends(plan)
    low, *_, high = marks_c(warning_c, error_c)
    return round(left + (temp_c - low) / (high - low) * (right - left))


def legend_y(plan: FloorPlan) -> int:
    """Middle row of the legend's bar."""
    return plan.legend[1] + round(0.95 * plan.text)


def _legend_ends(plan: FloorPlan) -> Pixel:
    left, _, right, _ = plan.legend
    return left + 2 * plan.text, left + round(0.62 * (right - left))


def _draw_legend(
    image: Image.Image, draw: ImageDraw.ImageDraw, cell: Cell, plan: FloorPlan, warning_c: float, error_c: float
) -> None:
    left, right = _legend_ends(plan)
    middle, half = legend_y(plan), max(3, plan.text // 3)
    marks = marks_c(warning_c, error_c)
    columns = np.linspace(marks[0], marks[-1], right - left + 1)
    bar = np.repeat(heat_colour(columns, warning_c, error_c)[None], 2 * half + 1, axis=0)
    image.paste(Image.fromarray(bar), (left, middle - half))
    for temp_c in marks[:4]:
        x = legend_x(plan, temp_c, warning_c, error_c)
        bold = temp_c >= warning_c
        for begin, end in ((middle - half - 3, middle - half - 1), (middle + half + 1, middle + half + 3)):
            draw.line((x, begin, x, end), INK, 1)
        write(image, (x, middle + half + 4), f"{temp_c:g} °C", INK, plan.text, bold=bold, anchor="ma")
    x, y = right + 2 * plan.text, middle
    for kind in (kind for kind in ICONS if kind in cell.kinds):
        if x + 2 * plan.text + width(kind, plan.text) > plan.legend[2]:
            x, y = right + 2 * plan.text, y + round(1.3 * plan.text)
        _paste(image, _icon(kind, max(4, plan.text // 3)), (x, y), INK)
        write(image, (x + plan.text // 2 + 3, y), kind, FAINT, plan.text, anchor="lm")
        x += 2 * plan.text + width(kind, plan.text)
    hint = "1–7: base to tool; inside: hottest, °C"
    if plan.motor >= 8 and y == middle and width(hint, plan.text) < plan.legend[2] - right - 2 * plan.text:
        write(image, (right + 2 * plan.text - 4, y + round(1.5 * plan.text)), hint, FAINT, plan.text, anchor="lm")


def _draw_work(image: Image.Image, draw: ImageDraw.ImageDraw, scene: Scene, plan: FloorPlan) -> None:
    """Lines from the arms to the stations they occupy, and the names of all stations over them."""
    where = {name: at for (name, _), at in zip(scene.cell.stations, plan.stations, strict=True)}
    thick = max(2, round((3 if len(scene.cell.arms) <= 16 else 2) * plan.scale))
    for a, names in enumerate(scene.at):
        ends = [where[name] for name in names if name in where]
        for begin, end in zip([plan.rings[a], *ends], ends, strict=False):
            mask = _stroke(end[0] - begin[0], end[1] - begin[1], thick)
            _paste(image, mask, ((begin[0] + end[0]) // 2, (begin[1] + end[1]) // 2), WORK)
        for x, y in ends:
            half = plan.station
            draw.rectangle((x - half, y - half, x + half, y + half), fill=WORK, outline=INK)
    for label in plan.labels:
        write(image, label.at, label.text, FAINT, plan.text, anchor="lm", halo=GROUND)


def _draw_arm(image: Image.Image, scene: Scene, plan: FloorPlan, a: int, colours: Array) -> None:
    mode, (x, y) = scene.mode[a], plan.rings[a]
    sprite = _plate(plan.ring, plan.motor, plan.reach, mode, scene.cell.kinds[a])
    image.paste(sprite, (x - sprite.width // 2, y - sprite.height // 2), sprite)
    if mode == WORKING:
        steps = round(scene.share[a] * ARC_STEPS)
        if steps:
            _paste(image, _arc(plan.reach, steps), (x, y), WORK)
    temps = scene.temp_c[a].tolist()
    for j, at in enumerate(plan.motors(a)):
        hot = temps[j] >= scene.warning_c
        _paste(image, _disc(plan.motor + (1 if hot else 0)), at, INK if hot else "#8a8a8a")
        red, green, blue = colours[j].tolist()
        _paste(image, _disc(plan.motor - 1), at, (red, green, blue))
        if plan.motor >= 8:
            dark = temps[j] >= (scene.warning_c + scene.error_c) / 2
            write(image, at, str(j + 1), PAPER if dark else INK, round(1.1 * plan.motor), anchor="mm")
    inner = plan.ring - plan.motor
    letters = min(inner, round(1.5 * plan.text))
    if mode == FAULTED:
        _paste(image, _cross(max(3, round(0.8 * inner)), max(2, inner // 5)), (x, y), FAULT)
    elif letters >= 9:
        write(image, (x, y), f"{max(temps):.0f}", INK, letters, bold=True, anchor="mm")


def _name_arm(image: Image.Image, scene: Scene, plan: FloorPlan, a: int) -> None:
    """The name below the ring, and below that what the arm does."""
    (x, y), text, faulted = plan.rings[a], plan.text, scene.mode[a] == FAULTED
    name = _short_names(scene.cell.arms, text, plan.rooms)[a]
    at = (x, y + plan.reach + 1)
    write(image, at, name, FAULT if faulted else INK, text, bold=faulted, anchor="ma", halo=GROUND)
    if plan.rows > 1:
        what = "fault" if faulted else scene.job[a] or "idle"
        colour = FAULT if faulted else WORK if scene.job[a] else FAINT
        below = (x, at[1] + text + 2)
        write(image, below, fitted(what, text, plan.rooms[a]), colour, text, anchor="ma", halo=GROUND)


@lru_cache(maxsize=64)
def _short_names(names: tuple[str, ...], text: int, rooms: tuple[int, ...]) -> tuple[str, ...]:
    """Names that fit: where some do not, without what they all begin with; what is left is cut."""
    if len(names) > 1 and any(width(n, text) > room for n, room in zip(names, rooms, strict=True)):
        same = 0
        while len({name[: same + 1] for name in names}) == 1 and same < min(map(len, names)) - 1:
            same += 1
        names = tuple(name[same:] for name in names)
    return tuple(fitted(name, text, room) for name, room in zip(names, rooms, strict=True))


def _draw_header(image: Image.Image, draw: ImageDraw.ImageDraw, scene: Scene, plan: FloorPlan) -> None:
    (across, _), text, margin = plan.size, plan.text, plan.text // 2 + 2
    clock, whole = _clock(scene.time_s), f"of {_clock(scene.horizon_s)}"
    first, second = round(0.85 * text), round(2.25 * text)
    write(image, (margin, first), clock, INK, text, bold=True, anchor="lm")
    after = margin + width(clock, text, bold=True) + text // 2
    write(image, (after, first), whole, FAINT, text, anchor="lm")
    room = across - after - width(whole, text) - 2 * text
    write(image, (across - margin, first), fitted(scene.title, text, room), FAINT, text, anchor="rm")
    hottest_c = float(scene.temp_c.max())
    x = margin
    for words, bad in (
        (f"{scene.finished} finished", False),
        (f"{scene.waiting} waiting", False),
        (f"{scene.faults} fault{'' if scene.faults == 1 else 's'}", scene.faults > 0),
        (f"hottest {hottest_c:.1f} °C", hottest_c >= scene.warning_c),
    ):
        write(image, (x, second), words, FAULT if bad else INK, text, bold=bad, anchor="lm")
        x += width(words, text, bold=bad) + round(1.6 * text)
    done = min(1.0, scene.time_s / scene.horizon_s) if scene.horizon_s > 0 else 1.0
    draw.rectangle((0, plan.header - 3, across, plan.header - 1), fill="#e6e6e6")
    draw.rectangle((0, plan.header - 3, round(done * across), plan.header - 1), fill=FAINT)


def _clock(time_s: float) -> str:
    """h:mm:ss."""
    seconds = round(time_s)
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _paste(image: Image.Image, mask: Image.Image, middle: Pixel, colour: str | tuple[int, int, int]) -> None:
    image.paste(colour, (middle[0] - mask.width // 2, middle[1] - mask.height // 2), mask)


def _blank(half_width: int, half_height: int) -> tuple[Image.Image, ImageDraw.ImageDraw, Pixel]:
    """A large mask, what draws on it, and its middle."""
    size = ((2 * half_width + 1) * FINE, (2 * half_height + 1) * FINE)
    mask = Image.new("L", size)
    return mask, ImageDraw.Draw(mask), (size[0] // 2, size[1] // 2)


@lru_cache(maxsize=64)
def _disc(radius: int) -> Image.Image:
    mask, pen, (x, y) = _blank(radius + 1, radius + 1)
    pen.circle((x, y), (radius + 0.5) * FINE, 255)
    return mask.reduce(FINE)


@lru_cache(maxsize=256)
def _arc(radius: int, steps: int) -> Image.Image:
    """From the top clockwise, so many of `ARC_STEPS`."""
    mask, pen, (x, y) = _blank(radius + 1, radius + 1)
    far, thick = radius * FINE, max(2, radius // 14) * FINE
    pen.arc((x - far, y - far, x + far, y + far), -90, -90 + 360 * steps / ARC_STEPS, 255, thick)
    return mask.reduce(FINE)


@lru_cache(maxsize=16)
def _cross(radius: int, thick: int) -> Image.Image:
    mask, pen, (x, y) = _blank(radius, radius)
    far = round(radius * 0.75 * FINE)
    pen.line((x - far, y - far, x + far, y + far), 255, thick * FINE)
    pen.line((x - far, y + far, x + far, y - far), 255, thick * FINE)
    return mask.reduce(FINE)


@lru_cache(maxsize=512)
def _stroke(dx: int, dy: int, thick: int) -> Image.Image:
    """A line, about its middle."""
    mask, pen, (x, y) = _blank(abs(dx) // 2 + thick, abs(dy) // 2 + thick)
    pen.line((x - dx * FINE / 2, y - dy * FINE / 2, x + dx * FINE / 2, y + dy * FINE / 2), 255, thick * FINE)
    return mask.reduce(FINE)


@lru_cache(maxsize=16)
def _icon(kind: MountKind, half: int) -> Image.Image:
    """How an arm is fixed: square for the floor, bar for a wall, ring for the ceiling, diamond for tilted."""
    mask, pen, (x, y) = _blank(half, half)
    far = half * FINE
    if kind == "floor":
        pen.rectangle((x - far * 0.8, y - far * 0.8, x + far * 0.8, y + far * 0.8), 255)
    elif kind == "wall":
        pen.rectangle((x - far, y - far * 0.35, x + far, y + far * 0.35), 255)
    elif kind == "ceiling":
        pen.ellipse((x - far, y - far, x + far, y + far), 0, 255, max(FINE, round(far * 0.4)))
    else:
        pen.polygon(((x, y - far), (x + far, y), (x, y + far), (x - far, y)), 255)
    return mask.reduce(FINE)


@lru_cache(maxsize=64)
def _plate(ring: int, motor: int, reach: int, mode: int, kind: MountKind) -> Image.Image:
    """What lies behind the motors: a round plate in the colour of the mode, the links, and how the arm is fixed."""
    side = (2 * reach + 3) * FINE
    sprite = Image.new("RGBA", (side, side), (255, 255, 255, 0))
    pen, middle = ImageDraw.Draw(sprite), side // 2
    far = (reach + 0.5) * FINE
    edge = FAULT if mode == FAULTED else LINE
    thick = max(2, reach // 14) * FINE if mode == FAULTED else FINE
    pen.ellipse((middle - far, middle - far, middle + far, middle + far), PLATES[mode], edge, thick)
    around = ring * FINE
    pen.arc(
        (middle - around, middle - around, middle + around, middle + around), 135, 45, LINE, max(1, motor // 2) * FINE
    )
    small = sprite.resize((side // FINE, side // FINE), Resampling.BOX)
    icon = _icon(kind, max(2, round(0.42 * motor)))
    small.paste(INK, (small.width // 2 - icon.width // 2, small.height // 2 + ring - icon.height // 2), icon)
    return small
