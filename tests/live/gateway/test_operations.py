"""Metrics, alarms and webhooks of a gateway."""

import asyncio
import hashlib
import hmac
import http.client
import json
import re
from collections import Counter
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import JobStatus, Result
from fleet.bus.protocol.operator import Alarm
from fleet.bus.router import Router
from fleet.errors import FleetError
from fleet.live.auction.rounds import NOT_OFFERED
from fleet.live.monitor import alarms, async_bridge
from fleet.live.monitor.async_bridge import AsyncBridge
from fleet.live.monitor.snapshot import ArmSnapshot, AuctioneerSnapshot, FleetListener, FleetSnapshot, JobScore
from scenarios.live import webhooks
from scenarios.live.metrics import METRICS, exposition
from scenarios.live.webhooks import MOST_WAITING, Webhook
from tests.live.gateway.moving_fleet import MovingFleet
from tests.live.gateway.served import Served
from tests.waiting import PATIENCE_S, wait_until

DOCS = Path(__file__).parents[3] / "docs"
ODD = 'a"b\\c\nd'
SECRET = "0123456789abcdef"
ALARM = Alarm("gateway", 1, 2.0, "7d1f", "fault", "arm_0 is faulted.")
LINE = re.compile(r"(?P<name>[a-z_:]+)\{(?P<labels>.*)\} (?P<value>[-+0-9.e]+)")
LABEL = re.compile(r'([a-z_]+)="((?:[^"\\\n]|\\["\\n])*)"(?:,|$)')


def parsed(text):
    """Values by name and labels of the exposition format 0.0.4, and types by name; written from its description."""
    values, types = {}, {}
    assert text.endswith("\n")
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            _, _, name, kind = line.split(" ")
            assert name not in types
            types[name] = kind
        elif not line.startswith("# HELP "):
            match = LINE.fullmatch(line)
            assert match, line
            labels = LABEL.findall(match["labels"])
            assert ",".join(f'{key}="{value}"' for key, value in labels) == match["labels"]
            plain = {k: re.sub(r"\\(.)", lambda m: {"n": "\n"}.get(m[1], m[1]), v) for k, v in labels}
            key = match["name"], tuple(sorted(plain.items()))
            assert key not in values
            assert match["name"] in types
            values[key] = float(match["value"])
    return values, types


FLEET = FleetSnapshot(
    "f",
    (
        ArmSnapshot(ODD, True, True, time_s=100.0, temp_c=(40.0, 55.5), headroom_k=4.5, p_saturation=0.25,
                    events={"award": 3}, worked_s=60.0, heat_n2m2s=12.5, state_age_s=0.5,
                    scores={"j": JobScore(difficulty=0.5), "k": JobScore(), "ended": JobScore(difficulty=0.5)}),
        ArmSnapshot("b", False, False),
    ),
    (AuctioneerSnapshot("au", True, 1.5),),
    {"waiting": 2, "finished": 7},
    (
        JobStatus("j", "waiting", release_s=0.0, accepted_s=40.0, reason="It waits until b is out of the way."),
        JobStatus("k", "waiting", reason=NOT_OFFERED.format(16)),
    ),
    time_s=100.0,
    speed=60.0,
    changes={"finished": 5000},
)  # fmt: skip


def test_the_metrics_are_in_the_text_format_of_prometheus():
    values, types = parsed(exposition(FLEET, Counter({("fault", "no"): 1})))

    def value(name, **labels):
        return values[f"thermofleet_{name}", tuple(sorted({"fleet": "f", **labels}.items()))]

    assert types == {f"thermofleet_{name}": kind for name, (kind, _) in METRICS.items()}
    assert {name for name, _ in values} == set(types)
    assert value("jobs", state="waiting") == 2
    assert value("job_changes_total", state="finished") == 5000
    assert (value("waiting_jobs", reason="space"), value("waiting_jobs", reason="queue")) == (1, 1)
    assert value("oldest_waiting_seconds") == 60.0
    assert value("motor_temperature_celsius", arm=ODD, joint="2") == 55.5
    assert value("p_saturation", arm=ODD) == 0.25
    assert value("arm_events_total", arm=ODD, kind="award") == 3
    assert value("silence_seconds", participant="au", role="auctioneer") == 1.5
    assert (value("bids", arm=ODD), value("bids", arm="b")) == (1, 0)
    assert value("present", arm="b") == 0
    assert value("alarms", kind="fault", acknowledged="no") == 1


def test_what_is_counted_is_0_if_there_is_none():
    values, _ = parsed(exposition(FleetSnapshot("f", (), (), {}, ()), Counter()))
    zero = {name for name, labels in values if values[name, labels] == 0.0}
    assert zero == {f"thermofleet_{name}" for name in ("jobs", "job_changes_total", "waiting_jobs", "alarms")}
    assert set(values.values()) == {0.0}
    full, _ = parsed(exposition(FLEET, Counter({("fault", "no"): 1})))
    assert {key for key in full if key[0] in zero} == {key for key in values if key[0] in zero}


def test_cached_messages_are_counted_as_the_documentation_says(router):
    with BusClient(router, "g") as link, BusClient(router, "g") as late:
        publish = link.publisher(keys.of_auction("g", "early", "result"), Result)
        for number in range(3):
            publish(Result("early", number, 1.0, JobStatus(f"early {number}", "cancelled")))
        listener = FleetListener(late)

        def counted():
            listener.serve(0.0)
            late.serve()
            return listener.view.snapshot(0.0).changes.get("cancelled", 0) >= 3

        wait_until(counted)
    text = " ".join((DOCS / "how_to" / "operate.md").read_text(encoding="utf-8").split())
    names = [f"thermofleet_{name}" for name, (_, what) in METRICS.items() if what.endswith("cached ones included.")]
    assert f"`{'` and `'.join(names)}` also count earlier messages" in text
    assert f"the last {keys.HISTORY} of each" in text


def test_the_dashboard_uses_only_metrics_that_are_exported():
    dashboard = DOCS / "assets" / "grafana.json"
    used = set(re.findall(r"thermofleet_(\w+)", dashboard.read_text(encoding="utf-8")))
    assert used
    assert used <= set(METRICS)
    panels = json.loads(dashboard.read_bytes())["panels"]
    assert all(panel["targets"] and panel["title"] for panel in panels)


def test_an_alarm_is_shown_acknowledged_and_published(gateway, arm, router):
    """The fault of an arm, from its event to the list of every listener on the bus."""
    with BusClient(router, "f") as link:
        listener = FleetListener(link)
        arm.post(lambda: arm.set("lost job", state="unfinished", reason="its arm is lost"))

        def alarm():
            found = [each for each in gateway.ask("GET", "/v4/alarms")[2] if each["subject"] == "lost job"]
            return found[0] if found else None

        seen = wait_until(alarm)
        assert (seen["kind"], seen["by"], seen["ended_s"]) == ("unfinished", "", None)
        for by in ("", " "):
            assert gateway.ask("POST", "/v4/alarms", {"alarm": seen["alarm"], "by": by})[0] == 422
        assert gateway.ask("POST", "/v4/alarms", {"alarm": "none", "by": "ann"})[0] == 409
        status, _, seen_by = gateway.ask("POST", "/v4/alarms", {"alarm": seen["alarm"], "by": "ann"})
        assert (status, seen_by["by"]) == (200, "ann")
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", seen_by["acknowledged"])
        assert gateway.ask("POST", "/v4/alarms", {"alarm": seen["alarm"], "by": "bob"})[0] == 409

        def published():
            listener.serve(0.0)
            link.serve()
            alarms = {each.alarm: each for each in listener.view.snapshot(0.0).alarms}
            return seen["alarm"] in alarms and alarms[seen["alarm"]].by == "ann"

        wait_until(published)
    line = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=PATIENCE_S)
    line.request("GET", "/metrics")
    reply = line.getresponse()
    assert reply.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    values, _ = parsed(reply.read().decode())
    labels = (("acknowledged", "yes"), ("fleet", "f"), ("kind", "unfinished"))
    assert values["thermofleet_alarms", labels] == 1
    line.close()


def test_an_alarm_of_a_monitor_that_has_exited_ends(gateway, router, monkeypatch):
    """Not while it is present, and not if it is about an auctioneer that the gateway has not heard."""

    def lasting():
        return {each["alarm"] for each in gateway.ask("GET", "/v4/alarms")[2] if each["ended_s"] is None}

    monkeypatch.setattr(alarms, "HOLD_S", 0.0)
    with BusClient(router, "f") as link:
        link.declare_token(keys.build("f", "monitor", "alive", "gone"))
        link.declare_token(keys.of_auction("f", "unheard", "alive"))
        publish = link.publisher(keys.build("f", "monitor", "alarm", "gone"), Alarm)
        publish(Alarm("gone", 1, 2.0, "of it", "fault", "It found it."))
        publish(Alarm("gone", 2, 2.0, "silence", "silent", "It does not reply.", "unheard"))
        wait_until(lambda: {"of it", "silence"} <= lasting())
    wait_until(lambda: "of it" not in lasting())
    assert "silence" in lasting()


def test_a_gateway_that_starts_reports_every_alarm_once_as_it_stands(router, monkeypatch):
    """What lasts, what ended while it was away, and what another gateway has changed since its recording."""
    monkeypatch.setattr(async_bridge, "FRESH_S", 1.0)

    async def run(kept):
        received = asyncio.Queue()
        with BusClient(router, "g") as link, BusClient(router, "g") as other:
            publish = other.publisher(keys.build("g", "monitor", "alarm", "other"), Alarm)
            publish(msgspec.structs.replace(ALARM, monitor="other", alarm="c", time_s=5.0, ended_s=4.0))
            async with AsyncBridge(link, lambda: None, kept=kept, on_alarm=received.put_nowait) as bridge:
                async with asyncio.timeout(PATIENCE_S):
                    first = [await received.get() for _ in range(3)]
                    await bridge.acknowledge("a", "ann")
                    return first, await received.get()

    kept = [msgspec.structs.replace(ALARM, alarm=name, number=number) for number, name in enumerate("abc", start=1)]
    kept[1] = msgspec.structs.replace(kept[1], ended_s=3.0)
    first, then = asyncio.run(run(kept))
    assert {(each.alarm, each.ended_s) for each in first} == {("a", None), ("b", 3.0), ("c", 4.0)}
    assert (then.alarm, then.by) == ("a", "ann")


def test_a_lost_connection_is_an_alarm_and_no_arm_is_called_absent(monkeypatch):
    """The router ends and another one begins at its port."""
    monkeypatch.setattr(alarms, "BEGIN_S", {"absent": 3.0})
    monkeypatch.setattr(alarms, "HOLD_S", 0.0)
    with ExitStack() as stack:
        first = stack.enter_context(Router())
        endpoint, port = first.endpoint, int(first.endpoint.rpartition(":")[2])
        stack.enter_context(MovingFleet(endpoint, ("a",), fleet="f"))
        gateway = stack.enter_context(Served(endpoint))

        def listed():
            return {(each["kind"], each["ended_s"] is None) for each in gateway.ask("GET", "/v4/alarms")[2]}

        wait_until(lambda: gateway.ask("GET", "/v4/jobs")[0] == 200)
        first.close()
        wait_until(lambda: ("connection", True) in listed())
        job = {"name": "x", "kind": "hold", "places": ["rack"]}
        status, _, problem = gateway.ask("POST", "/v4/ask", {"jobs": [job]})
        assert (status, problem["detail"][:37]) == (503, "The connection to the router is lost:")
        stack.enter_context(Router(port))
        wait_until(lambda: ("connection", False) in listed())
        assert listed() == {("connection", False)}


def test_an_arm_is_absent_because_its_states_are_malformed_if_they_are(router, monkeypatch):
    monkeypatch.setattr(alarms, "BEGIN_S", {"absent": 0.0})
    with BusClient(router, "f") as link, Served(router) as gateway:
        link.declare_token(keys.of_arm("f", "b", "alive"))

        def said():
            link._open().put(keys.of_arm("f", "b", "state"), b"{}")
            return [each["what"] for each in gateway.ask("GET", "/v4/alarms")[2] if each["kind"] == "absent"]

        (what,) = wait_until(said)
        assert what.startswith("b is absent: its states are malformed: ")


@asynccontextmanager
async def target(*replies, at="127.0.0.1", path=""):
    """A webhook that runs, and the requests that its target receives, which replies with these statuses in turn.

    After them it accepts everything; None: it never replies.
    """
    requests, left = asyncio.Queue(), [*replies]

    async def handle(reader, writer):
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        length = int(re.search(r"Content-Length: (\d+)", head)[1])
        requests.put_nowait((head, await reader.readexactly(length)))
        status = left.pop(0) if left else 200
        if status is None:
            await reader.read()  # until the sender gives up
        else:
            writer.write(f"HTTP/1.1 {status} X\r\n\r\n".encode())
        writer.close()
        await writer.wait_closed()

    async with await asyncio.start_server(handle, "127.0.0.1", 0) as server, asyncio.timeout(PATIENCE_S):
        hook = Webhook(f"http://{at}:{server.sockets[0].getsockname()[1]}{path}", SECRET)
        task = asyncio.create_task(hook.run())
        yield hook, requests
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def test_a_webhook_is_signed_and_repeated_until_it_is_accepted(monkeypatch):
    """A target that fails, and one that never replies, get the alarm again; the next alarm comes after it."""
    monkeypatch.setattr(webhooks, "RETRY_S", (0.01, 0.01, 0.01))
    monkeypatch.setattr(webhooks, "REPLY_S", 1.0)

    async def run():
        async with target(500, None, 204, path="/in?x=1") as (hook, requests):
            hook.send(ALARM)
            hook.send(msgspec.structs.replace(ALARM, number=2))
            return [await requests.get() for _ in range(4)]

    requests = asyncio.run(run())
    assert [json.loads(body)["number"] for _, body in requests] == [1, 1, 1, 2]
    for head, body in requests:
        assert head.startswith("POST /in?x=1 HTTP/1.1\r\n")
        at, digest = re.search(r"X-Thermofleet-Signature: t=(\d+),v1=(\w+)", head).groups()
        assert digest == hmac.new(SECRET.encode(), f"{at}.".encode() + body, hashlib.sha256).hexdigest()


@pytest.mark.parametrize(
    ("replies", "numbers"),
    [
        ([503] * 20, [1] * 21 + [2]),  # down for longer than all pauses: it gets every alarm when it is up again
        ([429] * 20, [1] * 21 + [2]),
        ([404] * 20, [1] * 3 + [2] * 3),  # an alarm that it refuses does not hold up the next one
    ],
)
def test_an_alarm_waits_for_a_target_that_is_down_and_not_for_one_that_refuses_it(monkeypatch, replies, numbers):
    monkeypatch.setattr(webhooks, "RETRY_S", (0.0, 0.0))

    async def run():
        async with target(*replies) as (hook, requests):
            hook.send(ALARM)
            hook.send(msgspec.structs.replace(ALARM, number=2))
            return [await requests.get() for _ in numbers]

    assert [json.loads(body)["number"] for _, body in asyncio.run(run())] == numbers


def test_a_target_that_accepts_nothing_raises_an_alarm_until_it_accepts_one(monkeypatch):
    """Its finding has the reason and no path, which may be secret; one failed attempt raises none."""
    monkeypatch.setattr(webhooks, "RETRY_S", (0.0, 0.0))

    async def run():
        async with target(500, 200, 403, 403, 403, 200, path="/secret") as (hook, requests):
            found = []
            # The first alarm is accepted in its second attempt. The third attempt of the second begins after the second
            # has failed. The last alarm is sent after the one before was accepted.
            for alarms, count in ((2, 2), (0, 3), (2, 2)):
                for _ in range(alarms):
                    hook.send(ALARM)
                for _ in range(count):
                    await requests.get()
                found.append([(each.kind, each.what) for each in hook.findings()])
            return hook._target, found

    at, found = asyncio.run(run())
    assert found == [[], [("webhook", f"The webhook at {at} accepts no alarms: status 403.")], []]
    assert re.fullmatch(r"127\.0\.0\.1:\d+", at)


def test_a_target_that_never_replies_holds_a_bounded_number_of_alarms_and_nothing_else():
    async def run():
        async with target(*[None] * 100, at="localhost") as (hook, requests):
            for number in range(10 * MOST_WAITING):
                hook.send(msgspec.structs.replace(ALARM, number=number))
            await requests.get()
            return len(hook._waiting)

    assert asyncio.run(run()) <= MOST_WAITING


@pytest.mark.parametrize(
    ("url", "secret", "says"),
    [
        ("http://127.0.0.1:1/x", "short", "set THERMOFLEET_WEBHOOK_SECRET to 16"),
        ("http://10.0.0.1/x", SECRET, "must be https"),
        ("ftp://127.0.0.1/x", SECRET, "must be a URL"),
        ("http://127.0.0.1:99999/x", SECRET, "Port out of range"),
    ],
)
def test_webhooks_are_for_this_machine_or_encrypted_and_signed(url, secret, says):
    with pytest.raises(FleetError, match=says):
        Webhook(url, secret)
