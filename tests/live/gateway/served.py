"""A gateway in this process, and the events of its streams."""

import asyncio
import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager

from fleet.bus.client import BusClient
from fleet.live.monitor.async_bridge import AsyncBridge
from scenarios.live.gateway import Readers, Server, application, listen
from tests.waiting import PATIENCE_S


class Served:
    """A gateway in this process, on a free port or the one given."""

    def __init__(self, endpoint, port=0, **options):
        self.port = port
        self.endpoint, self.options, self.readers = endpoint, options, Readers()
        self.started = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.run()))

    async def run(self):
        with listen("127.0.0.1", self.port) as bound, BusClient(self.endpoint, "f") as link:
            self.port = bound.getsockname()[1]
            async with AsyncBridge(link, self.readers.wake, monitor=f"gateway-{self.port}") as self.gateway:
                self.server = Server(application(self.gateway, self.readers, **self.options), self.readers)
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
