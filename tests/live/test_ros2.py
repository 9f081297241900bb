"""A fleet in ROS 2, and an arm with a ROS 2 driver, over a real router; rosbags and Zenoh decode the messages."""

import math
import queue
import random
import struct
import time
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import Int64, z_deserialize

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Ack, Award, Clock, ClockRequest, JobSpec, Quote, QuoteRequest
from fleet.bus.protocol.messages import DifficultyScores, Info, State
from fleet.bus.router import Router, open_client
from fleet.errors import BusError
from fleet.live.clock import FleetClock
from fleet.ros2 import bridge as ros2_bridge
from fleet.ros2.bridge import FRESH_S, WARM_S, ArmReadings, Bridge, Follower
from fleet.ros2.conversion import Joints, joint_names
from fleet.ros2.node import Node
from tests.waiting import PATIENCE_S, wait_until

JAZZY = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE, DIAGNOSTICS = "sensor_msgs/msg/JointState", "diagnostic_msgs/msg/DiagnosticArray"
JOINTS_KEY = "0/shop/arm_0/joint_states/sensor_msgs::msg::dds_::JointState_/"
DIAGNOSTICS_KEY = "0/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/"
BRIDGED_C = (30.5, 62.5, 76.25, 41.0, 33.0, 32.0, 31.0)


def state(arm="arm_0", time_s=12.25, **change):
    said = {"tick": 1, "mode": "working", "temp_c": BRIDGED_C, "headroom_k": -16.25, **change}
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

    def serve(self, *states):
        """The fleet publishes its states, and the bridge works for a moment."""
        self.say(*states)
        self.bridge.serve(time.monotonic() + 0.05)

    def until(self, condition, *states):
        """The first sample in ROS 2 for which it holds, while the fleet publishes its states again and again."""
        heard = []

        def found():
            while not self.came.empty():
                heard.append(self.came.get())
            return next(filter(condition, heard), None)

        return wait_until(found, lambda: self.serve(*states))

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
    message = JAZZY.deserialize_cdr(sample.payload.to_bytes(), JOINT_STATE)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 250_000_000)
    assert message.name == [f"joint_{number}" for number in range(1, 8)]
    assert [(*values,) for values in (message.position, message.velocity, message.effort)] == [q, qd, tau]


def test_a_state_becomes_diagnostics(make):
    domain = make()
    word = DifficultyScores("arm_0", 1, 12.0, "twin-1", ("press",), (0.75,), (0.5,))
    tell = domain.fleet.publisher(keys.of_arm("shop", "arm_0", "difficulty"), DifficultyScores)
    tell(word)  # what it remembers goes when `tell` goes

    def whole(sample):
        return under(DIAGNOSTICS_KEY)(sample) and b"d press" in sample.payload.to_bytes()

    sample = domain.until(whole, state())
    message = JAZZY.deserialize_cdr(sample.payload.to_bytes(), DIAGNOSTICS)
    levels = {status.name: status.level for status in message.status}
    assert levels == {
        "shop/arm_0: arm": 0, "shop/arm_0: joint_1": 0, "shop/arm_0: joint_2": 1, "shop/arm_0: joint_3": 2,
        **{f"shop/arm_0: joint_{number}": 0 for number in range(4, 8)}, "shop/arm_0: difficulty": 0,
    }  # fmt: skip
    values = {status.hardware_id: {pair.key: pair.value for pair in status.values} for status in message.status[1:8]}
    assert [float(values[f"shop/arm_0/joint_{number}"]["temperature_c"]) for number in range(1, 8)] == [*BRIDGED_C]


def test_node_and_publishers_are_visible_until_their_arm_leaves(make, monkeypatch):
    domain = make()
    domain.until(under(JOINTS_KEY), state())
    node, *publishers = sorted(domain.tokens(), key=lambda token: "/NN/" not in token)
    assert node.endswith("/0/0/NN/%/%/bridge")
    assert [token.split("/")[9] for token in publishers] == ["%diagnostics", "%shop%arm_0%joint_states"]
    monkeypatch.setattr(ros2_bridge, "GONE_S", 0.0)
    wait_until(lambda: len(domain.tokens()) == 2, domain.serve)
    assert domain.bridge.arms == ()


def test_keys_for_humble_have_no_hash(make):
    sample = make(humble=True).until(under(JOINTS_KEY), state())
    assert str(sample.key_expr) == JOINTS_KEY + "TypeHashNotSupported"


def test_invalid_names_are_changed_and_stay_unique(make):
    domain = make(fleet="7 shops ä")
    one, other = state(arm="arm-0"), state(arm="arm 0", time_s=99.0)
    domain.until(under("0/n7_shops/arm_0/joint_states/"), one)
    domain.until(under(DIAGNOSTICS_KEY), other, one)
    wait_until(lambda: domain.bridge.skipped, lambda: domain.serve(other))
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
    reality.update_temperatures({"joint_4": 32.0}, 0.0)
    state = state_of(reality)
    assert (state.q, state.qd, state.tau, state.current_a) == (Q, (), (), ())
    assert (state.temp_c[2:5], state.headroom_k) == ((30.0, 32.0, 30.0), 60.0 - 32.0)


def test_old_readings_are_not_published_again():
    reality = known()
    assert state_of(reality, 0.99 * FRESH_S) is not None
    assert state_of(reality, 1.01 * FRESH_S) is None
    late_s = 1.01 * WARM_S
    reality.update_joints(Joints(2.0, NAMES, Q), late_s)
    assert "no temperature of joint_1, joint_2" in reality.missing(late_s)


@pytest.mark.parametrize(("speed", "mode"), [(0.0, "idle"), (0.009, "idle"), (0.011, "working"), (-0.5, "working")])
def test_a_moving_arm_is_working(speed, mode):
    qd = (0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0)
    assert state_of(known(qd=qd)).mode == mode
    moved = known()  # without velocities: from positions over a second
    replay(moved, [tuple(q + 0.1 * i * v for q, v in zip(Q, qd, strict=True)) for i in range(1, 11)])
    assert state_of(moved, 1.0).mode == mode


def replay(reality, positions, stamp_s=0.1):
    """Ten positions a second, with stamps that increase by `stamp_s`."""
    for i, q in enumerate(positions, start=1):
        reality.update_joints(Joints(1.0 + stamp_s * i, NAMES, q), 0.1 * i)


def test_neither_another_turn_nor_noise_is_work_but_motion_without_a_clock_is():
    rng = np.random.default_rng(0)
    flips = [(*Q[:2], math.copysign(math.pi, 21.5 - i), *Q[3:]) for i in range(25)]
    noise = [tuple(q + 0.002 * e for q, e in zip(Q, rng.uniform(-1, 1, 7), strict=True)) for _ in range(25)]
    motion = [tuple(q + 0.005 * i for q in Q) for i in range(10)]
    for positions, stamp_s, mode in ((flips, 0.1, "idle"), (noise, 0.1, "idle"), (noise, 0.0, "idle")):
        still = known()
        replay(still, positions, stamp_s)
        assert state_of(still, 2.5).mode == mode
    for stamp_s in (0.1, 0.0, -0.1):
        moved = known()
        replay(moved, motion, stamp_s)
        assert state_of(moved, 1.0).mode == "working"


@pytest.mark.parametrize("wrong_c", [0.0, 318.6, 177.1, 12.0])
def test_an_impossible_temperature_neither_heats_nor_cools_the_headroom(wrong_c):
    reality = known()
    for now_s in (0.5, 1.0, 30.0):
        reality.update_joints(Joints(1.0 + now_s, NAMES, Q), now_s)
        reality.update_temperatures({"joint_2": wrong_c}, now_s)
        if now_s < 10:
            assert state_of(reality, now_s).headroom_k == 60.0 - 45.5
        assert reality.sensors.bad[1].startswith(f"joint 2 reads {wrong_c:.1f} °C")
    assert reality.sensors.doubt_k(30.0) > reality.sensors.doubt_k(1.0) > 2.0
    reality.update_temperatures({"joint_2": 44.0}, 30.5)
    assert (reality.sensors.bad, reality.sensors.doubt_k(30.5)) == ({}, 0.0)


class Place:
    """A real arm in ROS 2, whoever follows it, and the rest of the fleet."""

    def __init__(self, stack: ExitStack, monitor=None) -> None:
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
        self.follower = Follower(self.link, node, "real", reality, topics, clock, rate_hz=50.0, monitor=monitor)

    def play(self, payload, type_hash=HASH):
        key = f"3/gen3/joint_states/sensor_msgs::msg::dds_::JointState_/{type_hash}"
        self.ros.put(key, payload, attachment=ATTACHED)

    def warm(self, payload, type_hash=WARM_HASH):
        key = f"3/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/{type_hash}"
        self.ros.put(key, payload, attachment=ATTACHED)

    def live(self):
        """One reading of everything, as a driver publishes it."""
        self.play(joint_state())
        self.warm(diagnostics())

    def until(self, condition, each=None):
        def turn():
            (each or self.live)()
            self.follower.serve(time.monotonic() + 0.03)
            self.peer.serve()

        wait_until(condition, turn)


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


def test_states_that_a_pause_of_the_driver_withholds_are_not_lost_ones(place, monkeypatch):
    """A recorder counts gaps in the ticks as missed messages."""
    monkeypatch.setattr(ros2_bridge, "FRESH_S", 0.1)
    place.until(lambda: place.states)
    paused_s = time.monotonic()
    place.until(lambda: time.monotonic() > paused_s + 0.5, lambda: None)
    published = len(place.states)
    place.until(lambda: len(place.states) > published)
    ticks = [state.tick for state in place.states]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))


class Seen:
    """A monitor that keeps its readings."""

    version, scores = "d:1", (1.5, (41.0,) * 7)

    def __init__(self):
        self.readings = []

    def add(self, *readings):
        self.readings.append(readings)


def test_the_states_of_a_real_arm_have_the_scores_of_its_monitor():
    with ExitStack() as stack:
        seen = Seen()
        place = Place(stack, seen)

        zeros = (0.0,) * 7
        still = joint_state(qd=zeros, tau=zeros)
        place.until(lambda: place.states and place.infos, lambda: (place.play(still), place.warm(diagnostics())))
    assert (place.states[-1].motion_difficulty, place.states[-1].expected_c) == Seen.scores
    assert place.infos == [Info("real", 7, "d:1")]
    time_s, temp_c, q, *_ = (np.concatenate(each) for each in zip(*seen.readings, strict=True))
    assert (np.diff(time_s) > 0).all()
    assert (tuple(q[0]), tuple(temp_c[0])) == (Q, TEMP_C)


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
    place.until(lambda: place.states and place.link.malformed >= 2, lambda: (place.live(), rubbish(place)))
    assert {state.q for state in place.states} == {Q}
    assert {state.temp_c for state in place.states} == {TEMP_C}


def test_one_unusable_temperature_leaves_the_others(place, caplog):
    def send():
        place.play(joint_state())
        place.warm(diagnostics(temp_c=(*TEMP_C[:6], "41.5 C")))

    readings = place.follower._readings
    place.until(lambda: readings.missing(time.monotonic()) == "no temperature of joint_7", send)
    assert "temperature_c of gen3/joint_7 is no number: '41.5 C'" in caplog.text


def test_a_real_arm_takes_no_work_and_gives_the_reason(place):
    place.until(lambda: place.states)
    job = JobSpec(name="j", kind="hold", places=("rack",))
    got = []
    place.peer.query(
        keys.of_every_arm("shop", "quote"), QuoteRequest("a", (job,)), Quote, got.append, timeout_s=PATIENCE_S
    )
    award = Award("a.j", "a", "boss", "q", job)
    place.peer.query(keys.of_arm("shop", "real", "award"), award, Ack, got.append, timeout_s=PATIENCE_S)
    place.until(lambda: len(got) == 2)
    words = [word for answers in got for word in answers.messages.values()]
    (quote,) = (word for word in words if isinstance(word, Quote))
    (ack,) = (word for word in words if isinstance(word, Ack))
    assert (quote.capacity, [offer.feasible for offer in quote.estimates]) == (0, [False])
    assert "takes no work" in quote.estimates[0].reason
    assert not ack.accepted


def test_a_real_arm_uses_fleet_time(place):
    place.peer.reply_to(keys.of_clock("shop"), ClockRequest, lambda _: Clock(time_s=1e6, speed=1.0))

    place.until(lambda: place.states and place.states[-1].time_s >= 1e6)
    assert place.states[-1].time_s < 1e6 + PATIENCE_S + 5.0


def test_a_real_arm_needs_a_fleet_at_speed_1(place):
    place.peer.reply_to(keys.of_clock("shop"), ClockRequest, lambda _: Clock(time_s=0.0, speed=60.0))
    with pytest.raises(BusError, match="60 times as fast"):
        place.until(lambda: False)
