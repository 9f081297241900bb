"""Messages: what is said arrives to the last bit, and what is no number is refused on both ends."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.messages import (
    DifficultyScores,
    Info,
    MalformedMessage,
    State,
    check_name,
    decode,
    encode,
    encoding,
    schema,
)
from fleet.bus.protocol.operator import ControlRequest
from fleet.errors import BusError

numbers = st.floats(-1e12, 1e12)
names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=12)
ticks = st.integers(0, 2**40)
states = st.builds(
    State,
    arm=names,
    tick=ticks,
    time_s=numbers,
    mode=st.sampled_from(["idle", "working", "faulted"]),
    temp_c=st.lists(numbers, max_size=8).map(tuple),
    headroom_k=numbers,
)


@st.composite
def difficulty_words(draw):
    jobs = tuple(draw(st.lists(names, max_size=5, unique=True)))
    columns = st.lists(st.none() | numbers, min_size=len(jobs), max_size=len(jobs)).map(tuple)
    return DifficultyScores(draw(names), draw(ticks), draw(numbers), draw(names), jobs, draw(columns), draw(columns))


infos = st.builds(Info, arm=names, joints=st.integers(1, 9), twin=names)

STATE = State("arm_0", 3, 30.0, "working", (41.5, 40.0), 18.5)
WORD = DifficultyScores("arm_0", 3, 30.0, "twin-1", ("a", "b"), (0.25, None), (None, 1e-300))


def received(kind, payload, arm):
    """The message that came under the key of an arm."""
    return check_name(decode(kind, payload), arm, "arm")


@given(states | difficulty_words() | infos)
def test_what_is_said_arrives_to_the_last_bit(message):
    assert received(type(message), encode(message), message.arm) == message


@given(states | difficulty_words() | infos)
def test_the_wire_is_strict_json(message):
    """A second reader: Python's own, told to choke on NaN and Infinity."""
    parsed = json.loads(encode(message), parse_constant=pytest.fail)
    assert parsed["arm"] == message.arm


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_number_is_said_that_is_none(bad):
    with pytest.raises(ValueError, match="time_s"):
        State("a", 0, bad, "idle", (20.0,), 40.0)
    with pytest.raises(ValueError, match="temp_c"):
        State("a", 0, 0.0, "idle", (20.0, bad), 40.0)
    with pytest.raises(ValueError, match="headroom_k"):
        State("a", 0, 0.0, "idle", (20.0,), bad)
    with pytest.raises(ValueError, match="difficulty"):
        DifficultyScores("a", 0, 0.0, "", ("j",), (bad,), (None,))
    with pytest.raises(ValueError, match="p_saturation"):
        DifficultyScores("a", 0, 0.0, "", ("j",), (None,), (bad,))


def changed(message, **changes):
    fields = json.loads(encode(message))
    for name, value in changes.items():
        if value is ...:
            del fields[name]
        else:
            fields[name] = value
    return json.dumps(fields).encode()


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"null",
        b"[]",
        b"{",
        b"\xff\xfe",
        b"[" * 100_000,
        changed(STATE, headroom_k=None),
        changed(STATE, temp_c=[40.0, None]),
        changed(STATE, temp_c="hot"),
        changed(STATE, time_s=...),
        changed(STATE, mode="asleep"),
        changed(STATE, mode=1),
        changed(STATE, tick=-1),
        changed(STATE, tick=1.5),
        changed(STATE, arm=""),
        encode(STATE).replace(b"18.5", b"NaN"),
        encode(STATE).replace(b"18.5", b"1e999"),
    ],
)
def test_a_malformed_state_is_refused_with_words(payload):
    with pytest.raises(MalformedMessage, match=r"thermofleet\.State\.v4"):
        received(State, payload, "arm_0")


@pytest.mark.parametrize(
    "payload",
    [
        changed(WORD, difficulty=[0.25]),
        changed(WORD, p_saturation=[None, None, None]),
        changed(WORD, jobs=["a", "a"]),
        changed(WORD, jobs=["a", ""]),
        changed(WORD, difficulty=...),
        encode(STATE),
    ],
)
def test_a_malformed_difficulty_is_refused(payload):
    with pytest.raises(MalformedMessage):
        received(DifficultyScores, payload, "arm_0")


def test_nobody_speaks_for_another_arm():
    with pytest.raises(MalformedMessage, match="'arm_1' claims to be by 'arm_0'"):
        received(State, encode(STATE), "arm_1")


def test_a_malformed_message_is_a_bus_error_and_a_value_error():
    assert issubclass(MalformedMessage, BusError)
    assert issubclass(MalformedMessage, ValueError)


def test_what_a_later_version_adds_is_ignored():
    assert received(State, changed(STATE, mood="good"), "arm_0") == STATE


def test_an_integer_is_a_number():
    assert received(State, changed(STATE, headroom_k=18), "arm_0").headroom_k == 18.0


def test_a_schema_has_a_version():
    assert schema(Info) == "thermofleet.Info.v4"
    assert encoding(State) == "application/json;thermofleet.State.v4"


@pytest.mark.parametrize("action", ["pause", "resume"])
@pytest.mark.parametrize("arm", ["", "x" * 513])
def test_the_arm_of_a_pause_has_the_bounds_of_a_name(action, arm):
    request = {"request": "1", "action": {"action": action, "arm": arm}}
    with pytest.raises(MalformedMessage, match="length"):
        decode(ControlRequest, json.dumps(request).encode())
