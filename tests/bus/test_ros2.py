"""A ROS 2 node over a real router: keys, tokens and attachments are those of rmw_zenoh.

Its subscribers are played by bare Zenoh sessions, with rmw_zenoh's default settings; no ROS 2 runs here.
"""

import json
import queue
import struct
from contextlib import ExitStack

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh.ext import Int64, z_deserialize

from fleet.bus.router import Router
from fleet.errors import BusError
from fleet.ros2.conversion import plain_name
from fleet.ros2.node import (
    NO_HASH,
    Node,
    Topic,
    attachment,
    gid,
    node_token,
    publisher_token,
)
from tests.profiles import examples
from tests.waiting import PATIENCE_S

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = Topic("/chatter", STRING, STRING_HASH)
# Of github.com/ros2/rmw_zenoh, docs/design.md: the talker and the listener of demo_nodes_cpp.
CHATTER_KEY = f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
LISTENER_TOKEN = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
TALKER_TOKEN = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,7:,:,:,,"
)


def as_rmw_zenoh(endpoint: str) -> zenoh.Session:
    """A session as rmw_zenoh's DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5 opens it, but for the port."""
    gossip = {"enabled": True, "target": {"router": ["router", "peer"], "peer": ["router"]}}
    config = {
        "mode": "peer",
        "connect": {"endpoints": [endpoint]},
        "listen": {"endpoints": ["tcp/localhost:0"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": gossip},
        "timestamping": {"enabled": True},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


class Ros:
    """Somebody else in the domain."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.came: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self.tokens: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()

    def hear(self, key: str) -> None:
        self.subscriber = self.session.declare_subscriber(key, self.came.put)

    def see(self, domain: int) -> None:
        def came(sample: zenoh.Sample) -> None:
            self.tokens.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

        self.watch = self.session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", came, history=True)

    def wait_for(self, *token: str | bool) -> None:
        while self.tokens.get(timeout=PATIENCE_S) != token:
            pass


@pytest.fixture
def domain():
    """A router, what makes nodes of ours, and what makes others."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())

        def other():
            return Ros(stack.enter_context(as_rmw_zenoh(router.endpoint)))

        yield lambda name, **more: stack.enter_context(Node(router.endpoint, name, **more)), other


def test_keys_and_tokens_are_those_of_the_design_page():
    assert CHATTER.key == CHATTER_KEY
    assert node_token(2, "aac3178e146ba6f1fc6e6a4085e77f21", "listener") == LISTENER_TOKEN
    on_two = Topic("/chatter", STRING, STRING_HASH, domain=2)
    assert publisher_token(on_two, "8b20917502ee955ac4476e0266340d5c", "talker", 10, "::,7:,:,:,,") == TALKER_TOKEN


def test_a_namespace_is_part_of_key_and_token():
    topic = Topic("/robot1/arm/joint_states", "sensor_msgs/msg/JointState", "RIHS01_x", domain=7)
    assert topic.key == "7/robot1/arm/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_x"
    assert "/%robot1%arm%joint_states/" in publisher_token(topic, "z", "n", 1)


@examples(50)
@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_an_attachment_is_what_zenoh_itself_would_serialise(number, time_ns, sender):
    attached = zenoh.ZBytes(attachment(number, time_ns, sender))
    assert z_deserialize(tuple[Int64, Int64, bytes], attached) == (number, time_ns, sender)


@pytest.mark.parametrize("name", ["", "/", "chatter", "/a//b", "/a/", "/1a", "/a b", "/a*", "/a__b", "/ä", "/a/$*"])
def test_a_topic_that_ros_does_not_allow_is_refused(name):
    with pytest.raises(BusError, match="is no topic"):
        Topic(name, STRING, NO_HASH)


@pytest.mark.parametrize("number", [-1, 233])
def test_a_domain_that_ros_does_not_allow_is_refused(number):
    with pytest.raises(BusError, match="0 to 232"):
        Topic("/chatter", STRING, NO_HASH, domain=number)


@examples(50)
@given(st.text(max_size=20))
def test_any_name_becomes_part_of_a_topic(name):
    Topic(f"/{plain_name(name)}/joint_states", STRING, NO_HASH)


@examples(50)
@given(st.from_regex(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", fullmatch=True))
def test_a_good_name_stays(name):
    assert plain_name(name) == name


def test_a_message_arrives_with_the_attachment_of_rmw_zenoh(domain):
    node, other = domain
    ear = other()
    ear.hear(CHATTER_KEY)
    ear.see(0)
    talker = node("talker", now_ns=lambda: 1_700_000_000_123_456_789)
    publisher = talker.publisher(CHATTER)
    session = str(talker._open().zid())
    token = publisher_token(CHATTER, session, "talker", 1)
    ear.wait_for(node_token(0, session, "talker"), True)
    ear.wait_for(token, True)
    for payload in (b"one", b"two"):
        publisher.put(payload)
    for number, payload in ((1, b"one"), (2, b"two")):
        sample = ear.came.get(timeout=PATIENCE_S)
        assert (str(sample.key_expr), sample.payload.to_bytes()) == (CHATTER_KEY, payload)
        assert sample.attachment is not None
        said = z_deserialize(tuple[Int64, Int64, bytes], sample.attachment)
        assert said == (number, 1_700_000_000_123_456_789, gid(token))
    publisher.close()
    ear.wait_for(token, False)
    talker.close()
    ear.wait_for(node_token(0, session, "talker"), False)


@pytest.mark.parametrize("type_hash", [STRING_HASH, NO_HASH])
def test_messages_of_every_ros_version_arrive(domain, type_hash):
    node, other = domain
    listener, heard = node("listener"), queue.SimpleQueue()
    listener.listen(CHATTER, lambda *said: heard.put(said))
    talker = other()
    told = talker.session.declare_publisher(Topic("/chatter", STRING, type_hash).key)
    attached = struct.pack("<qqB16s", 1, 0, 16, bytes(16))
    for _ in range(200):  # a peer may lose what it says before it knows who listens
        told.put(b"hello", attachment=attached)
        try:
            assert heard.get(timeout=0.1) == (type_hash, b"hello")
            return
        except queue.Empty:
            continue
    pytest.fail("nothing was heard")


def test_messages_of_another_domain_do_not_arrive(domain):
    node, _ = domain
    listener, talker, heard = node("listener"), node("talker"), queue.SimpleQueue()
    listener.listen(CHATTER, lambda *said: heard.put(said))
    watcher = domain[1]()
    watcher.see(0)
    watcher.wait_for(node_token(0, str(talker._open().zid()), "talker"), True)
    for number in (1, 0):  # one line keeps the order
        talker.publisher(Topic("/chatter", STRING, STRING_HASH, domain=number)).put(str(number).encode())
    assert heard.get(timeout=PATIENCE_S) == (STRING_HASH, b"0")


def test_a_closed_node_raises(domain):
    node, _ = domain
    talker = node("talker")
    talker.close()
    with pytest.raises(BusError, match="not open"):
        talker.publisher(CHATTER)
