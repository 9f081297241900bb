"""Messages of an arm to ROS 2 and back."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.messages import DifficultyScores, MalformedMessage, State
from fleet.robot import ThermalLimits
from fleet.ros2.cdr import read_diagnostics, read_joints, write_diagnostics, write_joints
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
    joints_of,
    temperatures,
)
from tests.profiles import examples

UNHURRIED = examples(50)
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
@given(q=seven, qd=st.just(()) | seven, tau=st.just(()) | seven, time_s=st.floats(0, 1e6))
def test_joint_states_survive_a_round_trip(q, qd, tau, time_s):
    said = joints_of(state(q=q, qd=qd, tau=tau, time_s=time_s))
    assert said.names == NAMES
    back = in_order(read_joints(write_joints(said)), NAMES)
    assert back is not None
    assert (back.q, back.qd, back.tau) == (q, qd, tau)
    assert back.time_s == pytest.approx(time_s, abs=1e-9)


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


def test_joints_of_other_devices_are_ignored():
    assert in_order(Joints(0.0, ("finger",), (math.nan,)), NAMES) is None


@pytest.mark.parametrize(
    ("joints", "complaint"),
    [
        (Joints(0.0, ("joint_1",), (1.0,)), "not joint_2"),
        (Joints(0.0, ("joint_1", "joint_2", "joint_1"), (1.0, 2.0, 1.0)), "joint_1 twice"),
        (Joints(0.0, ("joint_1", "joint_2"), (1.0, math.nan)), "nan for position of joint_2"),
        (Joints(0.0, ("joint_1", "joint_2"), (math.nan, math.nan)), "nan for position of joint_1"),
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


def test_a_fault_is_an_error_of_the_arm():
    assert told(mode="faulted")[0].level == ERROR


def test_an_old_state_is_stale():
    assert {status.level for status in told(age_s=3.5, word=WORD)} == {STALE}
    assert {status.level for status in told(age_s=2.5, word=WORD)} == {OK}


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
    assert temperatures(statuses, NAMES, "f/arm_0") == dict(zip(NAMES, temp_c, strict=True))
    assert temperatures(statuses, NAMES, "f/arm_1") == {}


def test_stale_temperatures_are_ignored():
    assert temperatures(told(age_s=9.0), NAMES, "f/arm_0") == {}


@pytest.mark.parametrize("said", ["warm", "nan", "inf", ""])
def test_a_temperature_that_is_no_number_is_refused(said):
    status = Diagnostic(OK, "n", "", "joint_1", (("temperature_c", said),))
    with pytest.raises(MalformedMessage, match="temperature_c of joint_1"):
        temperatures([status], NAMES, "")
