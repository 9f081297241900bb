"""Bad motor sensors of live arms: the last possible temperature, growing doubt, and no jobs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import Quote
from fleet.bus.protocol.messages import State
from fleet.heat.motor import gen3_motors, reference_current
from fleet.heat.thermal import drive_heat, gen3_network, thermal_model
from fleet.live.monitor.health import check_arm
from fleet.live.monitor.snapshot import FleetView
from fleet.live.sensors import ArmSensors
from fleet.readings import TemperatureFilter
from fleet.robot import JOINTS
from scenarios.show.watch import format_work

GOOD_C = (30.0, 41.0, 33.0, 38.0, 31.0, 40.0, 39.0)


def state(tick: int, joint_2_c: float = 41.0, time_s: float | None = None, **fields: object) -> State:
    temp_c = (GOOD_C[0], joint_2_c, *GOOD_C[2:])
    return State("arm", tick, tick / 10 if time_s is None else time_s, "idle", temp_c, 60.0 - max(temp_c), **fields)


def quote() -> Quote:
    return Quote("arm", "a", "q", 1.0, "", 0.0, "idle", 59.0, 1, ())


@pytest.mark.parametrize("wrong_c", [0.0, 314.2, 105.8, 410.0, -127.0, 177.1, 55.0])
def test_an_arm_with_a_bad_sensor_is_neither_hot_nor_cool_and_gets_no_jobs_for_long(wrong_c):
    sensors = ArmSensors()
    sensors.check(state(1))
    first, later = sensors.check(state(2, wrong_c)), sensors.check(state(300, wrong_c))
    for checked in (first, later):
        assert checked.temp_c == GOOD_C
        assert checked.headroom_k < 19.0
    assert later.headroom_k < 0 < first.headroom_k
    assert f"joint 2 reads {wrong_c:.1f} °C, after 41.0 °C 29.9 s before" in sensors.fault
    assert sensors.check_quote(quote()).capacity == 0
    assert sensors.check(state(301, 42.0)).temp_c[1] == 42.0
    assert sensors.fault == ""
    assert sensors.check_quote(quote()) == quote()


@pytest.mark.parametrize("wrong_c", [0.0, 314.2, 410.0])
def test_a_sensor_that_was_never_good_leaves_no_headroom(wrong_c):
    sensors = ArmSensors()
    checked = sensors.check(state(1, wrong_c))
    assert (checked.temp_c[1], checked.headroom_k <= 0.0) == (40.0, True)
    assert sensors.check_quote(quote()).capacity == 0


def test_an_arm_that_reports_another_unit_is_bad_as_a_whole():
    sensors = ArmSensors()
    fahrenheit = tuple(1.8 * c + 32 for c in GOOD_C)
    checked = sensors.check(State("arm", 1, 0.1, "faulted", fahrenheit, -45.0))
    assert (set(checked.temp_c), sensors.fault.count("joint")) == ({60.0}, 7)
    assert (sensors.fault.count("sensor"), sensors.fault.endswith("not in °C")) == (1, True)


def test_an_arm_that_starts_again_may_have_another_temperature():
    for restarted in (state(1, 25.0, 50.3), state(400, 25.0, 1.0)):
        sensors = ArmSensors()
        sensors.check(state(300, 50.0, 50.0))
        assert sensors.check(restarted) is restarted


def test_the_longer_side_of_a_jump_counts_unless_it_repeats():
    for noise, bad in ((0.01, False), (0.0, True)):
        sensors = ArmSensors()
        sensors.check(state(1, 55.0))  # one wrong reading at the start
        for tick in range(2, 700):
            sensors.check(state(tick, 33.0 + noise * (tick % 3)))
            assert sensors.fault or tick > 300
        assert bool(sensors.fault) == bad
    long = ArmSensors()
    for tick in range(1, 3000):
        long.check(state(tick, 41.0))
    for tick in range(3000, 4000):
        assert long.check(state(tick, 12.0 + 0.01 * (tick % 3))).temp_c[1] == 41.0


def test_the_network_bounds_the_doubt_of_an_arm_whose_torques_are_known():
    """An arm with 30 % more heat than a nominal one stands idle for two hours, then holds a load outstretched."""
    motors, thermal, sensors = gen3_motors(), thermal_model(gen3_network()), ArmSensors()
    nodes_c, warned = np.array([*GOOD_C, *GOOD_C]), False
    for tick in range(1, 1680):
        time_s = 5.0 * tick
        tau = np.array([0.0, 50.0, 0.0, 21.0, 0.0, 1.0, 0.0]) * (time_s > 7200.0)
        heat_w = 1.3 * drive_heat(
            nodes_c, reference_current(tau, np.zeros(JOINTS), motors) ** 2, np.zeros(JOINTS), motors
        )
        nodes_c = thermal.step(nodes_c, heat_w, 24.0, 5.0)
        true_c = nodes_c[:JOINTS]
        temp_c = (*true_c[:1], *(true_c[1:2] if tick < 10 else [0.0]), *true_c[2:])
        before = State("arm", tick, time_s, "idle", temp_c, 60.0 - max(temp_c), tau=tuple(tau))
        checked = sensors.check(before)
        assert checked.headroom_k <= 60.0 - true_c.max() + 1e-6
        warned |= checked.headroom_k < 0
        if time_s == 7200.0:
            assert checked.temp_c[1] == pytest.approx(true_c[1], abs=6.0)
            assert sensors.check_quote(quote()).capacity == 1
            assert not warned
    assert sensors.check_quote(quote()).capacity == 0


def test_people_see_the_bad_sensor():
    view = FleetView("f")
    view.set_token("arm", "arm", True)
    view.update("arm", state(1), 0.0)
    view.update("arm", state(2, 0.0), 0.1)
    (arm,) = view.snapshot(0.2).arms
    assert (arm.present, arm.hottest_c, arm.joint, arm.mode) == (True, 41.0, 2, "idle")
    assert "bad sensor: joint 2 reads 0.0 °C" in format_work(arm)
    (finding,) = check_arm(arm, None)
    assert finding.level == "warning"
    assert "arm has impossible temperatures: joint 2 reads 0.0 °C" in finding.what


@given(st.lists(st.tuples(st.floats(0.01, 100), st.floats(-1, 1)), max_size=50), st.floats(20, 60))
def test_no_temperature_that_a_motor_can_have_is_bad(changes, now_c):
    sensors, time_s = TemperatureFilter(), 0.0
    for dt_s, share in changes:
        time_s, now_c = time_s + dt_s, min(90.0, max(20.0, now_c + share * (2.0 + 0.5 * dt_s)))
        sensors.update(time_s, {0: now_c})
        assert not sensors.bad
