"""ROS 2 itself: rclpy reads and writes our messages, and has the fleet do jobs by an action."""

import ctypes
import json
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Admission, JobStatus, Status, StatusRequest, Submission, SubmissionReply
from fleet.bus.router import Router
from fleet.ros2.cdr import (
    DIAGNOSTICS,
    JOINT_STATE,
    SPARE_BYTES,
    read_diagnostics,
    read_joints,
    type_hash,
    write_diagnostics,
    write_joints,
)
from fleet.ros2.conversion import Diagnostic, Joints

pytestmark = [pytest.mark.adapter, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
rclpy = pytest.importorskip("rclpy")
SOURCE = Path(__file__).parents[2] / "fleet" / "ros2" / "thermofleet_msgs"
PATIENCE_S = 20.0
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)
numbers = st.floats(allow_nan=False)
UNHURRIED = settings(deadline=None, max_examples=200)


@st.composite
def joint_states(draw):
    names = draw(st.lists(texts, max_size=8))
    lists = [draw(st.just(()) | st.tuples(*[numbers] * len(names))) for _ in range(3)]
    return Joints(draw(st.integers(0, 2**22)) / 4, tuple(names), *lists)


def fields(message):
    stamp = message.header.stamp
    lists = (tuple(values) for values in (message.position, message.velocity, message.effort))
    return Joints(stamp.sec + stamp.nanosec / 1e9, tuple(message.name), *lists)


@UNHURRIED
@given(joint_states())
def test_rclpy_reads_our_joint_states_and_we_read_those_of_rclpy(joints):
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import JointState

    ours = write_joints(joints)
    message = deserialize_message(ours, JointState)
    assert fields(message) == joints
    theirs = serialize_message(message)
    assert read_joints(theirs) == joints
    content = content_bytes(joints)
    assert len(ours) == content[-1] + 1
    assert len(theirs) - len(ours) in range(SPARE_BYTES + 1)
    assert [ours[at] for at in content] == [theirs[at] for at in content]


def content_bytes(joints):
    """Offsets of the bytes of a JointState that are no padding, by the rules of CDR (OMG DDSI-RTPS 2.5, 10.5).

    All other bytes of rclpy are undefined, and after the last one its buffer has spare bytes: this is why the same
    message, serialised again, has other bytes.
    """
    offsets, at = [*range(4), *range(4, 12)], 8  # header, then stamp; `at` counts from the end of the header

    def put(size, align):
        nonlocal at
        at += -at % align
        offsets.extend(range(4 + at, 4 + at + size))
        at += size

    for text in ("", None, *joints.names):  # frame_id, number of names, names
        put(4, 4)
        if text is not None:
            put(len(text.encode()) + 1, 1)
        else:
            assert at % 4 == 0
    for values in (joints.q, joints.qd, joints.tau):
        put(4, 4)
        for _ in values:
            put(8, 8)
    return offsets


statuses = st.builds(
    Diagnostic,
    level=st.integers(0, 3),
    name=texts,
    message=texts,
    hardware=texts,
    values=st.lists(st.tuples(texts, texts), max_size=4).map(tuple),
)


@UNHURRIED
@given(st.lists(statuses, max_size=4).map(tuple))
def test_rclpy_reads_our_diagnostics_and_we_read_those_of_rclpy(diagnostics):
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.serialization import deserialize_message, serialize_message

    message = deserialize_message(write_diagnostics(12.5, diagnostics), DiagnosticArray)
    assert message.header.stamp.sec == 12
    theirs = [(each.level[0], each.name, each.message, each.hardware_id) for each in message.status]
    assert theirs == [(each.level, each.name, each.message, each.hardware) for each in diagnostics]
    assert read_diagnostics(serialize_message(message)) == diagnostics


@pytest.mark.parametrize("kind", [JOINT_STATE, DIAGNOSTICS])
def test_the_type_hashes_are_those_that_ros_2_ships(kind):
    description = json.loads((Path(sys.prefix) / "share" / kind).with_suffix(".json").read_text(encoding="utf-8"))
    assert {each["type_name"]: each["hash_string"] for each in description["type_hashes"]}[kind] == type_hash(kind)


def test_our_quality_of_service_suits_the_usual_subscribers():
    """The token says: reliable, volatile, keep the last 10."""
    from rclpy import qos

    ours = qos.QoSProfile(
        depth=10, reliability=qos.ReliabilityPolicy.RELIABLE, durability=qos.DurabilityPolicy.VOLATILE
    )
    for theirs in (qos.QoSProfile(depth=10), qos.qos_profile_sensor_data):
        assert qos.qos_check_compatible(ours, theirs)[0] != qos.QoSCompatibility.ERROR
    latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
    assert qos.qos_check_compatible(ours, latched)[0] == qos.QoSCompatibility.ERROR


@pytest.fixture(scope="module")
def action_type(tmp_path_factory):
    """`DoJob`, generated from our package as colcon would do it."""
    build, prefix = tmp_path_factory.mktemp("build"), sys.prefix
    env = os.environ | {"AMENT_PREFIX_PATH": prefix, "PATH": f"{prefix}/bin{os.pathsep}{os.environ['PATH']}"}
    options = [
        f"-DCMAKE_PREFIX_PATH={prefix}",
        f"-DPython3_ROOT_DIR={prefix}",
        f"-DPython3_EXECUTABLE={sys.executable}",
    ]
    # The wheels name a Python that is only where they were built, so the first command fails after writing all files.
    subprocess.run(["cmake", "-S", SOURCE, "-B", build, *options], env=env, capture_output=True, check=False)
    made = subprocess.run(["cmake", "--build", build], env=env, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr[-2000:]
    for library in sorted(
        build.glob("libthermofleet_msgs__*.so")
    ):  # ROS 2 opens them by name, once loaded from anywhere
        ctypes.CDLL(str(library))
    sys.path.insert(0, str(build / "rosidl_generator_py"))
    from thermofleet_msgs.action import DoJob

    return DoJob


class Auctioneer:
    """Accepts jobs, and says what the test wants of their states; on a thread of its own."""

    def __init__(self, endpoint, fleet):
        self.jobs, self.states, self.ended = {}, {}, threading.Event()
        self._thread = threading.Thread(target=self._run, args=(endpoint, fleet))

    def _run(self, endpoint, fleet):
        with BusClient(endpoint, fleet) as link:
            link.reply_to(keys.of_jobs(fleet, "submit"), Submission, self._submit)
            link.reply_to(keys.of_jobs(fleet, "status"), StatusRequest, self._status)
            while not self.ended.is_set():
                link.serve(time.monotonic() + 0.05)

    def _submit(self, request):
        self.jobs |= {job.name: job for job in request.jobs}
        return SubmissionReply("boss", tuple(Admission(job.name, job.name != "twice", "known") for job in request.jobs))

    def _status(self, request):
        known = (self.states.get(job) or JobStatus(job, "waiting") for job in request.jobs)
        return Status("boss", 0.0, tuple(known))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self.ended.set()
        self._thread.join(PATIENCE_S)


class Shop:
    """An action server on the bus, and a client of ROS 2, served together."""

    def __init__(self, stack, action_type):
        from rclpy.action import ActionClient

        from fleet.ros2.job_action import JobAction

        self.router = stack.enter_context(Router())
        self.link = stack.enter_context(BusClient(self.router.endpoint, "shop"))
        self.jobs = stack.enter_context(JobAction(self.link, domain=77))
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=77)
        stack.callback(rclpy.shutdown, context=context)
        node = rclpy.create_node("customer", context=context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=context)
        self.executor.add_node(node)
        self.client = ActionClient(node, action_type, "/shop/do_job")
        self.feedback = []

    def until(self, done):
        deadline_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline_s, "waited in vain"
            self.jobs.serve(time.monotonic() + 0.02)
            for _ in range(4):
                self.executor.spin_once(timeout_sec=0.0)

    def send(self, goal):
        self.until(self.client.server_is_ready)
        asked = self.client.send_goal_async(goal, lambda message: self.feedback.append(message.feedback))
        self.until(asked.done)
        assert asked.result().accepted
        return asked.result()

    def result(self, handle):
        asked = handle.get_result_async()
        self.until(asked.done)
        return asked.result()


@pytest.fixture
def shop(action_type):
    with ExitStack() as stack:
        yield Shop(stack, action_type)


def test_a_goal_is_a_job_with_feedback_and_a_result(shop, action_type):
    from action_msgs.msg import GoalStatus

    goal = action_type.Goal(name="crate_1", kind="pick_place", places=["conveyor", "pallet"], repetitions=4, value=2.0)
    with Auctioneer(shop.router.endpoint, "shop") as boss:
        handle = shop.send(goal)
        shop.until(lambda: "crate_1" in boss.jobs)
        job = boss.jobs["crate_1"]
        assert (job.kind, job.places, job.repetitions, job.value) == ("pick_place", ("conveyor", "pallet"), 4, 2.0)
        assert (job.dwell_s, job.due_s) == (0.5, None)
        for cycles in (1, 2):
            boss.states["crate_1"] = JobStatus("crate_1", "awarded", arm="arm_0", award="x", cycles=cycles)
            shop.until(lambda: shop.feedback and shop.feedback[-1].cycles == cycles)  # noqa: B023
        cancelled = handle.cancel_goal_async()
        shop.until(cancelled.done)
        assert not cancelled.result().goals_canceling  # the bus cannot cancel yet
        boss.states["crate_1"] = JobStatus("crate_1", "finished", arm="arm_0", award="x", cycles=4, finished_s=9.0)
        done = shop.result(handle)
    assert [(each.state, each.arm) for each in shop.feedback] == [("awarded", "arm_0")] * 2
    assert done.status == GoalStatus.STATUS_SUCCEEDED
    assert (done.result.state, done.result.arm, done.result.cycles) == ("finished", "arm_0", 4)


def test_impossible_and_refused_goals_end_with_the_reason(shop, action_type):
    from action_msgs.msg import GoalStatus

    bad = shop.result(shop.send(action_type.Goal(kind="hold", places=["clamp"], dwell_s=60000.0)))
    assert bad.status == GoalStatus.STATUS_ABORTED
    assert "dwell_s" in bad.result.reason
    with Auctioneer(shop.router.endpoint, "shop"):
        refused = shop.result(shop.send(action_type.Goal(name="twice", kind="hold", places=["clamp"], dwell_s=1.0)))
    assert (refused.status, refused.result.reason) == (GoalStatus.STATUS_ABORTED, "not accepted: known")


def test_a_goal_is_cancelled_when_the_fleet_has_cancelled_its_job(shop, action_type, monkeypatch):
    from action_msgs.msg import GoalStatus

    from fleet.live.job_client import JobClient

    monkeypatch.setattr(JobClient, "cancel", lambda *_: "")  # until the bus can
    with Auctioneer(shop.router.endpoint, "shop") as boss:
        handle = shop.send(action_type.Goal(name="long", kind="hold", places=["clamp"], dwell_s=1.0))
        shop.until(lambda: "long" in boss.jobs)
        cancelled = handle.cancel_goal_async()
        shop.until(cancelled.done)
        assert cancelled.result().goals_canceling
        boss.states["long"] = JobStatus("long", "given_up", reason="cancelled")
        assert shop.result(handle).status == GoalStatus.STATUS_CANCELED
