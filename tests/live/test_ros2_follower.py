"""A real arm with a ROS 2 driver, whose messages rosbags writes, is an arm of the fleet."""

import math
import random
import struct
import time
from contextlib import ExitStack

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Ack, Award, Clock, ClockRequest, JobSpec, Quote, QuoteRequest
from fleet.bus.protocol.messages import Info, MalformedMessage, State
from fleet.bus.router import Router, open_client
from fleet.errors import BusError
from fleet.live.clock import FleetClock
from fleet.ros2.bridge import FRESH_S, WARM_S, ArmReadings, Follower
from fleet.ros2.conversion import Joints, joint_names
from fleet.ros2.node import Node
from tests.profiles import examples
from tests.waiting import PATIENCE_S

JAZZY = get_typestore(Stores.ROS2_JAZZY)
TYPES = JAZZY.types
NAMES = joint_names(7)
HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
"""Of sensor_msgs/JointState; origin: `ros2 topic info --verbose` in users' reports."""
WARM_HASH = "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
ATTACHED = struct.pack("<qqB16s", 1, 0, 16, bytes(16))
TEMP_C = (30.0, 45.5, 33.0, 38.25, 31.0, 30.0, 29.0)
Q = tuple(0.1 * joint for joint in range(7))


def header(sec):
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](sec, 0), "base")


def joint_state(names=NAMES, q=Q, qd=(), tau=(), sec=1):
    kind = "sensor_msgs/msg/JointState"
    arrays = (np.array(values, float) for values in (q, qd, tau))
    return bytes(JAZZY.serialize_cdr(TYPES[kind](header(sec), list(names), *arrays), kind))


def diagnostics(hardware="gen3", temp_c=TEMP_C):
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    pair, status = TYPES["diagnostic_msgs/msg/KeyValue"], TYPES["diagnostic_msgs/msg/DiagnosticStatus"]
    statuses = [
        status(0, name, "", f"{hardware}/{name}", [pair("temperature_c", str(value))])
        for name, value in zip(NAMES, temp_c, strict=True)
    ]
    return bytes(JAZZY.serialize_cdr(TYPES[kind](header(1), statuses), kind))


def known(**said):
    """What is known of an arm at the real second 0."""
    reality = ArmReadings(NAMES, "gen3")
    reality.update_joints(Joints(1.0, NAMES, Q, **said), 0.0)
    reality.update_temperatures(dict(zip(NAMES, TEMP_C, strict=True)), 0.0)
    return reality


def state_of(reality, real_s=0.0):
    return reality.state("real", 1, 5.0, real_s, 60.0)


def test_no_state_is_published_before_all_readings_are_present():
    reality = ArmReadings(NAMES)
    assert reality.missing(0.0) == "no joint state"
    assert state_of(reality) is None
    reality.update_joints(Joints(1.0, NAMES, Q), 0.0)
    reality.update_temperatures({name: 30.0 for name in NAMES if name != "joint_4"}, 0.0)
    assert reality.missing(0.0) == "no temperature of joint_4"
    assert state_of(reality) is None
    reality.update_temperatures({"joint_4": 30.0}, 0.0)
    assert state_of(reality) is not None


def test_old_readings_are_not_published_again():
    reality = known()
    assert state_of(reality, 0.99 * FRESH_S) is not None
    assert state_of(reality, 1.01 * FRESH_S) is None
    late_s = 1.01 * WARM_S
    reality.update_joints(Joints(2.0, NAMES, Q), late_s)
    assert "no temperature of joint_1, joint_2" in reality.missing(late_s)


def test_unmeasured_values_are_empty():
    state = state_of(known())
    assert (state.q, state.qd, state.tau, state.current_a) == (Q, (), (), ())
    assert state.temp_c == TEMP_C
    assert state.headroom_k == 60.0 - 45.5


@pytest.mark.parametrize(("speed", "mode"), [(0.0, "idle"), (0.009, "idle"), (0.011, "working"), (-0.5, "working")])
def test_a_moving_arm_is_working(speed, mode):
    qd = (0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0)
    assert state_of(known(qd=qd)).mode == mode
    moved = known()  # without velocities: from two positions, a tenth of a second apart
    moved.update_joints(Joints(1.1, NAMES, tuple(q + 0.1 * v for q, v in zip(Q, qd, strict=True))), 0.1)
    assert state_of(moved).mode == mode


@examples(50)
@given(st.permutations(NAMES), st.lists(st.tuples(*[st.floats(-6, 6)] * 3), min_size=7, max_size=7))
def test_the_order_of_joints_changes_no_reading(order, values):
    of = dict(zip(NAMES, values, strict=True))
    straight, mixed = (ArmReadings(NAMES), ArmReadings(NAMES))
    for reality, names in ((straight, NAMES), (mixed, tuple(order))):
        reality.update_joints(Joints(1.0, names, *zip(*(of[name] for name in names), strict=True)), 0.0)
        reality.update_temperatures(dict.fromkeys(names, 30.0), 0.0)
    assert state_of(straight) == state_of(mixed)


def test_a_reading_that_is_not_finite_changes_nothing():
    reality = known()
    with pytest.raises(MalformedMessage, match="nan for position of joint_1"):
        reality.update_joints(Joints(9.0, NAMES, (math.nan, *Q[1:])), 0.5)
    assert state_of(reality).q == Q


def test_a_gripper_on_the_same_topic_changes_nothing():
    reality = known()
    before = state_of(reality)
    reality.update_joints(Joints(1.5, ("finger",), (0.5,), (9.0,)), 0.5)
    assert state_of(reality) == before


class Place:
    """A real arm in ROS 2, whoever follows it, and the rest of the fleet."""

    def __init__(self, stack: ExitStack) -> None:
        router = stack.enter_context(Router())
        self.ros = stack.enter_context(open_client(router.endpoint, timeout_s=PATIENCE_S))
        self.link, self.peer = (stack.enter_context(BusClient(router.endpoint, "shop")) for _ in range(2))
        self.states: list[State] = []
        self.infos: list[Info] = []
        self.present: list[bool] = []
        self.peer.subscribe(keys.of_every_arm("shop", "state"), State, lambda _, word: self.states.append(word))
        self.peer.subscribe(keys.of_every_arm("shop", "info"), Info, lambda _, w: self.infos.append(w), history=True)
        self.peer.watch_tokens(keys.of_every_arm("shop", "alive"), lambda _, there: self.present.append(there))
        node = stack.enter_context(Node(router.endpoint, "follower", domain=3))
        clock = FleetClock(1.0, time.monotonic())
        reality = ArmReadings(NAMES, "gen3")
        topics = ("/gen3/joint_states", "/diagnostics")
        self.follower = Follower(self.link, node, "real", reality, topics, clock, rate_hz=50.0)

    def play(self, payload, type_hash=HASH):
        key = f"3/gen3/joint_states/sensor_msgs::msg::dds_::JointState_/{type_hash}"
        self.ros.put(key, payload, attachment=ATTACHED)

    def warm(self, payload, type_hash=WARM_HASH):
        key = f"3/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/{type_hash}"
        self.ros.put(key, payload, attachment=ATTACHED)

    def until(self, condition, each=lambda: None):
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, "waited in vain"
            each()
            self.follower.serve(time.monotonic() + 0.03)
            self.peer.serve()


@pytest.fixture
def place():
    with ExitStack() as stack:
        yield Place(stack)


@pytest.mark.parametrize("hashes", [(HASH, WARM_HASH), ("TypeHashNotSupported", "TypeHashNotSupported")])
def test_a_real_arm_is_an_arm_of_the_fleet(place, hashes):
    order = random.Random(1).sample(range(7), 7)
    qd, tau = tuple(0.02 * joint for joint in range(7)), tuple(-1.5 * joint for joint in range(7))
    names, *mixed = ([values[joint] for joint in order] for values in (NAMES, Q, qd, tau))
    gripper = joint_state(("finger",), (0.5,), (math.nan,), (math.nan,))

    def live():
        place.play(gripper, hashes[0])
        place.play(joint_state(names, *mixed), hashes[0])
        place.warm(diagnostics("someone_else", (99.0,) * 7), hashes[1])
        place.warm(diagnostics(), hashes[1])

    place.until(lambda: place.states and place.infos and place.present, live)
    said = place.states[-1]
    assert (said.arm, said.mode, said.job, said.temp_c) == ("real", "working", "", TEMP_C)
    assert (said.q, said.qd, said.tau) == (Q, qd, tau)
    assert place.infos == [Info("real", 7, "ros2 /gen3/joint_states")]
    assert place.present[-1]
    assert place.link.malformed == 0
    ticks = [state.tick for state in place.states]
    assert ticks == sorted(set(ticks))


@pytest.mark.parametrize(
    "rubbish",
    [
        lambda place: place.play(b"\x00\x01\x00\x00rubbish"),
        lambda place: place.play(joint_state(q=(math.nan,) * 7)),
        lambda place: place.play(joint_state(q=(9.0,) * 7), "RIHS01_another"),
        lambda place: place.warm(diagnostics(temp_c=("warm",) * 7)),
        lambda place: place.warm(diagnostics(temp_c=(99.0,) * 7), HASH),
    ],
    ids=["bytes", "nan", "another type", "no number", "type of another message"],
)
def test_malformed_messages_are_counted_and_change_nothing(place, rubbish):
    def live():
        place.play(joint_state())
        place.warm(diagnostics())
        rubbish(place)

    place.until(lambda: place.states and place.link.malformed >= 2, live)
    assert {state.q for state in place.states} == {Q}
    assert {state.temp_c for state in place.states} == {TEMP_C}


def test_a_real_arm_takes_no_work_and_gives_the_reason(place):
    def live():
        place.play(joint_state())
        place.warm(diagnostics())

    place.until(lambda: place.states, live)
    job = JobSpec(name="j", kind="hold", places=("rack",))
    got = []
    place.peer.query(
        keys.of_every_arm("shop", "quote"), QuoteRequest("a", (job,)), Quote, got.append, timeout_s=PATIENCE_S
    )
    award = Award("a.j", "a", "boss", "q", job)
    place.peer.query(keys.of_arm("shop", "real", "award"), award, Ack, got.append, timeout_s=PATIENCE_S)
    place.until(lambda: len(got) == 2, live)
    words = [word for answers in got for word in answers.messages.values()]
    (quote,) = (word for word in words if isinstance(word, Quote))
    (ack,) = (word for word in words if isinstance(word, Ack))
    assert (quote.capacity, [offer.feasible for offer in quote.estimates]) == (0, [False])
    assert "takes no work" in quote.estimates[0].reason
    assert not ack.accepted


def test_a_real_arm_uses_fleet_time(place):
    place.peer.reply_to(keys.of_clock("shop"), ClockRequest, lambda _: Clock(time_s=1e6, speed=1.0))

    def live():
        place.play(joint_state())
        place.warm(diagnostics())

    place.until(lambda: place.states and place.states[-1].time_s >= 1e6, live)
    assert place.states[-1].time_s < 1e6 + PATIENCE_S + 5.0


def test_a_real_arm_needs_a_fleet_at_speed_1(place):
    place.peer.reply_to(keys.of_clock("shop"), ClockRequest, lambda _: Clock(time_s=0.0, speed=60.0))
    with pytest.raises(BusError, match="60 times as fast"):
        place.until(lambda: False, lambda: None)
