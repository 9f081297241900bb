"""From a piece of work to the ways in which one arm would do it, as sampled motion with its torque."""

import logging
from pathlib import Path

import numpy as np

from fleet.errors import InfeasibleJob
from fleet.job import Place, Work
from fleet.motion import Phase, Plan
from fleet.robot import Robot, rotation
from fleet.sim.clearance import CLEARANCE_STEP_RAD, Clearance
from fleet.sim.description import ELBOW_ANGLES_DEG
from fleet.sim.itinerary import Itinerary, Leg, Stop, itinerary
from fleet.sim.kinematics import InverseKinematics, Pose, Unreachable
from fleet.sim.limits import broken_limit
from fleet.sim.models import ArmModel
from fleet.sim.plan_cache import PlanCache
from fleet.sim.trajectory import joined, line, move, rest

Array = np.ndarray
log = logging.getLogger(__name__)

SAME_ELBOW_M = 0.05
"""Postures whose elbows are closer than this at every stop load the joints alike: one variant."""


class Planner:
    """Plans the work of one arm: a few elbow postures, each at a few speeds."""

    def __init__(
        self,
        robot: Robot,
        *,
        elbows: int = 3,
        speeds: tuple[float, ...] = (1.0, 0.6),
        cache_dir: Path | None = None,
    ) -> None:
        """Prepare the models of the arm.

        Args:
            elbows: Most elbow postures to offer.
            speeds: Shares of the joint limits to offer, each in (0, 1].
            cache_dir: Where plans are kept between runs; None keeps none.
        """
        if elbows < 1:
            raise ValueError(f"Planner.elbows must be >= 1 (got {elbows}).")
        if not speeds or not all(0 < speed <= 1 for speed in speeds):
            raise ValueError(f"Planner.speeds must be some shares in (0, 1] (got {speeds}).")
        self.robot = robot
        self.elbows = elbows
        self.speeds = tuple(sorted(set(speeds), reverse=True))
        self._arm = ArmModel(robot)
        self._inverse = InverseKinematics(self._arm)
        self._clearance = Clearance(self._arm)
        self._cache = None if cache_dir is None else PlanCache(cache_dir)

    def plan(self, work: Work) -> tuple[Plan, ...]:
        """All variants, elbow by elbow from the quickest on, each from the fastest speed down.

        Raises:
            InfeasibleJob: no variant keeps within reach, joint stops, torque and clearance; says which, and where.
        """
        if self._cache is None:
            return self._plan(work)
        key = self._cache.key(self.robot, work, elbows=self.elbows, speeds=self.speeds)
        known = self._cache.load(key, self.robot.name, work)
        if isinstance(known, InfeasibleJob):
            raise known
        if known is not None:
            return known
        try:
            plans = self._plan(work)
        except InfeasibleJob as infeasible:
            self._cache.store_infeasible(key, infeasible)
            raise
        self._cache.store(key, plans)
        return plans

    def _plan(self, work: Work) -> tuple[Plan, ...]:
        route = itinerary(work)
        found: list[tuple[dict[Stop, Array], list[Plan]]] = []
        failures: list[_Failure] = []
        for elbow_deg in ELBOW_ANGLES_DEG:
            if len(found) == self.elbows:
                break
            try:
                stops = self._stops(route, elbow_deg)
                if any(self._same_elbow(stops, other) for other, _ in found):
                    continue
                self._check_clearance(route, stops)
            except _Failure as failure:
                failures.append(failure)
                continue
            plans = []
            for speed in self.speeds:
                try:
                    phases = [self._phase(work, legs, stops, speed) for legs in _with_start(route)]
                except _Failure as failure:
                    failures.append(failure)
                else:
                    plans.append(Plan(self.robot.name, work, len(found), speed, *phases))
            if plans:
                found.append((stops, plans))
        if not found:
            # The attempt that came furthest says most.
            worst = max(failures, key=lambda failure: failure.stage)
            raise InfeasibleJob(self.robot.name, worst.place, worst.reason)
        for failure in failures:
            log.debug("Arm %s drops a variant at %s: %s.", self.robot.name, failure.place, failure.reason)
        quickest_first = sorted((plans for _, plans in found), key=lambda plans: plans[0].duration_s(1))
        return tuple(
            Plan(plan.arm, work, elbow, plan.speed, *plan.phases)
            for elbow, plans in enumerate(quickest_first)
            for plan in plans
        )

    def _stops(self, route: Itinerary, elbow_deg: float) -> dict[Stop, Array]:
        """Joint positions of each stop with the elbow turned so far."""
        solved: dict[Stop, Array] = {}
        for stop, parent in route.tree().items():
            near = self.robot.home_q() if parent is None else solved[parent]
            try:
                solved[stop] = self._inverse.solve(_pose(stop), elbow_deg, near)
            except Unreachable as error:
                raise _Failure(stop.place, str(error), stage=len(solved)) from error
        return solved

    def _same_elbow(self, stops: dict[Stop, Array], other: dict[Stop, Array]) -> bool:
        return all(
            np.linalg.norm(self._arm.elbow_position(q) - self._arm.elbow_position(other[stop])) < SAME_ELBOW_M
            for stop, q in stops.items()
        )

    def _check_clearance(self, route: Itinerary, stops: dict[Stop, Array]) -> None:
        for stop, parent in route.tree().items():
            start = self.robot.home_q() if parent is None else stops[parent]
            hit = self._clearance.first_hit(line(start, stops[stop], CLEARANCE_STEP_RAD))
            if hit:
                raise _Failure(stop.place, f"collision: {hit} on the way", stage=_CLEARANCE_STAGE)

    def _phase(self, work: Work, legs: tuple[Leg, ...], stops: dict[Stop, Array], speed: float) -> Phase:
        """Sampled motion and torque of the legs; the first leg only says where the phase begins."""
        home = self.robot.home_q()
        where = [home if leg.to is None else stops[leg.to] for leg in legs]
        motions = [
            rest(end, leg.stay_s) if leg.stay_s else move(start, end, speed)
            for leg, start, end in zip(legs[1:], where, where[1:], strict=False)
        ]
        motion = joined(motions)
        of_leg = np.repeat(np.arange(1, len(legs)), [len(m) for m in motions])
        carries = np.array([leg.carries for leg in legs])[of_leg]
        presses = np.array([leg.presses for leg in legs])[of_leg]
        payload_kg = np.where(carries, work.payload_kg, 0.0)
        force = None
        if presses.any():
            # The hand pushes along its own z; the environment pushes back.
            push = work.force_n * rotation(work.places[0].tool_deg)[:, 2]
            force = np.where(presses[:, None], -push, 0.0)
        tau = self._arm.inverse_dynamics(motion.q, motion.qd, motion.qdd, payload_kg, force)
        broken = broken_limit(motion.q, motion.qd, motion.qdd, tau, self._arm.position_range)
        if broken:
            sample, reason = broken
            leg = legs[of_leg[sample]]
            place = leg.to.place if leg.to else work.places[0]
            load = f" with {payload_kg[sample]:g} kg" + (f" pressing {work.force_n:g} N" if presses[sample] else "")
            raise _Failure(place, reason + load, stage=_LIMIT_STAGE)
        profile = np.stack([motion.q, motion.qd, tau], axis=1)
        return Phase(profile.astype(np.float32), payload_kg.astype(np.float32))


_CLEARANCE_STAGE = 100
_LIMIT_STAGE = 101


class _Failure(Exception):
    """Why one variant is dropped, and how far it had come."""

    def __init__(self, place: Place, reason: str, stage: int) -> None:
        super().__init__(reason)
        self.place = place.name
        self.reason = reason
        self.stage = stage


def _with_start(route: Itinerary) -> list[tuple[Leg, ...]]:
    """The phases, each preceded by the leg that ends where it begins."""
    before = Leg(None)
    phases = []
    for legs in route.phases:
        phases.append((before, *legs))
        before = phases[-1][-1]
    return phases


def _pose(stop: Stop) -> Pose:
    pose = Pose(np.array(stop.place.position_m), rotation(stop.place.tool_deg))
    return pose.backed_off(stop.place.retreat_m) if stop.backed_off else pose
