"""The cell of a scenario as a picture: plan in metres, reach of each arm, places out of reach, and exclusions."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # options of matplotlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.transforms import Bbox

from fleet.arm.kinematics import FOREARM_M, HAND_M, REACH_M, UPPER_ARM_M
from fleet.env.render.picture import FAULT, INK, outlines
from fleet.env.render.scene import mount_kind
from scenarios.show.charts import COLOURS, shortened
from scenarios.show.layout import LayoutReport, Reach, shoulder_m
from scenarios.show.page import Badge, Head, Page, Section
from scenarios.spec.schema import Scenario
from scenarios.table import render

Array = np.ndarray
MOST_NAMED, MOST_NUMBERS, MOST_ROWS = 16, 24, 40
"""Arms whose mounts are described; rows of a matrix of exclusions with numbers; rows of the largest matrix drawn."""
LEGEND = "reach {:.2f} m above the floor: dashed outstretched, filled with the tool pointing down"
ARM_NAME, JOB_NAME = 16, 30
"""Most characters of names in the picture; of jobs also places and scenarios."""
LETTERS_PER_IN = 13
"""Of the lines below a picture."""
LEAST_IN, MATRIX_IN, IN_PER_M = (7.6, 6.6), 5.4, 0.8
"""Smallest width and height of a picture without exclusions, width of these, and the scale of large cells."""


def draw_plan(file: Path, scenario: Scenario, report: LayoutReport) -> None:
    """Write the plan of a cell as PNG, also of one with problems. These stand below it, as do names without room."""
    tasks = list(dict.fromkeys(task for e in report.exclusions for task in zip(e.arms, e.jobs, strict=True)))
    tasks.sort(key=lambda task: [arm.name for arm in scenario.arms].index(task[0]))
    matrix = 0 < len(tasks) <= MOST_ROWS
    points_m = [each.position_m[:2] for each in (*scenario.arms, *scenario.places)]
    wide, high = np.maximum(LEAST_IN, IN_PER_M * (np.ptp(points_m, axis=0) + 2 * REACH_M)).tolist()
    widths = (wide, MATRIX_IN) if matrix else (wide,)
    letters = round(LETTERS_PER_IN * sum(widths))
    lines = [line for each in report.problems for line in textwrap.wrap(f"✗ {each}", letters)]
    figure = Figure(figsize=(sum(widths), high + 0.2 * len(lines)), layout="constrained")
    FigureCanvasAgg(figure)
    grid: Any = figure.add_gridspec(1, len(widths), width_ratios=widths)
    axes = figure.add_subplot(grid[0])
    labels = _draw_cell(axes, scenario, report)
    if matrix:
        _draw_matrix(figure.add_subplot(grid[1]), tasks, report)
    if len(tasks) > MOST_ROWS:
        axes.set_xlabel(f"{axes.get_xlabel()}\nexclusions are not drawn: {len(tasks)} tasks, at most {MOST_ROWS}")
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", color=FAULT, fontsize=9)
    figure.draw_without_rendering()  # decides the scale of the axes
    figure.set_layout_engine("none")
    numbered = ", ".join(f"{number} {name}" for number, name in enumerate(_write_labels(axes, labels), start=1))
    figure.text(0.01, 0.0, textwrap.fill(numbered, letters), va="top", color=INK, fontsize=9)
    figure.savefig(file, format="png", bbox_inches="tight")


def plan_page(scenario: Scenario, report: LayoutReport) -> str:
    """The plan of a cell as a page on which arms are moved and turned, as HTML."""
    height_m, arms = _height_m(scenario), list[dict[str, Any]]()
    for i, spec in enumerate(scenario.arms):
        robot = spec.robot()
        shoulder = shoulder_m(robot)
        points = {"shoulder": shoulder - spec.position_m, "ahead": _ahead_m(robot.mount.rotation())[:2]}
        arms.append(
            {
                "name": spec.name,
                "colour": COLOURS[i % len(COLOURS)],
                "base": spec.position_m,
                "tilt": spec.tilt_deg,
                "radii": _radii_m(shoulder, height_m),
                "remark": _arm_remark(spec.name, report),
                **{name: each.tolist() for name, each in points.items()},
            }
        )
    plan = {
        "reach_m": REACH_M,
        "arms": arms,
        "places": [
            {
                "name": place.name,
                "at": place.position_m,
                "remark": _place_remark(place.name, report),
                "able": [each.arm for each in _of_place(place.name, report) if each.payload_kg is not None],
            }
            for place in scenario.places
        ],
        "fixtures": [outline.tolist() for fixture in scenario.fixtures for outline in outlines(fixture)],
    }
    drag = (
        "Drag an arm by its base, or turn it by the tip of its arrow; with the arrow keys it moves by 1 cm. Names "
        "without room are left out: point at a mark to read its name."
    )
    red = (
        "Red until an arm is moved: places where no arm can work, and arms that can do no job. Afterwards, only the "
        "reach of the outstretched arm is judged."
    )
    problems = [Badge(problem, good=False) for problem in report.problems]
    head = Head(remarks=(f"{drag} The {LEGEND.format(height_m)}.", red), badges=problems)
    cell = Section(key="cell", title="Cell", html=render("layout.html"))
    return Page(title=f"Plan of {scenario.name}", sections=[cell], head=head, plan=plan, narrow=False).html()


def _of_place(place: str, report: LayoutReport) -> list[Reach]:
    """What each arm can do at a place."""
    return [each for each in report.reach if each.place == place]


def _place_remark(place: str, report: LayoutReport) -> str:
    """Why no arm can work at a place; "" if an arm can."""
    entries = _of_place(place, report)
    if any(each.payload_kg is not None for each in entries):
        return ""
    lacks_m = min((each.lacks_m or 0.0 for each in entries), default=0.0)
    return f"lacks {lacks_m:.2f} m" if lacks_m else "no arm can work here"


def _arm_remark(arm: str, report: LayoutReport) -> str:
    """That an arm can do no job; "" if it can do one."""
    able = any(each.payload_kg is not None for each in report.reach if each.arm == arm)
    return "" if able else "can do no job"


def _height_m(scenario: Scenario) -> float:
    """Mean height of the places, at which reach is drawn."""
    return float(np.mean([place.position_m[2] for place in scenario.places])) if scenario.places else 0.0


def _radii_m(shoulder: Array, height_m: float) -> tuple[float, float]:
    """Radius of an arm's reach at a height, with the tool pointing down and outstretched."""
    reach = np.array([UPPER_ARM_M + FOREARM_M, REACH_M])
    down, stretched = np.sqrt(np.maximum(0.0, reach**2 - (height_m + np.array([HAND_M, 0.0]) - shoulder[2]) ** 2))
    return float(down), float(stretched)


def _ahead_m(turn: Array) -> Array:
    """An arrow from the base of a mount with this rotation, [3]."""
    return 0.18 * (turn[:, 0] if abs(turn[2, 0]) < 0.9 else turn[:, 2])


@dataclass(frozen=True)
class Label:
    """Text beside a point of the cell."""

    text: str
    """"": the point only, not to be covered."""
    at_m: Array
    colour: str


def _write_labels(axes: Axes, labels: Sequence[Label]) -> list[str]:
    """Write each label where it covers no point and no other: on a side of its point, else upright above or below it.

    Those in red come first. Points without room for their labels get the numbers 1, 2, … instead.

    Returns:
        The texts of the numbers, in order.
    """
    points = axes.transData.transform([label.at_m for label in labels])
    taken = [Bbox.from_extents(x - 6, y - 6, x + 6, y + 6) for x, y in points]
    named = [(label, *point) for label, point in zip(labels, points, strict=True) if label.text]
    numbered = list[str]()
    for label, x, y in sorted(named, key=lambda each: each[0].colour != FAULT):
        how: Any = {"ha": "center", "va": "center", "color": label.colour, "fontsize": 8, "zorder": 5}
        note = axes.annotate(label.text, tuple(label.at_m), (0, 0), textcoords="offset pixels", **how)
        box = note.get_window_extent()
        beside, below, upright = 9 + box.width / 2, 9 + box.height / 2, 9 + box.width / 2
        level = [((aside, 0), 0) for aside in (beside, -beside)] + [((0, aside), 0) for aside in (-below, below)]
        for aside, turn in (*level, ((0, -upright), 90), ((0, upright), 90)):
            size = (box.height, box.width) if turn else (box.width + 3, box.height)
            place = Bbox.from_bounds(x + aside[0] - size[0] / 2, y + aside[1] - size[1] / 2, *size)
            if not place.count_overlaps(taken):
                note.set_position(aside)
                note.set_rotation(turn)
                taken.append(place)
                break
        else:
            numbered.append(label.text.replace("\n", ", "))
            note.set(text=str(len(numbered)), fontsize=7, bbox={"boxstyle": "round,pad=0.1", "fc": "white", "lw": 0.5})
    return numbered


def _draw_cell(axes: Axes, scenario: Scenario, report: LayoutReport) -> list[Label]:
    """The cell from above, x to the right and y up; returns the names of arms and places, to be written."""
    labels = list[Label]()
    height_m = _height_m(scenario)
    for outline in (each for fixture in scenario.fixtures for each in outlines(fixture)):
        axes.add_patch(Polygon(outline, facecolor="#e4e0d8", edgecolor="#c9c9c9", zorder=0))
    at = {place.name: place.position_m for place in scenario.places}
    for i, spec in enumerate(scenario.arms):
        robot, colour = spec.robot(), COLOURS[i % len(COLOURS)]
        base, shoulder, turn = np.array(spec.position_m), shoulder_m(robot), robot.mount.rotation()
        down, stretched = {"facecolor": (colour, 0.10), "edgecolor": "none"}, {"edgecolor": colour, "linestyle": "--"}
        for radius_m, look in zip(_radii_m(shoulder, height_m), (down, stretched | {"fill": False}), strict=True):
            axes.add_patch(Circle((shoulder[0], shoulder[1]), radius_m, zorder=1, **look))
        axes.plot(*np.stack([base, shoulder])[:, :2].T, color=colour, linewidth=6, solid_capstyle="round", zorder=3)
        axes.plot(*base[:2], marker="s", color=colour, markersize=9, zorder=3)
        ahead = base + _ahead_m(turn)
        axes.annotate("", tuple(ahead[:2]), tuple(base[:2]), arrowprops={"arrowstyle": "-|>", "color": INK}, zorder=4)
        remark = _arm_remark(spec.name, report)
        name = shortened(spec.name, ARM_NAME)
        text = f"{name}: {remark}" if remark else name
        if len(scenario.arms) <= MOST_NAMED:
            text += f"\n{mount_kind(robot.mount)}{f', {base[2]:g} m high' if base[2] else ''}"
        labels += [
            Label(text, base[:2], FAULT if remark else INK),
            Label("", ahead[:2], INK),
            Label("", shoulder[:2], INK),
        ]
        for task in (task for task in report.at_once if task.arm == spec.name):
            axes.plot(*np.stack([shoulder, *(at[name] for name in task.places)])[:, :2].T, color=colour, zorder=2)
    for place in scenario.places:
        name, remark = shortened(place.name, JOB_NAME), _place_remark(place.name, report)
        colour, text = (FAULT, f"{name}: {remark}") if remark else (INK, name)
        axes.plot(*place.position_m[:2], marker="X" if remark else "D", color=colour, markersize=7, zorder=4)
        labels.append(Label(text, np.array(place.position_m[:2]), colour))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.grid(color="#e6e6e6", zorder=-1)
    axes.set(xlabel=f"x, m\n{LEGEND.format(height_m)}", ylabel="y, m")
    title = shortened(scenario.name, JOB_NAME)
    axes.set_title(f"{title}: {len(report.at_once)} of {len(scenario.arms)} arms can work at once (lines)")
    return labels


def _draw_matrix(axes: Axes, tasks: Sequence[tuple[str, str]], report: LayoutReport) -> None:
    """Share of the pairs of plans of two tasks that exclude each other."""
    share = np.full((len(tasks), len(tasks)), np.nan)
    for each in report.exclusions:
        row, column = (tasks.index(task) for task in zip(each.arms, each.jobs, strict=True))
        for a, b in ((row, column), (column, row)):
            share[a, b] = each.share
            if len(tasks) <= MOST_NUMBERS:
                text = "place" if each.same_place else f"{100 * each.share:.0f}"
                ink = "white" if each.share > 0.6 else INK
                size = 7.0 if len(tasks) <= MOST_NUMBERS / 2 else 5.0
                axes.text(b, a, text, ha="center", va="center", fontsize=size, color=ink)
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0)
    names = [f"{shortened(arm, ARM_NAME)}: {shortened(job, JOB_NAME)}" for arm, job in tasks]
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_title("Exclusions: % of the pairs of plans")
    axes.set_xlabel("place: both need one place")
