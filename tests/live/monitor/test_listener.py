"""A listener on a router has the view of a whole fleet."""

import time

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, StatusRequest
from fleet.bus.router import Router
from fleet.live.monitor import snapshot as listener_module
from fleet.live.monitor.snapshot import FleetListener
from tests.live.monitor.messages import stands
from tests.waiting import serve_until, wait_until


def test_a_listener_counts_only_the_jobs_of_the_present_fleet(monkeypatch):
    monkeypatch.setattr(listener_module, "STATUS_EVERY_S", 0.05)
    fleets = [stands(900.0, "a", "b"), stands(5.0, "c", state="waiting")]
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as auctioneer:
        auctioneer.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: fleets[0])
        seen = FleetListener(link)
        for fleet in ({"finished": 2}, {"waiting": 1}):
            serve_until(lambda fleet=fleet: seen.view.snapshot(0.0).counts == fleet, seen, auctioneer)
            del fleets[:-1]


def test_a_listener_receives_a_whole_fleet(fleet):
    heard, came = [], []
    fleet.event(ArmEvent(arm="a", number=0, time_s=1.0, kind="warning", joint=2))
    with BusClient(fleet.endpoint, "f") as link:
        listener = FleetListener(
            link, on_message=lambda *said: heard.append(said[:2]), on_presence=lambda *who: came.append(who)
        )
        wait_until(
            lambda: len({topic for topic, _ in heard}) >= 3,
            lambda: (fleet.say(), listener.serve(time.monotonic() + 0.05)),
        )
        (arm,) = listener.view.snapshot(time.monotonic()).arms
    assert {topic for topic, _ in heard} == {"state", "difficulty", "event"}  # the event was said before
    assert came == [("arm", "a", True)]
    assert arm.present
    assert arm.event == "warning joint 2"
