"""Posture recovery: a warm arm that holds a payload moves to a nearby posture that its twin rates as easier.

`scenarios.motion.posture_search` proposes the posture. MuJoCo performs it here, and the same hold without recovery from
the same temperatures. In both the arm first observes its motors for `Nearby.watch_s`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import repeat

import numpy as np

from fleet.engine.world import Arm
from fleet.errors import InfeasibleJob
from fleet.job import BOUNDS, Fixture
from fleet.motion import static_drive
from fleet.physics.models import ArmModel
from fleet.planning.random_motions import plan_motion
from fleet.robot import JOINTS
from fleet.thermal import NODES, WINDING, temperature_steps
from scenarios.motion.generate import Verification
from scenarios.motion.perform import Performance, perform
from scenarios.motion.posture_search import Nearby, RecoveryError, Search, holding
from twin.vae.twin import Twin

Array = np.ndarray

MOST_PAYLOAD_KG = 4.5
"""Kinova's rating of a Gen3 without gripper: 4.5 kg at full reach for a while (user guide, technical
specifications)."""
TICK_S = 2.0
"""Time step of temperatures while a hold is performed."""
MOST_HOLD_S = BOUNDS["dwell_s"].high
"""Longest hold that is planned, s."""
LEAST_REST_S = BOUNDS["dwell_s"].low
"""Shortest hold in the new posture, s."""


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
    """Origin of the posture: latent or joint space."""
    hottest: int
    """Hottest motor at the start, index 0..6."""
    difficulty_before: Array
    """One-sided torque difficulty of the hold, [joint], each in [0, 1)."""
    difficulty_after: Array
    tool_m: float
    """Displacement of the tool."""
    passed_over: dict[str, int]
    """Easier candidates that were rejected, by reason."""
    best_error: dict[str, float]
    """Smallest one-sided torque error of the hottest motor, z units, by origin of the candidates."""
    time_s: Array
    """Time since the start of the hold, s, [time]."""
    without_c: Array
    """True winding temperatures without recovery, °C, [time, joint]."""
    with_c: Array
    """The same with recovery, °C, [time, joint]."""
    error_rad: float
    """Largest deviation of a joint from its plan during the recovery."""

    @property
    def moved_rad(self) -> Array:
        """Displacement of each joint, [joint]."""
        return self.q_after - self.q_before

    @property
    def cooled_k(self) -> float:
        """Temperature drop of the hottest motor from start to end."""
        return float(self.with_c[0, self.hottest] - self.with_c[-1, self.hottest])

    @property
    def spared_k(self) -> float:
        """Difference of the hottest motor at the end, without minus with recovery."""
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
    fixtures: Sequence[Fixture] = (),
    seed: int = 0,
) -> Recovery:
    """Find an easier posture near a hold, and perform the hold with and without moving there.

    Args:
        arm: The true arm.
        q: Posture in which it holds the payload, rad, [joint].
        start_c: True temperatures, °C, [node]; the arm measures those of the windings.
        verification: The arm's thermal parameters and the ambient temperature.
        hold_s: Remaining time of the hold.
        fixtures: Boxes that neither the arm nor its payload may touch.

    Raises:
        RecoveryError: the payload, the posture or the time is out of range, the hold is infeasible, or no near posture
            is better.
    """
    near = nearby or Nearby()
    model = ArmModel(arm.robot, fixtures)
    check_hold(model, q, payload_kg)
    check_hold_time(hold_s, near)
    try:
        stay = plan_motion(model, np.stack([q]), dwell_s=[hold_s], payload_kg=payload_kg, speed=near.speed, name="hold")
    except InfeasibleJob as error:
        raise RecoveryError(f"Arm '{arm.robot.name}' cannot hold {payload_kg:g} kg there: {error.reason}.") from error
    on = partial(perform, arm, start_c=start_c, ambient_c=verification.ambient_c, tick_s=TICK_S)
    time_s = np.arange(0.0, hold_s + 1e-9, TICK_S)
    stayed = on(stay)
    before_c, now_c = _held(stayed, np.array([0.0, near.watch_s]))
    search = Search(
        twin, model, verification, near, np.asarray(q, dtype=float), payload_kg, before_c, now_c, hold_s - near.watch_s
    )
    result = search.best(np.random.default_rng(np.random.SeedSequence(seed)))
    recovered = on(result.plan)
    return Recovery(
        arm=arm.robot.name,
        twin_version=twin.version,
        payload_kg=payload_kg,
        q_before=search.q,
        q_after=result.candidate.q,
        origin=result.candidate.origin,
        hottest=search.hottest,
        difficulty_before=holding(twin, model, search.q[None], payload_kg).load[0],
        difficulty_after=holding(twin, model, result.candidate.q[None], payload_kg).load[0],
        tool_m=result.candidate.tool_m,
        passed_over=result.passed_over,
        best_error=result.best_error,
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
    """Raise RecoveryError if the payload or the posture is out of range."""
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


def check_hold_time(hold_s: float, near: Nearby) -> None:
    """Raise RecoveryError if the remaining time of a hold is out of range."""
    if not hold_s - near.watch_s >= LEAST_REST_S:
        raise RecoveryError(
            f"The arm observes its motors for {near.watch_s:g} s before it moves, so the hold must be longer by "
            f"{LEAST_REST_S:g} s or more (got {hold_s:g} s)."
        )
    if hold_s > MOST_HOLD_S:
        raise RecoveryError(f"A hold lasts {MOST_HOLD_S:g} s at most (got {hold_s:g} s).")


def hold_until(
    arm: Arm, q: Array, payload_kg: float, *, ambient_c: float, until_c: float, most_s: float = 7200.0
) -> Array:
    """True temperatures when the hottest motor reaches `until_c` in a hold from a cold start, °C, [node].

    Raises:
        RecoveryError: it stays cooler, or the hold is out of range.
    """
    model, temp_c = ArmModel(arm.robot), np.full(NODES, float(ambient_c))
    check_hold(model, q, payload_kg)
    load = static_drive(model.gravity_torque(q, payload_kg), arm.motors)
    alike = {"motors": arm.motors, "thermal": arm.thermal, "start_c": temp_c, "ambient_c": ambient_c}
    for temp_c in temperature_steps(repeat(load, round(most_s / TICK_S)), TICK_S, **alike):
        if temp_c[WINDING].max() >= until_c:
            return temp_c
    raise RecoveryError(
        f"Arm '{arm.robot.name}' does not get warm: holding {payload_kg:g} kg there for {most_s / 60:g} min heats its "
        f"hottest motor to {temp_c[WINDING].max():.1f} °C, less than {until_c:g} °C. There is nothing to recover from."
    )
