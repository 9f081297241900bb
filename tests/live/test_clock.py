"""Fleet time: monotone under any correction, and right within half a round trip."""

import ast
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.live.clock import SLEW, FleetClock, next_due_s

speed = st.floats(0.1, 1000.0)
moment = st.floats(0.0, 1e6)
span = st.floats(0.0, 1e4)
FLEET = Path(__file__).parents[2] / "fleet"
corrections = st.lists(st.tuples(span, st.floats(0.0, 5.0), st.floats(0.0, 1e7)), max_size=8)


def test_a_minute_at_sixtyfold_speed_is_an_hour():
    clock = FleetClock(60.0, real_s=1000.0, zero_s=7.0)
    assert clock.now_s(1000.0) == 7.0
    assert clock.now_s(1060.0) == 7.0 + 3600.0
    assert clock.now_s(900.0) == 7.0


@given(speed, moment, corrections, st.lists(span, min_size=2, max_size=20))
def test_a_clock_never_runs_backwards_and_its_rate_is_bounded(speed, start, corrections, spans):
    clock, real_s = FleetClock(speed, start), start
    before = clock.now_s(real_s)
    first_s = before
    for wait, trip, reading_s in corrections:
        asked, real_s = real_s + wait, real_s + wait + trip
        now_s = clock.now_s(real_s)
        assert now_s >= before
        clock = clock.slewed_to(asked, real_s, reading_s)
        assert clock.now_s(real_s) == now_s  # the correction itself is no jump
        before = now_s
    for step in spans:
        later = clock.now_s(real_s + step)
        passed = speed * ((real_s + step) - real_s)
        rounding = 1e-9 * (1.0 + abs(later))
        assert before + (1 - SLEW) * passed - rounding <= later <= before + (1 + SLEW) * passed + rounding
        before, real_s = later, real_s + step
    assert before >= first_s


@given(speed, span, st.floats(0.0, 5.0), st.floats(0.0, 1.0), st.floats(-100.0, 100.0))
def test_after_a_correction_a_clock_is_right_within_half_a_round_trip(speed, asked, trip, share, ahead):
    """The other clock is read at any moment between request and reply."""
    clock = FleetClock(speed, 0.0, speed * 100.0 + speed * ahead)  # the truth is speed · (real + 100)
    answered = asked + trip
    reading_s = speed * (asked + share * trip + 100.0)
    settled = answered + (abs(ahead) + trip) / SLEW + 1.0
    off = clock.slewed_to(asked, answered, reading_s).now_s(settled) - speed * (settled + 100.0)
    assert abs(off) <= speed * trip / 2 + 1e-6 * speed
    at_once = clock.set_to(asked, answered, reading_s).now_s(answered) - speed * (answered + 100.0)
    assert abs(at_once) <= speed * trip / 2 + 1e-6 * speed


def test_an_offset_is_removed_at_a_tenth_of_the_speed():
    clock = FleetClock(2.0, 0.0, 0.0).slewed_to(0.0, 0.0, 4.0)
    assert clock.now_s(10.0) == pytest.approx(20.0 + 2.0)
    assert clock.now_s(20.0) == pytest.approx(40.0 + 4.0)
    assert clock.now_s(30.0) == pytest.approx(60.0 + 4.0)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_must_be_a_positive_number(speed):
    with pytest.raises(ValueError, match=r"FleetClock\.speed"):
        FleetClock(speed)


def test_a_reply_before_its_request_is_refused():
    with pytest.raises(ValueError, match="answered_s must be >= asked_s"):
        FleetClock(1.0).slewed_to(2.0, 1.0, 0.0)


WALL = {("time", "time"), ("time", "time_ns"), ("datetime", "now"), ("datetime", "utcnow"), ("date", "today")}
ALLOWED = {
    "bus/security/certificates.py": "validity",
    "bus/security/tls.py": "validity",
    "live/monitor/async_bridge.py": "when a person has seen an alarm",
    "ros2/node.py": "stamps of ROS messages",
}


def test_no_participant_reads_the_wall_clock():
    """So a jump of the wall clock has no effect; benchmarks/chaos tests it on a fleet of processes."""
    readers = set()
    for path in (path for folder in ("live", "bus", "ros2") for path in (FLEET / folder).rglob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
        if WALL & {(node.value.id, node.attr) for node in attributes if isinstance(node.value, ast.Name)}:
            readers.add(path.relative_to(FLEET).as_posix())
    assert readers == ALLOWED.keys()


@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=40))
def test_a_periodic_action_keeps_its_rate_and_never_runs_twice_at_once(delays_s):
    """Each run is late by some delay: never closer than half a period, never ahead of its rate."""
    period_s, due_s, last_s = 0.1, 0.0, -math.inf
    for number, delay_s in enumerate(delays_s):
        now_s = max(due_s, last_s) + delay_s
        assert now_s - last_s >= 0.5 * period_s - 1e-9
        assert now_s >= number * period_s - 1e-9
        due_s, last_s = next_due_s(due_s, now_s, period_s), now_s


def test_small_delays_do_not_add_up():
    due_s = 0.0
    for _ in range(100):
        due_s = next_due_s(due_s, due_s + 0.04, 0.1)
    assert due_s == pytest.approx(10.0)
