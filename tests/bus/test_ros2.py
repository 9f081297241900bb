"""Messages and a node of ROS 2, against decoders that are not ours and the keys of rmw_zenoh."""

import json
import math
import queue
import random
import struct
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from pycdr2 import IdlStruct
from pycdr2.types import float64, int32, sequence, uint8, uint32
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import Int64, z_deserialize

from fleet.bus.protocol.messages import DifficultyScores, MalformedMessage, State
from fleet.bus.router import Router
from fleet.errors import BusError
from fleet.robot import ThermalLimits
from fleet.ros2.cdr import (
    DIAGNOSTICS,
    JOINT_STATE,
    MAX_ITEMS,
    SPARE_BYTES,
    read_diagnostics,
    read_joints,
    type_hash,
    write_diagnostics,
    write_joints,
)
from fleet.ros2.conversion import (
    ERROR,
    OK,
    STALE,
    WARN,
    Diagnostic,
    Joints,
    diagnostics_of,
    in_order,
    joint_names,
    plain_name,
    temperatures,
)
from fleet.ros2.node import NO_HASH, Node, Topic, attachment, gid, node_token, publisher_token
from tests.profiles import examples
from tests.waiting import PATIENCE_S

UNHURRIED = examples(50)
"""The first message of a kind builds its reader."""

HEADER = b"\x00\x01\x00\x00"
"""CDR, little endian, no options (OMG DDSI-RTPS 2.5, table 10.3)."""


@dataclass
class Time(IdlStruct):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct):
    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class KeyValue(IdlStruct):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct):
    header: Header
    status: sequence[DiagnosticStatus]


texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
numbers = st.floats(width=64)
times = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 999_999_999))


@st.composite
def joint_states(draw):
    """Names, and lists that are empty or as long, as ROS allows; any float, NaN too."""
    names = draw(st.lists(texts, max_size=9, unique=True))
    lists = [draw(st.just([]) | st.lists(numbers, min_size=len(names), max_size=len(names))) for _ in range(3)]
    return names, lists


def same(one, other):
    """Equal to the last bit; NaN equals NaN."""
    return np.array_equal(np.asarray(one, float), np.asarray(other, float), equal_nan=True)


def test_the_hash_of_a_joint_state_is_the_published_one():
    """Origin: `ros2 topic info --verbose` of joint_state_broadcaster's /joint_states, as found in users' reports."""
    assert type_hash(JOINT_STATE) == "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"


@pytest.mark.parametrize("kind", [JOINT_STATE, DIAGNOSTICS])
def test_the_types_are_the_same_in_every_version(kind):
    stores = [get_typestore(Stores[f"ROS2_{name}"]) for name in ("HUMBLE", "JAZZY", "LYRICAL")]
    assert {store.hash_rihs01(kind) for store in stores} == {type_hash(kind)}


@UNHURRIED
@given(joint_states(), st.integers(0, 2**22), st.integers(0, 1023))
def test_pycdr2_decodes_our_joint_state(state, sec, fraction):
    names, (q, qd, tau) = state
    payload = write_joints(Joints(sec + fraction / 1024, tuple(names), tuple(q), tuple(qd), tuple(tau)))
    assert payload[:4] == HEADER
    message = JointState.deserialize(payload)
    assert (message.header.stamp.sec, message.header.frame_id) == (sec, "")
    assert abs(message.header.stamp.nanosec - fraction * 1e9 / 1024) <= 0.5
    assert message.name == names
    for said, values in ((message.position, q), (message.velocity, qd), (message.effort, tau)):
        assert same(said, values)


@UNHURRIED
@given(joint_states(), times, texts)
def test_a_joint_state_of_pycdr2_is_decoded_and_encoded_byte_for_byte(state, stamp, frame):
    names, lists = state
    payload = JointState(Header(Time(*stamp), frame), names, *lists).serialize()
    joints = read_joints(payload)
    assert joints.names == tuple(names)
    assert joints.time_s == pytest.approx(stamp[0] + stamp[1] * 1e-9, abs=1e-6)
    for said, values in zip((joints.q, joints.qd, joints.tau), lists, strict=True):
        assert same(said, values)
    if not frame and abs(stamp[0]) < 2**20:  # a float holds the nanoseconds of so many seconds
        assert write_joints(joints) == payload


@UNHURRIED
@given(st.lists(st.tuples(st.integers(0, 3), texts, texts, texts, st.lists(st.tuples(texts, texts), max_size=4)),
                max_size=5))  # fmt: skip
def test_diagnostics_are_decoded_as_encoded(said):
    statuses = tuple(Diagnostic(*rest, values=tuple(values)) for *rest, values in said)
    payload = write_diagnostics(12.5, statuses)
    assert read_diagnostics(payload) == statuses
    again = [DiagnosticStatus(*rest, [KeyValue(*v) for v in values]) for *rest, values in said]
    assert DiagnosticArray(Header(Time(12, 500_000_000), ""), again).serialize() == payload


def test_a_zero_in_a_name_is_replaced():
    (status,) = read_diagnostics(write_diagnostics(0.0, [Diagnostic(0, "a\0b", "", "")]))
    assert status.name == "a\N{REPLACEMENT CHARACTER}b"


@pytest.mark.parametrize("time_s", [math.inf, math.nan, 1e300, -math.inf, 2.0**31, -(2.0**31) - 1])
def test_a_time_out_of_range_is_refused(time_s):
    with pytest.raises(ValueError, match="A ROS 2 time is"):
        write_joints(Joints(time_s, ()))


@pytest.mark.parametrize(
    ("lengths", "field"), [((1, 2, 2), "position"), ((2, 3, 0), "velocity"), ((2, 2, 1), "effort")]
)
def test_lists_that_do_not_fit_the_names_are_refused(lengths, field):
    payload = JointState(Header(Time(0, 0), ""), ["a", "b"], *([0.0] * length for length in lengths)).serialize()
    with pytest.raises(MalformedMessage, match=field):
        read_joints(payload)


@UNHURRIED
@given(st.binary(max_size=200) | st.binary(max_size=200).map(lambda rest: HEADER + rest))
def test_random_bytes_raise_nothing_else(payload):
    for read in (read_joints, read_diagnostics):
        message = None
        with suppress(MalformedMessage):
            message = read(payload)
        assert message is None or isinstance(message, Joints | tuple)


def test_a_list_that_is_too_long_is_refused():
    longest, longer = (
        JointState(Header(Time(0, 0), ""), ["j"] * count, [], [], []).serialize()
        for count in (MAX_ITEMS, MAX_ITEMS + 1)
    )
    assert len(read_joints(longest).names) == MAX_ITEMS
    with pytest.raises(MalformedMessage, match="Not a sensor_msgs/msg/JointState"):
        read_joints(longer)


def test_a_few_bytes_may_follow_a_message():
    """As after `serialize_message` of rclpy, which returns its whole buffer."""
    payload = write_joints(Joints(1.0, ("a", "b"), (0.5, 1.5)))
    for spare in range(SPARE_BYTES + 1):
        assert read_joints(payload + b"\x7f" * spare).q == (0.5, 1.5)
    with pytest.raises(MalformedMessage, match="size mismatch"):
        read_joints(payload + b"\x7f" * (SPARE_BYTES + 4))


LIMITS = ThermalLimits()
finite = st.floats(allow_nan=False, allow_infinity=False)
seven = st.tuples(*[finite] * 7)
NAMES = joint_names(7)


def state(temp_c=(30.0,) * 7, **change):
    words = {"arm": "arm_0", "tick": 1, "time_s": 12.5, "mode": "idle", "headroom_k": 60.0 - max(temp_c), **change}
    return State(temp_c=temp_c, **words)


def told(word=None, age_s=0.0, **change):
    return diagnostics_of("f", state(**change), word, LIMITS, age_s, 3.0)


@UNHURRIED
@given(q=seven, qd=st.just(()) | seven, tau=st.just(()) | seven, seed=st.integers(0, 999), more=st.integers(0, 4))
def test_order_and_other_joints_do_not_matter(q, qd, tau, seed, more):
    """Arms with grippers name those too, and joint_state_broadcaster sorts as it likes."""
    rng = random.Random(seed)
    columns = dict(zip(NAMES, range(7), strict=True)) | {f"finger_{number}": -1 for number in range(more)}
    names = rng.sample(sorted(columns), len(columns))

    def shuffled(values):
        return tuple(values[columns[name]] if columns[name] >= 0 else math.nan for name in names) if values else ()

    mixed = Joints(1.0, tuple(names), shuffled(q), shuffled(qd), shuffled(tau))
    assert in_order(read_joints(write_joints(mixed)), NAMES) == Joints(1.0, NAMES, q, qd, tau)


@pytest.mark.parametrize(
    ("joints", "complaint"),
    [
        (Joints(0.0, ("joint_1",), (1.0,)), "not joint_2"),
        (Joints(0.0, ("joint_1", "joint_2", "joint_1"), (1.0, 2.0, 1.0)), "joint_1 twice"),
        (Joints(0.0, ("joint_1", "joint_2"), (math.nan, math.nan)), "nan for position of joint_1"),
        (Joints(0.0, ("joint_1", "joint_2"), (), (0.0, 0.0)), "no position of joint_1, joint_2"),
        (Joints(0.0, ("joint_2", "joint_1"), (1.0, 1.0), (math.nan, 0.0)), "nan for velocity of joint_2"),
        (Joints(0.0, ("joint_1", "joint_2"), (1.0, 1.0), (), (math.inf, 0.0)), "inf for effort of joint_1"),
    ],
)
def test_an_incomplete_reading_is_refused(joints, complaint):
    with pytest.raises(MalformedMessage, match=complaint):
        in_order(joints, ("joint_1", "joint_2"))


def test_an_effort_that_is_nan_throughout_is_not_measured():
    both = (math.nan, math.nan)
    found = in_order(Joints(0.0, ("joint_1", "joint_2"), (1.0, 2.0), both, both), ("joint_1", "joint_2"))
    assert found == Joints(0.0, ("joint_1", "joint_2"), (1.0, 2.0))


@pytest.mark.parametrize(("temp_c", "level"), [(59.99, OK), (60.0, WARN), (74.99, WARN), (75.0, ERROR), (200.0, ERROR)])
def test_a_motor_is_judged_by_its_limits(temp_c, level):
    """60 and 75 °C: Kinova Gen3 user guide, safety thresholds of the motor temperature."""
    whole, *motors = told(temp_c=(20.0, 20.0, temp_c, 20.0))
    assert whole.level == OK
    assert [motor.level for motor in motors] == [OK, OK, level, OK]
    assert motors[2].name == "f/arm_0: joint_3"
    assert motors[2].hardware == "f/arm_0/joint_3"
    assert dict(motors[2].values) == {"temperature_c": repr(temp_c), "headroom_k": repr(60.0 - temp_c)}


def test_a_fault_is_an_error_of_the_arm_and_an_old_state_is_stale():
    assert told(mode="faulted")[0].level == ERROR
    assert {status.level for status in told(age_s=3.5, word=WORD)} == {STALE}
    assert {status.level for status in told(age_s=2.5, word=WORD)} == {OK}
    assert temperatures(told(age_s=3.5), NAMES, "f/arm_0") == ({}, ())


WORD = DifficultyScores("arm_0", 1, 12.0, "twin-1", ("j", "k", "l"), (0.5, None, 0.25), (0.1, None, None))


def test_the_difficulty_of_every_open_job_is_published():
    status = told(WORD)[-1]
    assert status.name == "f/arm_0: difficulty"
    assert status.message == "3 job(s) on offer, the easiest l"
    assert dict(status.values) == {
        "twin": "twin-1", "time_s": "12.0", "d j": "0.5", "p_saturation j": "0.1", "d k": "unknown",
        "p_saturation k": "unknown", "d l": "0.25", "p_saturation l": "unknown",
    }  # fmt: skip


@UNHURRIED
@given(st.tuples(*[st.floats(-50, 200)] * 7))
def test_temperatures_survive_a_round_trip(temp_c):
    statuses = read_diagnostics(write_diagnostics(1.0, told(temp_c=temp_c)))
    assert temperatures(statuses, NAMES, "f/arm_0") == (dict(zip(NAMES, temp_c, strict=True)), ())
    assert temperatures(statuses, NAMES, "f/arm_1") == ({}, ())


@pytest.mark.parametrize("said", ["warm", "nan", "inf", "", "41.5 C", "4_1.5", "٤١", "1e999"])
def test_a_temperature_that_is_no_number_is_left_out_and_named(said):
    values = {"joint_1": "40.25", "joint_2": said, "joint_3": " 4.1e1 "}
    statuses = [Diagnostic(OK, "n", "", name, (("temperature_c", text),)) for name, text in values.items()]
    temp_c, faults = temperatures(statuses, NAMES, "")
    assert temp_c == {"joint_1": 40.25, "joint_3": 41.0}
    assert faults == (f"The temperature_c of joint_2 is no number: '{said}'.",)


def test_two_temperatures_of_a_joint_are_left_out_and_named():
    once, again = (("temperature_c", "40.0"),), (("temperature_c", "41.0"),)
    statuses = [
        Diagnostic(OK, "n", "", "joint_1", once),
        Diagnostic(OK, "n", "", "joint_1", (*once, ("temperature_c", "41.0"))),
        Diagnostic(STALE, "n", "", "joint_2", once),
        Diagnostic(OK, "n", "", "joint_2", again),
        Diagnostic(OK, "n", "", "joint_2", (("voltage", "24"),)),
    ]
    faults = ("A DiagnosticArray has 3 values of temperature_c of joint_1.",)
    assert temperatures(statuses, NAMES, "") == ({"joint_2": 41.0}, faults)


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


@examples(50)
@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_an_attachment_is_what_zenoh_itself_would_serialise(number, time_ns, sender):
    attached = zenoh.ZBytes(attachment(number, time_ns, sender))
    assert z_deserialize(tuple[Int64, Int64, bytes], attached) == (number, time_ns, sender)


@pytest.mark.parametrize("name", ["", "/", "chatter", "/a//b", "/a/", "/1a", "/a b", "/a*", "/a__b", "/ä", "/a/$*"])
def test_a_topic_that_ros_does_not_allow_is_refused(name):
    with pytest.raises(BusError, match="is no topic"):
        Topic(name, STRING, NO_HASH)
    with pytest.raises(BusError, match="0 to 232"):
        Topic("/chatter", STRING, NO_HASH, domain=233)


@examples(50)
@given(st.text(max_size=20))
def test_any_name_becomes_part_of_a_topic_and_stays(name):
    part = plain_name(name)
    assert Topic(f"/{part}/joint_states", STRING, NO_HASH).key.startswith(f"0/{part}/joint_states/")
    assert plain_name(part) == part


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


def test_a_closed_node_raises(domain):
    node, _ = domain
    talker = node("talker")
    talker.close()
    with pytest.raises(BusError, match="not open"):
        talker.publisher(CHATTER)
