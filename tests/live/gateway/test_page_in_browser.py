"""The live page in a browser: Chromium, as Debian packages it, with WebGL in software."""

import io
import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect, sync_playwright

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import (
    Cancel,
    Change,
    ClearRequest,
    ControlRequest,
    Operation,
    Pause,
    ResetRequest,
    Settle,
)
from fleet.bus.router import Router
from scenarios.live.gateway import LivePage
from tests.live.gateway.moving_fleet import MovingFleet
from tests.live.gateway.served import Served
from tests.waiting import wait_until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_MS = 30_000
WATCHER, BOSS = "watcher-watcher-watcher", "operator-operator-operator"
EVIL_ARM = "<img src=x onerror=boom()> & \"'"
EVIL_TEXT = "<script>boom()</script>\u202egnp.exe\x07"
SHOWN_TEXT = r"<script>boom()</script>\u202egnp.exe\u0007"


@pytest.fixture(scope="module")
def browser():
    expect.set_options(timeout=PATIENCE_MS)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def router():
    with Router() as opened:
        yield opened.endpoint


@pytest.fixture
def fleet(router):
    with MovingFleet(router, ("arm_0", "arm_1"), fleet="f") as moving:
        yield moving


@pytest.fixture
def served(router, fleet):
    with Served(router, page=LivePage()) as opened:
        yield opened


@pytest.fixture
def open_page(browser):
    """Opens the page of a gateway; nothing may come from elsewhere, and no error may be logged."""
    opened, said = [], []

    def make(served, *, errors=False, wait=True, **options):
        page = browser.new_page(**{"viewport": {"width": 1300, "height": 900}, **options})
        opened.append(page)
        own = f"http://127.0.0.1:{served.port}/"
        page.on("request", lambda request: None if request.url.startswith((own, "data:")) else said.append(request.url))
        if not errors:
            page.on("console", lambda m: said.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(own)
        if wait:
            page.wait_for_selector("body[data-ready]", timeout=PATIENCE_MS)
        return page

    yield make
    for page in opened:
        page.close()
    assert [line for line in said if "GL Driver Message" not in line] == []


def canvas(page):
    """What the cell's canvas shows, [y, x, 3]."""
    picture = Image.open(io.BytesIO(page.locator("#cell canvas").screenshot()))
    return np.asarray(picture.convert("RGB")).astype(int)


def confirm(page, name="ann"):
    """Agree in the dialog that asks."""
    page.locator("#by").fill(name)
    page.locator("#go").click()


def answer(page):
    return expect(page.locator("#answer"))


@pytest.mark.ci_slow
def test_the_arms_are_shown_and_move(served, fleet, open_page):
    page = open_page(served)
    rows = page.locator("#arms tbody tr")
    expect(rows).to_have_count(2)
    expect(rows.nth(1)).to_contain_text("41.0 °C, joint 2")
    before = canvas(page)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 50
    assert wait_until(lambda: (np.abs(canvas(page) - before).max(axis=2) > 60).sum() > 100)
    counted = page.evaluate("({...dashboard})")
    page.wait_for_timeout(2000)
    assert page.evaluate("dashboard.states") - counted["states"] >= 30  # of 40 that are published


@pytest.mark.ci_slow
def test_a_job_of_the_form_is_quoted_submitted_and_finished(served, fleet, open_page):
    page = open_page(served)
    page.locator("#work").select_option(index=1)
    assert page.locator("#payload_kg").input_value() == "1.5"
    page.locator("#name").fill("my crate")
    page.locator("#repetitions").fill("3")
    page.locator("#ask").click()
    expect(page.locator("#quotes tbody tr")).to_have_count(2)
    expect(page.locator("#quotes tbody tr").first).to_contain_text("39.0 °C")
    page.locator("#send").click()
    page.locator("#back").click()
    assert fleet.requests == []
    page.locator("#send").click()
    confirm(page)
    answer(page).to_contain_text("my crate: accepted")
    (sent,) = fleet.requests
    (job,) = sent.jobs
    assert (sent.by, job.name, job.places, job.repetitions, job.payload_kg) == (
        "ann", "my crate", ("conveyor", "pallet"), 3, 1.5,
    )  # fmt: skip
    expect(page.locator("#offers tbody")).to_contain_text("✔ arm_0")
    page.locator("#settled-part summary").click()
    expect(page.locator("#settled tbody tr")).to_contain_text("✔ finished")
    expect(page.locator("#journal")).to_contain_text("arm_0 finished my crate.")


@pytest.mark.ci_slow
def test_a_job_is_cancelled_and_the_fleet_paused_with_the_name_of_the_person(served, fleet, open_page):
    served.ask(
        "POST", "/v4/jobs", {"jobs": [{"name": "long", "kind": "hold", "places": ["clamp"], "repetitions": 9999}]}
    )
    page = open_page(served)
    page.get_by_role("button", name="Cancel long").click()
    confirm(page, "ann")
    answer(page).to_contain_text("long: cancelled")
    assert (fleet.requests[-1].action, fleet.requests[-1].by) == (Cancel("long"), "ann")
    page.get_by_role("button", name="Pause all arms").click()
    confirm(page, "bob")
    expect(page.locator("#alert-list")).to_contain_text("All arms are paused by bob")
    assert fleet.requests[-1].action == Pause("*")
    expect(page.locator("#journal")).to_contain_text("bob")
    page.get_by_role("button", name="Resume all arms").click()
    confirm(page)
    expect(page.locator("#alert-list")).not_to_contain_text("paused")


@pytest.mark.ci_slow
def test_a_job_is_changed_and_settled_and_the_space_of_an_absent_arm_freed(served, fleet, router, open_page):
    with BusClient(router, "f") as other:  # an arm that leaves
        other.declare_token(keys.of_arm("f", "gone", "alive"))
        wait_until(lambda: any(arm["arm"] == "gone" for arm in served.ask("GET", "/v4/fleet")[2]["arms"]))
    fleet.paused["*"] = "ann"
    for name, state in (("late", "waiting"), ("lost", "unfinished")):
        fleet.post(lambda name=name, state=state: fleet.set(name, state=state, repetitions=3, cycles=2))
    page = open_page(served)
    page.get_by_role("button", name="Change late").click()
    page.locator("#new-value").fill("7")
    confirm(page)
    answer(page).to_contain_text("late: waiting")
    assert fleet.requests[-1].action == Change("late", value=7.0)
    expect(page.locator("#alarms")).to_contain_text("'lost' is unfinished")
    page.get_by_role("button", name="Done lost").click()
    confirm(page)
    answer(page).to_contain_text("lost: finished")
    assert fleet.requests[-1].action == Settle("lost", "done")
    expect(page.locator("#arms tbody tr", has_text="gone")).to_contain_text("◌ absent")
    page.get_by_role("button", name="Free the space of gone").click()
    confirm(page)
    answer(page).to_contain_text("gone: its space is free")
    assert fleet.requests[-1] == ClearRequest("gone", "ann")


def test_a_visitor_with_a_wrong_clock_changes_no_time_and_has_no_row_once_it_left(served, fleet, router, open_page):
    """The fleet is in its first hours, and the clock of the visitor shows 500 h."""
    page = open_page(served)
    rows, summary = page.locator("#arms tbody tr"), page.locator("#summary")
    with BusClient(router, "f") as visitor:
        visitor.declare_token(keys.of_arm("f", "visitor", "alive"))
        publish = visitor.publisher(keys.of_arm("f", "visitor", "state"), State)
        publish(State("visitor", 1, 1.8e6, "idle", (30.0,) * 7, 30.0))
        expect(rows).to_have_count(3)
        for _ in range(2):  # what the first one brought is drawn
            with page.expect_response("**/v4/fleet*"):
                pass
        expect(summary).not_to_contain_text("500:00")
        publish(State("visitor", 2, 1.8e6, "idle", (30.0,) * 7, 30.0, leaving=True))
        wait_until(lambda: served.ask("GET", "/v4/fleet")[2]["arms"][2]["leaving"])
    expect(rows).to_have_count(2)
    expect(summary).to_contain_text("2 of 2 arms present, 1 left.")
    page.reload()
    expect(summary).to_contain_text("2 of 2 arms present, 1 left.")
    expect(rows).to_have_count(2)


def test_a_fault_is_told_in_words_and_reset(served, fleet, open_page):
    page = open_page(served)
    fleet.ahead_s, fleet.mode["arm_1"], fleet.temp_c["arm_1"] = 3600.0, "faulted", 76.0
    expect(page.locator("#arms tbody tr").nth(1)).to_contain_text("✖ faulted")
    expect(page.locator("#arms tbody tr").nth(1)).to_contain_text("above the limit")
    expect(page.locator("#alarms")).to_contain_text("arm_1 is faulted: joint ")
    page.get_by_role("button", name="Reset arm_1").click()
    confirm(page)
    answer(page).to_contain_text("arm_1: its fault is cleared")
    assert fleet.requests[-1] == ResetRequest("ann")


def test_the_journal_has_sentences_with_names_in_order_of_time(served, fleet, open_page):
    page = open_page(served)
    job = JobStatus("crate", "finished", arm="arm_1", cycles=1, due_s=4000.0, finished_s=4065.0)
    for number, (time_s, kind, more) in enumerate(
        ((8000.0, "recover", {"reason": "cool again"}), (7000.0, "fault", {"job": "crate", "reason": "joint 2 is hot"}),
         (7500.0, "award", {"job": "crate", "reason": "plan 1, twin d:a37e7d"}), (4067.0, "home", {"job": "crate"}))
    ):  # fmt: skip
        event = ArmEvent("arm_1", number, time_s, kind, **more)
        fleet.post(lambda event=event: fleet.events["arm_1"](event))
    fleet.post(lambda: fleet.results(Result("auctioneer", 99, 4065.0, job)))
    request = ControlRequest("7", Change("crate", due_s=9000.0), "ann")
    fleet.post(lambda: fleet.operations(Operation("auctioneer", 7600.0, request, 99)))
    expect(page.locator("#journal tbody tr")).to_have_count(5)
    assert [row.split("\t") for row in page.locator("#journal tbody tr").all_inner_texts()] == [
        ["2:13:20", "arm_1 recovered: cool again."],
        ["2:06:40", "ann changed crate: due at 2:30:00."],
        ["1:56:40", "arm_1 stopped by a fault during crate: joint 2 is hot."],
        ["1:07:47", "arm_1 is at home after crate."],
        ["1:07:45", "arm_1 finished crate, 0:01:05 late."],
    ]


def test_a_press_ends_on_the_button_on_which_it_began(served, fleet, open_page):
    fleet.paused["*"] = "ann"
    fleet.post(lambda: fleet.set("crate", state="waiting"))
    page = open_page(served)
    page.get_by_role("button", name="Cancel crate").hover()
    page.mouse.down()
    for number in range(6):  # listed above it
        fleet.post(lambda number=number: fleet.set(f"lost {number}", state="unfinished"))
    page.wait_for_timeout(1500)
    page.mouse.up()
    expect(page.locator("#confirm-title")).to_have_text("Cancel crate?")
    expect(page.locator("#jobs tbody tr")).to_have_count(7)


def test_the_counts_follow_the_table_between_two_polls(served, fleet, open_page):
    fleet.paused["*"] = "ann"
    fleet.post(lambda: fleet.set("crate", state="waiting"))
    page = open_page(served, errors=True)
    expect(page.locator("#counts")).to_have_text("1 waiting.")
    page.route("**/v4/fleet*", lambda route: route.abort())
    for name, state in (("crate", "finished"), ("lost", "unfinished")):
        fleet.post(lambda name=name, state=state: fleet.set(name, state=state))
    expect(page.locator("#jobs tbody tr")).to_contain_text("lost")
    expect(page.locator("#counts")).to_have_text("1 finished, 1 unfinished.", timeout=5000)


@pytest.mark.ci_slow
def test_the_keyboard_is_enough(served, fleet, open_page):
    page = open_page(served)
    focused = page.locator(":focus")
    expect(page.locator("button:enabled", has_text="Pause all arms")).to_be_visible()
    for _ in range(60):  # a link that skips, areas that scroll, the buttons; from the start, as the page is still made
        page.keyboard.press("Tab")
        if focused.inner_text().endswith("Pause all arms"):
            break
    assert focused.inner_text().endswith("Pause all arms")
    assert focused.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    expect(page.locator("#confirm")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#confirm")).to_be_hidden()
    assert page.locator(":focus").get_attribute("id") == "pause-all"
    assert fleet.requests == []
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("document.activeElement.id || document.activeElement.getAttribute('aria-label') || ''")
        )
    assert {"resume-all", "Pause arm_1", "send", "work", "Journal of events"} <= reached
    page.locator("#cell canvas").focus()
    before = canvas(page)
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    assert wait_until(lambda: (np.abs(canvas(page) - before).max(axis=2) > 60).sum() > 300)


def test_a_dark_phone_shows_all_of_it(served, fleet, open_page):
    page = open_page(served, viewport={"width": 390, "height": 800}, color_scheme="dark")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for button in page.locator("button:visible").all():
        box = button.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["height"] >= 30
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert sum(map(int, re.findall(r"\d+", paper)[:3])) < 200


@pytest.mark.ci_slow
def test_hostile_long_and_javascript_s_own_names_stay_text(router, open_page):
    names = (EVIL_ARM, "constructor", "__proto__", "W" * 120)
    with MovingFleet(router, names, fleet="f") as fleet, Served(router, page=LivePage()) as served:
        page = open_page(served)
        fleet.post(lambda: fleet.set("q" * 120, arm="W" * 120, state="awarded"))
        expect(page.locator("#offers")).to_contain_text("W" * 120)
        expect(page.locator("#arms tbody tr")).to_have_count(4)
        expect(page.locator("#arms")).not_to_contain_text("paused")
        assert page.evaluate("document.documentElement.scrollWidth") <= 1300
        for cell in page.locator("#arms td, #jobs td, #journal td").all():
            assert cell.bounding_box()["width"] >= 50
        page.get_by_role("button", name="Pause __proto__").click()
        confirm(page)
        answer(page).to_contain_text("Paused: __proto__.")
        expect(page.locator("#arms tr", has_text="__proto__")).to_contain_text("paused")
        page.evaluate("() => { window.boom = () => { document.body.dataset.boom = 'yes'; }; }")
        fleet.post(lambda: fleet.set(EVIL_TEXT, EVIL_TEXT, state="waiting", reason=EVIL_TEXT))
        fleet.paused[EVIL_ARM] = EVIL_TEXT
        for place in ("#journal", "#jobs", "#alert-list"):
            expect(page.locator(place)).to_contain_text(SHOWN_TEXT)
        expect(page.locator("#arms")).to_contain_text(EVIL_ARM)
        assert page.get_by_role("button", name=f"Cancel {SHOWN_TEXT}").count() == 1
        page.get_by_role("button", name=f"Resume {EVIL_ARM}").click()
        expect(page.locator("#confirm-title")).to_have_text(f"Resume {EVIL_ARM}?")
        page.locator("#back").click()
        assert page.evaluate("document.querySelectorAll('img, main script').length") == 0
        assert page.evaluate("document.body.dataset.boom") is None
        page.close()  # before its gateway ends: it would try to connect again


def test_without_webgl_the_tables_and_requests_still_work(browser, served, fleet):
    flat = browser.browser_type.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    page = flat.new_page()
    page.goto(f"http://127.0.0.1:{served.port}/")
    page.wait_for_selector("body[data-ready]", timeout=PATIENCE_MS)
    expect(page.locator("#cell")).to_contain_text("cannot draw in 3-D")
    expect(page.locator("#arms tbody tr").nth(1)).to_contain_text("41.0 °C, joint 2")
    page.get_by_role("button", name="Pause arm_0").click()
    confirm(page)
    answer(page).to_contain_text("Paused: arm_0.")
    flat.close()


@pytest.mark.ci_slow
def test_a_page_asks_for_a_token_and_allows_what_its_role_may(router, fleet, open_page):
    with Served(router, page=LivePage(), tokens={WATCHER: "monitor", BOSS: "operator"}) as served:
        page = open_page(served, errors=True, wait=False)  # Chromium logs every 401
        for token in ("wrong-wrong-wrong-wrong", WATCHER):
            expect(page.locator("#login")).to_be_visible()
            page.locator("#token").fill(token)
            page.keyboard.press("Enter")
        page.wait_for_selector("body[data-ready]", timeout=PATIENCE_MS)
        expect(page.locator("#summary")).to_contain_text("Your role: monitor")
        expect(page.locator("#pause-all")).to_be_disabled()
        expect(page.locator("#send")).to_be_disabled()
        expect(page.locator("#arms tbody tr")).to_have_count(2)
        assert page.locator("#arms td:last-child button").count() == 0
        assert page.evaluate("localStorage.length") == 0
        assert WATCHER not in page.url + json.dumps(page.context.cookies())
        page.evaluate("sessionStorage.clear()")
        page.reload()
        page.locator("#token").fill(BOSS)
        page.keyboard.press("Enter")
        expect(page.locator("#pause-all")).to_be_enabled()


@pytest.mark.ci_slow
def test_the_page_connects_again_to_a_gateway_and_a_router_that_return(browser, open_page):
    with Router() as router:
        endpoint, port = router.endpoint, int(router.endpoint.rpartition(":")[2])
        with MovingFleet(endpoint, ("arm_0",), fleet="f") as fleet:
            with Served(endpoint, page=LivePage()) as served:
                page = open_page(served, errors=True)  # Chromium logs every refused connection
                expect(page.locator("#link")).to_have_text("● Connected")
            expect(page.locator("#link")).to_contain_text("Connecting again")
            with Served(endpoint, port=served.port, page=LivePage()):
                expect(page.locator("#link")).to_have_text("● Connected")
                expect(page.locator("#arms tbody tr")).to_contain_text("○ idle")
                router.close()
                expect(page.locator("#alert-list")).to_contain_text("the router or the fleet may be down")
                expect(page.locator("#arms tbody tr")).to_contain_text("◌ absent")
                with Router(port):
                    expect(page.locator("#arms tbody tr")).to_contain_text("○ idle")
                    expect(page.locator("#alert-list")).not_to_contain_text("may be down")
                    assert fleet.mode == {"arm_0": "idle"}


def test_an_alarm_stays_after_a_reload_until_somebody_has_seen_it(served, fleet, open_page):
    fleet.post(lambda: fleet.set("lost", state="given_up", reason="three faults"))
    page = open_page(served)
    row = page.locator("#alarms tbody tr", has_text="'lost' is abandoned: three faults")
    expect(row).to_contain_text("since")
    row.get_by_role("button", name="Acknowledge").click()
    confirm(page, "bob")
    answer(page).to_contain_text("bob has seen it.")
    page.reload()
    expect(row).to_contain_text("bob, ")
    expect(row.get_by_role("button")).to_have_count(0)
    arms = page.locator("#arms tbody tr")
    expect(arms.first).to_contain_text(" %")
    expect(arms.first.locator("td[data-label='Job']")).to_contain_text("No job waits.")
