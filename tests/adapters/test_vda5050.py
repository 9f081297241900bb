"""The station of VDA 5050 on a real MQTT broker; all it sends fits the published JSON schemas."""

import asyncio
import json
import queue
import shutil
import subprocess
import tarfile
import threading
import time
from contextlib import ExitStack

import pytest

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import Router
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Admission, JobStatus, Status, StatusRequest, Submission, SubmissionReply

pytestmark = [pytest.mark.adapter, pytest.mark.filterwarnings("ignore")]
mqtt = pytest.importorskip("paho.mqtt.client")
PATIENCE_S = 20.0
SCHEMAS = "vda-5050-cli@2.0.13"
"""Package of npm with the schemas of version 1.1 (MIT licence). Later versions have all fields that are used here."""


@pytest.fixture(scope="module")
def validators(tmp_path_factory):
    """Validators of the published schemas, by topic."""
    if shutil.which("npm") is None:
        pytest.skip("needs npm, to download the schemas")
    from jsonschema import Draft7Validator, FormatChecker
    from referencing import Registry, Resource

    place = tmp_path_factory.mktemp("schemas")
    subprocess.run(["npm", "pack", "--silent", SCHEMAS], cwd=place, check=True, timeout=120)
    with tarfile.open(next(place.glob("*.tgz"))) as archive:
        archive.extractall(place, filter="data")
    schemas = [json.loads(path.read_text(encoding="utf-8")) for path in (place / "package/schema/v1.1").glob("*.json")]
    registry = Registry().with_resources((each["$id"], Resource.from_contents(each)) for each in schemas)
    return {
        each["subtopic"].strip("/"): Draft7Validator(each, registry=registry, format_checker=FormatChecker())
        for each in schemas
        if "subtopic" in each
    }


@pytest.fixture
def broker():
    """Port of an MQTT broker on loopback."""
    from amqtt.broker import Broker

    config = {
        "listeners": {"default": {"type": "tcp", "bind": "127.0.0.1:0"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    ready, stop, port = threading.Event(), threading.Event(), []

    async def run():
        server = Broker(config)
        await server.start()
        port.append(server._servers["default"].instance.sockets[0].getsockname()[1])
        ready.set()
        await asyncio.to_thread(stop.wait)
        await server.shutdown()

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    assert ready.wait(PATIENCE_S)
    yield port[0]
    stop.set()
    thread.join(PATIENCE_S)


class Plant:
    """Master control on the broker, and an auctioneer on the bus."""

    def __init__(self, stack, port, link):
        self.states, self.jobs, self._station = {}, {}, None
        self.heard = queue.SimpleQueue()
        link.reply_to(keys.of_jobs("shop", "submit"), Submission, self._submit)
        link.reply_to(keys.of_jobs("shop", "status"), StatusRequest, self._status)
        self.mqtt = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        subscribed = threading.Event()
        self.mqtt.on_message = lambda _c, _d, message: self.heard.put((message.topic, json.loads(message.payload)))
        self.mqtt.on_subscribe = lambda *_: subscribed.set()
        self.mqtt.connect("127.0.0.1", port)
        self.mqtt.loop_start()
        stack.callback(self.mqtt.loop_stop)
        self.mqtt.subscribe("uagv/v2/thermofleet/cell_1/#")
        assert subscribed.wait(PATIENCE_S)
        self.headers = {"version": "2.0.0", "manufacturer": "thermofleet", "serialNumber": "cell_1"}

    def _submit(self, request):
        self.jobs |= {job.name: job for job in request.jobs}
        return SubmissionReply("boss", tuple(Admission(job.name, True) for job in request.jobs))

    def _status(self, request):
        return Status("boss", 0.0, tuple(self.states.get(job) or JobStatus(job, "waiting") for job in request.jobs))

    def send(self, topic, **content):
        header = {"headerId": 0, "timestamp": "2026-11-23T01:02:03.450Z", **self.headers}
        self.mqtt.publish(f"uagv/v2/thermofleet/cell_1/{topic}", json.dumps(header | content))
        return header | content


def test_an_order_over_mqtt_is_done_and_every_message_is_valid(broker, validators):
    from fleet.vda5050.mqtt import StationLink

    sent = []
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        boss, link = (stack.enter_context(BusClient(router.endpoint, "shop")) for _ in range(2))
        plant = Plant(stack, broker, boss)
        station = stack.enter_context(StationLink(link, "127.0.0.1", broker, serial="cell_1"))

        def until(wanted):
            deadline_s = time.monotonic() + PATIENCE_S
            while True:
                assert time.monotonic() < deadline_s, "waited in vain"
                station.serve(time.monotonic() + 0.05)
                boss.serve()
                while not plant.heard.empty():
                    topic, message = plant.heard.get()
                    topic = topic.rpartition("/")[2]
                    sent.append((topic, message))
                    if topic in ("state", "connection") and wanted(message):
                        return message

        until(lambda message: message.get("connectionState") == "ONLINE")
        until(lambda message: message.get("orderId") == "")
        action = {
            "actionType": "pick_place",
            "actionId": "a1",
            "blockingType": "HARD",
            "actionParameters": [
                {"key": "places", "value": ["conveyor", "pallet"]},
                {"key": "repetitions", "value": 4},
            ],
        }
        node = {"nodeId": "cell", "sequenceId": 0, "released": True, "actions": [action]}
        order = plant.send("order", orderId="o1", orderUpdateId=0, nodes=[node], edges=[])
        validators["order"].validate(order)
        until(lambda message: message.get("orderId") == "o1" and message["actionStates"])
        plant.states["o1/a1"] = JobStatus("o1/a1", "awarded", arm="arm_0", award="x", cycles=2)
        state = until(lambda message: message.get("actionStates") and "RUNNING" in str(message["actionStates"]))
        assert state["actionStates"][0]["resultDescription"] == "arm_0, 2 cycles done"
        assert plant.jobs["o1/a1"].repetitions == 4
        cancel = {"actionType": "cancelOrder", "actionId": "c1", "blockingType": "HARD", "actionParameters": []}
        plant.send("instantActions", actions=[cancel])
        state = until(lambda message: message.get("actionStates") and message["actionStates"][-1]["actionId"] == "c1")
        assert state["actionStates"][-1]["actionStatus"] == "FAILED"  # the bus cannot cancel yet
        plant.states["o1/a1"] = JobStatus("o1/a1", "finished", arm="arm_0", award="x", cycles=4, finished_s=9.0)
        until(lambda message: message.get("actionStates") and message["actionStates"][0]["actionStatus"] == "FINISHED")
        plant.send("order", orderId="", nodes="none")
        until(lambda message: message.get("errors") and message["errors"][-1]["errorType"] == "validationError")
        station.__exit__()
        deadline_s = time.monotonic() + PATIENCE_S
        while not any(message.get("connectionState") == "OFFLINE" for _, message in sent):
            assert time.monotonic() < deadline_s, "no message that the station is offline"
            topic, message = plant.heard.get(timeout=PATIENCE_S)
            sent.append((topic.rpartition("/")[2], message))
        stack.pop_all().close()
    own = [(topic, message) for topic, message in sent if topic in ("state", "connection")]
    assert len(own) >= 7
    for topic, message in own:
        validators[topic].validate(message)
    numbers = [message["headerId"] for topic, message in own if topic == "state"]
    assert numbers == list(range(len(numbers)))
