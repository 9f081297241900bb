"""A fleet in ROS 2 over a real router; rosbags and Zenoh decode the messages, not our code."""

import queue
import time
from contextlib import ExitStack

import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import Int64, z_deserialize

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.bus.router import Router, open_client
from fleet.ros2 import bridge as ros2_bridge
from fleet.ros2.bridge import Bridge
from fleet.ros2.node import Node
from tests.waiting import PATIENCE_S

HUMBLE, JAZZY = (get_typestore(Stores[f"ROS2_{name}"]) for name in ("HUMBLE", "JAZZY"))
JOINT_STATE, DIAGNOSTICS = "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"
JOINTS_KEY = "0/shop/arm_0/joint_states/sensor_msgs::msg::dds_::JointState_/"
DIAGNOSTICS_KEY = "0/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/"
TEMP_C = (30.5, 62.5, 76.25, 41.0, 33.0, 32.0, 31.0)


def state(arm="arm_0", time_s=12.25, **change):
    said = {"tick": 1, "mode": "working", "temp_c": TEMP_C, "headroom_k": -16.25, **change}
    return State(arm=arm, time_s=time_s, **said)


class Domain:
    """A fleet, a bridge, and somebody in ROS 2."""

    def __init__(self, stack: ExitStack, fleet: str = "shop", **how) -> None:
        router = stack.enter_context(Router())
        self.session = stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S))
        self.came: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self.ear = self.session.declare_subscriber("0/**", self.came.put)
        self.fleet = stack.enter_context(BusClient(router.endpoint, fleet))
        self.link = stack.enter_context(BusClient(router.endpoint, fleet))
        self.bridge = Bridge(self.link, stack.enter_context(Node(router.endpoint, "bridge")), **how)

    def say(self, *states):
        for each in states:
            self.fleet.publish(keys.of_arm(self.fleet.fleet, each.arm, "state"), each)

    def until(self, condition, *states):
        """What ROS 2 heard until it holds, while the fleet says its states again and again."""
        heard, deadline_s = [], time.monotonic() + PATIENCE_S
        while not (found := [sample for sample in heard if condition(sample)]):
            assert time.monotonic() < deadline_s, "waited in vain"
            self.say(*states)
            self.bridge.serve(time.monotonic() + 0.05)
            while not self.came.empty():
                heard.append(self.came.get())
        return found[0]

    def tokens(self):
        replies = self.session.liveliness().get("@ros2_lv/0/**", timeout=PATIENCE_S)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)


@pytest.fixture
def make():
    with ExitStack() as stack:
        yield lambda **how: Domain(stack, **how)


def under(start):
    return lambda sample: str(sample.key_expr).startswith(start)


def test_a_state_becomes_a_joint_state(make):
    domain = make()
    q, qd, tau = (tuple(scale * joint for joint in range(7)) for scale in (0.1, 0.01, -1.5))
    sample = domain.until(under(JOINTS_KEY), state(q=q, qd=qd, tau=tau))
    assert str(sample.key_expr) == JOINTS_KEY + JAZZY.hash_rihs01(JOINT_STATE)
    number, _, sender = z_deserialize(tuple[Int64, Int64, bytes], sample.attachment)
    assert number >= 1
    assert len(sender) == 16
    for store in (HUMBLE, JAZZY):
        message = store.deserialize_cdr(sample.payload.to_bytes(), JOINT_STATE)
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 250_000_000)
        assert message.name == [f"joint_{number}" for number in range(1, 8)]
        assert (*message.position,) == q
        assert (*message.velocity,) == qd
        assert (*message.effort,) == tau


def test_a_state_becomes_diagnostics(make):
    domain = make()
    word = DifficultyScores("arm_0", 1, 12.0, "twin-1", ("press",), (0.75,), (0.5,))
    tell = domain.fleet.publisher(keys.of_arm("shop", "arm_0", "difficulty"), DifficultyScores)
    tell(word)  # what it remembers goes when `tell` goes

    def whole(sample):
        return under(DIAGNOSTICS_KEY)(sample) and b"d press" in sample.payload.to_bytes()

    sample = domain.until(whole, state())
    message = HUMBLE.deserialize_cdr(sample.payload.to_bytes(), DIAGNOSTICS)
    levels = {status.name: status.level for status in message.status}
    assert levels == {
        "shop/arm_0: arm": 0, "shop/arm_0: joint_1": 0, "shop/arm_0: joint_2": 1, "shop/arm_0: joint_3": 2,
        **{f"shop/arm_0: joint_{number}": 0 for number in range(4, 8)}, "shop/arm_0: difficulty": 0,
    }  # fmt: skip
    values = {status.hardware_id: {pair.key: pair.value for pair in status.values} for status in message.status[1:8]}
    assert [float(values[f"shop/arm_0/joint_{number}"]["temperature_c"]) for number in range(1, 8)] == [*TEMP_C]


def test_node_and_publishers_are_visible_until_their_arm_leaves(make, monkeypatch):
    domain = make()
    domain.until(under(JOINTS_KEY), state())
    node, *publishers = sorted(domain.tokens(), key=lambda token: "/NN/" not in token)
    assert node.endswith("/0/0/NN/%/%/bridge")
    assert [token.split("/")[9] for token in publishers] == ["%diagnostics", "%shop%arm_0%joint_states"]
    monkeypatch.setattr(ros2_bridge, "GONE_S", 0.0)
    deadline_s = time.monotonic() + PATIENCE_S
    while len(domain.tokens()) > 2 and time.monotonic() < deadline_s:
        domain.bridge.serve(time.monotonic() + 0.1)
    assert len(domain.tokens()) == 2
    assert domain.bridge.arms == ()


def test_keys_for_humble_have_no_hash(make):
    sample = make(humble=True).until(under(JOINTS_KEY), state())
    assert str(sample.key_expr) == JOINTS_KEY + "TypeHashNotSupported"


def test_invalid_names_are_changed_and_stay_unique(make):
    domain = make(fleet="7 shops ä")
    one, other = state(arm="arm-0"), state(arm="arm 0", time_s=99.0)
    domain.until(under("0/n7_shops/arm_0/joint_states/"), one)
    domain.until(under(DIAGNOSTICS_KEY), other, one)
    deadline_s = time.monotonic() + PATIENCE_S
    while not domain.bridge.skipped and time.monotonic() < deadline_s:
        domain.say(other)
        domain.bridge.serve(time.monotonic() + 0.05)
    assert domain.bridge.arms == ("arm-0",)
    assert "is that of 'arm-0'" in domain.bridge.skipped["arm 0"]


def test_arms_that_cannot_be_published_do_not_affect_the_others(make, monkeypatch):
    monkeypatch.setattr(ros2_bridge, "MAX_ARMS", 2)
    domain = make()
    said = [state(arm="late", time_s=1e11), *(state(arm=f"arm_{number}") for number in range(5))]
    domain.until(lambda sample: "/arm_1/" in str(sample.key_expr), *said)
    assert domain.bridge.arms == ("arm_0", "arm_1")
    assert "A ROS 2 time is" in domain.bridge.skipped["late"]
    assert len(domain.bridge.skipped) == 2
