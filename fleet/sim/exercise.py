"""Jobs in joint space: motion between given or drawn postures as real plans, quick to make in great numbers.

A planner answers "how would this arm do that work"; here the work is whatever the postures amount to. The draws are
the natural mix of work on which a twin is judged, and light motions of other kinds: rehearsal explores with them.
"""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fleet.errors import FleetError, InfeasibleJob
from fleet.job import Place, Work
from fleet.motion import Phase, Plan
from fleet.robot import JOINTS, POSTURES, Robot, angles_deg
from fleet.sim.clearance import CLEARANCE_STEP_RAD, Clearance
from fleet.sim.itinerary import GRASP_S
from fleet.sim.limits import broken_limit
from fleet.sim.models import ArmModel
from fleet.sim.trajectory import Motion, joined, line, move, rest

Array = np.ndarray
log = logging.getLogger(__name__)

EXERCISE_VERSION = 1
"""Raised whenever the same draw would give another motion."""
MOST_DRAWS = 50
"""Per wanted job; where more fail, the arm hardly has room to move."""


NATURAL_MIX = (0.4, 0.3, 0.3)
"""Shares of going to and fro, of the same with a wait at the end under load, and of holds."""

REACH = (0.6, 0.6)
"""Beta distribution of the reach, 0 near, 1 nearly outstretched: cells are laid out for either, less often between."""
FOLDED = np.array([0.0, -0.35, np.pi, -2.35, 0.0, -0.87, 1.57])
"""Near Kinova's `retract`, far enough from the stop of joint 4 to move."""
_SCATTER = np.array([1.2, 0.25, 0.3, 0.3, 0.4, 0.6, 0.8])


@dataclass(frozen=True, eq=False)
class _Leg:
    motion: Motion
    payload_kg: float
    to: int | None
    """Stop at which it ends; None is home."""


def exercise(
    arm: ArmModel,
    stops: Array,
    *,
    dwell_s: float | Sequence[float] | Array,
    payload_kg: float,
    speed: float,
    name: str = "exercise",
) -> Plan:
    """The plan of going from stop to stop and back to the first, on straight lines in joint space, from and to home.

    One stop is a hold: the payload is taken up at the end of the approach and let go in the retreat. With more, it is
    carried from the end of the first dwell to the end of the last, and the way back is empty, as in a sort.

    Args:
        stops: Postures, rad, [stop, joint].
        dwell_s: Standstill at each stop, > 0, one for all or one per stop; of a hold, how long one repetition lasts.
        payload_kg: Point mass at the flange.
        speed: Share of the joint limits, (0, 1].
        name: Its places are called `{name}/stop_1` and so on.

    Raises:
        InfeasibleJob: the way runs into the floor or the arm's own base, or breaks a joint stop or a torque limit.
        ValueError: an argument is out of range.
    """
    stops = np.asarray(stops, dtype=float)
    dwell = _checked_dwell(stops, dwell_s)
    if not 0 < speed <= 1:
        raise ValueError(f"The speed of an exercise is a share of the limits in (0, 1] (got {speed}).")
    if not 0 <= payload_kg < np.inf:
        raise ValueError(f"The payload of an exercise must be >= 0 (got {payload_kg}).")
    places = _places(arm, stops, name)
    work = _work(places, payload_kg, dwell)
    _check_way(arm, stops, places)
    phases = [_phase(arm, legs, places) for legs in _legs(arm.robot.home_q(), stops, dwell, payload_kg, speed)]
    return Plan(arm.robot.name, work, 0, speed, *phases)


def random_jobs(
    robot: Robot, count: int, rng: np.random.Generator, *, payload_kg: tuple[float, float] = (0.0, 4.0), name: str = ""
) -> tuple[Plan, ...]:
    """So many jobs of the natural mix: from pick to place and back, payload, speed and reach at random.

    Some wait 4 to 15 s over the far place with the payload in the hand, some only hold it. Of the jobs of a nominal
    Gen3 with a gripper of 0.9 kg at 23 °C, repeated for half an hour, a third stays below 40 °C and a fifth passes
    60 °C, first in joint 2.

    Args:
        payload_kg: Least and most.
        name: Begins the names of the jobs' places; `job` by default.
    """
    arm = ArmModel(robot)
    return _drawn(arm, count, name or "job", lambda label: _natural(arm, rng, payload_kg, label))


def light_jobs(robot: Robot, count: int, rng: np.random.Generator, *, name: str = "") -> tuple[Plan, ...]:
    """So many light motions unlike the natural mix, with at most 0.5 kg: folded, elbow out, fast wrist, turned base.

    Of a nominal Gen3 on the floor at 23 °C they all stay below 40 °C over half an hour.

    Args:
        name: Begins the names of the jobs' places; `light` by default.
    """
    arm = ArmModel(robot)
    return _drawn(arm, count, name or "light", lambda label: _light(arm, rng, label))


def _drawn(arm: ArmModel, count: int, name: str, draw: Callable[[str], Plan]) -> tuple[Plan, ...]:
    """Feasible draws; what is not is drawn again and counted."""
    if count < 0:
        raise ValueError(f"The number of jobs must be >= 0 (got {count}).")
    plans: list[Plan] = []
    refused: Counter[str] = Counter()
    while len(plans) < count:
        try:
            plans.append(draw(f"{name}_{len(plans) + 1}"))
        except InfeasibleJob as error:
            refused[error.reason.split(":")[0]] += 1
        if refused.total() > MOST_DRAWS * count:
            raise FleetError(
                f"Arm '{arm.robot.name}' can do {len(plans)} of {len(plans) + refused.total()} drawn motions "
                f"({_listed(refused)}); give its mount more room."
            )
    log.debug("Arm %s: %d jobs drawn, %d drawn again (%s).", arm.robot.name, count, refused.total(), _listed(refused))
    return tuple(plans)


def _listed(refused: Counter[str]) -> str:
    return ", ".join(f"{reason} {times}" for reason, times in refused.most_common()) or "none refused"


def _natural(arm: ArmModel, rng: np.random.Generator, payload_kg: tuple[float, float], name: str) -> Plan:
    kind = rng.choice(("sort", "wait", "hold"), p=NATURAL_MIX)
    stops = _reaching(rng, 1 if kind == "hold" else 2)
    dwell = rng.uniform(0.3, 1.0, len(stops))
    if kind == "wait":
        dwell[-1] = rng.uniform(4.0, 15.0)
    if kind == "hold":
        dwell[-1] = rng.uniform(10.0, 40.0)
    speed = rng.uniform(0.3, 1.0)
    return exercise(arm, stops, dwell_s=dwell, payload_kg=rng.uniform(*payload_kg), speed=speed, name=name)


def _reaching(rng: np.random.Generator, count: int) -> Array:
    """Postures in front of the arm, all about as far from it, elbow up, rad, [posture, joint]."""
    near = np.array([0.0, 0.0, np.pi, -2.1, 0.0, 0.9, 1.57])
    far = np.array([0.0, 1.4, np.pi, -0.3, 0.0, 0.9, 1.57])
    return near + rng.beta(*REACH) * (far - near) + rng.uniform(-1.0, 1.0, (count, JOINTS)) * _SCATTER


def _light(arm: ArmModel, rng: np.random.Generator, name: str) -> Plan:
    kind = rng.integers(4)
    stops = (_folded, _elbow_out, _wrist, _turned)[kind](rng)
    return exercise(
        arm,
        stops,
        dwell_s=rng.uniform(0.5, 2.0, len(stops)),
        payload_kg=rng.uniform(0.0, 0.5),
        speed=rng.uniform(0.3, 0.8),
        name=name,
    )


def _around(rng: np.random.Generator, posture: Array, width: Sequence[float], count: int = 2) -> Array:
    return posture + rng.uniform(-1.0, 1.0, (count, JOINTS)) * np.array(width)


def _folded(rng: np.random.Generator) -> Array:
    return _around(rng, FOLDED, (0.8, 0.25, 0.3, 0.15, 0.8, 0.5, 1.5))


def _elbow_out(rng: np.random.Generator) -> Array:
    posture = np.array(POSTURES["home"])
    posture[2] += rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.5)
    return _around(rng, posture, (0.6, 0.2, 0.25, 0.25, 0.6, 0.4, 0.8))


def _wrist(rng: np.random.Generator) -> Array:
    """One posture of the arm, and the hand turned far to and fro."""
    posture = _around(rng, np.array(POSTURES["home"]), (1.0, 0.2, 0.2, 0.2, 0.0, 0.0, 0.0), 1)
    return _around(rng, posture[0], (0.0, 0.0, 0.0, 0.0, 1.2, 0.9, 2.0))


def _turned(rng: np.random.Generator) -> Array:
    posture = np.array(POSTURES["home"])
    posture[0] += rng.choice([-1.0, 1.0]) * rng.uniform(1.8, 2.8)
    return _around(rng, posture, (0.4, 0.2, 0.2, 0.2, 0.3, 0.4, 0.8))


def _checked_dwell(stops: Array, dwell_s: float | Sequence[float] | Array) -> Array:
    """Standstill per stop, s, [stop]."""
    if stops.ndim != 2 or stops.shape[1] != JOINTS or len(stops) == 0 or not np.isfinite(stops).all():
        raise ValueError(f"The stops of an exercise must be finite [stop, {JOINTS}], at least one (got {stops.shape}).")
    dwell = np.asarray(dwell_s, dtype=float)
    if dwell.shape not in ((), (len(stops),)) or not (np.isfinite(dwell) & (dwell > 0)).all():
        raise ValueError(f"dwell_s must be > 0, one for all {len(stops)} stops or one each (got {dwell_s}).")
    return np.broadcast_to(dwell, len(stops))


def _places(arm: ArmModel, stops: Array, name: str) -> tuple[Place, ...]:
    poses = [arm.tool_pose(q) for q in stops]
    return tuple(
        Place(
            name=f"{name}/stop_{i}",
            position_m=(float(x[0]), float(x[1]), float(x[2])),
            tool_deg=angles_deg(turned),
            retreat_m=0.0,
        )
        for i, (x, turned) in enumerate(poses, start=1)
    )


def _work(places: tuple[Place, ...], payload_kg: float, dwell: Array) -> Work:
    ends = places if len(places) == 1 else (places[0], places[-1])
    kind = "hold" if len(places) == 1 else "sort"
    return Work(kind=kind, places=ends, payload_kg=float(payload_kg), dwell_s=float(dwell.max()))


def _check_way(arm: ArmModel, stops: Array, places: tuple[Place, ...]) -> None:
    # Straight lines between postures within the joint stops keep within them.
    clearance = Clearance(arm)
    low, high = arm.position_range.T
    for i, stop in enumerate(stops):
        if ((stop < low) | (stop > high)).any():
            joint = int(np.argmax(np.maximum(low - stop, stop - high)))
            reason = f"joint limit: joint_{joint + 1} would stand at {stop[joint]:.2f} rad"
            raise InfeasibleJob(arm.robot.name, places[i].name, reason)
    before = arm.robot.home_q()
    for i, stop in enumerate((*stops, stops[0])):
        if hit := clearance.first_hit(line(before, stop, CLEARANCE_STEP_RAD)[1:]):
            raise InfeasibleJob(arm.robot.name, places[i % len(places)].name, f"collision: {hit} on the way")
        before = stop


def _legs(home: Array, stops: Array, dwell: Array, payload_kg: float, speed: float) -> tuple[list[_Leg], ...]:
    """Approach, cycle and retreat."""
    first = stops[0]
    there, back = _Leg(move(home, first, speed), 0.0, 0), _Leg(move(first, home, speed), 0.0, None)
    if len(stops) == 1:
        grasp = rest(first, GRASP_S)
        cycle = [_Leg(rest(first, dwell[0]), payload_kg, 0)]
        return [there, _Leg(grasp, 0.0, 0)], cycle, [_Leg(grasp, payload_kg, 0), back]
    cycle = [_Leg(rest(first, dwell[0]), 0.0, 0)]
    for i in range(1, len(stops)):
        cycle.append(_Leg(move(stops[i - 1], stops[i], speed), payload_kg, i))
        cycle.append(_Leg(rest(stops[i], dwell[i]), payload_kg, i))
    cycle.append(_Leg(move(stops[-1], first, speed), 0.0, 0))
    return [there], cycle, [back]


def _phase(arm: ArmModel, legs: list[_Leg], places: tuple[Place, ...]) -> Phase:
    tau = []
    for leg in legs:
        motion = leg.motion
        torque = _torque(arm, leg)
        if broken := broken_limit(motion.q, motion.qd, motion.qdd, torque, arm.position_range):
            place = places[leg.to or 0].name
            raise InfeasibleJob(arm.robot.name, place, f"{broken[1]} with {leg.payload_kg:g} kg")
        tau.append(torque)
    motion = joined([leg.motion for leg in legs])
    profile = np.stack([motion.q, motion.qd, np.concatenate(tau)], axis=1)
    payload_kg = np.repeat([leg.payload_kg for leg in legs], [len(leg.motion) for leg in legs])
    return Phase(profile.astype(np.float32), payload_kg.astype(np.float32))


def _torque(arm: ArmModel, leg: _Leg) -> Array:
    motion = leg.motion
    if len(motion) and not motion.qd.any():
        # A rest needs one torque, and it is often most of the samples.
        return np.tile(arm.gravity_torque(motion.q[0], leg.payload_kg), (len(motion), 1))
    return arm.inverse_dynamics(motion.q, motion.qd, motion.qdd, leg.payload_kg)
