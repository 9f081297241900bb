"""Messages of ROS 2 against decoders that are not ours: rosbags reads what we write, and pycdr2, which knows the layout
from dataclasses written by hand here, writes and reads the same bytes."""

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pycdr2 import IdlStruct
from pycdr2.types import float64, int32, sequence, uint8, uint32
from rosbags.typesys import Stores, get_typestore

from fleet.bus.protocol.messages import MalformedMessage
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
from fleet.ros2.conversion import Diagnostic, Joints
from tests.profiles import examples

STORES = {name: get_typestore(Stores[f"ROS2_{name}"]) for name in ("HUMBLE", "JAZZY", "LYRICAL")}

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


def test_the_hash_of_a_string_is_the_published_one():
    """Origin: github.com/ros2/rmw_zenoh, docs/design.md, the key of the topic `chatter`."""
    assert type_hash("std_msgs/msg/String") == "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_the_hash_of_a_joint_state_is_the_published_one():
    """Origin: `ros2 topic info --verbose` of joint_state_broadcaster's /joint_states, as found in users' reports."""
    assert type_hash(JOINT_STATE) == "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"


@pytest.mark.parametrize("kind", [JOINT_STATE, DIAGNOSTICS])
def test_the_types_are_the_same_in_every_version(kind):
    assert {store.hash_rihs01(kind) for store in STORES.values()} == {type_hash(kind)}


@UNHURRIED
@given(joint_states(), st.integers(0, 2**22), st.integers(0, 1023))
def test_rosbags_and_pycdr2_decode_our_joint_state(state, sec, fraction):
    names, (q, qd, tau) = state
    payload = write_joints(Joints(sec + fraction / 1024, tuple(names), tuple(q), tuple(qd), tuple(tau)))
    assert payload[:4] == HEADER
    for message in (*(store.deserialize_cdr(payload, JOINT_STATE) for store in STORES.values()),
                    JointState.deserialize(payload)):  # fmt: skip
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
    for message in (*(store.deserialize_cdr(payload, DIAGNOSTICS) for store in STORES.values()),
                    DiagnosticArray.deserialize(payload)):  # fmt: skip
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 500_000_000)
        found = [(s.level, s.name, s.message, s.hardware_id, [(v.key, v.value) for v in s.values])
                 for s in message.status]  # fmt: skip
        assert found == said
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
        with suppress(MalformedMessage):
            read(payload)


@pytest.mark.parametrize("count", [MAX_ITEMS, MAX_ITEMS + 1])
def test_a_list_that_is_too_long_is_refused(count):
    payload = JointState(Header(Time(0, 0), ""), ["j"] * count, [], [], []).serialize()
    if count <= MAX_ITEMS:
        assert len(read_joints(payload).names) == count
    else:
        with pytest.raises(MalformedMessage, match="Not a sensor_msgs/msg/JointState"):
            read_joints(payload)


def test_a_few_bytes_may_follow_a_message():
    """As after `serialize_message` of rclpy, which returns its whole buffer."""
    payload = write_joints(Joints(1.0, ("a", "b"), (0.5, 1.5)))
    for spare in range(SPARE_BYTES + 1):
        assert read_joints(payload + b"\x7f" * spare).q == (0.5, 1.5)
    with pytest.raises(MalformedMessage, match="size mismatch"):
        read_joints(payload + b"\x7f" * (SPARE_BYTES + 4))
