"""A gateway without a browser: the live page, requests, errors, rights, streams and the command."""

import asyncio
import gzip
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Admission, Status, SubmissionReply
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause, ResetRequest, Resume
from fleet.bus.router import Router
from fleet.errors import Refused, RefusedForNow
from fleet.live.monitor.snapshot import FleetView
from scenarios.live.fleet_processes import page_of
from scenarios.live.gateway import FILES, MAX_BYTES, MAX_TABLE_BYTES, LivePage, scene_of
from scenarios.live.requests import reset_arm
from scenarios.spec.load import load
from tests import commands
from tests.live.gateway.moving_fleet import MovingFleet
from tests.live.gateway.served import Served, events, numbers_of, of
from tests.live.many_jobs import ManyJobs, entries
from tests.waiting import PATIENCE_S, serving, wait_until

BROWSER = {"Accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}
CRATE_JSON = {"name": "crate 1", "kind": "hold", "places": ["rack"]}
JSON = "application/json"
PAUSE = {"request": "1", "action": {"action": "pause"}}
ARMS, FLY, LATE = {"action": "resume", "arms": "a"}, {"action": "fly"}, {"action": "change", "job": "a", "due_s": -5}
SETTLE = {"action": "settle", "job": "a", "outcome": "so"}
CSV = {"Content-Type": "text/csv; charset=utf-8"}
WATCHER, SENDER, BOSS = "watcher-watcher-watcher", "sender-sender-sender", "operator-operator-operator"


@pytest.fixture(scope="module")
def guarded(router, arm):
    tokens = {WATCHER: "monitor", SENDER: "submitter", BOSS: "operator"}
    with Served(router, page=LivePage(), tokens=tokens) as opened:
        yield opened


def get(gateway, path, headers=(), method="GET"):
    """Status, headers and text of an answer."""
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    try:
        line.request(method, path, headers=dict(headers))
        answer = line.getresponse()
        body = answer.read()
        packed = answer.headers.get("Content-Encoding") == "gzip" and body
        return answer.status, answer.headers, (gzip.decompress(body) if packed else body).decode()
    finally:
        line.close()


def test_browsers_get_a_page_that_may_load_nothing_from_elsewhere_and_run_no_inline_script(gateway):
    assert get(gateway, "/")[1].get_content_type() == "application/json"  # for programs
    status, headers, text = get(gateway, "/", BROWSER)
    assert (status, headers.get_content_type(), 'id="cell"' in text) == (200, "text/html", True)
    rules = dict(rule.strip().split(" ", 1) for rule in headers["Content-Security-Policy"].split(";"))
    assert rules["default-src"] == rules["form-action"] == rules["frame-ancestors"] == rules["base-uri"] == "'none'"
    assert rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "<style" not in text
    assert "style=" not in text
    assert not re.search(r"<[^>]*\son\w+=", text)
    assert all(part.startswith(' src="/page/') for part in text.split("<script")[1:])
    for name in (*FILES, "three.js"):
        status, headers, text = get(gateway, f"/page/{name}")
        assert (status, headers["X-Content-Type-Options"]) == (200, "nosniff"), name
        assert len(text) > 500
        assert "innerHTML" not in text or name == "three.js"


def test_without_the_page_the_gateway_serves_no_html(router, arm):
    with Served(router) as plain:
        assert get(plain, "/", BROWSER)[1].get_content_type() == "application/json"
        assert get(plain, "/page/cell.js")[0] == 404


def test_the_page_needs_no_token_and_everything_about_the_fleet_does(guarded):
    for wrong in ("Bearer wrong", f"Basic {BOSS}", f"Bearer {BOSS}x", f"Bearer {BOSS[:-1]}"):
        status, kind, reply = guarded.ask("GET", "/v4/fleet", headers={"Authorization": wrong})
        assert (status, kind) == (401, "application/problem+json"), wrong
        says = "This gateway needs a token" if wrong.startswith("Basic") else "This token is not valid."
        assert reply["detail"].startswith(says)
    assert guarded.ask("GET", "/v4/fleet", headers={"Authorization": f"bearer {BOSS}", "Host": "any"})[0] == 200
    assert get(guarded, "/", BROWSER)[0] == 200
    assert get(guarded, "/page/dashboard.js")[0] == 200
    for path in ("/", "/v4/fleet", "/v4/cell", "/v4/scene", "/v4/events", "/v4/jobs", "/docs"):
        assert get(guarded, path)[0] == 401, path
        assert get(guarded, path, {**BROWSER})[0] == (200 if path == "/" else 401), path
    assert get(guarded, "/page/../v4/fleet")[0] in (401, 404)
    assert get(guarded, "/page/nothing")[0] == 404
    assert get(guarded, "/page/cell.js", method="POST")[0] == 401


def test_the_scene_is_the_cell_that_the_auctioneer_describes(gateway, arm):
    _, _, text = get(gateway, "/v4/scene")
    scene, cell = json.loads(text), arm.cell()
    assert [(each["name"], tuple(each["position"])) for each in scene["arms"]] == [
        (each.name, each.position_m) for each in cell.arms
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


def test_a_fault_is_reset_over_http(gateway, arm):
    arm.mode["a+1"] = "faulted"
    token = ("POST", "/v4/reset")
    assert gateway.ask(*token, {"arm": "a+1", "by": "ann"})[2] == {"arm": "a+1", "changed": True}
    assert arm.requests[-1] == ResetRequest("ann")
    assert gateway.ask(*token, {"arm": "a+1"})[2]["changed"] is False
    status, _, reply = gateway.ask(*token, {"arm": "nobody"})
    assert status == 404
    assert reply["detail"].startswith("There is no arm 'nobody'. Arms: a+1")
    assert gateway.ask(*token, {"arm": "a/b"})[0] == 422


def test_an_online_arm_that_offers_no_reset_is_not_called_offline():
    with Router() as own_router, Served(own_router.endpoint) as gateway, BusClient(own_router.endpoint, "f") as own:
        own.declare_token(keys.of_arm("f", "own", "alive"))
        tell = own.publisher(keys.of_arm("f", "own", "state"), State)

        def is_present():
            tell(State("own", 1, 1.0, "faulted", (40.0,), 20.0))
            return any(arm["arm"] == "own" and arm["present"] for arm in gateway.ask("GET", "/v4/fleet")[2]["arms"])

        wait_until(is_present)
        status, _, reply = gateway.ask("POST", "/v4/reset", {"arm": "own"})
        with pytest.raises(Refused, match="'own' is online and offers no reset"):
            reset_arm("own", "ann", own_router.endpoint, "f")
    assert (status, reply["detail"]) == (
        409,
        "The arm 'own' is online and offers no reset: its fault must be cleared at the arm.",
    )


def test_the_snapshot_names_the_paused_arms_and_as_many_jobs_as_asked_for(gateway, arm):
    jobs = [
        {"name": f"crate {number}", "kind": "hold", "places": ["clamp"], "repetitions": 1000} for number in (1, 2, 3)
    ]
    assert gateway.ask("POST", "/v4/jobs", {"jobs": jobs})[0] == 200
    pause = {"request": "p1", "action": {"action": "pause", "arm": "a+1"}, "by": "ann"}
    assert gateway.ask("POST", "/v4/control", pause)[2]["changed"] is True
    assert arm.requests[-1] == ControlRequest("p1", Pause("a+1"), "ann")
    reply = wait_until(
        lambda: (snapshot := gateway.ask("GET", "/v4/fleet?jobs=1")[2])["paused"].get("a+1") and snapshot
    )
    assert reply["paused"] == {"*": "ann", "a+1": "ann"}
    assert len(reply["jobs"]) == 1
    gateway.ask("POST", "/v4/control", {"request": "p2", "action": {"action": "resume", "arm": "a+1"}})


def test_up_starts_the_page_with_the_certificate_of_an_operator(tmp_path):
    part = page_of("quickstart", "q", "tls/127.0.0.1:7447", tmp_path, tmp_path / "recording", ["http://[::1]:9/"])
    assert part.argv[part.argv.index("--endpoint") + 1] == f"tls/127.0.0.1:7447#{tmp_path}/operator"
    assert part.ready == f"ready page http://127.0.0.1:{part.argv[part.argv.index('--port') + 1]}/"
    assert part.argv[-2:] == ("--webhook", "http://[::1]:9/")


def test_the_fleet_is_shown_with_ages(gateway, arm):
    arm.post(lambda: arm.set("crate 1", state="waiting", repetitions=1, cycles=0))

    def fleet():
        _, kind, snapshot = gateway.ask("GET", "/v4/fleet")
        assert kind == "application/json"
        present = snapshot["arms"] and snapshot["arms"][0]["present"]
        return snapshot if present and snapshot["counts"].get("waiting") else None

    snapshot = wait_until(fleet)
    assert snapshot["fleet"] == "f"
    (seen,) = snapshot["arms"]
    assert (seen["arm"], seen["hottest_c"], seen["joint"], seen["headroom_k"]) == ("a+1", 41.5, 2, 18.5)
    assert seen["state_age_s"] >= 0


def test_jobs_are_submitted_and_quoted(gateway, arm):
    status, _, reply = gateway.ask("POST", "/v4/jobs", {"jobs": [CRATE_JSON], "by": "me"})
    assert (status, reply["jobs"][0]["accepted"]) == (200, True)
    assert arm.requests[-1].jobs[0].name == "crate 1"
    status, _, reply = gateway.ask("GET", "/v4/jobs?job=crate%201")
    assert (status, reply["jobs"][0]["state"]) == (200, "waiting")
    status, _, reply = gateway.ask("POST", "/v4/ask", {"jobs": [CRATE_JSON]})
    assert (status, reply["quotes"][0]["estimates"][0]["plans"][0]["difficulty"]) == (200, 0.2)


def test_all_jobs_of_a_large_fleet_are_told_and_counted():
    """Without an auctioneer, so without results."""
    desk = ManyJobs(*entries(481, "waiting", reason="Its place is in use."), *entries(300), *entries(1, "unfinished"))
    counts = {"waiting": 481, "finished": 300, "unfinished": 1}
    with Router() as router, BusClient(router.endpoint, "f") as link, Served(router.endpoint) as gateway:
        desk.reply_on(link)
        with serving(link):
            wait_until(lambda: gateway.ask("GET", "/v4/fleet?jobs=0")[2]["counts"] == counts)
            status, _, reply = gateway.ask("GET", "/v4/jobs")
            assert {job["job"] for job in gateway.ask("GET", "/v4/fleet?jobs=5")[2]["jobs"]} >= {"unfinished_0000"}
            wait_until(lambda: [alarm["kind"] for alarm in gateway.ask("GET", "/v4/alarms")[2]] == ["unfinished"])
    assert (status, reply["counts"], reply["next"]) == (200, counts, "")
    assert sorted(job["job"] for job in reply["jobs"]) == sorted(desk.entries)


PROBLEMS = [
    (422, "POST /v4/jobs", "Not a thermofleet.Submission", "{"),
    (422, "POST /v4/jobs", "length >= 1", {"jobs": []}),
    (422, "POST /v4/jobs", "place", {"jobs": [{**CRATE_JSON, "places": ["a", "b"]}]}),
    (422, "POST /v4/jobs", "Not a", b"\xff"),
    (415, "POST /v4/jobs", "application/json", {"jobs": [CRATE_JSON]}, {"Content-Type": "text/plain"}),
    (503, "POST /v4/jobs", "no room", {"jobs": [CRATE_JSON], "by": "disk full"}),
    (409, "POST /v4/jobs", "There is no 'nobody'.", {"jobs": [CRATE_JSON], "by": "nobody"}),
    (422, "POST /v4/ask", "length >= 1", {"jobs": []}),
    (413, "POST /v4/jobs", "at most", b" " * (MAX_BYTES + 1)),
    (413, "POST /v4/jobs", "at most 1000000 bytes", b" " * (MAX_TABLE_BYTES + 1), CSV),
    (422, "POST /v4/jobs", "The table has 1 error:\n  row 1: no column name and no column kind", b"", CSV),
    (422, "POST /v4/jobs", "The table is not a text file in UTF-8", b"\x00", CSV),
    (422, "POST /v4/jobs", "The table has 101 columns; a job table has at most 100", "a" + "," * 100, CSV),
    (422, "POST /v4/jobs?shift_begin=6", "shift_begin must be a date with time and zone, as", b"", CSV),
    (415, "POST /v4/ask", "application/json", b"", CSV),
    (404, "GET /v4/nothing", "Not Found"),
    (405, "DELETE /v4/jobs", "Not Allowed"),
    (421, "GET /v4/fleet", "evil.example", None, {"Host": "evil.example"}),
    (421, "GET /page/cell.js", "evil.example", None, {"Host": "evil.example:80"}),
    (422, "POST /v4/control", "`. Allowed: cancel, change, pause, resume, settle", {**PAUSE, "action": FLY}),
    (422, "POST /v4/control", "`. Allowed: done, redo", {**PAUSE, "action": SETTLE}),
    (422, "POST /v4/jobs", "Submission.by must have 1 to 128 printable", {"jobs": [CRATE_JSON], "by": "a\nb"}),
    (422, "POST /v4/jobs?by=%1b", "Submission.by must have 1 to 128", b"name,kind,places\na,hold,pallet", CSV),
    (422, "POST /v4/control", "ControlRequest.by must have 1 to 128 printable", {**PAUSE, "by": "\u202ea"}),
    (422, "POST /v4/clear", "ClearRequest.by must have 1 to 128 printable", {"arm": "a+1", "by": ".a"}),
    (422, "POST /v4/reset", "ResetBody.by must have 1 to 128 printable", {"arm": "a+1", "by": "\r"}),
    (422, "POST /v4/alarms", "AcknowledgeBody.by must have 1 to 128 printable", {"alarm": "a", "by": "\r"}),
    (422, "POST /v4/control", "Change.due_s must be between 0 and", {**PAUSE, "action": LATE}),
    (422, "POST /v4/control", "Unknown field 'arms' in action; did you mean 'arm'?", {**PAUSE, "action": ARMS}),
    (422, "POST /v4/ask", "Unknown field 'payloadkg' in jobs[0]", {"jobs": [{**CRATE_JSON, "payloadkg": 1}]}),
    (422, "POST /v4/reset", "Unknown field 'name'. Allowed: arm, by.", {"arm": "a+1", "name": ""}),
    (422, "POST /v4/alarms", "Unknown field 'who'. Allowed: alarm, by.", {"alarm": "a", "by": "b", "who": "c"}),
    (422, "POST /v4/alarms", "An object has the field 'by' twice.", '{"alarm": "a", "by": "b", "by": "c"}'),
    (422, "POST /v4/alarms", "Not", b'{"alarm": "a", "by": "b", "x": "\xff"}'),
    (422, "POST /v4/jobs?by=erp", "Parameters are for a table (text/csv);", {"jobs": [CRATE_JSON]}),
    (415, "POST /v4/ask", "be UTF-8", {"jobs": [CRATE_JSON]}, {"Content-Type": JSON + "; charset=latin-1"}),
    (415, "POST /v4/ask", "must not be compressed (got Content-Encoding 'gzip", b"x", {"Content-Encoding": "gzip"}),
    (422, "GET /v4/jobs?job=" + "x" * 10_000, "?job=NAME must have 1 to 128 printable characters"),
    (422, "GET /v4/jobs?" + "job=abcdefghijklmnop&" * 3300, "The names of 3300 jobs have 62,7"),
    (403, "GET /v4/fleet", "may send no requests (got 'http://evil.exam", None, {"Origin": "http://evil.example"}),
    (403, "GET /v4/fleet", "Web pages of other hosts may send no requests (got 'null')", None, {"Origin": "null"}),
    (403, "POST /v4/jobs", "(got 'Sec-Fetch-Site: cross-site').", {"jobs": []}, {"Sec-Fetch-Site": "cross-site"}),
    (422, "POST /v4/jobs", "`. Allowed: hold, pick_place", {"jobs": [{**CRATE_JSON, "kind": "fly"}]}),
    (422, "GET /v4/fleet?jobs=all", "?jobs=N is the number of jobs to list, 0..4096 (got 'all')."),
    (422, "GET /v4/jobs?name=a", "There is no parameter 'name' of this request. Parameters: job."),
    (422, "POST /v4/reset?arm=a", "There is no parameter 'arm' of this request. It has none.", {"arm": "a"}),
]
"""Status and request, what the reply says, and body and headers of the request."""


@pytest.mark.parametrize("case", PROBLEMS)
def test_an_error_is_a_problem_document(gateway, case):
    status, request, says, *body_and_headers = case
    got, kind, reply = gateway.ask(*request.split(" ", 1), *body_and_headers)
    assert (got, kind) == (status, "application/problem+json")
    assert reply["status"] == status
    assert says in reply["detail"]


def test_a_path_names_all_its_methods(gateway):
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    for method, path in (("PUT", "/v4/jobs"), ("DELETE", "/v4/alarms")):
        line.request(method, path)
        reply = line.getresponse()
        assert (reply.status, {*reply.headers["Allow"].split(", ")}) == (405, {"GET", "HEAD", "POST"})
        reply.read()
    line.close()


def test_a_table_is_submitted_in_messages_or_all_its_faults_are_told(gateway, arm):
    head, before = "name;kind;places;payload;release;after", len(arm.requests)
    rows = [f"{i}/Teil;pick_place;conveyor > pallet;0,5;2026-11-23 06:{i % 60:02};{i + 1}/Teil" for i in range(199)]
    table = "\n".join([head, *rows, "199/Teil;hold;pallet;;;"])
    path = "/v4/jobs?shift_begin=2026-11-23T06:00%2B01:00&by=plan"
    status, _, reply = gateway.ask("POST", path, table.encode("cp1252"), CSV)
    assert status == 200
    assert all(each["accepted"] for each in reply["jobs"])
    sent = arm.requests[before:]
    assert [len(request.jobs) for request in sent] == [64, 64, 64, 8]
    assert {request.by for request in sent} == {"plan"}
    jobs = [job for request in sent for job in request.jobs]
    assert [each["job"] for each in reply["jobs"]] == [f"{i}/Teil" for i in range(200)]  # as the rows
    assert [job.name for job in jobs] == [f"{i}/Teil" for i in range(199, -1, -1)]  # each after those it waits for
    assert {job.name: job.release_s for job in jobs if job.name != "199/Teil"} == {
        f"{i}/Teil": 60.0 * (i % 60) for i in range(199)
    }
    wrong = f"{head}\na;hold;moon;;;\nb;hold;mars;;;\n"
    status, kind, reply = gateway.ask("POST", path, wrong, CSV)
    assert (status, kind, len(arm.requests)) == (422, "application/problem+json", before + 4)
    assert "The table has 2 errors:\n  row 2, column places: no place 'moon'" in reply["detail"]
    assert "row 3, column places: no place 'mars'" in reply["detail"]
    status, _, reply = gateway.ask("POST", path, f"{head}\na;hld;pallet;two;;\n", CSV)
    assert (status, reply["detail"].count("row 2, column ")) == (422, 2)


def test_jobs_of_a_table_that_are_refused_are_named_by_row_and_what_was_accepted_is_said(gateway, arm, monkeypatch):
    def submit(request, own=arm.submit):
        reply = own(request)
        if len(request.jobs) == 1:  # what waits is sent last
            raise RefusedForNow("The journal has no room.")
        stuck = Admission("j1", False, "It waits for 'no/one'.")
        return SubmissionReply("auctioneer", tuple(stuck if each.job == "j1" else each for each in reply.jobs))

    monkeypatch.setattr(arm, "submit", submit)
    rows = [f"j{i},hold,pallet,{'no/one' * (i == 1)}" for i in range(65)]
    text = "\n".join(["name,kind,places,after", *rows])
    status, _, reply = gateway.ask("POST", "/v4/jobs", text[: text.index("j64")], CSV)
    assert (status, [each["reason"] for each in reply["jobs"] if not each["accepted"]]) == (
        200,
        ["row 3, column after: It waits for 'no/one'."],
    )
    status, _, reply = gateway.ask("POST", "/v4/jobs", text, CSV)
    assert status == 503
    accepted = ", ".join(f"row {number}" for number in (2, *range(4, 67)))
    assert reply["detail"].endswith(f"The journal has no room. Accepted before: {accepted}.")


def test_a_body_of_unknown_length_is_limited_too(gateway):
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    parts = (b" " * 10_000 for _ in range(7))
    line.request("POST", "/v4/jobs", parts, {"Content-Type": "application/json"}, encode_chunked=True)
    assert line.getresponse().status == 413
    line.close()


def test_a_slow_body_is_a_timeout(router, monkeypatch):
    monkeypatch.setattr("scenarios.live.gateway.BODY_S", 0.2)
    with Served(router) as served, socket.create_connection(("127.0.0.1", served.port)) as line:
        line.settimeout(PATIENCE_S)
        head = (
            "POST /v4/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
        )
        line.sendall(f"{head}{{".encode())
        assert b" 408 " in line.recv(1000)


def test_without_an_auctioneer_the_gateway_says_so():
    with Router() as empty, Served(empty.endpoint) as served:
        status, _, reply = served.ask("POST", "/v4/jobs", {"jobs": [CRATE_JSON]})
        assert (status, reply["detail"]) == (503, "No auctioneer is online in this fleet.")
        status, _, reply = served.ask("GET", "/v4/fleet")
        assert (status, reply["arms"]) == (200, [])


def test_a_token_may_do_what_its_role_may(guarded):
    def ask(token, method, path, body=None):
        return guarded.ask(method, path, body, {"Authorization": f"Bearer {token}"})

    assert ask(WATCHER, "GET", "/")[2]["role"] == "monitor"
    assert ask(WATCHER, "GET", "/v4/jobs")[0] == 200
    status, _, reply = ask(WATCHER, "POST", "/v4/jobs", {"jobs": [CRATE_JSON]})
    assert (status, reply["detail"]) == (403, "This token has the role monitor; this request needs submitter.")
    assert ask(SENDER, "POST", "/v4/jobs", {"jobs": [CRATE_JSON]})[0] == 200
    for path, body in (("control", PAUSE), ("reset", {"arm": "a+1"})):
        status, _, reply = ask(SENDER, "POST", f"/v4/{path}", body)
        assert (status, reply["detail"]) == (403, "This token has the role submitter; this request needs operator.")


def test_the_first_page_lists_all_requests(gateway):
    status, _, reply = gateway.ask("GET", "/")
    assert (status, reply["role"]) == (200, "operator")
    offered = {(entry["method"], entry["path"]) for entry in reply["requests"]}
    assert {("GET", "/v4/fleet"), ("POST", "/v4/jobs")} <= offered
    for method, path in offered - {("GET", "/v4/events"), ("GET", "/metrics")}:
        assert gateway.ask(method, path, {} if method == "POST" else None)[0] in (200, 422)


def test_no_other_origin_is_ever_allowed(gateway):
    _, headers, _ = get(gateway, "/v4/fleet", {"Origin": "http://evil.example"})
    assert not [name for name in headers if name.lower().startswith("access-control")]


def test_the_page_may_send_requests_and_be_linked_to_from_anywhere(gateway):
    own = f"http://127.0.0.1:{gateway.port}"
    proxied = {"Origin": "https://fleet.example", "Sec-Fetch-Site": "same-origin"}
    for headers in ({"Origin": own}, {"Origin": own, "Sec-Fetch-Site": "same-origin"}, proxied):
        assert get(gateway, "/v4/fleet", headers)[0] == 200, headers
    assert get(gateway, "/", {**BROWSER, "Sec-Fetch-Site": "cross-site"})[0] == 200
    assert get(gateway, "/v4/fleet", {"Sec-Fetch-Site": "cross-site"})[0] == 403


def test_a_file_of_the_page_is_compressed_if_the_request_accepts_that(gateway):
    for accepts, coding in (("identity", None), ("gzip, br", "gzip")):
        _, headers, text = get(gateway, "/page/cell.js", {"Accept-Encoding": accepts})
        assert (headers["Content-Encoding"], headers["Vary"]) == (coding, "Accept, Accept-Encoding")
        assert len(text) > 500


def test_the_stream_has_all_messages(gateway, arm):
    with gateway.stream() as (_, file):
        arm.happens(0)
        found = events(file, lambda found: {"state", "difficulty", "event"} <= {name for _, name, _ in found})
    assert {"role": "arm", "name": "a+1", "there": True} in [each["message"] for each in of("presence", found)]
    assert of("state", found)[0]["name"] == "a+1"
    assert of("state", found)[0]["message"]["temp_c"][:2] == [30.0, 41.5]
    assert of("event", found)[0]["message"]["kind"] == "warning"
    numbers = [int(number.partition("-")[2]) for number, _, _ in found]
    assert numbers == sorted(set(numbers))


def test_a_reader_that_reconnects_misses_no_event(gateway, arm):
    with gateway.stream() as (_, file):
        arm.happens(100)
        last = events(file, lambda found: 100 in numbers_of(found))[-1][0]
    arm.happens(101)
    with gateway.stream({"Last-Event-ID": last}) as (_, file):
        found = events(file, lambda found: len(of("event", found)) == 1)
        last = found[-1][0]
    with gateway.stream({"Last-Event-ID": last}) as (_, file):  # nothing has happened meanwhile
        arm.happens(102)
        arm.happens(103)
        found += events(file, lambda found: len(of("event", found)) == 2)
    assert numbers_of(found) == [101, 102, 103]
    assert not of("gap", found)
    boot = last.partition("-")[0]
    with gateway.stream({"Last-Event-ID": f"{boot}-99999999"}) as (_, file):  # no message has had this number yet
        found = events(file, lambda found: set(numbers_of(found)) >= {100, 101, 102, 103})
    assert found[0] == (None, "gap", {})
    with gateway.stream({"Last-Event-ID": "otherlife-99999999"}) as (_, file):  # before a restart: all again
        found = events(file, lambda found: set(numbers_of(found)) >= {100, 101, 102, 103})
    assert found[0] == (None, "gap", {})
    assert not of("gap", found[1:])


def test_a_silent_stream_sends_heartbeats(monkeypatch):
    monkeypatch.setattr("scenarios.live.gateway.HEARTBEAT_S", 0.05)
    with Router() as empty, Served(empty.endpoint) as served, served.stream() as (_, file):
        assert any(": heartbeat" in file.readline() for _ in range(30))


def test_a_stuck_reader_is_dropped_and_delays_no_other(monkeypatch):
    big = "x" * 4000
    monkeypatch.setattr("scenarios.live.gateway.STUCK_S", 0.5)
    with ExitStack() as stack:  # of its own: who joins a fleet later would get all these events
        router = stack.enter_context(Router()).endpoint
        arm = stack.enter_context(MovingFleet(router, ("arm_0",), fleet="f"))
        served = stack.enter_context(Served(router))
        stack.enter_context(served.stream(receive_bytes=4096))
        _, file = stack.enter_context(served.stream())
        wait_until(lambda: len(served.readers.connected) == 2)
        slowest_s = 0.0
        for number in range(600):  # far more than socket buffers hold
            said_s = time.monotonic()
            arm.happens(number, big)
            if number % 100 == 99:
                events(file, lambda found, n=number: n in numbers_of(found))
                slowest_s = max(slowest_s, time.monotonic() - said_s)
        assert slowest_s < PATIENCE_S
        wait_until(lambda: len(served.readers.connected) == 1)  # the stuck one is gone, the other still reads
        arm.happens(600)
        assert events(file, lambda found: 600 in numbers_of(found))
        wait_until(lambda: len(served.server.server_state.connections) == 1)  # and so is its connection


def test_the_number_of_readers_is_limited(gateway):
    with ExitStack() as stack:
        for _ in range(64):
            stack.enter_context(gateway.stream())
        wait_until(lambda: len(gateway.readers.connected) == 64)
        assert gateway.ask("GET", "/v4/events")[0] == 503
        assert gateway.ask("GET", "/v4/fleet")[0] == 200
    wait_until(lambda: not gateway.readers.connected)  # who disconnects is removed


@pytest.mark.parametrize(
    "begun",
    [
        "POST /v4/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{",
        "POST /v4/jobs HTTP/1.1\r\nHost: loc",
        "",
    ],
    ids=["bodies", "headers", "connections"],
)
def test_300_unfinished_requests_hold_nobody_up(router, arm, begun, monkeypatch):
    for limit in ("HEADER_S", "BODY_S"):
        monkeypatch.setattr(f"scenarios.live.gateway.{limit}", 3 * PATIENCE_S)
    with Served(router) as served, ExitStack() as lines:
        for _ in range(300):
            line = lines.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            line.sendall(begun.encode())
        replies = []
        for request in (("GET", "/v4/fleet"), ("POST", "/v4/jobs", {"jobs": [CRATE_JSON]})):
            try:  # the rate is limited, too
                wait_until(lambda request=request: replies.append(served.ask(*request)) or replies[-1][0] == 200)
            finally:
                assert replies[-1][0] == 200, replies[-1]


def test_requests_beyond_the_rate_are_refused_until_a_pause(router, monkeypatch):
    with Served(router) as served:
        with monkeypatch.context() as patch:
            patch.setattr("scenarios.live.gateway.RATE_HZ", 1.0)  # which a slow machine also exceeds
            answers = [served.ask("GET", "/")[0] for _ in range(400)]
        assert answers[:100] == [200] * 100
        assert 429 in answers
        wait_until(lambda: served.ask("GET", "/")[0] == 200)


ROOT = Path(__file__).parents[3]


@contextmanager
def process(endpoint, *options):
    """The command in a process of its own, from when it says that it is ready, and its address."""
    started = commands.start("bus", "gateway", "--fleet", "f", "--endpoint", endpoint, "--port", 0, *options)
    try:
        line = started.stdout.readline()
        assert line.startswith("ready gateway http://127.0.0.1:"), line + started.stderr.read()
        yield started, line.split()[2]
    finally:
        started.kill()
        started.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_the_command_exits_on_a_signal_even_while_a_reader_is_connected(router, number, code):
    with process(router) as (started, address):
        port = int(address.split(":")[2].split("/")[0])
        line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        line.request("GET", "/v4/events")
        assert line.getresponse().status == 200
        started.send_signal(number)
        assert started.wait(PATIENCE_S) == code
        line.close()
        assert "Traceback" not in started.stderr.read()


def test_a_gateway_of_a_fleet_without_participants_names_those_that_have_some(router, arm):
    with process(router, "--fleet", "nofleet") as (started, _):
        started.terminate()
        said = started.communicate(timeout=PATIENCE_S)[1]
    assert f"No participant of the fleet 'nofleet' is online yet. Fleets at {router}: f." in said


@pytest.mark.ci_slow
def test_the_command_waits_for_a_router():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with Router(port):
        pass  # now the port is free, and was a router's
    started = commands.start("bus", "gateway", "--fleet", "f", "--endpoint", f"tcp/127.0.0.1:{port}", "--port", 0)
    try:
        assert "Waiting for a router." in started.stderr.readline()
        assert started.poll() is None
        with Router(port):
            assert started.stdout.readline().startswith("ready gateway http://127.0.0.1:")
            started.terminate()
            assert started.wait(PATIENCE_S) == 0
    finally:
        started.kill()
        started.communicate(timeout=PATIENCE_S)


@pytest.mark.ci_slow
@pytest.mark.skipif(shutil.which("node") is None, reason="no Node")
def test_the_monitor_in_javascript_shows_the_fleet(router, arm, tmp_path):
    log = tmp_path / "log"  # a pipe that nobody reads would stop it
    with process(router) as (_, address), log.open("w") as out:
        arm.post(lambda: arm.set("crate 1", state="waiting", repetitions=1, cycles=0))
        arm.happens(7)
        command = ["node", str(ROOT / "examples" / "monitor.mjs"), address, "3"]
        node = subprocess.Popen(command, stdout=out, env=os.environ | {"NO_COLOR": "1"})
        try:
            wait_until(lambda: node.poll() is not None, lambda: arm.happens(7))
        finally:
            node.kill()
            node.wait(timeout=PATIENCE_S)
    printed = log.read_text(encoding="utf-8")
    assert node.returncode == 0
    assert re.search(r"a\+1 .*idle.*41\.5.*2 .*18\.5", printed)
    assert "warning" in printed
    assert "crate 1 0.20" in printed
