"""Readers of a gateway's events, and senders of unfinished requests, do not slow each other."""

import socket
import time
from contextlib import ExitStack

import pytest

from fleet.bus.router import Router
from tests.live.gateway.served import CRATE_JSON, Served, events, numbers_of, of
from tests.waiting import PATIENCE_S, wait_until


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


def test_a_reader_that_disconnects_is_removed(gateway, arm):
    for _ in range(3):
        with gateway.stream() as (_, file):
            file.readline()
            wait_until(lambda: gateway.readers.connected)
        wait_until(lambda: not gateway.readers.connected, lambda: arm.state(1))


def test_the_number_of_readers_is_limited(gateway):
    with ExitStack() as stack:
        for _ in range(64):
            stack.enter_context(gateway.stream())
        wait_until(lambda: len(gateway.readers.connected) == 64)
        assert gateway.ask("GET", "/v4/events")[0] == 503
        assert gateway.ask("GET", "/v4/fleet")[0] == 200


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
    monkeypatch.setattr("scenarios.cli.live.gateway.HEADER_S", 3 * PATIENCE_S)
    with Served(router, body_s=3 * PATIENCE_S) as served, ExitStack() as lines:
        for _ in range(300):
            line = lines.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            line.sendall(begun.encode())
        for request in (("GET", "/v4/fleet"), ("POST", "/v4/jobs", {"jobs": [CRATE_JSON]})):
            wait_until(lambda request=request: served.ask(*request)[0] == 200)  # the rate is limited, too


def test_requests_beyond_the_rate_are_refused_until_a_pause(router, monkeypatch):
    with Served(router) as served:
        with monkeypatch.context() as patch:
            patch.setattr("scenarios.live.http_access.RATE_HZ", 1.0)  # which a slow machine also exceeds
            answers = [served.ask("GET", "/")[0] for _ in range(400)]
        assert answers[:100] == [200] * 100
        assert 429 in answers
        wait_until(lambda: served.ask("GET", "/")[0] == 200)
