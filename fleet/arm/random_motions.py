"""Motions between given or random postures as plans, made quickly, without inverse kinematics.

Random motions are either a typical mix of work, on which twins are evaluated, or light motions of other kinds, for
training.
"""

import logging
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from fleet.arm.model import ArmModel
from fleet.arm.task_phases import GRASP_S
from fleet.arm.trajectory import CollisionChecker, JointMotion, LoadedMotion, build_phase, move, rest
from fleet.errors import FleetError, InfeasibleJob
from fleet.job import LONGEST_GRASP_S, Place, Work
from fleet.motion import Plan
from fleet.robot import JOINTS, POSTURES, Robot, angles_deg

Array = np.ndarray
log = logging.getLogger(__name__)

MAX_DRAWS = 50
"""Samples per requested job; if all fail, the arm hardly has room to move."""

TYPICAL_MIX = (0.4, 0.3, 0.3)
"""Shares of moves to a place and back, of the same with a wait under load at the end, and of holds."""
REACH = (0.6, 0.6)
"""Beta distribution of the reach, 0 near to 1 nearly outstretched: most cells use one of the ends."""
FOLDED = np.array([0.0, -0.35, np.pi, -2.35, 0.0, -0.87, 1.57])
"""Near Kinova's `retract`, far enough from the stop of joint 4 to move."""
_SCATTER = np.array([1.2, 0.25, 0.3, 0.3, 0.4, 0.6, 0.8])


def plan_motion(
    arm: ArmModel,
    stops: Array,
    *,
    dwell_s: float | Sequence[float] | Array,
    payload_kg: float,
    speed: float,
    name: str = "motion",
) -> Plan:
    """Plan of moving from stop to stop and back to the first, on straight lines in joint space, from and to home.

    One stop is a hold: the hand grasps the payload at the end of the approach and releases it in the retreat. With
    more stops it carries the payload from the end of the first dwell to the end of the last, and returns empty, as in
    a sort.

    Args:
        stops: Postures, rad, [stop, joint].
        dwell_s: Standstill at each stop, > 0, one for all or one per stop; for a hold, the length of one repetition,
            within `fleet.job.BOUNDS`.
        payload_kg: Point mass at the flange.
        speed: Share of the joint limits, (0, 1].
        name: The plan's places are called `{name}/stop_1` and so on.

    Raises:
        InfeasibleJob: the motion collides with the floor or the arm's own base, or exceeds a joint or torque limit.
        ValueError: an argument is out of range.
    """
    stops = np.asarray(stops, dtype=float)
    dwell = _dwell_times(stops, dwell_s)
    if not 0 < speed <= 1:
        raise ValueError(f"speed must be a share of the limits in (0, 1] (got {speed}).")
    if not 0 <= payload_kg < np.inf:
        raise ValueError(f"payload_kg must be >= 0 and finite (got {payload_kg}).")
    places = _places(arm, stops, name)
    _check_path(arm, stops, places)
    holds = len(places) == 1
    work = Work(
        kind="hold" if holds else "sort",
        places=places if holds else (places[0], places[-1]),
        payload_kg=float(payload_kg),
        # That of a sort is the time of the hand; a longer standstill waits with the payload in the hand.
        dwell_s=float(dwell.max() if holds else min(dwell.max(), LONGEST_GRASP_S)),
    )
    home, first = arm.robot.home_q(), stops[0]

    def part(motion: JointMotion, to: int = 0, kg: float = 0.0) -> LoadedMotion:
        return LoadedMotion(motion, places[to].name, kg)

    approach, retreat = [part(move(home, first, speed))], [part(move(first, home, speed))]
    if len(stops) == 1:
        approach.append(part(rest(first, GRASP_S)))
        cycle = [part(rest(first, dwell[0]), 0, payload_kg)]
        retreat.insert(0, part(rest(first, GRASP_S), 0, payload_kg))
    else:
        cycle = [part(rest(first, dwell[0]))]
        for i in range(1, len(stops)):
            cycle.append(part(move(stops[i - 1], stops[i], speed), i, payload_kg))
            cycle.append(part(rest(stops[i], dwell[i]), i, payload_kg))
        cycle.append(part(move(stops[-1], first, speed)))
    return Plan(arm.robot.name, work, 0, speed, *(build_phase(arm, parts) for parts in (approach, cycle, retreat)))


def random_jobs(
    robot: Robot,
    count: int,
    rng: np.random.Generator,
    *,
    payload_kg: tuple[float, float] = (0.0, 4.0),
    name: str = "job",
) -> tuple[Plan, ...]:
    """`count` random jobs of the typical mix: from pick to place and back, with random payload, speed and reach.

    Some wait 4 to 15 s at the far place with the payload in the hand, some only hold it. Of the jobs of a nominal
    Gen3 with a gripper of 0.9 kg at 23 °C, repeated for half an hour, a third stays below 40 °C and a fifth passes
    60 °C, first in joint 2.

    Args:
        payload_kg: Smallest and largest.
        name: Prefix of the names of the jobs' places.
    """
    arm = ArmModel(robot)

    def draw(label: str) -> Plan:
        kind = rng.choice(("sort", "wait", "hold"), p=TYPICAL_MIX)
        stops = _reaching(rng, 1 if kind == "hold" else 2)
        dwell = rng.uniform(0.3, 1.0, len(stops))
        if kind == "wait":
            dwell[-1] = rng.uniform(4.0, 15.0)
        if kind == "hold":
            dwell[-1] = rng.uniform(10.0, 40.0)
        speed = rng.uniform(0.3, 1.0)
        return plan_motion(arm, stops, dwell_s=dwell, payload_kg=rng.uniform(*payload_kg), speed=speed, name=label)

    return _feasible(arm, count, name, draw)


def light_jobs(robot: Robot, count: int, rng: np.random.Generator, *, name: str = "light") -> tuple[Plan, ...]:
    """`count` random light motions unlike the typical mix: folded, elbow out, fast wrist or turned base, to 0.5 kg.

    With a nominal Gen3 on the floor at 23 °C they all stay below 40 °C over half an hour.

    Args:
        name: Prefix of the names of the jobs' places.
    """
    arm = ArmModel(robot)

    def draw(label: str) -> Plan:
        stops = (_folded, _elbow_out, _wrist, _turned)[rng.integers(4)](rng)
        dwell = rng.uniform(0.5, 2.0, len(stops))
        payload_kg = rng.uniform(0.0, 0.5)
        return plan_motion(arm, stops, dwell_s=dwell, payload_kg=payload_kg, speed=rng.uniform(0.3, 0.8), name=label)

    return _feasible(arm, count, name, draw)


def _feasible(arm: ArmModel, count: int, name: str, draw: Callable[[str], Plan]) -> tuple[Plan, ...]:
    """`count` feasible samples; infeasible ones are repeated."""
    if count < 0:
        raise ValueError(f"The number of jobs must be >= 0 (got {count}).")
    plans: list[Plan] = []
    refused: Counter[str] = Counter()
    while len(plans) < count:
        try:
            plans.append(draw(f"{name}_{len(plans) + 1}"))
        except InfeasibleJob as error:
            refused[error.reason.split(":")[0]] += 1
        if refused.total() > MAX_DRAWS * count:
            raise FleetError(
                f"Arm '{arm.robot.name}' can do {len(plans)} of {len(plans) + refused.total()} random motions "
                f"({_listed(refused)}); give its mount more room."
            )
    log.debug("Arm %s: %d random jobs, %d infeasible (%s).", arm.robot.name, count, refused.total(), _listed(refused))
    return tuple(plans)


def _listed(refused: Counter[str]) -> str:
    return ", ".join(f"{reason} {times}" for reason, times in refused.most_common()) or "none refused"


def _reaching(rng: np.random.Generator, count: int) -> Array:
    """Postures in front of the arm, all about equally far from it, elbow up, rad, [posture, joint]."""
    near = np.array([0.0, 0.0, np.pi, -2.1, 0.0, 0.9, 1.57])
    far = np.array([0.0, 1.4, np.pi, -0.3, 0.0, 0.9, 1.57])
    return _around(rng, near + rng.beta(*REACH) * (far - near), _SCATTER, count)


def _around(rng: np.random.Generator, posture: Array, width: Sequence[float] | Array, count: int = 2) -> Array:
    return posture + rng.uniform(-1.0, 1.0, (count, JOINTS)) * np.array(width)


def _folded(rng: np.random.Generator) -> Array:
    return _around(rng, FOLDED, (0.8, 0.25, 0.3, 0.15, 0.8, 0.5, 1.5))


def _elbow_out(rng: np.random.Generator) -> Array:
    posture = np.array(POSTURES["home"])
    posture[2] += rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.5)
    return _around(rng, posture, (0.6, 0.2, 0.25, 0.25, 0.6, 0.4, 0.8))


def _wrist(rng: np.random.Generator) -> Array:
    """One posture of the arm, with the hand turned far in both directions."""
    posture = _around(rng, np.array(POSTURES["home"]), (1.0, 0.2, 0.2, 0.2, 0.0, 0.0, 0.0), 1)
    return _around(rng, posture[0], (0.0, 0.0, 0.0, 0.0, 1.2, 0.9, 2.0))


def _turned(rng: np.random.Generator) -> Array:
    posture = np.array(POSTURES["home"])
    posture[0] += rng.choice([-1.0, 1.0]) * rng.uniform(1.8, 2.8)
    return _around(rng, posture, (0.4, 0.2, 0.2, 0.2, 0.3, 0.4, 0.8))


def _dwell_times(stops: Array, dwell_s: float | Sequence[float] | Array) -> Array:
    """Standstill per stop, s, [stop]."""
    if stops.ndim != 2 or stops.shape[1] != JOINTS or len(stops) == 0 or not np.isfinite(stops).all():
        raise ValueError(f"stops must be finite [stop, {JOINTS}], at least one (got shape {stops.shape}).")
    dwell = np.asarray(dwell_s, dtype=float)
    if dwell.shape not in ((), (len(stops),)) or not (np.isfinite(dwell) & (dwell > 0)).all():
        raise ValueError(f"dwell_s must be > 0, one for all {len(stops)} stops or one per stop (got {dwell_s}).")
    return np.broadcast_to(dwell, len(stops))


def _places(arm: ArmModel, stops: Array, name: str) -> tuple[Place, ...]:
    places = []
    for i, (position_m, turn) in enumerate(map(arm.tool_pose, stops), start=1):
        x, y, z = position_m.tolist()
        places.append(Place(name=f"{name}/stop_{i}", position_m=(x, y, z), tool_deg=angles_deg(turn), retreat_m=0.0))
    return tuple(places)


def _check_path(arm: ArmModel, stops: Array, places: tuple[Place, ...]) -> None:
    # Straight lines between postures within the joint stops keep within them.
    low, high = arm.position_range.T
    for stop, place in zip(stops, places, strict=True):
        if ((stop < low) | (stop > high)).any():
            joint = int(np.argmax(np.maximum(low - stop, stop - high)))
            reason = f"joint limit: joint_{joint + 1} would stand at {stop[joint]:.2f} rad"
            raise InfeasibleJob(arm.robot.name, place.name, reason)
    checker, previous = CollisionChecker(arm), arm.robot.home_q()
    for stop, place in zip((*stops, stops[0]), (*places, places[0]), strict=True):
        if collision := checker.on_path(previous, stop):
            raise InfeasibleJob(arm.robot.name, place.name, collision)
        previous = stop
