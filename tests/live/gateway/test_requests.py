"""The bus over HTTP with real sockets: requests, errors and rights."""

import http.client
import socket

import pytest

from fleet.bus.protocol.operator import Cancel, ControlRequest
from fleet.bus.router import Router
from scenarios.live.gateway import MAX_BYTES
from tests.live.gateway.served import CRATE_JSON, Served
from tests.waiting import PATIENCE_S, wait_until


def test_the_fleet_is_shown_with_ages(gateway, arm):
    def fleet():
        _, kind, told = gateway.ask("GET", "/v4/fleet")
        assert kind == "application/json"
        return told if told["arms"] and told["arms"][0]["present"] and told["jobs"] else None

    told = wait_until(fleet, lambda: arm.state(3))
    assert told["fleet"] == "f"
    (seen,) = told["arms"]
    assert (seen["arm"], seen["hottest_c"], seen["joint"], seen["headroom_k"]) == ("a+1", 41.5, 2, 18.5)
    assert 0 <= seen["state_age_s"] < 3.0
    assert told["counts"] == {"waiting": 1}


def test_jobs_are_submitted_and_quoted(gateway, arm):
    status, _, told = gateway.ask("POST", "/v4/jobs", {"jobs": [CRATE_JSON], "by": "me"})
    assert (status, told["jobs"][0]["accepted"]) == (200, True)
    assert arm.asked[-1].jobs[0].name == "crate 1"
    status, _, told = gateway.ask("GET", "/v4/jobs?job=crate%201")
    assert (status, told["jobs"][0]["state"]) == (200, "waiting")
    status, _, told = gateway.ask("POST", "/v4/ask", {"jobs": [CRATE_JSON]})
    assert (status, told["quotes"][0]["estimates"][0]["plans"][0]["difficulty"]) == (200, 0.25)


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status", "says"),
    [
        ("POST", "/v4/jobs", "{", {}, 422, "Not a thermofleet.Submission"),
        ("POST", "/v4/jobs", {"jobs": []}, {}, 422, "length >= 1"),
        ("POST", "/v4/jobs", {"jobs": [{**CRATE_JSON, "places": ["a", "b"]}]}, {}, 422, "place"),
        ("POST", "/v4/jobs", b"\xff", {}, 422, "Not a"),
        ("POST", "/v4/jobs", {"jobs": [CRATE_JSON]}, {"Content-Type": "text/plain"}, 415, "application/json"),
        ("POST", "/v4/jobs", {"jobs": [CRATE_JSON], "by": "disk full"}, {}, 503, "no room"),
        ("POST", "/v4/ask", {"jobs": []}, {}, 422, "length >= 1"),
        ("POST", "/v4/jobs", b" " * (MAX_BYTES + 1), {}, 413, "at most"),
        ("GET", "/v4/nothing", None, {}, 404, "Not Found"),
        ("DELETE", "/v4/jobs", None, {}, 405, "Not Allowed"),
        ("GET", "/v4/fleet", None, {"Host": "evil.example"}, 421, "evil.example"),
        ("GET", "/v4/fleet", None, {"Host": "evil.example:80"}, 421, "evil.example"),
    ],
)
def test_an_error_is_a_problem_document(gateway, method, path, body, headers, status, says):
    got, kind, told = gateway.ask(method, path, body, headers)
    assert (got, kind) == (status, "application/problem+json")
    assert told["status"] == status
    assert says in told["detail"]


def test_a_body_of_unknown_length_is_limited_too(gateway):
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    parts = (b" " * 10_000 for _ in range(7))
    line.request("POST", "/v4/jobs", parts, {"Content-Type": "application/json"}, encode_chunked=True)
    assert line.getresponse().status == 413
    line.close()


def test_a_slow_body_is_a_timeout(router):
    with Served(router, body_s=0.2) as served, socket.create_connection(("127.0.0.1", served.port)) as line:
        line.settimeout(PATIENCE_S)
        head = (
            "POST /v4/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n"
        )
        line.sendall(f"{head}{{".encode())
        assert b" 408 " in line.recv(1000)


def test_without_an_auctioneer_the_gateway_says_so():
    with Router() as empty, Served(empty.endpoint) as served:
        status, _, told = served.ask("POST", "/v4/jobs", {"jobs": [CRATE_JSON]})
        assert (status, told["detail"]) == (503, "There is no auctioneer in this fleet.")
        status, _, told = served.ask("GET", "/v4/fleet")
        assert (status, told["arms"]) == (200, [])


def test_only_requests_with_the_token_are_served(router):
    token = "sixteen-or-more-characters"
    with Served(router, tokens={token: "operator"}) as served:
        for wrong in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {token}"},
                      {"Authorization": f"Bearer {token}x"}, {"Authorization": f"Bearer {token[:-1]}"}):  # fmt: skip
            status, kind, _ = served.ask("GET", "/v4/fleet", headers=wrong)
            assert (status, kind) == (401, "application/problem+json")
        with served.stream() as (_, file):
            assert " 401 " in file.readline()
        status, _, _ = served.ask("GET", "/v4/fleet", headers={"Authorization": f"bearer {token}", "Host": "any"})
        assert status == 200


def test_a_token_may_do_what_its_role_may(router, arm):
    watcher, sender = "watcher-watcher-watcher", "sender-sender-sender"
    with Served(router, tokens={watcher: "monitor", sender: "submitter"}) as served:

        def ask(token, method, path, body=None):
            return served.ask(method, path, body, {"Authorization": f"Bearer {token}"})

        assert ask(watcher, "GET", "/v4/jobs")[0] == 200
        status, _, told = ask(watcher, "POST", "/v4/jobs", {"jobs": [CRATE_JSON]})
        assert (status, told["detail"]) == (403, "This token has the role monitor; this request needs submitter.")
        assert ask(sender, "POST", "/v4/jobs", {"jobs": [CRATE_JSON]})[0] == 200
        status, _, told = ask(sender, "POST", "/v4/control", {"request": "1", "action": {"action": "pause"}})
        assert (status, told["detail"]) == (403, "This token has the role submitter; this request needs operator.")


def test_an_operator_cancels_over_http(gateway, arm):
    cancel = {"request": "1", "action": {"action": "cancel", "job": "crate 1"}, "by": "ann"}
    status, _, told = gateway.ask("POST", "/v4/control", cancel)
    assert (status, told["changed"]) == (200, True)
    assert arm.asked[-1] == ControlRequest("1", Cancel("crate 1"), "ann")
    assert gateway.ask("POST", "/v4/control", {"request": "1", "action": {"action": "fly"}})[0] == 422


def test_the_first_page_lists_all_requests(gateway):
    status, _, told = gateway.ask("GET", "/")
    assert (status, told["role"]) == (200, "operator")
    offered = {(entry["method"], entry["path"]) for entry in told["requests"]}
    assert {("GET", "/v4/fleet"), ("POST", "/v4/jobs")} <= offered
    for method, path in offered - {("GET", "/v4/events")}:
        assert gateway.ask(method, path, {} if method == "POST" else None)[0] in (200, 422)


def test_no_other_origin_is_ever_allowed(gateway):
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    line.request("GET", "/v4/fleet", headers={"Origin": "http://evil.example"})
    assert not [name for name in line.getresponse().headers if name.lower().startswith("access-control")]
    line.close()
