"""The bus over HTTP with real sockets: messages, requests, and readers that do not slow each other."""

import asyncio
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from fleet.bus.client.client import BusClient, Refused
from fleet.bus.client.router import Router
from fleet.bus.protocol import auction as bus
from fleet.bus.protocol import keys
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.examples import EXAMPLES
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.protocol.operator import Cancel, Controlled, ControlRequest
from fleet.live.monitor.async_bridge import AsyncBridge
from scenarios.cli.live.gateway import Server, listen
from scenarios.live.http_app import MAX_BYTES, Readers, application

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0
CRATE_JSON = {"name": "crate 1", "kind": "hold", "places": ["rack"]}


class StandIn:
    """A fleet of one arm `a+1` and an auctioneer, on a thread of its own."""

    def __init__(self, endpoint):
        self.link, self.stop, self.asked = BusClient(endpoint, "f"), threading.Event(), []
        self.thread = threading.Thread(target=self.serve)

    def __enter__(self):
        link = self.link.open()
        link.reply_to(keys.of_arm("f", "a+1", "quote"), bus.QuoteRequest, self.quote)
        link.declare_token(keys.of_arm("f", "a+1", "alive"))
        self.event = link.publisher(keys.of_arm("f", "a+1", "event"), bus.ArmEvent)
        link.reply_to(keys.of_jobs("f", "submit"), bus.Submission, self.submit)
        link.reply_to(keys.of_jobs("f", "status"), bus.StatusRequest, self.status)
        link.reply_to(keys.of_jobs("f", "cell"), CellRequest, lambda _: EXAMPLES[Cell])
        link.reply_to(keys.of_jobs("f", "control"), ControlRequest, self.control)
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join()
        self.link.close()

    def serve(self):
        while not self.stop.is_set():
            self.link.serve(time.monotonic() + 0.05)

    def quote(self, request):
        assert request.dry_run
        offers = tuple(bus.JobEstimate(job.name, (bus.PlanQuote(difficulty=0.25),)) for job in request.jobs)
        return bus.Quote("a+1", request.auction, "", 3.0, "t", 1.0, "idle", 20.0, 1, offers)

    def submit(self, word):
        if word.by == "disk full":
            raise Refused("The journal has no room.")
        self.asked.append(word)
        return bus.SubmissionReply("au", tuple(bus.Admission(job.name, True) for job in word.jobs))

    def control(self, request):
        self.asked.append(request)
        return Controlled("au", request.request, changed=True)

    def status(self, word):
        return bus.Status("au", 9.0, (bus.JobStatus("crate 1", "waiting"),))

    def state(self, tick, arm="a+1"):
        word = State(arm=arm, tick=tick, time_s=float(tick), mode="idle", temp_c=(30.0, 41.5), headroom_k=18.5)
        self.link.publish(keys.of_arm("f", arm, "state"), word)

    def difficulty(self):
        word = DifficultyScores("a+1", 1, 1.0, "t", ("crate 1",), (0.5,), (None,))
        self.link.publish(keys.of_arm("f", "a+1", "difficulty"), word)

    def happens(self, number, reason=""):
        self.event(bus.ArmEvent(arm="a+1", number=number, time_s=1.0, kind="warning", joint=2, reason=reason))


class Served:
    """A gateway in this process, on a free port or the one given."""

    def __init__(self, endpoint, port=0, **options):
        self.port = port
        self.endpoint, self.options, self.readers = endpoint, options, Readers()
        self.started = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.run()))

    async def run(self):
        stuck_s = self.options.get("stuck_s", 10.0)
        with listen("127.0.0.1", self.port, stuck_s) as bound, BusClient(self.endpoint, "f") as link:
            async with AsyncBridge(link, self.readers.put) as self.gateway:
                self.server = Server(application(self.gateway, self.readers, **self.options), self.readers)
                self.port = bound.getsockname()[1]
                self.started.set()
                await self.server.serve(sockets=[bound])

    def __enter__(self):
        self.thread.start()
        assert self.started.wait(PATIENCE_S)
        return self

    def __exit__(self, *_):
        self.server.should_exit = True
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()

    def ask(self, method, path, body=None, headers=()):
        """Status, content type and JSON of an answer."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            sent = json.dumps(body) if isinstance(body, dict | list) else body
            line.request(method, path, sent, {"Content-Type": "application/json", **dict(headers)})
            answer = line.getresponse()
            return answer.status, answer.headers.get_content_type(), json.loads(answer.read() or b"null")
        finally:
            line.close()

    @contextmanager
    def stream(self, headers=(), receive_bytes=None):
        """The lines of a stream of events, as a file."""
        with socket.socket() as line:
            if receive_bytes:
                line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
            line.settimeout(PATIENCE_S)
            line.connect(("127.0.0.1", self.port))
            head = "".join(f"{name}: {value}\r\n" for name, value in dict(headers).items())
            line.sendall(f"GET /v4/events HTTP/1.1\r\nHost: localhost:{self.port}\r\n{head}\r\n".encode())
            with line.makefile("r", encoding="utf-8", newline="\n") as file:
                yield line, file


def events(file, enough):
    """Events of a stream by id, topic and data, until there are enough."""
    found, now = [], {}
    deadline_s = time.monotonic() + PATIENCE_S
    while not enough(found):
        assert time.monotonic() < deadline_s, found
        text = file.readline()
        assert text, f"the stream ended after {found}"
        name, colon, value = text.rstrip("\n").partition(": ")
        if colon and name in ("id", "event", "data"):
            now[name] = value
        elif text == "\n" and "event" in now:
            found.append((now.get("id"), now["event"], json.loads(now["data"])))
            now = {}
    return found


def of(topic, found):
    return [data for _, name, data in found if name == topic]


def numbers_of(found):
    """What the arm numbered its events with."""
    return [data["message"]["number"] for data in of("event", found)]


@pytest.fixture(scope="module")
def router():
    with Router() as opened:
        yield opened.endpoint


@pytest.fixture(scope="module")
def arm(router):
    with StandIn(router) as standing:
        yield standing


@pytest.fixture(scope="module")
def gateway(router, arm):
    with Served(router) as served:
        yield served


def until(condition, make=lambda: None):
    """The first true value of a condition that other threads bring about."""
    deadline_s = time.monotonic() + PATIENCE_S
    pause = threading.Event()
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "waited in vain"
        make()
        pause.wait(0.02)
    return value


def test_the_fleet_is_shown_with_ages(gateway, arm):
    def fleet():
        _, kind, told = gateway.ask("GET", "/v4/fleet")
        assert kind == "application/json"
        return told if told["arms"] and told["arms"][0]["present"] and told["jobs"] else None

    told = until(fleet, lambda: arm.state(3))
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


@pytest.mark.parametrize(
    "begun",
    [
        "POST /v4/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{",
        "POST /v4/jobs HTTP/1.1\r\nHost: loc",
        "",
    ],
    ids=["bodies", "headers", "connections"],
)
def test_300_unfinished_requests_hold_nobody_up(router, arm, begun):
    with Served(router) as served, ExitStack() as lines:
        for _ in range(300):
            line = lines.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            line.sendall(begun.encode())
        time.sleep(2.5)  # the rate of one address is limited, too
        start_s = time.monotonic()
        assert served.ask("GET", "/v4/fleet")[0] == 200
        assert served.ask("POST", "/v4/jobs", {"jobs": [CRATE_JSON]})[0] == 200
        assert time.monotonic() - start_s < 3.0


def test_requests_beyond_the_rate_are_refused_until_a_pause(router):
    with Served(router) as served:
        answers = [served.ask("GET", "/")[0] for _ in range(400)]
        assert answers[:100] == [200] * 100
        assert 429 in answers
        time.sleep(0.5)
        assert served.ask("GET", "/")[0] == 200


def test_no_other_origin_is_ever_allowed(gateway):
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    line.request("GET", "/v4/fleet", headers={"Origin": "http://evil.example"})
    assert not [name for name in line.getresponse().headers if name.lower().startswith("access-control")]
    line.close()


def test_the_stream_has_all_messages(gateway, arm):
    with gateway.stream() as (_, file):
        arm.state(1)
        arm.difficulty()
        arm.happens(0)
        found = events(file, lambda found: {"state", "difficulty", "event"} <= {name for _, name, _ in found})
    assert of("presence", found)[0]["message"] == {"role": "arm", "name": "a+1", "there": True}
    assert of("state", found)[0]["name"] == "a+1"
    assert of("state", found)[0]["message"]["temp_c"] == [30.0, 41.5]
    assert of("event", found)[0]["message"]["kind"] == "warning"
    numbers = [int(number.partition("-")[2]) for number, _, _ in found]
    assert numbers == sorted(set(numbers))


def test_a_reader_that_reconnects_misses_no_event(gateway, arm):
    with gateway.stream() as (_, file):
        arm.happens(100)
        last = events(file, lambda found: 100 in numbers_of(found))[-1][0]
    for number in range(101, 104):
        arm.happens(number)
    with gateway.stream({"Last-Event-ID": last}) as (_, file):
        found = events(file, lambda found: len(of("event", found)) == 3)
    assert numbers_of(found) == [101, 102, 103]
    assert not of("gap", found)
    with gateway.stream({"Last-Event-ID": "otherlife-99999999"}) as (_, file):  # before a restart: all again
        assert events(file, lambda found: set(numbers_of(found)) >= {100, 101, 102, 103})


def test_a_silent_stream_sends_heartbeats():
    with Router() as empty, Served(empty.endpoint, heartbeat_s=0.05) as served, served.stream() as (_, file):
        assert any(": heartbeat" in file.readline() for _ in range(30))


def test_a_stuck_reader_is_dropped_and_delays_no_other(router, arm):
    big = "x" * 4000
    with Served(router, stuck_s=0.5) as served, served.stream(receive_bytes=4096), served.stream() as (_, file):
        until(lambda: len(served.readers.connected) == 2)
        slowest_s = 0.0
        for number in range(600):  # far more than socket buffers hold
            said_s = time.monotonic()
            arm.happens(number, big)
            if number % 100 == 99:
                events(file, lambda found, n=number: n in numbers_of(found))
                slowest_s = max(slowest_s, time.monotonic() - said_s)
        assert slowest_s < 5.0
        until(lambda: len(served.readers.connected) == 1)  # the stuck one is gone, the other still reads
        arm.happens(600)
        assert events(file, lambda found: 600 in numbers_of(found))
        until(lambda: len(served.server.server_state.connections) == 1)  # and so is its connection


def test_a_reader_that_disconnects_is_removed(gateway, arm):
    for _ in range(3):
        with gateway.stream() as (_, file):
            file.readline()
            until(lambda: gateway.readers.connected)
        until(lambda: not gateway.readers.connected, lambda: arm.state(1))


def test_the_number_of_readers_is_limited(gateway):
    with ExitStack() as stack:
        for _ in range(64):
            stack.enter_context(gateway.stream())
        until(lambda: len(gateway.readers.connected) == 64)
        assert gateway.ask("GET", "/v4/events")[0] == 503
        assert gateway.ask("GET", "/v4/fleet")[0] == 200


@contextmanager
def process(endpoint, *options):
    """The command in a process of its own, from when it says that it is ready, and its address."""
    command = [sys.executable, "-u", "-c", "from scenarios.cli.main import main; main()", "gateway", "--fleet", "f"]
    command += ["--endpoint", endpoint, "--port", "0", *options]
    started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
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


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node")
def test_the_monitor_in_javascript_shows_the_fleet(router, arm, tmp_path):
    log = tmp_path / "log"  # a pipe that nobody reads would stop it
    with process(router) as (_, address), log.open("w") as out:
        arm.state(1)
        arm.difficulty()
        arm.happens(7)
        command = ["node", str(ROOT / "examples" / "monitor.mjs"), address, "3"]
        node = subprocess.Popen(command, stdout=out, env=os.environ | {"NO_COLOR": "1"})
        try:
            until(lambda: node.poll() is not None, lambda: (arm.state(1), arm.difficulty(), arm.happens(7)))
        finally:
            node.kill()
            node.wait(timeout=PATIENCE_S)
    told = log.read_text(encoding="utf-8")
    assert node.returncode == 0
    assert re.search(r"a\+1 .*idle.*41\.5.*2 .*18\.5", told)
    assert "warning" in told
    assert "crate 1 0.50" in told
