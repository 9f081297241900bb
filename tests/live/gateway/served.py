"""A gateway in this process, the fleet behind it, and what a reader gets from its streams."""

import asyncio
import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager

from docs.bus_contract import EXAMPLES
from fleet.bus.client import BusClient, Refused
from fleet.bus.protocol import auction as bus
from fleet.bus.protocol import keys
from fleet.bus.protocol.cell import Cell, CellRequest
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.protocol.operator import Controlled, ControlRequest
from fleet.live.monitor.async_bridge import AsyncBridge
from scenarios.live.gateway import Readers, Server, application, listen
from tests.waiting import PATIENCE_S

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
