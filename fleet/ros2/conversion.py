"""Convert between messages of this bus and those of ROS 2: joint states and diagnostics.

A JointState has no temperatures. Those are diagnostics, written and read in one way: a status whose `hardware_id` ends
with the name of the joint, with the value `temperature_c`.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite, isnan

from fleet.bus.protocol.messages import DifficultyScores, MalformedMessage, State
from fleet.robot import ThermalLimits

OK, WARN, ERROR, STALE = range(4)
"""Levels of a diagnostic_msgs/DiagnosticStatus."""
TEMPERATURE = "temperature_c"
"""Key of a motor's temperature, °C."""
MAX_JOBS = 256
"""Jobs in one status."""


@dataclass(frozen=True)
class Joints:
    """Content of a sensor_msgs/JointState; lists are empty where nothing is measured."""

    time_s: float
    names: tuple[str, ...]
    q: tuple[float, ...] = ()
    """rad, [joint], in the order of the names."""
    qd: tuple[float, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[float, ...] = ()
    """N·m, [joint]."""


@dataclass(frozen=True)
class Diagnostic:
    """Content of a diagnostic_msgs/DiagnosticStatus."""

    level: int
    name: str
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...] = ()


def joint_names(joints: int) -> tuple[str, ...]:
    """Joint names of Kinova: `joint_1` …"""
    return tuple(f"joint_{number}" for number in range(1, joints + 1))


def joints_of(state: State) -> Joints:
    """Joint state of an arm of the fleet."""
    return Joints(state.time_s, joint_names(len(state.temp_c)), state.q, state.qd, state.tau)


def in_order(joints: Joints, names: tuple[str, ...]) -> Joints | None:
    """Select the named joints, in that order; None without any of them: a topic may have other publishers.

    A velocity or effort that is NaN for every named joint counts as not measured: ros2_control writes so.

    Raises:
        MalformedMessage: a joint is missing or named twice, it has no positions, or a value is not finite.
    """
    at = {name: index for index, name in enumerate(joints.names)}
    missing = [name for name in names if name not in at]
    if len(missing) == len(names):
        return None
    if missing:
        raise MalformedMessage(f"A JointState has {', '.join(sorted(at))}, but not {', '.join(missing)}.")
    if twice := [name for name in names if joints.names.count(name) > 1]:
        raise MalformedMessage(f"A JointState names {', '.join(twice)} twice.")
    if not joints.q:
        raise MalformedMessage(f"A JointState has no position of {', '.join(names)}.")
    selected: dict[str, tuple[float, ...]] = {}
    for field, ros_field in _FIELDS.items():
        values = getattr(joints, field)
        selected[field] = tuple(values[at[name]] for name in names) if values else ()
        if field != "q" and all(map(isnan, selected[field])):
            selected[field] = ()
        for name, value in zip(names, selected[field], strict=False):
            if not isfinite(value):
                raise MalformedMessage(f"A JointState has {value} for {ros_field} of {name}.")
    return Joints(joints.time_s, names, **selected)


_FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


def diagnostics_of(
    fleet: str, state: State, difficulty: DifficultyScores | None, limits: ThermalLimits, age_s: float, stale_s: float
) -> tuple[Diagnostic, ...]:
    """Diagnostics of an arm: one status of the arm, one of each motor, and one of its difficulties.

    Args:
        age_s: Age of the state, real seconds; above `stale_s` it is stale.
    """
    arm = f"{fleet}/{state.arm}"
    stale = f"no state for {age_s:.1f} s" if age_s > stale_s else ""
    whole = Diagnostic(
        STALE if stale else ERROR if state.mode == "faulted" else OK,
        f"{arm}: arm",
        stale or state.mode,
        arm,
        (("mode", state.mode), ("job", state.job), ("headroom_k", repr(state.headroom_k))),
    )
    names = joint_names(len(state.temp_c))
    motors = (_motor(arm, name, temp_c, limits, stale) for name, temp_c in zip(names, state.temp_c, strict=True))
    return (whole, *motors, *([] if difficulty is None else [_difficulty(arm, difficulty, stale)]))


def _motor(arm: str, name: str, temp_c: float, limits: ThermalLimits, stale: str) -> Diagnostic:
    if temp_c >= limits.error_c:
        level, text = ERROR, f"above the error limit of {limits.error_c:g} °C"
    elif temp_c >= limits.warning_c:
        level, text = WARN, f"above the warning limit of {limits.warning_c:g} °C"
    else:
        level, text = OK, f"{limits.warning_c - temp_c:.1f} K below the warning limit"
    values = ((TEMPERATURE, repr(temp_c)), ("headroom_k", repr(limits.warning_c - temp_c)))
    message = stale or f"{temp_c:.1f} °C, {text}"
    return Diagnostic(STALE if stale else level, f"{arm}: {name}", message, f"{arm}/{name}", values)


def _difficulty(arm: str, scores: DifficultyScores, stale: str) -> Diagnostic:
    scored = list(zip(scores.jobs, scores.difficulty, scores.p_saturation, strict=True))[:MAX_JOBS]
    values = [("twin", scores.twin), ("time_s", repr(scores.time_s))]
    for job, difficulty, p_saturation in scored:
        values += [(f"d {job}", _number(difficulty)), (f"p_saturation {job}", _number(p_saturation))]
    known = [(difficulty, job) for job, difficulty, _ in scored if difficulty is not None]
    easiest = f", the easiest {min(known)[1]}" if known else ""
    message = stale or f"{len(scores.jobs)} job(s) on offer{easiest}"
    return Diagnostic(STALE if stale else OK, f"{arm}: difficulty", message, arm, tuple(values))


def _number(value: float | None) -> str:
    return "unknown" if value is None else repr(value)


def temperatures(
    diagnostics: Iterable[Diagnostic], names: tuple[str, ...], hardware: str
) -> tuple[Mapping[str, float], tuple[str, ...]]:
    """Motor temperatures by joint, °C, as far as the diagnostics have them, and a sentence on each unusable one.

    Args:
        hardware: Text before the joint's name in `hardware_id`, without the `/`; "" for none.
    """
    wanted = {f"{hardware}/{name}" if hardware else name: name for name in names}
    texts: dict[str, list[str]] = {}
    for status in diagnostics:
        if status.hardware in wanted and status.level != STALE:
            texts.setdefault(status.hardware, []).extend(text for key, text in status.values if key == TEMPERATURE)
    temp_c: dict[str, float] = {}
    faults: list[str] = []
    for joint, given in texts.items():
        if len(given) > 1:
            faults.append(f"A DiagnosticArray has {len(given)} values of {TEMPERATURE} of {joint}.")
        elif given and not _is_finite(given[0]):
            faults.append(f"The {TEMPERATURE} of {joint} is no number: '{given[0][:40]}'.")
        elif given:
            temp_c[wanted[joint]] = float(given[0])
    return temp_c, tuple(faults)


_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)
"""As a temperature is written; `float` also reads `4_1.5`, `nan` and digits of other scripts."""


def _is_finite(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None and isfinite(float(text))


def plain_name(name: str) -> str:
    """Make any name one part of a topic: other characters become `_`, so different names may give the same."""
    allowed = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name)).strip("_")
    return allowed if allowed[:1].isalpha() else f"n{allowed}"
