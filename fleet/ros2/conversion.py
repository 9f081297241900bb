"""Between the words of this bus and what ROS 2 says of an arm: joint states and diagnostics. No bytes here.

A JointState has no temperature, so those travel as diagnostics: a status whose `hardware_id` ends with the name of the
joint, with the value `temperature_c`. What is written so is also how it is read.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite, isnan

from fleet.bus.protocol.messages import DifficultyScores, MalformedMessage, State
from fleet.robot import ThermalLimits

OK, WARN, ERROR, STALE = range(4)
"""Levels of a diagnostic_msgs/DiagnosticStatus."""
TEMPERATURE = "temperature_c"
"""Key under which a motor's temperature stands, °C."""
MOST_JOBS = 256
"""In one status."""


@dataclass(frozen=True)
class Joints:
    """What a sensor_msgs/JointState says; lists are empty where nothing is measured."""

    time_s: float
    names: tuple[str, ...]
    q: tuple[float, ...] = ()
    """rad, [joint]; the order is that of the names."""
    qd: tuple[float, ...] = ()
    """rad/s, [joint]."""
    tau: tuple[float, ...] = ()
    """N·m, [joint]."""


@dataclass(frozen=True)
class Diagnostic:
    """A diagnostic_msgs/DiagnosticStatus."""

    level: int
    name: str
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...] = ()


def joint_names(joints: int) -> tuple[str, ...]:
    """`joint_1` … as Kinova calls them."""
    return tuple(f"joint_{number}" for number in range(1, joints + 1))


def joints_of(state: State) -> Joints:
    """The joint state of an arm of ours."""
    return Joints(state.time_s, joint_names(len(state.temp_c)), state.q, state.qd, state.tau)


def in_order(joints: Joints, names: tuple[str, ...]) -> Joints | None:
    """The joints named, in that order; None where there is none of them: others speak under the same topic.

    A velocity or effort that is NaN for every joint named counts as not measured: ros2_control writes so.

    Raises:
        MalformedMessage: one of the joints is missing or named twice, or a value of theirs is not finite.
    """
    at = {name: index for index, name in enumerate(joints.names)}
    missing = [name for name in names if name not in at]
    if len(missing) == len(names):
        return None
    if missing:
        raise MalformedMessage(f"A JointState has {', '.join(sorted(at))}, but not {', '.join(missing)}.")
    twice = [name for name in names if joints.names.count(name) > 1]
    if twice:
        raise MalformedMessage(f"A JointState names {', '.join(twice)} twice.")
    taken: dict[str, tuple[float, ...]] = {}
    for field in ("q", "qd", "tau"):
        values = getattr(joints, field)
        taken[field] = tuple(values[at[name]] for name in names) if values else ()
        if field != "q" and all(isnan(value) for value in taken[field]):
            taken[field] = ()
        for name, value in zip(names, taken[field], strict=False):
            if not isfinite(value):
                raise MalformedMessage(f"A JointState says {value} for {_FIELDS[field]} of {name}.")
    return Joints(joints.time_s, names, **taken)


_FIELDS = {"q": "position", "qd": "velocity", "tau": "effort"}


def diagnostics_of(
    fleet: str, state: State, difficulty: DifficultyScores | None, limits: ThermalLimits, age_s: float, stale_s: float
) -> tuple[Diagnostic, ...]:
    """How an arm of ours is: one status for it, one per motor, one for what it finds difficult.

    Args:
        age_s: Of the state, real seconds; older than `stale_s` is stale.
    """
    arm = f"{fleet}/{state.arm}"
    stale = f"nothing heard for {age_s:.1f} s" if age_s > stale_s else ""
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
        level, words = ERROR, f"above the error limit of {limits.error_c:g} °C"
    elif temp_c >= limits.warning_c:
        level, words = WARN, f"above the warning limit of {limits.warning_c:g} °C"
    else:
        level, words = OK, f"{limits.warning_c - temp_c:.1f} K below the warning limit"
    values = ((TEMPERATURE, repr(temp_c)), ("headroom_k", repr(limits.warning_c - temp_c)))
    message = stale or f"{temp_c:.1f} °C, {words}"
    return Diagnostic(STALE if stale else level, f"{arm}: {name}", message, f"{arm}/{name}", values)


def _difficulty(arm: str, word: DifficultyScores, stale: str) -> Diagnostic:
    scored = list(zip(word.jobs, word.difficulty, word.p_saturation, strict=True))[:MOST_JOBS]
    values = [("twin", word.twin), ("time_s", repr(word.time_s))]
    for job, difficulty, p_saturation in scored:
        values += [(f"d {job}", _number(difficulty)), (f"p_saturation {job}", _number(p_saturation))]
    known = [(difficulty, job) for job, difficulty, _ in scored if difficulty is not None]
    easiest = f", the easiest {min(known)[1]}" if known else ""
    message = stale or f"{len(word.jobs)} job(s) on offer{easiest}"
    return Diagnostic(STALE if stale else OK, f"{arm}: difficulty", message, arm, tuple(values))


def _number(value: float | None) -> str:
    return "unknown" if value is None else repr(value)


def temperatures(diagnostics: Iterable[Diagnostic], names: tuple[str, ...], hardware: str) -> Mapping[str, float]:
    """Motor temperatures by joint, °C, as far as the diagnostics tell them.

    Args:
        hardware: What stands before the joint's name in `hardware_id`, without the `/`; "" for nothing.

    Raises:
        MalformedMessage: a temperature is no finite number.
    """
    wanted = {f"{hardware}/{name}" if hardware else name: name for name in names}
    found: dict[str, float] = {}
    for status in diagnostics:
        name = wanted.get(status.hardware)
        said = dict(status.values).get(TEMPERATURE)
        if name is None or said is None or status.level == STALE:
            continue
        try:
            found[name] = float(said)
        except ValueError as error:
            raise MalformedMessage(f"The {TEMPERATURE} of {status.hardware} is no number: '{said[:40]}'.") from error
        if not isfinite(found[name]):
            raise MalformedMessage(f"The {TEMPERATURE} of {status.hardware} is {said}.")
    return found
