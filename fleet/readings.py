"""Judge the readings of a Gen3: what its joints, motors and sensors cannot report, what was probably meant, a remedy.

Sources of the limits: Kinova Gen3 user guide (stops, p. 85 safety limits of speed and torque) and the thermal network
in `fleet/data/gen3_thermal.json`. Limits of the statistics leave room around 34 public logs of a Gen3 (docs/logs.md).
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from fleet.errors import distinguish
from fleet.heat.motor import gen3_motors, thermal_data
from fleet.robot import JOINTS, ThermalLimits, half_turn

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = np.ndarray

STOPS_RAD = np.array([np.inf, 2.25, np.inf, 2.58, np.inf, 2.10, np.inf]) + np.deg2rad(5.0)
"""Stops of the user guide (128.9°, 147.8°, 120.3°), plus 5° for the zero of the encoders."""
SPEED_RAD_S = 2 * np.array([2.62] * 4 + [4.36] * 3)
"""Twice the hard safety limit of the speed, 150 and 250 °/s."""
TORQUE_NM = 2 * np.array([105.0] * 4 + [52.0] * 3)
"""Twice the hard safety limit of the torque."""
TEMP_RANGE_C = (-40.0, 200.0)
"""Range of a motor's temperature sensor."""
RARE = 0.05
"""Share of rows beyond these, from which the unit is wrong: without those rows, only the light load would be left."""
COOL_C, HOT_C = 65.0, ThermalLimits().error_c + 10.0
"""Upper limits of median temperatures over a log, °C: of the coolest motor (an idle wrist has 45), and of any motor (it
stops at 75)."""
TEMP_STEP_K = 2.0
"""Change of a motor temperature by resolution and noise of the sensor; the public logs have up to 1 K."""
MOST_STEP_S = 10.0
"""Largest median time between two samples, s: across a longer one neither motion nor heat is known."""
STALE_S = 8.0
"""Rows that repeat for longer are stale, s. Public logs repeat rows for up to 6.6 s, when their logger was late."""
EVEN = 1e-11
"""Change of a step from row to row that is rounding, in the unit of the reading; a step is more than 10⁴ of these."""
STUCK_S, STUCK_ROWS = 30.0, 20
"""One sensor that repeats its reading for so long, in so many rows, is dead if those of the other joints change."""
FINE = 0.7
"""Share of readings that differ from the one before, from which torques and currents are fine enough to be judged."""
LEAST_ROWS = 20
"""Rows from which angles, velocities, torques and currents are compared."""
DRIVES_RAD_S = 0.05
"""Mean speed above which an angle that never changes is a dead channel."""
MOST_MOTION_STEP_S = 0.6
"""Median time between samples up to which velocities and changes of position must agree; slower logs miss moves."""
LEAST_MOTION_RAD, LEAST_TORQUE_NM = 0.5, 3.0
"""Motion and RMS torque of a joint from which readings are compared."""
AGREES = 1.6
"""Factor between velocity and change of position that sampling explains; the public logs have 0.86 to 1.12."""
AMP_PER_NM = (0.01, 0.5)
"""Range of motor current over torque, A/(N·m); the public logs have 0.04 to 0.17."""
PUBLIC_AMP_PER_NM, FRICTION_NM = 0.17, 10.0
"""Largest current over torque in the public logs, A/(N·m); torque that may change without current: twice the largest
friction of these logs, N·m."""
UPRIGHT_NM = 11.0
"""Most torque that gravity causes while all angles are within 2π degrees of zero, with 4.5 kg, N·m."""
MISFIT = 0.05
"""Share of the squared torque that gravity leaves unexplained in a wrong log; of the public logs only one has more."""
BETTER = 3.0
"""Factor by which another reading of the log must reduce that share before it is named; at most 1.1 in that log."""
BACK = 0.05
"""Share of lines across which an angle jumps back, from which a log has two arms; the public logs have none."""
SLOW_RAD_S = 0.2
"""Speed up to which gravity causes most of the torque."""
UNHELD, UNHELD_NM = 0.25, 0.8
"""Share of the squared torque, and RMS torque, that no mount and payload of a Gen3 leave unexplained. The public logs
have a share of at most 0.11; with 8.85 times their torque (lbf·in) it is at least 0.26, with a tenth 0.5, except that
of a joint turning alone."""
MOST_PAYLOAD_KG = 5.0
"""Largest payload with which torques are explained."""


BAD_SENSOR = "a sensor is bad, or this is not in °C"
"""Cause of impossible temperatures."""


@dataclass(frozen=True, eq=False)
class BadReading:
    """Readings that a Gen3 cannot have."""

    what: str
    """What is wrong, with joint and value; the part before the first colon is the kind."""
    remedy: str
    """What was probably meant, and what to do, in sentences; may be empty."""
    rows: Array = field(default_factory=lambda: np.arange(0))
    """Index of the wrong rows; none where all are."""
    most: bool = False
    """Whether more than half of the rows are wrong in this way."""

    @property
    def whole(self) -> bool:
        """Whether the source is unusable, not only these rows."""
        return self.most or not len(self.rows)


def most_temp_change_k(dt_s: Array | float) -> Array:
    """Largest change of a motor temperature in a time, K, [..., joint].

    A winding at the most current warms by K_cu i² / C_w, 0.75 K/s in a large joint. Twice that allows for the spread of
    both numbers between arms.

    Args:
        dt_s: s, [...].
    """
    return TEMP_STEP_K + 2.0 * _warming_k_per_s() * np.asarray(dt_s)[..., None]


@cache
def _warming_k_per_s() -> Array:
    motors, limit_c = gen3_motors(), ThermalLimits().error_c
    hot = 1.0 + motors.alpha_cu_per_k * (limit_c - motors.reference_c)
    return motors.copper_w_per_a2 * hot * motors.current_max_a**2 / np.array(thermal_data()["winding_j_per_k"])


class TemperatureFilter:
    """Last possible motor temperatures of a live arm; other readings are of a bad sensor.

    Rejected are readings outside `TEMP_RANGE_C`, a first reading of exactly 0.0, and all readings while no motor is
    below `COOL_C`. After a change that no motor can make, readings are rejected until the next such change, or until
    they have gone on for `STUCK_S` longer than those before it without repeating.

    Attributes:
        temp_c: Last possible temperature by joint, °C.
        bad: Sentence on the impossible readings of a joint, by joint; `BAD_SENSOR` is their cause.
    """

    def __init__(self) -> None:
        self.temp_c: dict[int, float] = {}
        self.bad: dict[int, str] = {}
        self._good_s: dict[int, float] = {}
        self._since_s: dict[int, tuple[float, float]] = {}
        """Begin of the possible readings without such a change, and of the impossible ones after it."""
        self._last: dict[int, tuple[float, float]] = {}

    def update(self, time_s: float, temp_c: Mapping[int, float]) -> None:
        """Apply temperatures by joint, °C; a time that goes back is of an arm that started again."""
        if time_s < max((at_s for at_s, _ in self._last.values()), default=time_s):
            self.__init__()
        unit = min(temp_c.values(), default=0.0) > COOL_C and len(temp_c) > 1
        for joint, now_c in temp_c.items():
            self._judge(joint, time_s, now_c, unit)

    def doubt_k(self, time_s: float) -> float:
        """Largest change that a motor with a bad sensor can have made since its last possible reading, K; else 0."""
        return max((_change_k(time_s - self._good_s[j]) for j in self.bad if j in self._good_s), default=0.0)

    def _judge(self, joint: int, time_s: float, now_c: float, unit: bool) -> None:
        good_c, good_s = self.temp_c.get(joint), self._good_s.get(joint, time_s)
        last_s, last_c = self._last.get(joint, (time_s, now_c))
        self._last[joint] = time_s, now_c
        jump = "" if good_c is None else f", after {good_c:.1f} °C {time_s - good_s:.1f} s before"
        possible = not unit and TEMP_RANGE_C[0] <= now_c <= TEMP_RANGE_C[1]
        possible &= now_c != 0.0 if good_c is None else abs(now_c - good_c) <= _change_k(time_s - good_s)
        good_since_s, bad_since_s = self._since_s.get(joint, (time_s, time_s))
        if joint in self.bad and good_c is not None:
            goes_on = abs(now_c - last_c) <= _change_k(time_s - last_s)
            bad_since_s = bad_since_s if goes_on and now_c != last_c else time_s
            longer = time_s - bad_since_s > good_s - good_since_s + STUCK_S and not unit and 0.0 < now_c < HOT_C
            possible = longer or (possible and not goes_on)
            good_since_s = bad_since_s if longer else good_since_s
        elif possible:
            bad_since_s = time_s
        self._since_s[joint] = good_since_s, bad_since_s
        if possible:
            self.temp_c[joint], self._good_s[joint] = now_c, time_s
            self.bad.pop(joint, None)
        else:
            self.bad[joint] = f"joint {joint + 1} reads {now_c:.1f} °C{jump}"


def all_possible(time_s: Array, temp_c: Array) -> bool:
    """Return whether `TemperatureFilter` accepts all temperatures of an arm, [row] and [row, joint]."""
    if not len(time_s):
        return True
    steps_s, changes_k = np.diff(time_s), np.abs(np.diff(temp_c, axis=0)).max(axis=1)
    in_range = TEMP_RANGE_C[0] <= temp_c.min() and temp_c.max() <= TEMP_RANGE_C[1]
    cool = temp_c.shape[1] < 2 or temp_c.min(axis=1).max() <= COOL_C
    return bool(in_range and cool and (temp_c[0] != 0.0).all()) and bool(
        (changes_k <= most_temp_change_k(steps_s).max(axis=1)).all()
    )


def _change_k(dt_s: float) -> float:
    return float(most_temp_change_k(max(dt_s, 0.0)).max())


def judge_time(time_s: Array) -> list[BadReading]:
    """Whether times can be seconds.

    Args:
        time_s: Increasing, [row].
    """
    if len(time_s) < 3 or (step := float(np.median(np.diff(time_s)))) <= MOST_STEP_S:
        return []
    units = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
    guess = next((f"Are these {name} (then {step / f:.3g} s)? " for name, f in units if step / f <= MOST_STEP_S), "")
    what = f"time has a sample every {step:.6g} s, from {time_s[0]:.10g} to {time_s[-1]:.10g}"
    return [BadReading(what, f"{guess}Give seconds, with at most {MOST_STEP_S:g} s between samples.")]


@np.errstate(over="ignore", invalid="ignore")  # of numbers that only a damaged file has
def judge(time_s: Array, readings: Mapping[str, Array], *, degrees: bool, measured: bool = True) -> list[BadReading]:
    """Readings that no Gen3 can have.

    Args:
        time_s: Strictly increasing, [row].
        readings: `q` rad, `qd` rad/s, `tau` N·m; `current_a` A and `temp_c` °C if there are any, [row, joint].
        degrees: Whether the source has degrees, for the guess at what was meant.
        measured: Whether sensors made them; those of a simulation may repeat, and only their ranges are judged.
    """
    if not len(time_s):
        return []
    bad = list(_out_of_range(readings, degrees))
    if not measured:
        return bad
    unit = _wrong_unit(readings["temp_c"]) if "temp_c" in readings else ()
    bad = [*judge_time(time_s), *unit, *bad, *_interleaved(time_s, readings)]
    if any(found.whole for found in bad):
        return bad
    bad += _stuck(time_s, readings)
    bad += [_stale(time_s, start, end) for start, end in repeats(time_s, readings, STALE_S)]
    bad += _filled(time_s, readings)
    if "temp_c" in readings:
        bad += _impossible_changes(time_s, readings["temp_c"])
    bad = [replace(found, most=found.most or 2 * len(found.rows) > len(time_s)) for found in bad]
    if any(found.whole for found in bad) or len(time_s) < LEAST_ROWS:
        return bad
    good = np.ones(len(time_s), dtype=bool)
    for found in bad:
        good[found.rows] = False
    sound = {channel: values[good] for channel, values in readings.items()}
    return [
        *bad,
        *_motion(time_s[good], sound, degrees),
        *_currents(sound),
        *_upright(sound, degrees),
        *(list(_gravity(sound)) or unheld(sound)),
    ]


def judge_plan(time_s: Array, readings: Mapping[str, Array], *, degrees: bool) -> list[BadReading]:
    """Readings that no planned motion of a Gen3 can have: wrong units, or torques that do not hold the arm.

    Args:
        time_s: As in `judge`, as are the others.
    """
    if not len(time_s):
        return []
    bad = [*judge_time(time_s), *_out_of_range(readings, degrees)]
    if not bad and len(time_s) >= LEAST_ROWS and readings["qd"].any():  # else the speeds are those of the angles
        bad += _motion(time_s, readings, degrees)
    return bad or unheld(readings)


def runs(mask: Array, least: int = 1) -> list[tuple[int, int]]:
    """First index and end of every run of at least `least` true values, [n]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).reshape(-1, 2)
    return [(a, b) for a, b in edges[edges[:, 1] - edges[:, 0] >= least].tolist()]


def repeats(time_s: Array, readings: Mapping[str, Array], least_s: float) -> list[tuple[int, int]]:
    """Runs of rows, first and end, in which all readings repeat those of the row before for longer than `least_s`.

    Rows without temperatures count while a joint moves: a simulated arm at rest repeats its rows.
    """
    rows = np.concatenate(list(readings.values()), axis=1)
    same = np.concatenate([[False], (np.diff(rows, axis=0) == 0).all(axis=1)])
    if "temp_c" not in readings:
        same &= (readings["qd"] != 0).any(axis=1)
    least_s = max(least_s, 4.0 * float(np.median(np.diff(time_s)))) if len(time_s) > 1 else least_s
    return [(a, b) for a, b in runs(same) if time_s[b - 1] - time_s[a - 1] > least_s]


def possible_temperatures(time_s: Array, temp_c: Array) -> Array:
    """Whether each motor temperature can be that of a motor, beside those before and after, [row, joint].

    Readings without an impossible change between them form a group. The longest group counts; so does each other
    group that a motor can reach from the last counted reading before it, or the first one after it.
    """
    possible = (temp_c >= TEMP_RANGE_C[0]) & (temp_c <= TEMP_RANGE_C[1])
    jump = np.abs(np.diff(temp_c, axis=0)) > most_temp_change_k(np.diff(time_s))
    for j in np.flatnonzero(jump.any(axis=0) | ~possible.all(axis=0)):
        edges = np.flatnonzero(jump[:, j] | np.diff(possible[:, j])) + 1
        groups = [group for group in np.split(np.arange(len(time_s)), edges) if possible[group[0], j]]
        if not groups:
            continue
        longest = max(range(len(groups)), key=lambda i: len(groups[i]))
        for others, near, far in ((groups[longest + 1 :], 0, -1), (groups[:longest][::-1], -1, 0)):
            last = groups[longest][far]
            for group in others:
                allowed = most_temp_change_k(abs(time_s[group[near]] - time_s[last]))[j]
                if abs(temp_c[group[near], j] - temp_c[last, j]) > allowed:
                    possible[group, j] = False
                else:
                    last = group[far]
    return possible


def _out_of_range(readings: Mapping[str, Array], degrees: bool) -> Iterator[BadReading]:
    q, remedy = readings["q"], "Are the joints in another order, or is this another arm?"
    if degrees:
        what = "beyond its stops, ±128.9°, ±147.8°, ±120.3° for joints 2, 4, 6"
        yield from _limited(q, STOPS_RAD, np.rad2deg(q), "°", what, remedy)
    else:
        what = "beyond its stops, ±2.25, ±2.58, ±2.10 rad for joints 2, 4, 6"
        turned = q.min() >= 0 and (np.abs(half_turn(q)) <= STOPS_RAD).all()
        if np.abs(q).max() > 2 * np.pi:
            remedy = "Are these degrees?"
        elif turned:
            remedy = "Do the angles run from 0 to 2π? Give them from −π to π."
        yield from _limited(q, STOPS_RAD, q, " rad", what, remedy)
    speed = "Are these °/s? The unit is rad/s." if not degrees else "Check the unit, °/s."
    for channel, limit, unit, guess in (
        ("qd", SPEED_RAD_S, " rad/s", speed),
        ("tau", TORQUE_NM, " N·m", "Are these N·mm or N·cm? The unit is N·m."),
        ("current_a", 2 * gen3_motors().current_max_a, " A", "Are these mA? The unit is A."),
    ):
        if channel in readings:
            what = f"more than a Gen3 has ({_NAMES[channel]})"
            yield from _limited(readings[channel], limit, readings[channel], unit, what, guess, RARE)
    if "temp_c" in readings:
        temp_c = readings["temp_c"]
        middle_c, half_k = np.mean(TEMP_RANGE_C), np.ptp(TEMP_RANGE_C) / 2
        yield from _limited(temp_c - middle_c, half_k, temp_c, "", "not a motor temperature in °C", "")


def _wrong_unit(temp_c: Array) -> Iterator[BadReading]:
    usual_c = np.median(temp_c, axis=0)
    if usual_c.min() > COOL_C or usual_c.max() > HOT_C:
        joint = int(usual_c.argmax())
        usual, hot = distinguish(usual_c[joint], HOT_C)
        what = f"above {hot} °C" if usual_c.max() > HOT_C else f"and that of no joint is below {COOL_C:g} °C"
        what = f"the median temperature of joint {joint + 1} is {usual}, {what}"
        yield BadReading(what, _unit_of(usual_c[usual_c > COOL_C]))


_NAMES = {"q": "angle", "qd": "velocity", "tau": "torque", "current_a": "current", "temp_c": "temperature"}


def _limited(
    values: Array, most: Array | float, shown: Array, unit: str, what: str, remedy: str, share: float = 0.5
) -> Iterator[BadReading]:
    outside = np.abs(values) > most
    rows = np.flatnonzero(outside.any(axis=1))
    for row in rows:
        joint = int(outside[row].argmax())
        found = f"joint {joint + 1} at {shown[row, joint]:.5g}{unit} is {what}"
        yield BadReading(found, remedy, np.array([row]), len(rows) > share * len(values))


def _unit_of(temp_c: Array) -> str:
    """Question for the units in which temperatures would be those of motors."""
    units: tuple[tuple[str, Callable[[Array], Array]], ...] = (
        ("kelvin", lambda t: t - 273.15),
        ("°F", lambda t: (t - 32) / 1.8),
        ("tenths of °C", lambda t: t / 10),
        ("hundredths of °C", lambda t: t / 100),
        ("thousandths of °C", lambda t: t / 1000),
    )
    fits = [(name, to_c(temp_c)) for name, to_c in units]
    fits = [f"{name} (then {c.max():.3g} °C)" for name, c in fits if c.min() > 10 and c.max() < ThermalLimits().error_c]
    return f"{'Are these ' + ' or '.join(fits) + '? ' if fits else ''}Give °C."


_NEEDED = "Every command needs it: repair it and record again."
_WITHOUT = {
    "temp_c": "Identification, training and forecasts need the temperatures of all joints: repair it and record "
    "again. `thermofleet twin score` needs none: give it a plain log (docs/logs.md) without any temp_c column.",
    "current_a": "A plain log (docs/logs.md) without any current_a column is read, too: its torques replace them.",
}
"""What can be done with a log one of whose sensors is dead, by channel; of others, `_NEEDED`."""


def _stuck(time_s: Array, readings: Mapping[str, Array]) -> Iterator[BadReading]:
    """Sensors that repeat one reading while those of the other joints change, or while the arm moves.

    The temperatures of all joints may repeat for some minutes, as sensors with whole degrees do; if they are equal, or
    the arm moves for long, they may not.
    """
    works = (np.diff(readings["tau"], axis=0) != 0).any(axis=1)
    moved = np.abs(_steps(readings["q"])).sum(axis=1)
    for channel in _NAMES:
        if channel not in readings:
            continue
        changes = np.diff(readings[channel], axis=0) != 0
        # Of a coarse channel most readings repeat: only a reading that is 0 all the time says something.
        coarse = channel in ("tau", "current_a") and changes.sum() < FINE * changes.size
        for j in range(JOINTS):
            for a, b in runs(~changes[:, j], min(STUCK_ROWS, len(changes))):
                value, span_s = readings[channel][a, j] + 0.0, time_s[b] - time_s[a]
                whole = b - a == len(changes) and value == 0.0
                never = whole and channel == "temp_c"
                padded = whole and not readings["qd"][:, j].any() and not readings["q"][:, j].any()
                if coarse and not padded and not _contradicted(channel, readings, j, slice(a, b + 1)):
                    continue
                alive = np.delete(changes[a:b], j, axis=1).mean() >= 0.5
                if channel in ("q", "qd"):
                    alive = _moves(channel, time_s, readings, j, slice(a, b + 1))
                elif coarse and not padded:
                    alive = True  # the joint moves
                elif channel != "temp_c":
                    alive |= moved[a:b].sum() > LEAST_MOTION_RAD
                elif span_s >= 4 * STUCK_S and not changes[a:b].any():
                    alike = not np.ptp(readings[channel][a])  # a placeholder
                    fine = value % 1 != 0 and span_s >= 10 * STUCK_S
                    moves = moved[a:b].sum() > 10 * LEAST_MOTION_RAD and works[a:b].mean() >= 0.5
                    alive |= (alike or fine) and moves
                if not never and not (alive and span_s >= STUCK_S):
                    continue
                stands = f"is {value:.5g}"
                if channel in ("q", "qd"):
                    stands = f"never changes, but its {'velocity' if channel == 'q' else 'angle'} does"
                what = f"{_NAMES[channel]} of joint {j + 1} {stands}, for {span_s:.4g} s"
                remedy = f"Is its sensor dead? {_WITHOUT.get(channel, _NEEDED)}"
                if value == 0.0 and j == JOINTS - 1 and channel != "q":
                    remedy = "Is this an arm with six joints, padded with zeros? Only logs of a Gen3 (seven) are read."
                yield BadReading(what, remedy, np.arange(a if value == 0.0 else a + 1, b + 1))


def _moves(channel: str, time_s: Array, readings: Mapping[str, Array], joint: int, rows: slice) -> bool:
    """Whether a joint whose angle or velocity stands for some rows moves, by the other one.

    A velocity of 0 says nothing: slow logs miss moves.
    """
    dt_s, q, qd = np.diff(time_s[rows]), readings["q"][rows, joint], readings["qd"][rows, joint]
    if channel == "q":
        speed = np.abs(qd[:-1])
        moves = speed > DRIVES_RAD_S
        return bool(speed.mean() > DRIVES_RAD_S or (speed * dt_s)[moves].sum() > LEAST_MOTION_RAD)
    apart = np.abs(half_turn(np.diff(q) - qd[0] * dt_s))[dt_s <= 1.5 * np.median(dt_s)]  # without gaps
    return bool(qd[0] != 0.0 and apart[apart > LEAST_MOTION_RAD / 10].sum() > LEAST_MOTION_RAD)


def _contradicted(channel: str, readings: Mapping[str, Array], joint: int, rows: slice) -> bool:
    """Whether a loaded joint moves and its current changes while its torque stands, or the other way round."""
    other = {"tau": "current_a", "current_a": "tau"}[channel]
    if other not in readings or np.ptp(readings["q"][rows, joint]) < LEAST_MOTION_RAD:
        return False
    least_a = LEAST_TORQUE_NM * PUBLIC_AMP_PER_NM
    least, change = (LEAST_TORQUE_NM, least_a) if channel == "tau" else (least_a, FRICTION_NM)
    return bool(abs(readings[channel][rows, joint][0]) > least and np.ptp(readings[other][rows, joint]) > change)


def _stale(time_s: Array, start: int, end: int) -> BadReading:
    span_s = time_s[end - 1] - time_s[start - 1]
    what = f"all readings repeat for {span_s:.3g} s"
    return BadReading(what, "Did the connection to the arm stall? These lines count as a gap.", np.arange(start, end))


def _impossible_changes(time_s: Array, temp_c: Array) -> Iterator[BadReading]:
    possible = possible_temperatures(time_s, temp_c)
    for j in np.flatnonzero(~possible.all(axis=0)):
        for a, b in runs(~possible[:, j]):
            row, beside = (a, a - 1) if a else (b - 1, min(b, len(time_s) - 1))
            dt_s = abs(time_s[row] - time_s[beside])
            what = (
                f"temperature of joint {j + 1} jumps: {temp_c[row, j]:.5g} °C beside {temp_c[beside, j]:.5g} °C within "
                f"{dt_s:.3g} s, where a motor changes by at most {most_temp_change_k(dt_s)[j]:.2g} K"
            )
            yield BadReading(what, "Did its sensor fail?", np.arange(a, b))


def _steps(q: Array) -> Array:
    """Change of the angles by at most half a turn, rad, [row − 1, joint]."""
    return half_turn(np.diff(q, axis=0))


def _filled(time_s: Array, readings: Mapping[str, Array]) -> Iterator[BadReading]:
    """Rows between which all readings change evenly, as those between the ends of a gap do after interpolation."""
    steps = [_steps(values) if name == "q" else np.diff(values, axis=0) for name, values in readings.items()]
    step = np.concatenate(steps, axis=1)
    moves = (np.abs(step[1:]) > 1e4 * EVEN).any(axis=1, keepdims=True)
    even = ((np.abs(np.diff(step, axis=0)) <= EVEN) & moves).all(axis=1)
    for a, b in runs(np.asarray(even), 4):
        if (span_s := time_s[b + 1] - time_s[a]) > STUCK_S:
            what = f"all readings change evenly for {span_s:.3g} s, with no noise"
            remedy = "Was a gap filled by interpolation? These lines count as one."
            yield BadReading(what, remedy, np.arange(a + 1, b + 1))


def _interleaved(time_s: Array, readings: Mapping[str, Array]) -> Iterator[BadReading]:
    """Angles that jump there and back, unlike the velocities, as in a file with the lines of two arms."""
    dt_s, moved, qd = np.diff(time_s), _steps(readings["q"]), readings["qd"]
    if len(time_s) < LEAST_ROWS or np.median(dt_s) > MOST_MOTION_STEP_S:
        return
    apart = np.abs(moved - (qd[1:] + qd[:-1]) / 2.0 * dt_s[:, None])
    jumps = (apart > LEAST_MOTION_RAD) & (np.abs(moved) > LEAST_MOTION_RAD)
    back = [np.count_nonzero(np.diff(np.sign(moved[jumps[:, j], j]))) for j in range(JOINTS)]
    if max(back) > BACK * len(time_s):
        what = f"the angle of joint {np.argmax(back) + 1} jumps back and forth {max(back)} times, unlike its velocity"
        yield BadReading(what, "Are two arms in one log? Write a file for each arm.")


def clock_step(time_s: Array, temp_c: Array) -> int | None:
    """Row after a step of an hour across which no motor temperature changes, as if a clock was put forward.

    Args:
        time_s: Increasing, [row].
        temp_c: [row, joint].
    """
    dt_s, change_k = np.diff(time_s), np.abs(np.diff(temp_c, axis=0)).max(axis=1)
    steps = np.flatnonzero((np.abs(dt_s - 3600.0) < MOST_STEP_S) & (change_k < TEMP_STEP_K))
    return int(steps[0]) + 1 if len(steps) else None


def _motion(time_s: Array, readings: Mapping[str, Array], degrees: bool) -> Iterator[BadReading]:
    """Velocities that disagree with the changes of position."""
    dt_s, moved, qd = np.diff(time_s), _steps(readings["q"]), readings["qd"]
    new = (np.diff(np.concatenate([readings["q"], qd, readings["tau"]], axis=1), axis=0) != 0).any(axis=1)
    # A repeated row hides the motion until the next one.
    usable = new & np.concatenate([[True], new[:-1]]) & (dt_s <= 1.5 * np.median(dt_s))
    expected = (qd[1:] + qd[:-1]) / 2.0 * dt_s[:, None]
    slow = len(dt_s) > 0 and bool(np.median(dt_s) > MOST_MOTION_STEP_S)
    moved, expected = moved[usable], expected[usable]
    usual = (np.abs(moved) < 1.0).all(axis=1)  # rad: beyond, sampling may hide turns
    moved, expected = moved[usual], expected[usual]
    if len(moved) < LEAST_ROWS / 2:
        return
    path_rad = np.maximum(*(np.ptp(np.cumsum(steps, axis=0), axis=0) for steps in (moved, expected)))
    norms = np.sqrt(np.outer((moved**2).sum(axis=0), (expected**2).sum(axis=0)))
    alike = np.abs(moved.T @ expected) / np.maximum(norms, 1e-12)  # [joint of the angle, joint of the velocity]
    for j in np.flatnonzero(path_rad > LEAST_MOTION_RAD / 5):
        by_angle, by_speed = moved[:, j], expected[:, j]
        if not (by_angle.any() and by_speed.any()):
            if path_rad[j] < LEAST_MOTION_RAD:
                continue
            still, other = ("velocity", "angle") if by_angle.any() else ("angle", "velocity")
            yield BadReading(f"{still} of joint {j + 1} never changes, but its {other} does", "Is the channel dead?")
            continue
        if not slow and alike[j, j] < 0.8 and alike[j].max() > 0.97:
            what = f"the angle of joint {j + 1} follows the velocity of joint {alike[j].argmax() + 1}, not its own"
            yield BadReading(what, "Are the columns in another order?")
        ratio = float((by_angle * by_speed).sum() / (by_speed**2).sum())
        # A slow log misses moves: there only a proportional difference in many of them says something.
        if slow and min(_count(by_angle), _count(by_speed)) < LEAST_ROWS / 2:
            continue
        if alike[j, j] < (0.97 if slow else 0.8) or 1 / AGREES < ratio < AGREES:
            continue
        what = f"joint {j + 1}: the angle changes {ratio:.3g} times as much as the integrated velocity"
        yield BadReading(what, _unit_of_motion(ratio, degrees))


def _count(changes: Array) -> float:
    """How many changes share the motion equally, [row]: 1 if all but one are small (participation ratio)."""
    return float((changes**2).sum() ** 2 / (changes**4).sum())


def _unit_of_motion(ratio: float, degrees: bool) -> str:
    if ratio < 0:
        return "Does one of them have the other sign? Make positive velocities enlarge the angle."
    turn, angles, speeds = 180 / np.pi, "Are the angles in ", "Are the velocities in "
    causes = (
        (turn, f"{speeds}rad/s" if degrees else f"{angles}degrees"),
        (1 / turn, f"{angles}radians" if degrees else f"{speeds}°/s"),
        (60.0, "Is time in minutes"),
        (3600.0, "Is time in hours"),
        (86400.0, "Is time in days"),
        (1e-3, "Is time in milliseconds"),
        (6.0 if degrees else np.pi / 30, f"{speeds}revolutions per minute"),
    )
    fits = [f"{cause}? " for factor, cause in causes if 0.8 < ratio / factor < 1.25]
    unit = "degrees, °/s" if degrees else "rad, rad/s"
    return f"{''.join(fits)}Give {unit} and seconds."


def _currents(readings: Mapping[str, Array]) -> Iterator[BadReading]:
    """Currents that disagree with the torques."""
    if "current_a" not in readings:
        return
    for j in range(JOINTS):
        tau, current_a = readings["tau"][:, j], readings["current_a"][:, j]
        squares, product = float((tau**2).sum()), float((tau * current_a).sum())
        if squares < len(tau) * LEAST_TORQUE_NM**2 or product**2 < 0.64 * squares * float((current_a**2).sum()):
            continue
        slope = product / squares
        if not AMP_PER_NM[0] <= slope <= AMP_PER_NM[1]:
            unit = "Does one of them have the other sign?" if slope < 0 else "Are these mA or N·mm?"
            what = f"current and torque of joint {j + 1} disagree: {slope:.3g} A per N·m, where a Gen3 has about 0.1"
            yield BadReading(what, f"{unit} Give A, N·m and the signs in docs/logs.md.")


def _upright(readings: Mapping[str, Array], degrees: bool) -> Iterator[BadReading]:
    """Angles within ±2π that would be those of an upright arm, with torques of other angles, whatever its mount."""
    q, tau = readings["q"], readings["tau"]
    raw = np.abs(np.rad2deg(q)).max()
    if not (degrees and 1.0 < raw < 2 * np.pi and np.median(np.abs(tau).max(axis=1)) > UPRIGHT_NM):
        return
    rows = np.linspace(0, len(q) - 1, 60).astype(int)
    # The factor exceeds that of chance; at rest, one posture explains a torque about as well as another.
    if 1.5 * _misfit(np.rad2deg(q[rows]), tau[rows]) < _misfit(q[rows], tau[rows]):
        what = f"all angles are within ±{raw:.3g}°, where an arm stands upright, but its torques are not small"
        yield BadReading(what, "Are these radians? Give degrees, or write a plain log in rad.")


@cache
def _links() -> "list[tuple[Array, Rotation, Array, float]]":
    """Of each link from joint 1 on: position and rotation in the link before, center of mass in it, and mass."""
    from scipy.spatial.transform import Rotation  # SciPy takes longer to load than all else that watches a fleet

    text = resources.files("fleet").joinpath("arm/assets/gen3.xml").read_text(encoding="utf-8")
    links = list[tuple[Array, Rotation, Array, float]]()
    for body in ElementTree.fromstring(text).iter("body"):
        inertial = body.find("inertial")
        if body.find("joint") is not None and inertial is not None:
            offset, (w, *xyz), center = (
                np.array(numbers.split(), dtype=float)
                for numbers in (body.attrib["pos"], body.attrib.get("quat", "1 0 0 0"), inertial.attrib["pos"])
            )
            links.append((offset, Rotation.from_quat([*xyz, w]), center, float(inertial.attrib["mass"])))
    return links


def gravity_terms(q: Array) -> Array:
    """Torque that holds the arm against 9.81 m/s² along −x, −y and −z of its base, N·m, [row, joint, 6].

    Three terms are those of the links, three those of 1 kg at the flange; mount and payload are their factors.

    Args:
        q: rad, [row, joint].
    """
    from scipy.spatial.transform import Rotation

    turn, at = Rotation.from_rotvec(np.zeros((len(q), 3))), np.zeros((len(q), 3))
    axes, pivots, moments = list[Array](), list[Array](), list[Array]()  # moments: mass times position, and mass
    for (offset, fixed, center, mass_kg), angle in zip(_links(), q.T, strict=True):
        at = at + turn.apply(offset)
        turn = turn * fixed * Rotation.from_rotvec(np.outer(angle, (0.0, 0.0, 1.0)))
        axes.append(turn.apply((0.0, 0.0, 1.0)))
        pivots.append(at)
        moments.append(mass_kg * np.column_stack([at + turn.apply(center), np.ones(len(q))]))
    flange = at + turn.apply((0.0, 0.0, -0.061525))
    terms = np.zeros((len(q), JOINTS, 6))
    for j, (axis, pivot) in enumerate(zip(axes, pivots, strict=True)):
        beyond = np.sum(moments[j:], axis=0)
        terms[:, j, :3] = 9.81 * np.cross(axis, beyond[:, :3] - beyond[:, 3:] * pivot)
        terms[:, j, 3:] = 9.81 * np.cross(axis, flange - pivot)
    return terms


def _gravity(readings: Mapping[str, Array]) -> Iterator[BadReading]:
    """Torques that no mount and payload explain, but another order, unit or sign of the joints does."""
    q, tau = _slow(readings)
    if len(q) < 10 or np.sqrt((tau**2).mean(axis=0)).max() < LEAST_TORQUE_NM or (misfit := _misfit(q, tau)) < MISFIT:
        return
    alternatives = [(_misfit(q_, tau_), meant) for q_, tau_, meant in _alternatives(q, tau)]
    least, meant = min(alternatives, key=lambda each: each[0])
    if least * BETTER < misfit:
        what = f"the torques do not fit the angles: gravity leaves {misfit:.0%} of the squared torque unexplained"
        yield BadReading(what, f"With {meant} it would be {least:.0%}. Check the columns, signs and units.")


def _slow(readings: Mapping[str, Array]) -> tuple[Array, Array]:
    """Angles and torques of at most 60 rows with little motion, [row, joint]."""
    slow = np.flatnonzero(np.abs(readings["qd"]).max(axis=1) < SLOW_RAD_S)
    rows = slow if len(slow) < 10 else slow[np.linspace(0, len(slow) - 1, 60).astype(int)]
    return readings["q"][rows], readings["tau"][rows]


def unheld(readings: Mapping[str, Array]) -> list[BadReading]:
    """Torques that no Gen3 has at rest in these postures, in any mount and with any payload.

    Args:
        readings: `q` rad, `qd` rad/s, `tau` N·m, [row, joint].
    """
    q, tau = _slow(readings)
    if not len(q) or _unexplained([(q, tau)]) < UNHELD:
        return []
    rms_nm = np.sqrt((tau**2).mean())
    what = f"the torques, {rms_nm:.3g} N·m RMS, do not hold the arm: in every mount, gravity needs others"
    meant = {"kgf·m, or currents in A": 9.81, "lbf·in or kgf·cm": 0.1}
    fits = [f"Are these {unit}? " for unit, factor in meant.items() if _unexplained([(q, factor * tau)]) < UNHELD]
    return [BadReading(what, f"{(*fits, 'Was the torque measured? ')[0]}Give N·m.")]


def mounts_differ(*several: Mapping[str, Array]) -> bool:
    """Whether no single mount explains the torques of several logs of one arm, with a payload each.

    Args:
        several: `q` rad, `qd` rad/s, `tau` N·m, [row, joint].
    """
    return _unexplained([(q, tau) for q, tau in map(_slow, several) if len(q)]) > UNHELD


def _unexplained(parts: Sequence[tuple[Array, Array]]) -> float:
    """Share of the squared torque that gravity leaves unexplained in the best mount, of the worst part.

    Args:
        parts: Angles, rad, and torques, N·m, [row, joint], each with a payload of its own.
    """
    mounts, kg = _mounts(), np.arange(0.0, MOST_PAYLOAD_KG + 0.1, 0.5)
    factors = np.concatenate(np.broadcast_arrays(mounts[:, None], mounts[:, None] * kg[:, None]), axis=-1)
    worst = np.zeros(len(mounts))
    for q, tau in parts:
        terms, torque = gravity_terms(q).reshape(-1, 6), tau.ravel()
        needed = ((factors @ (terms.T @ terms)) * factors).sum(axis=-1)
        left = np.maximum(needed - 2.0 * factors @ (terms.T @ torque) + torque @ torque, 0.0)  # [mount, payload]
        share = left / np.maximum(np.maximum(needed, torque @ torque), 1e-9)
        share[left < len(torque) * UNHELD_NM**2] = 0.0
        worst = np.maximum(worst, share.min(axis=1))
    return float(worst.min(initial=np.inf))


@cache
def _mounts(count: int = 600) -> Array:
    """Evenly distributed directions of gravity (Fibonacci lattice), [mount, 3]."""
    middle = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * middle / count, middle * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])


def _misfit(q: Array, tau: Array) -> float:
    """Share of the squared torque that gravity does not explain, whatever the mount and the payload."""
    terms, torque = gravity_terms(q).reshape(-1, 6), tau.ravel()
    left = torque - terms @ np.linalg.lstsq(terms, torque, rcond=None)[0]
    return float(left @ left / (torque @ torque))


def _alternatives(q: Array, tau: Array) -> Iterator[tuple[Array, Array, str]]:
    orders = [(f"joints {i + 1} and {k + 1} swapped", _swapped(i, k)) for i, k in combinations(range(JOINTS), 2)]
    orders += [("the joints in reverse order", np.arange(JOINTS)[::-1])]
    orders += [(f"the joints shifted by {k}", np.roll(np.arange(JOINTS), k)) for k in range(1, JOINTS)]
    for name, order in orders:
        yield q, tau[:, order], f"the torques of {name}".replace("of the joints", "of joints")
        yield q[:, order], tau[:, order], name
        yield q[:, order], tau, f"the angles of {name}".replace("of the joints", "of joints")
    for j in range(JOINTS):
        sign = np.where(np.arange(JOINTS) == j, -1.0, 1.0)
        yield q, tau * sign, f"the other sign of the torque of joint {j + 1}"
        yield q * sign, tau, f"the other sign of the angle of joint {j + 1}"
    yield np.rad2deg(q), tau, "angles in radians"


def _swapped(i: int, k: int) -> Array:
    order = np.arange(JOINTS)
    order[[i, k]] = k, i
    return order
