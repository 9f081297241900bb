"""Posture recovery: a warm arm that holds a payload moves to a nearby posture which its twin finds easier.

What is proposed comes from `scenarios.posture_search`; here it is performed in MuJoCo, beside the same hold without
recovery, from the same temperatures. Both begin with watching the motors for `Nearby.watch_s`.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from fleet.errors import InfeasibleJob
from fleet.motion import Plan
from fleet.motor import reference_current
from fleet.robot import JOINTS
from fleet.sim.exercise import exercise
from fleet.sim.models import ArmModel
from fleet.sim.world import Arm
from fleet.thermal import NODES, WINDING, advance, drive_heat
from scenarios.generate import Verification
from scenarios.perform import Performance, perform
from scenarios.posture_search import Nearby, RecoveryError, Search, holding
from twin.score import Twin

Array = np.ndarray

MOST_PAYLOAD_KG = 4.5
"""Kinova's rating of a Gen3 without gripper: 4.5 kg at full reach for a while (user guide, technical
specifications)."""
TICK_S = 2.0
"""How often heat follows temperature while a hold is performed."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """A hold with and without recovery, both performed from the same temperatures."""

    arm: str
    twin_version: str
    payload_kg: float
    q_before: Array
    """rad, [joint]."""
    q_after: Array
    """rad, [joint]."""
    origin: str
    """Where the posture came from: latent or joint space."""
    hottest: int
    """The motor that was hottest, index 0..6."""
    difficulty_before: Array
    """One-sided torque difficulty of holding there, [joint], each in [0, 1)."""
    difficulty_after: Array
    tool_m: float
    """How far the tool moved."""
    passed_over: dict[str, int]
    """Easier candidates that were not taken, by reason."""
    best_error: dict[str, float]
    """Least one-sided torque error of the hottest motor, z units, by where candidates came from."""
    time_s: Array
    """Since the arm began to hold, s, [time]."""
    without_c: Array
    """True winding temperatures of going on, °C, [time, joint]."""
    with_c: Array
    """The same with the recovery, which the arm leaves for after watching, °C, [time, joint]."""
    error_rad: float
    """Farthest that a joint was from its plan while the recovery was performed."""

    @property
    def moved_rad(self) -> Array:
        """How far each joint turned, [joint]."""
        return self.q_after - self.q_before

    @property
    def cooled_k(self) -> float:
        """By how much the motor that was hottest is cooler in the end than at the beginning."""
        return float(self.with_c[0, self.hottest] - self.with_c[-1, self.hottest])

    @property
    def spared_k(self) -> float:
        """By how much the hottest motor of all is cooler in the end than without recovery."""
        return float(self.without_c[-1].max() - self.with_c[-1].max())


def recover(
    twin: Twin,
    arm: Arm,
    q: Array,
    payload_kg: float,
    *,
    start_c: Array,
    verification: Verification,
    hold_s: float = 600.0,
    nearby: Nearby | None = None,
    seed: int = 0,
) -> Recovery:
    """Propose an easier posture near a hold, and perform the hold with and without going there.

    Args:
        arm: The true arm.
        q: Posture in which it holds the payload, rad, [joint].
        start_c: True temperatures, °C, [node]; the arm itself knows those of the windings.
        verification: What the arm knows of its heat, and the air.
        hold_s: How long it has still to hold.

    Raises:
        RecoveryError: the payload, the posture or the time is out of range, the hold itself cannot be done, or
            nothing near is better; says which.
    """
    near = nearby or Nearby()
    model = ArmModel(arm.robot)
    check_hold(model, q, payload_kg)
    if not hold_s > near.watch_s:
        raise RecoveryError(
            f"The arm watches its motors for {near.watch_s:g} s before it goes, so it must have longer to hold than "
            f"that (got {hold_s:g} s)."
        )
    stay = _exercise(model, [q], [hold_s], payload_kg, near.speed)
    on = partial(perform, arm, start_c=start_c, ambient_c=verification.ambient_c, tick_s=TICK_S)
    time_s = np.arange(0.0, hold_s + 1e-9, TICK_S)
    stayed = on(stay)
    before_c, now_c = _held(stayed, np.array([0.0, near.watch_s]))
    search = Search(
        twin, model, verification, near, np.asarray(q, dtype=float), payload_kg, before_c, now_c, hold_s - near.watch_s
    )
    found = search.best(np.random.default_rng(np.random.SeedSequence(seed)))
    recovered = on(found.plan)
    return Recovery(
        arm=arm.robot.name,
        twin_version=twin.version,
        payload_kg=payload_kg,
        q_before=search.q,
        q_after=found.candidate.q,
        origin=found.candidate.origin,
        hottest=search.hottest,
        difficulty_before=holding(twin, model, search.q[None], payload_kg).load[0],
        difficulty_after=holding(twin, model, found.candidate.q[None], payload_kg).load[0],
        tool_m=found.candidate.tool_m,
        passed_over=found.passed_over,
        best_error=found.best_error,
        time_s=time_s,
        without_c=_held(stayed, time_s),
        with_c=_held(recovered, time_s),
        error_rad=recovered.error_rad,
    )


def _held(run: Performance, time_s: Array) -> Array:
    """Winding temperatures at times since the arm began to hold, °C, [time, joint]."""
    since_s = run.time_s - run.plan.approach.duration_s
    return np.stack([np.interp(time_s, since_s, temp_c) for temp_c in run.temp_c.T], axis=1)


def check_hold(model: ArmModel, q: Array, payload_kg: float) -> None:
    """Refuse a hold that is out of range.

    Raises:
        RecoveryError: says what is allowed.
    """
    if not 0 <= payload_kg <= MOST_PAYLOAD_KG:
        raise RecoveryError(f"A Gen3 is rated for a payload of 0 … {MOST_PAYLOAD_KG:g} kg (got {payload_kg:g}).")
    posture = np.asarray(q, dtype=float)
    if posture.shape != (JOINTS,) or not np.isfinite(posture).all():
        raise RecoveryError(f"A posture is {JOINTS} finite joint angles, rad (got {q}).")
    low, high = model.position_range.T
    for j in np.flatnonzero((posture < low) | (posture > high)):
        raise RecoveryError(
            f"Joint {j + 1} turns from {low[j]:.2f} to {high[j]:.2f} rad, so the arm cannot hold at {posture[j]:.2f}."
        )


def warmed(arm: Arm, q: Array, payload_kg: float, *, ambient_c: float, until_c: float, most_s: float = 7200.0) -> Array:
    """True temperatures when a hold from a cold start has brought its hottest motor to `until_c`, °C, [node].

    Raises:
        RecoveryError: it never gets so warm, or the hold is out of range.
    """
    model = ArmModel(arm.robot)
    check_hold(model, q, payload_kg)
    tau, temp_c = model.gravity_torque(q, payload_kg), np.full(NODES, float(ambient_c))
    rest = np.zeros(JOINTS)
    current_sq = reference_current(tau, rest, arm.motors) ** 2
    phi, gamma = arm.thermal.step_matrices(TICK_S)
    for _ in range(round(most_s / TICK_S)):
        if temp_c[WINDING].max() >= until_c:
            return temp_c
        heat_w = drive_heat(temp_c, current_sq, rest, arm.motors)
        temp_c = advance(temp_c, heat_w, ambient_c, phi, gamma, arm.thermal.to_ambient)
    raise RecoveryError(
        f"Arm '{arm.robot.name}' does not get warm: holding {payload_kg:g} kg there for {most_s / 60:g} min heats its "
        f"hottest motor to {temp_c[WINDING].max():.1f} °C, less than {until_c:g} °C. Nothing to recover from."
    )


def _exercise(model: ArmModel, stops: list[Array], dwell_s: list[float], payload_kg: float, speed: float) -> Plan:
    try:
        return exercise(model, np.stack(stops), dwell_s=dwell_s, payload_kg=payload_kg, speed=speed, name="hold")
    except InfeasibleJob as error:
        raise RecoveryError(f"Arm '{model.robot.name}' cannot hold {payload_kg:g} kg there: {error.reason}.") from error
