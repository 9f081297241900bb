"""Plans and postures of one arm that were worked out before; the physics is loaded only for what is new."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fleet.errors import InfeasibleJob
from fleet.job import Work
from fleet.motion import Plan
from fleet.robot import Robot
from fleet.sim.plan_cache import PlanCache

if TYPE_CHECKING:
    from fleet.sim.planner import Planner


class KnownPlans:
    """As `fleet.sim.planner.Planner` with a cache, but light as long as the cache knows the answer."""

    def __init__(self, robot: Robot, *, elbows: int, speeds: tuple[float, ...], cache_dir: Path) -> None:
        """Plan for an arm; arguments as for a `Planner`."""
        self._robot, self._elbows, self._speeds, self._folder = robot, elbows, speeds, cache_dir
        self._cache = PlanCache(cache_dir)
        self._planner: Planner | None = None

    def plan(self, work: Work) -> tuple[Plan, ...]:
        """All variants.

        Raises:
            InfeasibleJob: there is none.
        """
        if self._planner is None:
            speeds = tuple(sorted(set(self._speeds), reverse=True))
            key = self._cache.key(self._robot, work, elbows=self._elbows, speeds=speeds)
            known = self._cache.load(key, self._robot.name, work)
            if isinstance(known, InfeasibleJob):
                raise known
            if known is not None:
                return known
            from fleet.sim.planner import Planner

            self._planner = Planner(self._robot, elbows=self._elbows, speeds=self._speeds, cache_dir=self._folder)
        return self._planner.plan(work)


def rest_torque(robot: Robot, cache_dir: Path) -> np.ndarray:
    """Torque that holds an arm at home, N·m, [joint]."""
    cache = PlanCache(cache_dir)
    key = cache.rest_key(robot)
    known = cache.load_rest(key)
    if known is not None:
        return known
    from fleet.sim.models import ArmModel

    rest_tau = ArmModel(robot).gravity_torque(robot.home_q())
    cache.store_rest(key, rest_tau)
    return rest_tau
