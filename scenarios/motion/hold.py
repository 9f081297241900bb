"""Thermal endurance of a static hold: torque, current, steady temperature and minutes to the limits.

Gravity torque comes from MuJoCo, temperatures from the thermal network. The arm starts cold (everything at ambient
temperature) or idle-warm (powered for hours without load).
"""

from dataclasses import dataclass
from typing import cast, get_args

import msgspec
import numpy as np

from fleet.errors import FleetError, distinguish, nearest
from fleet.heat.motor import Motors, current, gen3_motors, thermal_data
from fleet.heat.thermal import (
    HOUSING,
    NODES,
    WINDING,
    ThermalModel,
    advance,
    drive_heat,
    gen3_network,
    node_heat,
    steady_state,
    thermal_model,
)
from fleet.motion import static_drive
from fleet.robot import GEN3, JOINTS, RATING, Cooling, Robot, ThermalLimits
from scenarios.motion.recover import parse_posture
from scenarios.table import Table

Array = np.ndarray
PerJoint = tuple[float, ...]
MaybePerJoint = tuple[float | None, ...]

LIMITS_C = (ThermalLimits().warning_c, ThermalLimits().error_c)
STEP_S = 2.0
"""Time step; heat is taken at its midpoint, so the error is of second order."""
LONGEST_S = 24 * 3600.0
"""A limit that is not passed within this time counts as never passed."""
BURNT_C = 250.0
"""Where the simulation of a runaway ends: far above every insulation class (H: 180 °C)."""


class HoldError(FleetError):
    """A hold that cannot be computed."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """Effect of a hold on the seven joints from one start."""

    t60_min: MaybePerJoint
    """Minutes until the motor passes the warning limit, 60 °C; None when never."""
    t75_min: MaybePerJoint
    """Minutes until the motor passes the error limit, 75 °C, where the arm faults; None when never."""
    steady_c: MaybePerJoint
    """Steady motor temperature; None for a thermal runaway."""
    torque_nm: PerJoint
    """Holding torque, magnitude."""
    current_a: PerJoint
    """Motor current at the start temperature, magnitude."""


@dataclass(frozen=True, kw_only=True)
class HoldResult:
    """A hold from both starts."""

    payload_kg: float
    posture: str
    q_deg: PerJoint
    ambient_c: float
    cooling: Cooling
    tool_kg: float
    cold: Course
    idle_warm: Course
    note: str
    """Limits of these numbers."""


def hold(
    payload_kg: float,
    posture: str = "outstretched",
    ambient_c: float = 25.0,
    *,
    cooling: str = "still_air",
    tool_kg: float = 0.0,
    beyond_rating: bool = False,
) -> HoldResult:
    """Torque, current and temperatures of a nominal Gen3 on the floor that holds a payload still.

    The command line checks the ranges of the numbers.

    Args:
        payload_kg: A point mass at the flange.
        posture: A name from `fleet.robot.POSTURES`, or seven comma-separated joint angles in degrees.
        tool_kg: Mass of the gripper, at the flange.
        beyond_rating: Accept a load beyond the rating of the Gen3 for a short time.

    Raises:
        HoldError: unknown cooling, the load is beyond the rating, or the hold needs more torque than a motor has.
        PostureError: the posture is unknown, or beyond a joint stop.
    """
    from fleet.arm.model import ArmModel

    if cooling not in get_args(Cooling):
        raise HoldError(f"Unknown cooling '{cooling}'{nearest(cooling, get_args(Cooling))}")
    strategy = cast("Cooling", cooling)
    arm = ArmModel(Robot(name="arm", tool_kg=tool_kg))
    q = parse_posture(posture, arm.position_range)
    tau = arm.gravity_torque(q, payload_kg)
    _check_torque(tau, payload_kg, posture)
    reach_m, load_kg = arm.reach_m(q), payload_kg + tool_kg
    if load_kg > RATING.temporary_kg and not beyond_rating:
        raise HoldError(
            f"{load_kg:g} kg is beyond the rating of the Gen3: {RATING.temporary_kg:g} kg for a short time, "
            f"{RATING.allowed_kg(reach_m, np.inf):.1f} kg continuously at this reach of {reach_m:.2f} m, gripper "
            "included. Make it lighter, or add --beyond-rating."
        )
    cold, idle_warm = courses(tau, ambient_c, thermal_model(gen3_network(cooling=strategy)), gen3_motors())
    return HoldResult(
        payload_kg=payload_kg,
        posture=posture,
        q_deg=_rounded(np.rad2deg(q)),
        ambient_c=ambient_c,
        cooling=strategy,
        tool_kg=tool_kg,
        cold=cold,
        idle_warm=idle_warm,
        note=_note(tau, cold, load_kg, reach_m),
    )


def courses(tau: Array, ambient_c: float, model: ThermalModel, motors: Motors) -> tuple[Course, Course]:
    """Hold with torques, N·m, [joint], from a cold and from an idle-warm start."""
    rest, current_sq = np.zeros(JOINTS), static_drive(tau, motors).current_sq
    end_c = steady_state(model, current_sq, rest, motors, ambient_c)
    start_c = np.stack([np.full(NODES, ambient_c), model.steady(node_heat(rest, motors.idle_w), ambient_c)])
    minutes = passing_times(model, current_sq, motors, ambient_c, start_c, end_c) / 60.0
    cold, idle_warm = (
        Course(
            t60_min=_rounded_or_none(minutes[s, 0]),
            t75_min=_rounded_or_none(minutes[s, 1]),
            steady_c=_rounded_or_none(np.full(JOINTS, np.inf) if end_c is None else end_c[WINDING]),
            torque_nm=_rounded(np.abs(tau)),
            current_a=_rounded(np.abs(current(tau, rest, start_c[s, HOUSING], motors))),
        )
        for s in range(2)
    )
    return cold, idle_warm


def passing_times(
    model: ThermalModel, current_sq: Array, motors: Motors, ambient_c: float, start_c: Array, end_c: Array | None
) -> Array:
    """When each winding passes each of `LIMITS_C`, s, [start, limit, joint]; infinite where it never does.

    From a start below the steady state a constant load only heats, so a limit is passed at most once, and exactly when
    the steady temperature lies above it.

    Args:
        current_sq: Squared current at the magnets' reference temperature, A², [joint].
        start_c: °C, [start, node].
        end_c: Steady temperatures, °C, [node]; None for a runaway, which is simulated until `BURNT_C`.
    """
    limits_c = np.array(LIMITS_C)[:, None]  # [limit, joint]
    times_s = np.where(start_c[:, None, WINDING] >= limits_c, 0.0, np.inf)
    to_come = np.broadcast_to(np.inf if end_c is None else end_c[WINDING], times_s.shape) > limits_c
    no_friction_w = np.zeros(JOINTS)
    half, full = model.step_matrices(STEP_S / 2), model.step_matrices(STEP_S)
    temp_c = start_c
    for step in range(round(LONGEST_S / STEP_S)):
        burnt = temp_c.max(axis=1) > BURNT_C if end_c is None else np.zeros(len(temp_c), bool)  # [start]
        if not np.any((to_come & np.isinf(times_s))[~burnt]):
            break
        heat = drive_heat(temp_c, current_sq, no_friction_w, motors)
        middle_c = advance(temp_c, heat, ambient_c, *half, model.to_ambient)
        heat = drive_heat(middle_c, current_sq, no_friction_w, motors)
        next_c = np.where(burnt[:, None], temp_c, advance(temp_c, heat, ambient_c, *full, model.to_ambient))
        before, after = temp_c[:, None, WINDING], next_c[:, None, WINDING]
        passed = (before < limits_c) & (after >= limits_c)
        share = (limits_c - before) / np.where(passed, after - before, 1.0)
        times_s = np.where(passed, (step + share) * STEP_S, times_s)
        temp_c = next_c
    return times_s


def as_json(result: HoldResult) -> dict[str, object]:
    """The result as plain values: lists of 7 (joint 1 first), null for never."""
    plain = msgspec.json.decode(msgspec.json.encode(result))
    return {"payload": plain.pop("payload_kg"), **plain}


def as_table(result: HoldResult) -> Table:
    """The result for people: one row per joint."""
    tool = f" and a tool of {result.tool_kg:g} kg" if result.tool_kg else ""
    cold, warm = result.cold, result.idle_warm
    rows = tuple(
        (
            str(j + 1),
            f"{cold.torque_nm[j]:.1f}",
            f"{cold.current_a[j]:.2f} | {warm.current_a[j]:.2f}",
            _cell(cold.steady_c[j]),
            f"{_cell(cold.t60_min[j])} | {_cell(warm.t60_min[j])}",
            f"{_cell(cold.t75_min[j])} | {_cell(warm.t75_min[j])}",
        )
        for j in range(JOINTS)
    )
    return Table(
        caption=f"Holding {result.payload_kg:g} kg{tool}, {result.posture}, {result.ambient_c:g} °C, {result.cooling}",
        head=("joint", "torque N·m", "current A", "settles °C", "min to 60 °C", "min to 75 °C"),
        rows=rows,
        notes=(result.note, "Minutes from a cold start | from idle-warm; – is never."),
    )


def _check_torque(tau: Array, payload_kg: float, posture: str) -> None:
    clip = np.array(GEN3.torque_clip)
    for j in np.flatnonzero(np.abs(tau) > clip):
        needed, most = distinguish(abs(tau[j]), clip[j])
        raise HoldError(
            f"Holding {payload_kg:g} kg in posture '{posture}' takes {needed} N·m at joint {j + 1}; its motor gives at "
            f"most {most} N·m."
        )


def _note(tau: Array, course: Course, load_kg: float, reach_m: float) -> str:
    limit_c = thermal_data()["identified_below_c"]
    sentences = [
        f"Above {limit_c:g} °C the model extrapolates: it was identified on logs of a real arm that stayed below."
    ]
    continuous_kg = RATING.allowed_kg(reach_m, np.inf)
    if load_kg > continuous_kg:
        load, rating = distinguish(load_kg, continuous_kg, 3)
        sentences.append(f"{load} kg at {reach_m:.2f} m reach is above the continuous rating of {rating} kg.")
    warning = np.array(GEN3.torque_warning)
    sentences += [
        "Joint {} needs {} N·m, above the arm's torque warning of {} N·m.".format(
            j + 1, *distinguish(abs(tau[j]), warning[j])
        )
        for j in np.flatnonzero(np.abs(tau) > warning)
    ]
    if course.steady_c[0] is None:
        sentences.append(
            "The hold has no steady temperature, because copper loss grows faster than cooling. "
            f"The simulation ends when a motor reaches {BURNT_C:g} °C."
        )
    return " ".join(sentences)


def _rounded(values: Array) -> PerJoint:
    return tuple(round(float(value), 3) for value in values)


def _rounded_or_none(values: Array) -> MaybePerJoint:
    return tuple(round(float(value), 3) if np.isfinite(value) else None for value in values)


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
