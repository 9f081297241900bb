"""The pages in a browser: Chromium, as Debian packages it, with WebGL in software."""

import io
import shutil
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from fleet.arm.kinematics import REACH_M
from scenarios.run.log import RunLog, open_run
from scenarios.show.layout import LayoutReport, Reach, shoulder_m
from scenarios.show.page import Head, Section
from scenarios.show.page import Page as Report
from scenarios.show.plan import plan_page
from scenarios.show.run_page import runs_page
from scenarios.show.twin_report import panels
from scenarios.spec.load import load
from scenarios.table import Table

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
COLOURS = """element => {
  let behind = element;
  while (behind && getComputedStyle(behind).backgroundColor === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
  const style = getComputedStyle(element);
  const ink = element instanceof SVGElement ? style.fill : style.color;
  return [ink, behind ? getComputedStyle(behind).backgroundColor : "rgb(255, 255, 255)"];
}"""
"""Colour of the words of an element, and of what is behind them."""
HEIGHT_OF_TEXT = """element => {
  const range = document.createRange();
  range.selectNodeContents(element);
  return range.getBoundingClientRect().height;
}"""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser: Browser, tmp_path: Path) -> Iterator[Callable[..., Page]]:
    """Opens a text or a file in a page; nothing may be requested, and nothing may fail."""
    opened, said = list[Page](), list[str]()

    def show(content: str | Path, ready: str = "body[data-ready]", **options: Any) -> Page:
        if isinstance(content, str):
            (tmp_path / "page.html").write_text(content, encoding="utf-8")
            content = tmp_path / "page.html"
        page = browser.new_page(**options)
        page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: said.append(request.url) if not request.url.startswith("file:") else None)
        page.goto(content.as_uri())
        page.wait_for_selector(ready, timeout=300_000)
        opened.append(page)
        return page

    yield show
    for page in opened:
        page.close()
    assert [line for line in said if "GL Driver Message" not in line] == []


@pytest.fixture
def page(open_page: Callable[..., Page], run_folder: Path) -> Page:
    """The report of the shared run."""
    return open_page(run_folder / "report.html", viewport={"width": 1200, "height": 900})


NARROW = {"width": 390, "height": 850}


def overflow_px(page: Page) -> int:
    """How much wider the page is than the window."""
    return page.locator("html").evaluate("e => e.scrollWidth - e.clientWidth")


def canvas(page: Page) -> np.ndarray:
    """What the cell's canvas shows, uint8 [y, x, 3]."""
    page.wait_for_timeout(200)  # two frames or more
    picture = Image.open(io.BytesIO(page.locator(".cell canvas").screenshot()))
    return np.asarray(picture.convert("RGB")).astype(int)


def test_the_cell_is_drawn_and_moves_with_the_clock(page: Page, run_folder: Path) -> None:
    run = open_run(run_folder)
    before = canvas(page)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 50
    work = next(event.time_s for event in run.events if event.kind == "finish")
    page.locator("#time").fill(str(round(work - 20)))
    page.locator("#time").dispatch_event("input")
    after = canvas(page)
    assert (np.abs(after - before).max(axis=2) > 60).sum() > 200
    minutes, seconds = divmod(round(work - 20), 60)
    assert page.locator("#clock").inner_text() == f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"


def test_the_cursor_of_the_figure_and_the_clock_are_one(page: Page) -> None:
    figure = page.locator(".chart .draglayer .nsewdrag").first
    figure.scroll_into_view_if_needed()
    box = figure.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    hours, minutes, seconds = map(int, page.locator("#clock").inner_text().split(":"))
    assert 3600 * hours + 60 * minutes + seconds == pytest.approx(3600, abs=30)  # the middle of two hours
    cursor = page.locator(".chart .cursor").first.bounding_box()
    assert cursor is not None
    assert cursor["x"] == pytest.approx(box["x"] + box["width"] / 2, abs=3)


def test_a_click_on_an_event_goes_there(page: Page, run_folder: Path) -> None:
    row = page.locator("#events tbody tr:not(.lost)").first
    at_s, arm = float(row.get_attribute("data-time") or "nan"), row.get_attribute("data-arm")
    assert (at_s + 5, arm) in [(pytest.approx(event.time_s), event.arm) for event in open_run(run_folder).events]
    row.click()
    assert float(page.locator("#time").input_value()) == pytest.approx(at_s, abs=0.5)
    assert page.locator("#arm option:checked").inner_text() == arm
    page.locator("input.filter[data-table=events]").fill("no such words")
    assert page.locator("#events tbody tr:visible").count() == 0


def test_the_keyboard_plays_and_turns(page: Page) -> None:
    page.locator("#speed").select_option("240")
    page.locator("body").press("Space")
    assert page.locator("#play").get_attribute("aria-label") == "pause"
    page.locator("#clock:not(:text('0:00:01'))").wait_for()
    page.locator("body").press("Space")
    assert float(page.locator("#time").input_value()) > 2
    still = canvas(page)
    page.locator(".cell canvas").press("ArrowRight")
    assert (np.abs(canvas(page) - still).max(axis=2) > 60).sum() > 200


@pytest.mark.parametrize("width", [390, 1200])
def test_two_shifts_play_in_step(open_page, run: RunLog, width: int) -> None:
    text = runs_page({name: replace(run) for name in ("one", "other")}, model=run.cell_model())
    page = open_page(text, viewport={"width": width, "height": 900})
    page.locator("#time").fill("3600")
    page.locator("#time").dispatch_event("input")
    one, other = page.locator(".now").all_inner_texts()
    assert one == other != ""
    hottest = max(
        range(len(run.arms)),
        key=lambda arm: np.interp(3600, run.readings.time_s, run.readings.temp_c[:, arm].max(axis=1)),
    )
    assert one.startswith(run.arms[hottest])
    boxes = [cell.bounding_box() for cell in page.locator(".cell canvas").all()]
    assert len(boxes) == 2
    side_by_side = boxes[0]["y"] == boxes[1]["y"]  # pyright: ignore[reportOptionalSubscript]
    assert side_by_side == (width > 800)
    for box, scale in zip(boxes, page.locator(".cell .scale").all(), strict=True):
        assert scale.bounding_box()["y"] >= box["y"] + box["height"]  # pyright: ignore[reportOptionalSubscript]
    assert overflow_px(page) <= 0


@pytest.mark.ci_slow
def test_a_narrow_page_overprints_nothing(open_page, run_folder: Path) -> None:
    page = open_page(run_folder / "report.html", viewport=NARROW)
    page.wait_for_timeout(500)
    assert page.locator(".chart").count() == 2
    for chart in page.locator(".chart").all():
        legend, plot = (chart.locator(name).first.bounding_box() for name in (".legend", ".draglayer .nsewdrag"))
        assert legend is not None
        assert plot is not None
        assert legend["y"] + legend["height"] <= plot["y"] + 1
    assert overflow_px(page) <= 0


def test_a_narrow_table_breaks_no_short_word_and_scrolls_in_its_box(open_page) -> None:
    why = "14 other jobs went first on arm_1, 13 shorter"
    words = ("rush_hold_part-006", "2:05:09", "54 min 51 s", "finished", why)
    table = Table(head=("job", "due", "late by", "state", "why"), rows=(words,), numbers=False)
    page = open_page(Report(title="a", sections=[Section(tables=(table,))]).html(), "table", viewport=NARROW)
    for word in ("2:05:09", "finished"):
        height_px = page.get_by_role("cell", name=word).evaluate(HEIGHT_OF_TEXT)
        assert height_px < 30, word  # one line
    assert overflow_px(page) <= 0


def test_a_narrow_table_of_figures_keeps_the_names_of_its_rows_and_tiles_wrap(open_page) -> None:
    rows = (("predictions", *["0.123 to 0.456"] * 6),)
    table = Table(head=("", *("hottest", "coolest") * 3), rows=rows)
    head = Head(tiles=(("hottest motor", f"70 °C {'x' * 54}", ""),))
    report = Report(title="a", sections=[Section(tables=(table,))], head=head)
    page = open_page(report.html(), ".figures dd", viewport=NARROW)
    assert page.get_by_role("cell", name="predictions").evaluate(HEIGHT_OF_TEXT) < 30  # one line
    assert overflow_px(page) <= 0


def test_panels_of_a_narrow_page_cover_no_other_panel_and_scroll_in_their_box(open_page) -> None:
    """Labels with four decimals of four panels, each with a y axis of its own, as of the error by epochs."""
    lines = [
        {"type": "scatter", "x": ["untrained", "2"], "y": [0.7975 + 0.01 * n, 0.799], "name": "a"} for n in range(4)
    ]
    cells = {(0, n): [line] for n, line in enumerate(lines)}
    charts = panels("epochs", cells, x="epochs", y=("mean |error| (σ)",), heads=("a", "b", "c", "d"))
    origin = Table(head=("", ""), rows=(("thermofleet", "0.1.0 " * 20),), numbers=False)
    report = Report(title="a", sections=[Section(charts=charts)], origin=origin)
    page = open_page(report.html(), ".chart .ytick text", viewport=NARROW)
    assert overflow_px(page) <= 0
    plots = [box for each in page.locator(".draglayer .nsewdrag").all() if (box := each.bounding_box())]
    texts = page.locator('[class^="y"][class$="tick"] text, .g-ytitle text').all()
    labels = [box for each in texts if (box := each.bounding_box())]
    assert len(plots) == 4
    assert len(labels) > 8
    for number, one in enumerate(labels):
        for other in (*plots, *labels[number + 1 :]):
            apart = (
                max(one[axis], other[axis]) - min(one[axis] + one[size], other[axis] + other[size])
                for axis, size in (("x", "width"), ("y", "height"))
            )
            assert max(apart) > -0.5, (one, other)  # px
    assert page.get_by_role("cell", name="thermofleet").evaluate(HEIGHT_OF_TEXT) < 30  # one line


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Relative luminance of colours uint8 [..., 3] (WCAG 2)."""
    linear = np.where(rgb / 255 <= 0.04045, rgb / 255 / 12.92, ((rgb / 255 + 0.055) / 1.055) ** 2.4)
    return linear @ (0.2126, 0.7152, 0.0722)


@pytest.mark.ci_slow
def test_words_have_contrast_in_light_and_dark(open_page, run_folder: Path) -> None:
    for scheme in ("light", "dark"):
        page = open_page(run_folder / "report.html", color_scheme=scheme)
        for selector in ("h1", ".verdict", ".faint", ".status", "#events td", ".chart .ytick text"):
            colours = page.locator(selector).first.evaluate(COLOURS)
            ink, paper = (
                luminance(np.array([int(x) for x in c[c.index("(") + 1 :].rstrip(")").split(",")[:3]])) for c in colours
            )
            bright, dim = max(ink, paper), min(ink, paper)
            assert (bright + 0.05) / (dim + 0.05) >= 4.5, (scheme, selector, colours)


def test_names_in_a_long_row_overlap_nothing_and_every_mark_has_its_name(open_page) -> None:
    """30 arms and 60 places in a row of 19 m; one place, in the middle, is red and has its name first."""
    arm, place, xs_m = load("quickstart").arms[0], load("quickstart").places[0], np.linspace(-9.5, 9.5, 30)
    arms = tuple(replace(arm, name=f"arm_{n}", position_m=(x, 0.0, 0.0)) for n, x in enumerate(xs_m))
    places = tuple(
        replace(place, name=f"{side}_{n}", position_m=(x + aside_m, 0.45, 0.25))
        for n, x in enumerate(xs_m)
        for side, aside_m in (("left", -0.12), ("right", 0.12))
    )
    scenario = replace(load("quickstart"), arms=arms, places=places)
    reach = tuple(
        Reach(arm=one.name, place=at.name, payload_kg=None if at.name == "left_15" else 1.0, lacks_m=0.0)
        for one in arms
        for at in places
    )
    empty = {"exclusions": (), "at_once": (), "problems": ()}
    report = LayoutReport(scenario="a", clearance_m=0.0, reach=reach, excluded_share=0.0, largest=True, **empty)
    page = open_page(plan_page(scenario, report), viewport={"width": 1400, "height": 900})
    labels = [label for label in page.locator("#plan text").all() if label.is_visible()]
    marks = [*labels, *page.locator(".arm rect, .arm .tip, .place polygon").all()]
    boxes = [box for mark in marks if (box := mark.bounding_box())]
    assert len(boxes) == len(labels) + 2 * len(arms) + len(places)
    for number, one in enumerate(boxes[: len(labels)]):
        for other in boxes[number + 1 :]:
            apart = (
                max(one[axis], other[axis]) - min(one[axis] + one[size], other[axis] + other[size])
                for axis, size in (("x", "width"), ("y", "height"))
            )
            assert max(apart) > -0.1, (one, other)  # px
    names = [label.text_content() or "" for label in labels]
    assert "left_15: no arm can work here" in names
    assert sum(name.startswith("arm_") for name in names) >= 15
    titles = page.locator("#plan title").all_text_contents()
    assert {title.split(":")[0] for title in titles} == {each.name for each in (*arms, *places)}


def test_a_moved_and_turned_arm_reaches_what_the_lines_to_paste_say(open_page) -> None:
    """`shoulder_m` of the changed arms tells the distance that places lack; the arm hangs at a wall."""
    first, *_ = load("quickstart").arms
    scenario = replace(load("quickstart"), arms=(replace(first, tilt_deg=(90.0, 10.0, 170.0)),))
    empty = {"exclusions": (), "at_once": (), "problems": ()}
    near = Reach(arm=first.name, place="belt", payload_kg=None, lacks_m=None)  # within reach, but not with this tool
    report = LayoutReport(scenario="a", clearance_m=0.0, reach=(near,), excluded_share=0.0, largest=True, **empty)
    page = open_page(plan_page(scenario, report))
    assert page.locator("#changes").input_value() == ""
    assert page.locator('[data-place="belt"] text').text_content() == "belt: no arm can work here"
    assert page.locator(".arm.unable .name").text_content() == "arm_0: can do no job"
    for handle, x, y in ((".arm rect", 90, -40), (".arm .tip", -80, 60)):
        box = page.locator(handle).bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down()
        page.mouse.move(box["x"] + x, box["y"] + y, steps=4)
        page.mouse.up()
    changed = tomllib.loads(page.locator("#changes").input_value())
    assert set(changed) == {"position_m", "tilt_deg"}
    assert changed["tilt_deg"][:2] == [90, 10]
    assert abs(changed["tilt_deg"][2] - 170) > 20
    shoulder = shoulder_m(replace(first, **{name: tuple(value) for name, value in changed.items()}).robot())
    lacks_m = {p.name: np.linalg.norm(np.subtract(p.position_m, shoulder)) - REACH_M for p in scenario.places}
    expected = {name for name, far in lacks_m.items() if far > 0}
    assert 0 < len(expected) < len(lacks_m)
    assert page.locator(".arm.unable").count() == 0
    told = {each.get_attribute("data-place"): each.text_content() for each in page.locator(".place.lacks").all()}
    assert set(told) == expected
    for name, text in told.items():
        assert float(text.split(" lacks ")[1].split()[0]) == pytest.approx(lacks_m[name], abs=0.011)
