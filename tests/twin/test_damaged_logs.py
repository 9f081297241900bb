"""Damaged logs: every kind of damage is named with a remedy, or cut out; a sound log is read, wherever the arm starts.

The logs are made here, with torques of the simulated arm. The damage is of kinds that public reports describe.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fleet.arm.model import ArmModel
from fleet.errors import LogError
from fleet.readings import (
    BadReading,
    _impossible_changes,
    gravity_terms,
    judge,
    most_temp_change_k,
    mounts_differ,
    possible_temperatures,
)
from fleet.robot import Robot
from twin.logs.reader import of_arm, read
from twin.logs.recording import READINGS, Recording

ARM = ArmModel(Robot(name="logged"))
TORQUE_PER_AMP = np.array([10.2] * 4 + [6.6] * 3)
START = np.array([0.6, -0.5, 2.7, 0.9, 0.8, -0.7, 1.6])
CHANNELS = ("Pos", "Velocity", "Torque", "Current", "Temp")
NAMES = ["Time (s)", *(f"{group}_{k}" for group in CHANNELS for k in range(7))]
PLAIN_NAMES = ["time_s", *(f"{group}_{k}" for group in READINGS for k in range(1, 8))]
ROWS = 300
PLAIN_FACTORS = (np.pi / 180, np.pi / 180, -1.0, 1.0, 1.0)


@dataclass
class Log:
    """Numbers of a log; a test damages it and writes it."""

    time_s: np.ndarray
    groups: dict[str, np.ndarray]
    """[row, joint] by `CHANNELS`, in units of a Gen3 log."""

    def text(self, names: list[str] = NAMES, separator: str = ",") -> str:
        columns = np.column_stack([self.time_s, *self.groups.values()])
        lines = [separator.join(map(repr, row)) for row in columns.tolist()]
        return "\n".join([separator.join(names), *lines]) + "\n"

    def plain(self) -> "Log":
        scaled = {name: v * f for (name, v), f in zip(self.groups.items(), PLAIN_FACTORS, strict=True)}
        scaled["Pos"] = (scaled["Pos"] + np.pi) % (2 * np.pi) - np.pi
        return Log(self.time_s, scaled)


def sound(
    rows: int = ROWS,
    rate_hz: float = 2.0,
    start: np.ndarray = START,
    swing: float = 0.4,
    seed: int = 0,
    kg: float = 0.7,
) -> Log:
    """Slow swings of all joints, with noise as that of a real arm."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(rows) / rate_hz + rng.uniform(0, 0.01, rows)
    omega, shift = rng.uniform(0.1, 0.4, 7), rng.uniform(0, 6, 7)
    angle = np.outer(time_s, omega) + shift
    q, qd = start + swing * np.sin(angle), swing * omega * np.cos(angle)
    tau = ARM.inverse_dynamics(q, qd, np.zeros_like(q), kg) + rng.normal(0, 0.15, q.shape)
    current = tau / TORQUE_PER_AMP + rng.normal(0, 0.03, q.shape)
    temp = 30 + 0.8 * np.arange(7) + 4 * (1 - np.exp(-time_s / 300))[:, None] + rng.normal(0, 0.02, q.shape)
    return Log(time_s, dict(zip(CHANNELS, (np.rad2deg(q) % 360, np.rad2deg(qd), -tau, current, temp), strict=True)))


def changed(group: str, change: Callable[[np.ndarray], np.ndarray], joints: object = slice(None)) -> Callable[[], str]:
    """A log in which a channel of some joints is another, [row, joint]."""

    def make() -> str:
        log = sound()
        log.groups[group][:, joints] = change(log.groups[group][:, joints].copy())
        return log.text()

    return make


def rows_set(group: str, joint: int, first: int, last: int, value: float) -> Callable[[], str]:
    """A log in which one joint reads a value from row `first` to before row `last`."""

    def change(values: np.ndarray) -> np.ndarray:
        values[first:last] = value
        return values

    return changed(group, change, joint)


def timed(change: Callable[[np.ndarray], np.ndarray], rate_hz: float = 2.0) -> Callable[[], str]:
    def make() -> str:
        log = sound(rate_hz=rate_hz)
        log.time_s = change(log.time_s)
        return log.text()

    return make


def reordered(order: list[int], *groups: str) -> Callable[[], str]:
    def make() -> str:
        log = sound()
        for group in groups:
            log.groups[group] = log.groups[group][:, order]
        return log.text()

    return make


def plainly(change: Callable[[Log], object]) -> Callable[[], str]:
    """A plain log after a change."""

    def make() -> str:
        log = sound().plain()
        change(log)
        return log.text(PLAIN_NAMES)

    return make


def scaled(group: str, factor: float) -> Callable[[Log], object]:
    return lambda log: log.groups.update({group: log.groups[group] * factor})


def held(values: np.ndarray) -> np.ndarray:
    """From the middle on the value of the middle."""
    values[len(values) // 2 - 20 :] = values[len(values) // 2 - 20]
    return values


def header(*names: str) -> Callable[[], str]:
    return lambda: ",".join(names) + "\n" + "\n".join(["1," * (len(names) - 1) + "1"] * 30) + "\n"


def stood(log: Log) -> str:
    log.groups["Temp"][:] = log.groups["Temp"][50]
    return log.text()


def filled(log: Log, first: int, last: int) -> str:
    """With a gap that is filled by interpolation, as pandas does."""
    for values in log.groups.values():
        values[first:last] = np.linspace(values[first - 1], values[last], last - first + 2)[1:-1]
    return log.text()


def short_moves(dead: str = "", joint: int = 0, *, noise: float = 1.0) -> str:
    """A plain log at 1 Hz of short moves between rests, in which a sensor stands from the minute on."""
    rng, log, time_s = np.random.default_rng(0), sound().plain(), np.arange(ROWS, dtype=float)
    way = np.interp(time_s % 120.0, [20.0, 24.0, 80.0, 84.0], [0.0, 1.0, 1.0, 0.0])
    moves, out = (time_s % 60.0 > 20.0) & (time_s % 60.0 < 24.0), time_s % 120.0 < 60.0
    q, qd = START + 0.8 * way[:, None], np.tile(0.2 * (moves & out) - 0.2 * (moves & ~out), (7, 1)).T
    tau = ARM.inverse_dynamics(q, qd, np.zeros_like(q), 2.0)
    exact = {"Pos": q, "Velocity": qd, "Torque": tau, "Current": tau / TORQUE_PER_AMP}
    sizes = {"Pos": 2e-4, "Velocity": 2e-3, "Torque": 0.1, "Current": 0.01}
    for name, values in exact.items():
        log.groups[name] = values + noise * sizes[name] * rng.standard_normal(values.shape)
    log.time_s = time_s
    if dead:
        log.groups[dead][60:, joint] = log.groups[dead][60, joint]
    return log.text(PLAIN_NAMES)


SWAP = [0, 3, 2, 1, 4, 5, 6]
TURN = 180 / np.pi
WHOLE = {
    "joint 4 beyond its stop": (changed("Pos", lambda v: np.full_like(v, 170.0), 3), "joint 4 at 170° is beyond its"),
    "joint 2 beyond its stop, in rad": (
        plainly(lambda log: log.groups["Pos"].__setitem__((slice(None), 1), -2.5)),
        "joint 2 at -2.5 rad is beyond its stops.* Are the joints in another order",
    ),
    "Fahrenheit": (changed("Temp", lambda v: v * 1.8 + 32), r"above 85 °C. Are these °F \(then 3"),
    "one joint in Fahrenheit": (changed("Temp", lambda v: v * 1.8 + 32, 5), r"temperature of joint 6 .* °F"),
    "kelvin": (changed("Temp", lambda v: v + 273.15), r"Are these kelvin \(then 3"),
    "tenths": (changed("Temp", lambda v: np.round(v * 10)), r"tenths of °C \(then 3"),
    "thousandths": (changed("Temp", lambda v: np.round(v * 1000)), r"thousandths of °C \(then 3"),
    "mA": (changed("Current", lambda v: v * 1000), "is more than a Gen3 has .current.*Are these mA"),
    "currents of another motor": (changed("Current", lambda v: v * 7), "current and torque of joint 2 disagree"),
    "N·mm": (changed("Torque", lambda v: v * 1000), "Are these N·mm"),
    "joints 2 and 4 swapped": (reordered(SWAP, *CHANNELS), "joints 2 and 4 swapped it would be"),
    "torques swapped": (reordered(SWAP, "Torque", "Current"), "torques of joints 2 and 4 swapped"),
    "joints reversed": (reordered([6, 5, 4, 3, 2, 1, 0], "Torque", "Current"), "joints in reverse order"),
    "joints shifted": (reordered([1, 2, 3, 4, 5, 6, 0], *CHANNELS), "joints shifted by 1|beyond its stops"),
    "sign of one current": (changed("Current", np.negative, 1), "joint 2 disagree: -.* other sign"),
    "sign of one velocity": (changed("Velocity", np.negative, 4), "joint 5: the angle changes -.* other sign"),
    "sign of one angle": (changed("Pos", lambda v: -v % 360, 1), "joint 2: the angle changes -.* other sign"),
    "velocities in rad/s": (changed("Velocity", np.deg2rad), "Are the velocities in rad/s"),
    "angles in radians": (changed("Pos", np.deg2rad), "Are the angles in radians"),
    "velocities in rpm": (changed("Velocity", lambda v: v / 6), "revolutions per minute"),
    "ms at 1 kHz": (timed(lambda t: np.round(t * 1000), 250.0), "Are these milliseconds|time in milliseconds"),
    "microseconds": (timed(lambda t: np.round(t * 1e6)), "Are these microseconds"),
    "minutes": (timed(lambda t: t / 60), "Is time in minutes"),
    "hours": (timed(lambda t: t / 3600), "Is time in hours"),
    "days of a spreadsheet": (timed(lambda t: 46027 + t / 86400), "Is time in days"),
    "number of the sample": (timed(lambda t: np.arange(len(t)) * 1.0), "the angle changes 0.5"),
    "no clock": (timed(np.zeros_like), "time is always 0 s"),
    "velocities in another order": (reordered([6, 5, 4, 3, 2, 1, 0], "Velocity"), "joint 1 follows the velocity of"),
    "an angle that stands for a minute": (rows_set("Pos", 1, 10, 270, 330.0), "angle of joint 2 never changes"),
    "an angle that stands through short moves": (
        lambda: short_moves("Pos", 1, noise=0.0),
        "line [0-9]+: angle of joint 2 never changes, but its velocity does, for .* Every command needs it",
    ),
    "a velocity that stands": (
        lambda: short_moves("Velocity", 1),
        "line [0-9]+: velocity of joint 2 never changes, but its angle does, for .* Every command needs it",
    ),
    "a torque that stands without noise": (
        lambda: short_moves("Torque", 1, noise=0.0),
        "line [0-9]+: torque of joint 2 is .* Is its sensor dead. Every command needs it",
    ),
    "a current that stands without noise": (
        lambda: short_moves("Current", 1, noise=0.0),
        "line [0-9]+: current of joint 2 is .* Is its sensor dead",
    ),
    "columns between bars": (lambda: sound().text().replace(",", "|"), "Columns are separated by commas"),
    "a velocity not measured": (changed("Velocity", np.zeros_like, 3), "velocity of joint 4 never changes"),
    "a dead current sensor": (
        changed("Current", lambda v: np.full_like(v, 0.4), 5),
        "current of joint 6 is 0.4, for .* without any current_a column is read",
    ),
    "torque that dies midway": (
        changed("Torque", held, 2),
        r"torque of joint 3 is .* sensor dead\? Every command needs it",
    ),
    "sensor that dies midway": (changed("Temp", held, 1), r"joint 2 is .* dead\? .* twin score` needs none"),
    "all temperatures stand": (lambda: stood(sound(rows=800)), "temperature of joint 1 is 3.* sensor dead"),
    "newest line first": (
        lambda: "\n".join([",".join(NAMES), *sound().text().splitlines()[:0:-1], ""]),
        "newest line the first. Sort",
    ),
    "tabs and decimal commas": (
        lambda: sound().text().replace(",", "\t").replace(".", ","),
        "no good line of numbers.*decimal comma",
    ),
    "a placeholder for all temperatures": (changed("Temp", lambda v: np.full_like(v, 25.0)), "joint 1 is 25, for 14"),
    "no temperatures": (changed("Temp", np.zeros_like), "temperature of joint 1 is 0, for 14"),
    "degrees as rad": (plainly(scaled("Pos", TURN)), "Are these degrees"),
    "angles from 0 to 2π": (
        plainly(lambda log: log.groups.update(Pos=log.groups["Pos"] % (2 * np.pi))),
        "from 0 to 2π. Give them from −π to π",
    ),
    "seconds of the day": (timed(lambda t: (t + 86_340.0) % 86_400.0), "is this midnight. Add 86400 s"),
    "a clock set back": (timed(lambda t: 1.8e9 + t - 3600.0 * (t > 60.0)), "was the clock set back for winter time"),
    "seconds since 1970 with six digits": (
        timed(lambda t: np.round(1.8e9 + 20.0 * t, -3)),
        "time stands at 1800000000 s from line",
    ),
    "°/s as rad/s": (plainly(scaled("Velocity", TURN)), "Are (these|the velocities in) °/s"),
    "torque as the Gen3 reports it": (plainly(scaled("Torque", -1.0)), "joint 2 disagree: -.* signs in docs/logs.md"),
    "seventh joint of zeros": (
        plainly(lambda log: [values.__setitem__((slice(None), 6), 0.0) for values in log.groups.values()]),
        "joint 7 is 0, .* six joints",
    ),
    "UR RTDE": (header("timestamp", *(f"actual_q_{k}" for k in range(6))), "Universal Robots.* Write columns time_s"),
    "KUKA": (header("$TIMER", "$AXIS_ACT_A1"), "KUKA"),
    "rostopic": (header("%time", "field.header.seq", "field.position0"), "ROS messages, by its column '%time'"),
    "PlotJuggler": (header("__time", "/joint_states/joint_1/position"), "ROS messages"),
    "Kortex": (header("time", "actuators[0].position"), "Kortex API"),
    "no unit of time": (lambda: sound().text(["Time [s]", *NAMES[1:]]), r"spelling: rename 'Time \[s\]' to 'Time \(s"),
    "plain counted from 0": (
        lambda: sound().plain().text([n if n == "time_s" else f"{n[:-1]}{int(n[-1]) - 1}" for n in PLAIN_NAMES]),
        "counted from 0: rename 'q_0' to 'q_1'",
    ),
    "eight joints counted from 0": (
        header(NAMES[0], *(f"{name[:-1]}{k}" for name in NAMES[1::7] for k in range(8))),
        "has 8 joints; only logs of a Gen3",
    ),
    "clock of the day": (
        lambda: "\n".join([",".join(NAMES), *(f"06:00:{n % 60:02d}" + ",1" * 35 for n in range(30)), ""]),
        "time is in seconds, or as 2026",
    ),
}
"""Text, and the sentence; `--skip-damaged` changes nothing."""


@pytest.mark.parametrize("name", WHOLE)
def test_a_wrong_unit_order_or_channel_is_named_and_never_read(name: str, tmp_path: Path):
    make, sentence = WHOLE[name]
    path = tmp_path / "log.csv"
    path.write_text(make(), encoding="utf-8")
    for damaged in ("refuse", "skip"):
        with pytest.raises(LogError, match=sentence) as caught:
            read(path, damaged=damaged)
        assert "..." not in str(caught.value)
        assert "?." not in str(caught.value)


def stale(log: Log, first: int, last: int) -> str:
    for values in log.groups.values():
        values[first:last] = values[first]
    return log.text()


def doubled(text: str, first: int, last: int) -> str:
    lines = text.splitlines(keepends=True)
    return "".join([*lines[:last], *lines[first:last], *lines[last:]])


def spikes() -> str:
    log = sound()
    log.groups["Temp"][50:52, 3] = -127.0
    log.groups["Temp"][51:60, 6] += 12.0
    return log.text()


LINES = {
    "zeros of a sensor": (rows_set("Temp", 5, 40, 60, 0.0), range(40, 60), "temperature of joint 6 jumps: 0 °C beside"),
    "zeros at the start": (rows_set("Temp", 2, 0, 9, 0.0), range(9), "temperature of joint 3 jumps"),
    "a step for a while": (rows_set("Temp", 0, 200, 240, 55.0), range(200, 240), "joint 1 jumps: 55 °C"),
    "sensor dead near the end": (rows_set("Temp", 4, 270, 300, 12.0), range(270, 300), "joint 5 jumps: 12 °C"),
    "two sensors at once": (spikes, range(50, 60), "joint 4 at -127 is not a motor temperature"),
    "a joint beyond its stop": (rows_set("Pos", 5, 7, 8, 150.0), range(7, 8), "joint 6 at 150° is beyond its stops"),
    "a torque no arm has": (rows_set("Torque", 1, 80, 81, 999.0), range(80, 81), "joint 2 at -999 N·m is more than"),
    "stale to the end": (lambda: stale(sound(), 270, 300), range(271, 300), "all readings repeat for 14.5 s"),
    "stale between": (lambda: stale(sound(rate_hz=10), 100, 200), range(101, 200), "all readings repeat for 9.9 s"),
    "a gap filled by interpolation": (lambda: filled(sound(), 100, 190), range(100, 190), "change evenly for 45.5 s"),
    "a second header": (lambda: sound().text().replace("\n", f"\n{','.join(NAMES)}\n", 2), (), "repeats the header"),
    "a comma for thousands": (
        lambda: sound().text() + "1," * 36 + "1\n",
        (),
        r"line 302: 37 fields where the header has 36 \(a comma in a number\?\)\.",
    ),
    "a line of NUL bytes": (lambda: doubled(sound().text(), 1, 1) + "\0" * 90, (), "line 302: holds NUL bytes"),
}
"""Text, rows that are dropped, and the sentence."""


@pytest.mark.parametrize("name", LINES)
def test_damaged_lines_are_named_and_cut_out(name: str, tmp_path: Path):
    make, rows, sentence = LINES[name]
    path = tmp_path / "log.csv"
    path.write_text(make(), encoding="utf-8")
    with pytest.raises(LogError, match=f'{sentence}.*Use damaged="skip"') as caught:
        read(path)
    assert "?." not in str(caught.value)
    (recording,) = read(path, damaged="skip")
    assert len(recording.time_s) == ROWS - len(rows)
    assert recording.temp_c is not None
    assert 25 < recording.temp_c.min() < recording.temp_c.max() < 45
    assert recording.dropped


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_short_moves_between_rests_are_read(noise: float, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(short_moves(noise=noise), encoding="utf-8")
    assert len(read(path)[0].time_s) == ROWS


def test_a_short_hold_is_told_but_stays(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    # The logger of the public logs repeats up to 13 rows.
    path = tmp_path / "log.csv"
    path.write_text(stale(sound(), 100, 113), encoding="utf-8")
    with caplog.at_level(logging.WARNING, logger="twin.logs.reader"):
        assert len(read(path)[0].time_s) == ROWS
    assert "4 % of the lines repeat the one before" in caplog.text


HARMLESS: dict[str, Callable[[str], bytes]] = {
    "UTF-16, big end first": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "byte order mark and Windows ends": lambda text: text.replace("\n", "\r\n").encode("utf-8-sig"),
    "tabs": lambda text: text.replace(",", "\t").encode(),
    "sep and comments": lambda text: ("sep=,\r\n# night shift\n\n" + text.replace("\n", "\n# pause\n", 9)).encode(),
    "index of pandas": lambda text: "".join(
        f"{n - 1 if n else 'Unnamed: 0'},{line}\n" for n, line in enumerate(text.splitlines())
    ).encode(),
    "a comma at the end": lambda text: text.replace("\n", ",\n").encode(),
    "old line ends": lambda text: text.replace("\n", "\r").encode(),
    "quoted numbers": lambda text: ('"' + text.replace(",", '","').replace("\n", '"\n"')[:-1]).encode(),
    "quoted names": lambda text: ('"' + text.replace(",", '","', 35).replace("\n", '"\n', 1)).encode(),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_differences_are_read(name: str, tmp_path: Path):
    path, log = tmp_path / "log.csv", sound()
    path.write_bytes(HARMLESS[name](log.text()))
    (recording,) = read(path)
    assert recording.dropped == ()
    np.testing.assert_allclose(recording.temp_c, log.groups["Temp"])
    np.testing.assert_allclose(recording.time_s, log.time_s)


@pytest.mark.parametrize("date", ["2026-03-29T01:59:{:09.6f}+01:00", "2026-03-29 01:59:{:09.6f}", "{:.6f}"])
def test_dates_and_seconds_since_1970_are_counted_from_the_first(date: str, tmp_path: Path):
    log = sound(rows=100)
    lines = log.text().splitlines()
    seconds = log.time_s + (1.8e9 if "T" not in date and " " not in date else 0.0)
    dated = [f"{date.format(s)},{line.partition(',')[2]}" for s, line in zip(seconds, lines[1:], strict=True)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([lines[0], *dated, ""]), encoding="utf-8")
    np.testing.assert_allclose(read(path)[0].time_s, log.time_s - log.time_s[0], atol=1e-5)


@given(
    start=st.lists(st.floats(-1.6, 1.6), min_size=7, max_size=7),
    swing=st.floats(0.0, 0.45),
    rate_hz=st.sampled_from([1.0, 2.0, 10.0, 100.0]),
    seed=st.integers(0, 1000),
    kg=st.floats(0.0, 4.0),
)
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_a_sound_log_is_never_refused(start, swing, rate_hz, seed, kg):
    log = sound(150, rate_hz, np.array(start), swing, seed, kg).plain()
    readings = dict[str, np.ndarray](zip(READINGS, log.groups.values(), strict=True))
    assert [found.what for found in judge(log.time_s, readings, degrees=True)] == []
    assert [found.what for found in judge(log.time_s, readings, degrees=False)] == []


@given(
    angle=st.lists(st.floats(-0.08, 0.08), min_size=7, max_size=7),
    swing=st.sampled_from([0.0, 0.02]),
    seed=st.integers(0, 1000),
)
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_an_arm_on_a_wall_near_zero_is_not_asked_about_radians(angle, swing, seed):
    rng = np.random.default_rng(seed)
    time_s = np.arange(ROWS) / 2.0
    q = np.array(angle) + swing * np.sin(np.outer(time_s, rng.uniform(0.1, 0.4, 7))) + rng.normal(0, 1e-5, (ROWS, 7))
    tau = gravity_terms(q) @ [1.0, 0.0, 0.0, 0.7, 0.0, 0.0] + rng.normal(0, 0.15, q.shape)
    readings = {"q": q, "qd": np.gradient(q, time_s, axis=0), "tau": tau}
    assert not any("radians" in found.remedy for found in judge(time_s, readings, degrees=True))


@pytest.mark.parametrize("pair", [(2, 4), (3, 5), (3, 6)])
def test_swapped_joints_of_an_arm_with_a_light_load_are_named(pair):
    log = sound(rows=600, swing=0.3, kg=0.0).plain()
    order = list(range(7))
    order[pair[0]], order[pair[1]] = pair[::-1]
    readings = {name: values[:, order] for name, values in zip(READINGS, log.groups.values(), strict=True)}
    names = f"joints {pair[0] + 1} and {pair[1] + 1} swapped"
    assert any(names in found.remedy for found in judge(log.time_s, readings, degrees=True))


@pytest.mark.parametrize("every_s", [2.5, 5.0, 8.0])
def test_a_slow_log_of_short_moves_is_read(every_s):
    """Two short moves, whose velocity is that of one sample each."""
    time_s = np.arange(0.0, 1800.0, 0.1)
    moves = 1.0 * (abs(time_s - 600.0) < 0.75) - 1.0 * (abs(time_s - 1200.0) < 0.75)
    qd = 0.5 * moves[:, None] * (np.arange(7) == 3) + np.zeros((1, 7))
    q = np.cumsum(qd, axis=0) * 0.1 + 0.3
    rng = np.random.default_rng(0)
    tau = ARM.inverse_dynamics(q, qd, np.zeros_like(q), 0.7) + rng.normal(0, 0.15, q.shape)
    rows = slice(None, None, round(every_s * 10))
    readings = {"q": q[rows], "qd": qd[rows], "tau": tau[rows]}
    assert judge(time_s[rows], readings, degrees=False) == []


@given(st.lists(st.floats(-3, 3), min_size=7, max_size=7), st.floats(0, 5))
def test_gravity_is_that_of_the_model(q, kg):
    terms = gravity_terms(np.array([q]))[0]
    np.testing.assert_allclose(terms[:, 2] + kg * terms[:, 5], ARM.gravity_torque(np.array(q), kg), atol=1e-6)


@given(st.floats(0, 100), st.floats(0, 100))
def test_a_motor_may_change_more_in_a_longer_time(one_s, other_s):
    less, more = most_temp_change_k(np.sort([one_s, other_s]))
    assert (less <= more).all()
    assert (most_temp_change_k(0.0) == 2.0).all()


def test_no_reading_is_possible_where_none_is_in_range():
    hot = np.full((3, 7), 300.0)
    assert not possible_temperatures(np.arange(3.0), hot).any()
    assert BadReading("all", "").whole


@pytest.mark.parametrize(("channel", "digits"), [("tau", 1), ("current_a", 1), ("temp_c", 0)])
def test_coarse_recorders_and_slow_ones_are_not_refused(channel: str, digits: int) -> None:
    """Most readings of such a channel repeat: no sensor is dead for that."""
    time_s = np.arange(0.0, 900.0, 0.5)
    q = 0.4 * np.sin(np.outer(time_s, 0.1 * np.arange(1, 8)) + np.arange(7))
    tau = gravity_terms(q)[:, :, 2] + 0.1 * np.cos(q)
    readings = {
        "q": q,
        "qd": np.gradient(q, time_s, axis=0),
        "tau": tau,
        "temp_c": 31.0 + np.arange(7) + 0.2 * np.sin(q),
    }
    readings["current_a"] = 0.1 * readings["tau"]
    readings[channel] = readings[channel].round(digits)
    assert judge(time_s, readings, degrees=False) == []
    slow = {name: values[::4] for name, values in readings.items()}
    assert judge(time_s[::4], slow, degrees=False) == []


def test_a_cooling_arm_whose_angles_and_torques_are_rounded_to_zero_is_read() -> None:
    rng, time_s = np.random.default_rng(0), np.arange(600.0)
    q = np.tile([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.0], (len(time_s), 1))
    flickers = (q != 0.0) & (rng.random(q.shape) < 0.1)
    tau = gravity_terms(q)[:, :, 2].round() * (q != 0.0) + flickers
    temp_c = 30.0 + np.arange(7) + 4.0 * np.exp(-time_s / 300.0)[:, None] + rng.normal(0.0, 0.02, q.shape)
    readings = {"q": q, "qd": 0.0 * q, "tau": tau, "current_a": (0.1 * tau).round(1), "temp_c": temp_c}
    assert judge(time_s, readings, degrees=False) == []


@pytest.mark.parametrize("rows", [1, 5])
@pytest.mark.parametrize("damaged", ["refuse", "skip"])
def test_the_lines_of_two_arms_in_one_file_are_named(rows: int, damaged: str, tmp_path: Path) -> None:
    """Alternately, and in blocks: nothing of them is read."""
    one, other = sound(), sound(start=-START, seed=1)
    second = np.arange(ROWS) // rows % 2 == 1
    for group, values in one.groups.items():
        values[second] = other.groups[group][second]
    (tmp_path / "log.csv").write_text(one.text(), encoding="utf-8")
    with pytest.raises(LogError, match=r"jumps back and forth .* Are two arms in one log"):
        read(tmp_path / "log.csv", damaged=damaged)


@pytest.mark.parametrize(("step_s", "colder_k"), [(3600.0, 0.0), (3600.0, 5.0), (1800.0, 0.0)])
def test_a_clock_put_forward_an_hour_is_told(step_s: float, colder_k: float, tmp_path: Path, caplog) -> None:
    log = sound()
    log.time_s[150:] += step_s
    log.groups["Temp"][150:] -= colder_k
    (tmp_path / "log.csv").write_text(log.text(), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        read(tmp_path / "log.csv")
    assert ("line 152: time steps by 3600 s" in caplog.text) == (step_s == 3600.0 and not colder_k)


def test_a_jump_is_told_beside_the_reading_that_it_contradicts() -> None:
    """Of the first readings that is the last one, not the first, which is within reach."""
    time_s, temp_c = np.arange(0.0, 60.0), np.full((60, 7), 30.0)
    temp_c[:15, 2] = np.linspace(31.0, 40.0, 15)
    (found,) = _impossible_changes(time_s, temp_c)
    assert found.what.startswith("temperature of joint 3 jumps: 40 °C beside 30 °C within 1 s")


UNHELD: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "zero": (lambda tau: 0.0 * tau, "Was the torque measured?"),
    "kgf·m": (lambda tau: tau / 9.81, "Are these kgf·m"),
    "amperes": (lambda tau: tau / TORQUE_PER_AMP, "currents in A"),
    "lbf·in": (lambda tau: 8.85 * tau, "Are these lbf·in"),
    "noise": (lambda tau: np.random.default_rng(0).normal(0.0, 3.0, tau.shape), "Was the torque measured?"),
}


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("name", UNHELD)
def test_a_torque_that_does_not_hold_the_arm_is_refused(name: str, measured: bool, tmp_path: Path) -> None:
    """Of a log and of a plan: with it, a forecast would be far too cool."""
    log, (change, question) = sound(kg=0.0), UNHELD[name]
    path = tmp_path / "log.csv"
    path.write_text(log.text(), encoding="utf-8")
    assert read(path, measured=measured)
    log.groups["Torque"] = change(log.groups["Torque"])
    log = log.plain()
    log.groups.pop("Current")
    path.write_text(log.text([each for each in PLAIN_NAMES if "current" not in each]), encoding="utf-8")
    with pytest.raises(LogError, match="do not hold the arm") as refused:
        read(path, measured=measured)
    assert question in str(refused.value)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_log_and_a_plan_of_one_arm_have_one_mount(sign: float) -> None:
    """With the other sign the arm would hang from the ceiling."""
    parts = []
    for start, factor in ((START, 1.0), (START[::-1], sign)):
        q = start + 0.3 * np.sin(np.linspace(0.0, 5.0, 50))[:, None]
        parts.append({"q": q, "qd": 0.0 * q, "tau": factor * gravity_terms(q)[:, :, 2]})
    assert mounts_differ(*parts) == (sign < 0)


def test_a_log_with_the_other_sign_among_those_of_one_arm_is_told(caplog: pytest.LogCaptureFixture) -> None:
    logs = list[Recording]()
    for seed, sign in enumerate((1.0, -1.0, 1.0)):
        q = START + 0.4 * np.random.default_rng(seed).standard_normal((50, 7))
        tau = sign * gravity_terms(q)[:, :, 2]
        logs.append(Recording(name=f"day {seed}", time_s=np.arange(50.0), q=q, qd=0.0 * q, tau=tau))
    assert of_arm(logs, None, Path("logs")) == logs
    assert "logs: no mount of one arm explains the torques of all its 3 logs. Without 'day 1', one does." in caplog.text
    caplog.clear()
    of_arm(logs[::2], None, Path("logs"))
    assert not caplog.text


PLANS: dict[str, tuple[Callable[[dict[str, np.ndarray]], object], str]] = {
    "milliseconds": (lambda p: p.update(time_s=1000.0 * p["time_s"]), "Are these milliseconds"),
    "minutes": (lambda p: p.update(time_s=p["time_s"] / 60.0), "Is time in minutes"),
    "number of the sample": (lambda p: p.update(time_s=10.0 * p["time_s"]), "changes 0.1 times as much"),
    "°/s": (lambda p: p.update(qd=np.rad2deg(p["qd"]) * 0.2), "changes 0.0873 times as much"),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_in_other_units_is_refused(name: str, tmp_path: Path) -> None:
    """Its run would be longer, or its friction larger."""
    time_s = np.arange(0.0, 60.0, 0.1)
    angle = np.outer(time_s, 0.2 * np.ones(7))
    q = START + 0.4 * np.sin(angle)
    plan = {"time_s": time_s, "q": q, "qd": 0.08 * np.cos(angle), "tau": gravity_terms(q)[:, :, 2]}
    head = ",".join(["time_s", *(f"{name}_{j}" for name in ("q", "qd", "tau") for j in range(1, 8))])
    path, (change, question) = tmp_path / "plan.csv", PLANS[name]
    for sound_plan, factor in ((True, 0.0), (True, 1.0), (False, 1.0)):
        plan["qd"] = factor * 0.08 * np.cos(angle)  # all zero: not given
        if not sound_plan:
            change(plan)
        rows = np.column_stack(list(plan.values())).tolist()
        path.write_text("\n".join([head, *(",".join(map(repr, row)) for row in rows), ""]), encoding="utf-8")
        if sound_plan:
            assert len(read(path, measured=False)[0].time_s) == len(time_s)
    with pytest.raises(LogError, match=question):
        read(path, measured=False)
