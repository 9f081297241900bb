"""The column beside the cell: what waits to be claimed, how urgent it is, and who may take it."""

from PIL import Image, ImageDraw

from fleet.env.floor_plan import FloorPlan
from fleet.env.lettering import fitted, width, write
from fleet.env.scene import Offer, Scene

INK, FAINT, LINE, ACCENT, LATE = "#222222", "#666666", "#c9c9c9", "#4477aa", "#cc2222"
MOST_MARKS = 12
"""Above this many arms, those who may are counted and not marked one by one."""


def draw_queue(image: Image.Image, draw: ImageDraw.ImageDraw, scene: Scene, plan: FloorPlan) -> None:
    """The jobs on offer, oldest first; the last line counts those that found no room."""
    left, top, right, bottom = plan.side
    text, margin = plan.text, plan.text // 2 + 2
    x, room = left + margin, right - left - 2 * margin
    line = round(1.35 * text)
    y = top + margin
    write(image, (x, y), "Queue", INK, text, bold=True, anchor="la")
    y += round(1.7 * text)
    if not scene.offers:
        write(image, (x, y), "nothing on offer", FAINT, text, anchor="la")
        y += line
    each = 3 * line + text // 2
    shown = max(0, min(len(scene.offers), (bottom - 2 * line - y) // each))
    for offer in scene.offers[:shown]:
        write(image, (x, y), fitted(offer.job, text, room), INK, text, anchor="la")
        mass = f"{offer.payload_kg:g} kg" if offer.payload_kg else "no payload"
        write(image, (x, y + line), mass, FAINT, text, anchor="la")
        late = offer.due_in_s < 0
        words = fitted(due(offer.due_in_s), text, room - width(mass, text) - text // 2, bold=late)
        write(image, (x + room, y + line), words, LATE if late else FAINT, text, bold=late, anchor="ra")
        _draw_takers(image, draw, offer, plan, (x, y + 2 * line), room)
        y += each
        draw.line((x, y - text // 3, x + room, y - text // 3), "#e6e6e6", 1)
    hidden = scene.waiting - shown
    if hidden > 0:
        write(image, (x, y), f"+ {hidden} more", FAINT, text, anchor="la")
    if scene.offers and len(scene.cell.arms) <= MOST_MARKS:
        middle, half = bottom - line, max(2, text // 3)
        for words, fill in (("free", ACCENT), ("busy", None)):
            draw.rectangle((x, middle - half, x + 2 * half, middle + half), fill=fill, outline=fill or "#8a8a8a")
            write(image, (x + 2 * half + 5, middle), words, FAINT, text)
            x += 2 * half + 5 + width(words, text) + text
        if x + 2 * half + 5 + width("unable", text) < right:
            draw.line((x, middle, x + 2 * half, middle), LINE, 1)
            write(image, (x + 2 * half + 5, middle), "unable", FAINT, text)


def due(due_in_s: float) -> str:
    """How long a job has, in words."""
    minutes = abs(due_in_s) / 60
    much = f"{minutes / 60:.1f} h" if minutes >= 100 else f"{minutes:.0f} min"
    return f"{much} late" if due_in_s < 0 else f"{much} left"


def _draw_takers(
    image: Image.Image, draw: ImageDraw.ImageDraw, offer: Offer, plan: FloorPlan, at: tuple[int, int], room: int
) -> None:
    """A mark per arm: full may take it now, hollow could but is busy or its station is, a dash cannot."""
    (x, y), text = at, plan.text
    if len(offer.able) > MOST_MARKS:
        words = f"{sum(offer.free)} free of {sum(offer.able)} able"
        write(image, (x, y), fitted(words, text, room), ACCENT if any(offer.free) else FAINT, text, anchor="la")
        return
    half = max(2, text // 3)
    step = min(2 * half + 5, room // len(offer.able))
    middle = y + half + 2
    for i, (able, free) in enumerate(zip(offer.able, offer.free, strict=True)):
        left = x + i * step
        if able:
            box = (left, middle - half, left + 2 * half, middle + half)
            draw.rectangle(box, fill=ACCENT if free else None, outline=ACCENT if free else "#8a8a8a")
        else:
            draw.line((left + 1, middle, left + 2 * half - 1, middle), LINE, 1)
