"""Simulate schedules from the present to the end of a shift, with what a dispatcher observes.

It has the plans and space of all arms, their current jobs, the jobs in the slots, and of each arm the measured motor
temperatures, the estimated housings and the identified thermal network. If the arms learn (source `twin`), the heat of
the plans and the temperatures are corrected as in their predictions. It knows breaks, and when a present failure will
be repaired. The simulator has no jobs without a slot, no future jobs, no future failures, no future ambient
temperature, no sensor errors and no true temperatures.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet.engine.batch import Engine, RewardWeights
from fleet.engine.state import BROKEN, DONE, GIVEN_UP, RUNNING, State
from fleet.engine.tables import Plans, Script, Tables
from fleet.errors import listed
from fleet.heat.thermal import HOUSING, WINDING
from fleet.observation import Layout, Observation

Array = np.ndarray

SIDE_BY_SIDE = 32
"""Number of schedules simulated at once."""


@dataclass(frozen=True, eq=False)
class Present:
    """Jobs of a shift at one time; entries of jobs without a slot are undefined."""

    now_s: float
    open: Array
    """Jobs in the slots, int [n]."""
    can: Array
    """Whether an arm has a plan for a job, bool [arm, job, option]."""
    stations: Array
    """Stations of each job as bits, uint64 [job, word]."""


class CellSimulator:
    """Simulates schedules of a cell, for any number of its shifts one after the other.

    Args:
        tables: The fleet with the models that the arms have of themselves.
        arms, slots: Number of arms and of slots.
        weights: Of the reward terms.
    """

    def __init__(self, tables: Tables, arms: int, slots: int, weights: RewardWeights) -> None:
        self._tables, self._weights = tables, weights
        layout = Layout(arms, slots, plans=tables.work.shape[3])
        own = tables._replace(ambient_c=tables.ambient_c.copy(), plans=tables.plans.copy())
        self._engine = Engine(own, SIDE_BY_SIDE, layout, weights)
        self._state: State | None = None
        none = np.zeros((0, 0))
        self._engine.play((none.astype(int), none.astype(int), none, none), np.zeros(0))  # compiles

    def with_limits(self, warning_c: float, error_c: float) -> "CellSimulator":
        """A simulator of the same cell with other limits of the motors, °C, for a margin."""
        engine = self._engine
        tables = self._tables._replace(warning_c=warning_c, error_c=error_c)
        return CellSimulator(tables, engine.layout.arms, engine.layout.slots, self._weights)

    @property
    def rows(self) -> int:
        """Maximum number of schedules at once."""
        return self._engine.envs

    @property
    def dt_s(self) -> float:
        """Decision interval."""
        return self._engine.tables.dt_s

    @property
    def horizon_s(self) -> float:
        """Length of a shift."""
        return self._engine.tables.ticks * self.dt_s

    def look(self, engine: Engine, env: int, seen: Mapping[str, Observation]) -> Present:
        """Start from the current state of a row of another engine with the same task types.

        Args:
            seen: Observations of its arms.
        """
        state, slot_job = engine.state, engine.offers.slot_job[env]
        count, open_ = int(state.number[env]), slot_job[slot_job >= 0]
        known = state.copy(slice(env, env + 1), slice(0, count))
        hidden = (known.status[0] != DONE) & (known.status[0] != RUNNING)
        hidden[open_] = False
        known.status[0, hidden] = GIVEN_UP
        known.absences["kind"][(known.absences["kind"] == BROKEN) & (known.absences["begin"] > known.tick)] = 0
        known.temp_c[0, :, WINDING] = [each.temp_c for each in seen.values()]
        known.temp_c[0, :, HOUSING] = [each.housing_c for each in seen.values()]
        mine, tick = self._engine, int(state.tick[env])
        if engine.tables.learns:
            self._correct(engine, env, known)
        mine.tables.work["difficulty"] = engine.tables.work["difficulty"]  # it decides between claims
        mine.tables.ambient_c[:] = self._tables.ambient_c[:, [min(tick, mine.tables.ticks - 1)]]
        mine.load(known)
        self._state = mine.state.copy(slice(0, 1))
        fleet, kind = int(state.fleet[env]), known.kind[0]
        can, stations = mine.tables.work["plan"][fleet, kind].swapaxes(0, 1) >= 0, mine.tables.stations[fleet, kind]
        unknown = ~np.isin(np.arange(count), open_)
        can[:, unknown], stations[unknown] = False, 0
        return Present(tick * self.dt_s, open_, can, stations)

    def _correct(self, engine: Engine, env: int, known: State) -> None:
        """Set the heat of the plans for known jobs, and the temperatures, to the corrected values."""
        kinds = np.unique(known.kind[0, known.status[0] != GIVEN_UP])
        excess, offset_k = engine.measured(env, kinds.tolist())
        known.temp_c[0, :, WINDING] -= offset_k[:, None]
        tables = self._engine.tables
        plans = tables.work["plan"][int(known.fleet[0])][kinds]  # [kind, arm, option]
        factor = np.broadcast_to(1.0 + excess.T[..., None], plans.shape)
        has = plans >= 0
        for name in ("current_sq", "friction_w"):
            tables.plans[name][plans[has]] = self._tables.plans[name][plans[has]] * factor[has][:, None, None]

    def run(self, schedules: Plans, discount: Array) -> Script:
        """Results of at most `rows` schedules from the time of the last `look`.

        Args:
            schedules: An `agents.schedules.Schedules`.
            discount: Factor on the reward of each step of a shift, [tick]; a shorter one ends the simulation.

        Raises:
            RuntimeError: before the first look.
            ValueError: too many schedules, arrays of other shapes, an arm or option that does not exist, or a discount
                that is not finite.
        """
        if self._state is None:
            raise RuntimeError("There is no present to begin at: call look() before run().")
        mine = self._engine
        _check(schedules, discount, self.rows, mine.tables.work.shape, int(mine.state.number[0]), mine.tables.ticks)
        for own, saved in zip(mine.state, self._state, strict=True):
            own[:] = saved
        return mine.play(schedules, discount)


def _check(schedules: Plans, discount: Array, rows: int, work: tuple[int, ...], jobs: int, ticks: int) -> None:
    """Check the indices that the compiled loop reads; `work` has the shape [fleet, kind, arm, option]."""
    arm, option = schedules[:2]
    shapes = [np.shape(each) for each in schedules]
    if len(shapes[0]) != 2 or shapes[0][1] != jobs or shapes[0][0] > rows or len(set(shapes)) != 1:
        raise ValueError(
            f"Schedules must be arrays [schedule, job] of at most {rows} schedules and {jobs} jobs, all of "
            f"the same shape (got {listed(shapes)})."
        )
    for name, values, most in (("arm", arm, work[2]), ("option", option, work[3])):
        if not np.issubdtype(values.dtype, np.integer) or (values < 0).any() or (values >= most).any():
            raise ValueError(
                f"The {name} of a schedule must be an integer from 0 to {most - 1}, also of a job that is "
                f"left out (got {values.dtype} from {values.min()} to {values.max()})."
            )
    if np.ndim(discount) != 1 or len(discount) > ticks or not np.isfinite(discount).all():
        raise ValueError(
            f"The discount must be at most {ticks} finite factors, one for each step of a shift "
            f"(got shape {np.shape(discount)})."
        )


class Lookahead:
    """The simulator of a cell for one of its shifts."""

    def __init__(self, simulator: CellSimulator, engine: Engine, env: int = 0) -> None:
        self.simulator, self._engine, self._env = simulator, engine, env

    @property
    def slot_job(self) -> Array:
        """Jobs in the slots of the observation by their numbers, int [slot], −1 for an empty one."""
        return self._engine.offers.slot_job[self._env]

    @property
    def now_s(self) -> float:
        """Time since the start of the shift."""
        return float(self._engine.state.tick[self._env]) * self.simulator.dt_s

    def with_limits(self, warning_c: float, error_c: float) -> "Lookahead":
        """The same shift with other limits of the motors; see `CellSimulator.with_limits`."""
        return Lookahead(self.simulator.with_limits(warning_c, error_c), self._engine, self._env)

    def look(self, seen: Mapping[str, Observation]) -> Present:
        """Start from the current state; see `CellSimulator.look`."""
        return self.simulator.look(self._engine, self._env, seen)
