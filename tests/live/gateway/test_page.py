"""The live page without a browser: what is served to whom, and under which policy."""

import asyncio
import gzip
import http.client
import json
import re

import pytest

from fleet.bus.protocol.auction import Status
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause, ResetRequest, Resume
from fleet.bus.router import Router
from fleet.live.monitor.snapshot import FleetView
from scenarios.live.fleet_processes import page_of
from scenarios.live.gateway import FILES, PAGE, LivePage, scene_of
from scenarios.spec.load import load
from tests.live.gateway.moving_fleet import MovingFleet, until
from tests.live.gateway.served import PATIENCE_S, Served

BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
WATCHER, BOSS = "watcher-watcher-watcher", "operator-operator-operator"


@pytest.fixture(scope="module")
def router():
    with Router() as opened:
        yield opened.endpoint


@pytest.fixture(scope="module")
def fleet(router):
    with MovingFleet(router, ("arm_0", "arm_1"), fleet="f") as moving:
        yield moving


@pytest.fixture(scope="module")
def served(router, fleet):
    with Served(router, page=LivePage()) as opened:
        yield opened


@pytest.fixture(scope="module")
def guarded(router, fleet):
    with Served(router, page=LivePage(), tokens={WATCHER: "monitor", BOSS: "operator"}) as opened:
        yield opened


def get(served, path, headers=(), method="GET"):
    """Status, headers and text of an answer."""
    line = http.client.HTTPConnection("127.0.0.1", served.port, timeout=PATIENCE_S)
    try:
        line.request(method, path, headers=dict(headers))
        answer = line.getresponse()
        body = answer.read()
        packed = answer.headers.get("Content-Encoding") == "gzip" and body
        return answer.status, answer.headers, (gzip.decompress(body) if packed else body).decode()
    finally:
        line.close()


def test_browsers_get_the_page_and_programs_the_list_of_requests(served):
    status, headers, text = get(served, "/", BROWSER)
    assert (status, headers.get_content_type()) == (200, "text/html")
    assert 'id="cell"' in text
    status, headers, text = get(served, "/")
    assert (status, headers.get_content_type(), json.loads(text)["role"]) == (200, "application/json", "operator")


def test_the_page_may_load_nothing_from_elsewhere_and_run_no_inline_script(served):
    _, headers, text = get(served, "/", BROWSER)
    rules = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    assert rules["default-src"] == rules["form-action"] == rules["frame-ancestors"] == rules["base-uri"] == "'none'"
    assert rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "<style" not in text
    assert "style=" not in text
    assert not re.search(r"<[^>]*\son\w+=", text)
    assert all(part.startswith(' src="/page/') for part in text.split("<script")[1:])
    for name in (*FILES, "three.js"):
        status, headers, text = get(served, f"/page/{name}")
        assert (status, headers["X-Content-Type-Options"]) == (200, "nosniff"), name
        assert len(text) > 500
        assert "innerHTML" not in text or name == "three.js"


def test_without_the_page_the_gateway_serves_no_html(router, fleet):
    with Served(router) as plain:
        assert get(plain, "/", BROWSER)[1].get_content_type() == "application/json"
        assert get(plain, "/page/cell.js")[0] == 404


def test_the_page_needs_no_token_and_everything_about_the_fleet_does(guarded):
    assert get(guarded, "/", BROWSER)[0] == 200
    assert get(guarded, "/page/dashboard.js")[0] == 200
    for path in ("/", "/v4/fleet", "/v4/cell", "/v4/scene", "/v4/events", "/v4/jobs", "/docs"):
        assert get(guarded, path)[0] == 401, path
        assert get(guarded, path, {**BROWSER})[0] == (200 if path == "/" else 401), path
    assert get(guarded, "/page/../v4/fleet")[0] in (401, 404)
    assert get(guarded, "/page/nothing")[0] == 404
    assert get(guarded, "/page/cell.js", method="POST")[0] == 401
    token = {"Authorization": f"Bearer {WATCHER}"}
    assert json.loads(get(guarded, "/", token)[2])["role"] == "monitor"
    status, _, told = guarded.ask("POST", "/v4/reset", {"arm": "arm_0"}, token)
    assert (status, told["detail"]) == (403, "This token has the role monitor; this request needs operator.")


def test_a_page_of_another_name_gets_nothing_without_tokens(served):
    assert get(served, "/", {**BROWSER, "Host": "evil.example"})[0] == 421
    assert get(served, "/page/cell.js", {"Host": "evil.example"})[0] == 421


def test_the_scene_is_the_cell_that_the_auctioneer_describes(served, fleet):
    _, _, text = get(served, "/v4/scene")
    scene, cell = json.loads(text), fleet.cell()
    assert [(arm["name"], tuple(arm["position"])) for arm in scene["arms"]] == [
        (arm.name, arm.position_m) for arm in cell.arms
    ]
    assert [place["name"] for place in scene["places"]] == [place.name for place in cell.places]
    assert (scene["heat"]["warning_c"], scene["heat"]["error_c"]) == (cell.warning_c, cell.error_c)
    assert sum(link["turns"] for link in scene["links"]) == 7


def test_a_scenario_is_drawn_without_an_auctioneer():
    scenario = load("heat_wave")

    async def nobody():
        raise AssertionError("asked for the cell")

    scene = asyncio.run(LivePage(scene_of(scenario)).scene(nobody))
    assert [box["name"] for box in scene["fixtures"]] == [fixture.name for fixture in scenario.fixtures]
    assert len(scene["arms"]) == len(scenario.arms)


def test_a_pause_is_seen_when_it_is_requested_and_not_when_it_is_history():
    view = FleetView("f")

    def paused(action, time_s, by="ann"):
        view.update("au", Operation("au", time_s, ControlRequest("1", action, by)), 0.0)
        return view.snapshot(0.0).paused

    assert paused(Pause("a"), 1.0) == {"a": "ann"}
    assert paused(Pause("*"), 2.0, "bob") == {"a": "ann", "*": "bob"}
    view.update_jobs(Status("au", 5.0, (), paused={"c": "eve"}), 0.0)
    assert paused(Pause("b"), 4.0) == {"c": "eve"}  # the reply is newer
    assert paused(Resume("c"), 6.0) == {}
    assert paused(Pause("b"), 7.0) == {"b": "ann"}
    assert paused(Resume("*"), 8.0) == {}


def test_a_fault_is_reset_over_http(served, fleet):
    fleet.mode["arm_1"] = "faulted"
    token = ("POST", "/v4/reset")
    assert served.ask(*token, {"arm": "arm_1", "by": "ann"})[2] == {"arm": "arm_1", "changed": True}
    assert fleet.requests[-1] == ResetRequest("ann")
    assert served.ask(*token, {"arm": "arm_1"})[2]["changed"] is False
    status, _, told = served.ask(*token, {"arm": "nobody"})
    assert (status, told["detail"]) == (503, "There is no arm 'nobody' in this fleet.")
    assert served.ask(*token, {"arm": "a/b"})[0] == 422


def test_the_snapshot_names_the_paused_arms_and_as_many_jobs_as_asked_for(served, fleet):
    jobs = [
        {"name": f"crate {number}", "kind": "hold", "places": ["clamp"], "repetitions": 1000} for number in (1, 2, 3)
    ]
    assert served.ask("POST", "/v4/jobs", {"jobs": jobs})[0] == 200
    pause = {"request": "p1", "action": {"action": "pause", "arm": "arm_0"}, "by": "ann"}
    assert served.ask("POST", "/v4/control", pause)[0] == 200
    told = until(lambda: (snapshot := served.ask("GET", "/v4/fleet?jobs=1")[2])["paused"] and snapshot)
    assert told["paused"] == {"arm_0": "ann"}
    assert len(told["jobs"]) == 1
    served.ask("POST", "/v4/control", {"request": "p2", "action": {"action": "resume", "arm": "arm_0"}})


def test_up_starts_the_page_with_the_certificate_of_an_operator(tmp_path):
    part = page_of("quickstart", "q", "tls/127.0.0.1:7447", tmp_path)
    assert part.argv[part.argv.index("--endpoint") + 1] == f"tls/127.0.0.1:7447#{tmp_path}/operator"
    assert part.ready == f"ready page http://127.0.0.1:{part.argv[-1]}/"


def test_the_page_is_small():
    contents = LivePage().contents
    assert len(contents[PAGE]) < 5_000
    assert sum(map(len, contents.values())) < 250_000
