"""Plans of one arm for a work: several elbow postures and speeds, as sampled motion with torque."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fleet.arm.gen3 import ELBOW_ANGLES_DEG
from fleet.arm.kinematics import InverseKinematics, Pose, Unreachable
from fleet.arm.model import ArmModel
from fleet.arm.task_phases import Segment, TaskPhases, TaskStop, task_phases
from fleet.arm.time_limit import check_time
from fleet.arm.trajectory import CollisionChecker, LoadedMotion, build_phase, move, rest
from fleet.errors import InfeasibleJob
from fleet.job import Fixture, Work
from fleet.motion import RATE_HZ, Plan
from fleet.robot import Robot, rotation

Array = np.ndarray
log = logging.getLogger(__name__)

SAME_ELBOW_M = 0.05
"""Variants with elbows closer than this at every stop load the joints equally and count as one."""
_COLLISION_STAGE = 100
_LIMIT_STAGE = 101


class Planner:
    """Plans the work of one arm: a few elbow postures, each at a few speeds."""

    def __init__(
        self,
        robot: Robot,
        fixtures: Sequence[Fixture] = (),
        *,
        elbows: int = 3,
        speeds: tuple[float, ...] = (1.0, 0.6),
    ) -> None:
        """Load the models of the arm.

        Args:
            fixtures: Boxes that neither the arm nor its payload may touch.
            elbows: Maximum number of elbow postures.
            speeds: Shares of the joint limits, each in (0, 1].
        """
        if elbows < 1:
            raise ValueError(f"Planner.elbows must be >= 1 (got {elbows}).")
        if not speeds or not all(0 < speed <= 1 for speed in speeds):
            raise ValueError(f"Planner.speeds must be one or more shares in (0, 1] (got {speeds}).")
        self.robot = robot
        self.elbows = elbows
        self.speeds = tuple(sorted(set(speeds), reverse=True))
        self._arm = ArmModel(robot, fixtures)
        self._inverse = InverseKinematics(self._arm)
        self._collisions = CollisionChecker(self._arm)

    def plan(self, work: Work) -> tuple[Plan, ...]:
        """All variants: elbow postures in order of duration, each from the highest speed down.

        Raises:
            PlanningTimeout: the time limit of this thread has passed (`fleet.arm.time_limit.time_limit`).
            InfeasibleJob: no variant is within reach, joint stops and torque limits and free of collision; reports
                the variant that came furthest.
        """
        phases = task_phases(work)
        variants: list[tuple[dict[TaskStop, Array], list[Plan]]] = []
        failures: list[tuple[int, InfeasibleJob]] = []
        for elbow_deg in ELBOW_ANGLES_DEG:
            if len(variants) == self.elbows:
                break
            check_time()
            postures: dict[TaskStop, Array] = {}
            try:
                self._solve(phases, elbow_deg, postures)
            except InfeasibleJob as failure:
                failures.append((len(postures), failure))
                continue
            if any(self._same_elbow(postures, other) for other, _ in variants):
                continue
            try:
                self._check_collisions(phases, postures, work.payload_kg)
            except InfeasibleJob as failure:
                failures.append((_COLLISION_STAGE, failure))
                continue
            plans = []
            for speed in self.speeds:
                check_time()
                try:
                    plans.append(self._plan(work, phases, postures, speed))
                except InfeasibleJob as failure:
                    failures.append((_LIMIT_STAGE, failure))
            if plans:
                variants.append((postures, plans))
        if not variants:
            raise max(failures, key=lambda failure: failure[0])[1]
        for _, failure in failures:
            log.debug("Dropped a variant: %s", failure)
        by_duration = sorted((plans for _, plans in variants), key=lambda plans: plans[0].duration_s(1))
        return tuple(replace(plan, elbow=elbow) for elbow, plans in enumerate(by_duration) for plan in plans)

    def _solve(self, phases: TaskPhases, elbow_deg: float, postures: dict[TaskStop, Array]) -> None:
        """Put the joint positions of each stop, with this elbow angle, into `postures`."""
        for stop, previous in phases.previous_stops().items():
            check_time()
            near = self.robot.home_q() if previous is None else postures[previous]
            try:
                postures[stop] = self._inverse.solve(_pose(stop), elbow_deg, near)
            except Unreachable as error:
                raise InfeasibleJob(self.robot.name, stop.place.name, str(error)) from error

    def _same_elbow(self, postures: dict[TaskStop, Array], other: dict[TaskStop, Array]) -> bool:
        return all(
            np.linalg.norm(self._arm.elbow_position(q) - self._arm.elbow_position(other[stop])) < SAME_ELBOW_M
            for stop, q in postures.items()
        )

    def _check_collisions(self, phases: TaskPhases, postures: dict[TaskStop, Array], payload_kg: float) -> None:
        for ends, carries in phases.paths().items():
            check_time()
            start, end = (self.robot.home_q() if stop is None else postures[stop] for stop in ends)
            if collision := self._collisions.on_path(start, end, payload_kg if carries else 0.0):
                stop = ends[1] or ends[0]
                assert stop is not None, "no path leads from home to home"
                raise InfeasibleJob(self.robot.name, stop.place.name, collision)

    def _plan(self, work: Work, phases: TaskPhases, postures: dict[TaskStop, Array], speed: float) -> Plan:
        here, built = self.robot.home_q(), []
        for segments in phases:
            check_time()
            parts = []
            for segment in segments:
                start, here = here, self.robot.home_q() if segment.to is None else postures[segment.to]
                parts.append(_loaded_motion(work, segment, start, here, speed))
            self._check_rating(parts)
            built.append(build_phase(self._arm, parts))
        return Plan(self.robot.name, work, 0, speed, *built)

    def _check_rating(self, parts: list[LoadedMotion]) -> None:
        """Check the load of one phase, in which it is carried without a break, at its farthest posture.

        Raises:
            InfeasibleJob: the load exceeds the arm's rating.
        """
        carried = [part for part in parts if part.payload_kg]
        carried_s = sum(len(part.motion) for part in carried) / RATE_HZ
        postures = [(part, part.motion.q if part.motion.qd.any() else part.motion.q[:1]) for part in carried]
        reaches_m = [(self._arm.reach_m(q), part) for part, path in postures for q in path]
        if reaches_m:
            reach_m, farthest = max(reaches_m, key=lambda each: each[0])
            if overload := self.robot.overload(farthest.payload_kg, reach_m, carried_s):
                raise InfeasibleJob(self.robot.name, farthest.place, overload, too_heavy=True)


def _loaded_motion(work: Work, segment: Segment, start: Array, end: Array, speed: float) -> LoadedMotion:
    return LoadedMotion(
        rest(end, segment.pause_s) if segment.pause_s else move(start, end, speed),
        place=(segment.to.place if segment.to else work.places[0]).name,
        payload_kg=work.payload_kg if segment.carries else 0.0,
        pressing_n=work.force_n if segment.presses else 0.0,
        direction=rotation(work.places[0].tool_deg)[:, 2],  # the hand presses along its own z axis
    )


def _pose(stop: TaskStop) -> Pose:
    pose = Pose(np.array(stop.place.position_m), rotation(stop.place.tool_deg))
    return pose.retracted(stop.place.retreat_m) if stop.retracted else pose
