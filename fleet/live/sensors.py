"""Bad motor sensors of a live arm: its states and quotes with the last possible temperatures, and less headroom."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from fleet.bus.protocol.auction import Quote
from fleet.bus.protocol.messages import State
from fleet.readings import BAD_SENSOR, SPEED_RAD_S, TEMP_STEP_K, TORQUE_NM, TemperatureFilter, most_temp_change_k
from fleet.robot import JOINTS, ThermalLimits

if TYPE_CHECKING:
    from fleet.heat.motor import Motors
    from fleet.heat.thermal import ThermalModel

HOTTER = np.array([1.0, 1.5])
"""Heat of the likely arm and of one of few that become hotter, over that of a nominal one: two standard deviations of
copper loss and of the resistance from housing to ambient (`fleet/data/gen3_thermal.json`)."""
AMBIENT_C, KNOWN_S = np.array([22.0, 28.0]), 10.0
"""Ambient temperatures of both if the arm does not measure it, and the longest time between states in which the torque
is known."""


class ArmSensors:
    """Judges the states of one arm, in their order."""

    def __init__(self) -> None:
        self._filter, self._tick = TemperatureFilter(), 0
        self._warning_c = ThermalLimits().warning_c
        self._headroom_k = 0.0
        self._nodes_c: np.ndarray | None = None
        """Predicted temperatures while a sensor is bad, of the likely and of a hotter arm, [2, node]."""
        self._before: State | None = None

    @property
    def fault(self) -> str:
        """Sentence on the impossible temperatures of the last state; "" without any."""
        bad = self._filter.bad
        return "; ".join([*(bad[joint] for joint in sorted(bad)), BAD_SENSOR]) if bad else ""

    @property
    def why_unfit(self) -> str:
        """Why the arm gets no jobs, after its name; "" if its temperatures leave headroom, or are possible."""
        return "has impossible temperatures" if self._filter.bad and self._headroom_k <= 0 else ""

    def check(self, state: State) -> State:
        """The state with a possible temperature of every motor, and the headroom that is left in any case.

        A motor with a bad sensor has its last possible temperature or, if the states have torques, what a nominal
        thermal network yields from there on. One without a possible temperature so far counts as the hottest of the
        others, without headroom.
        """
        if state.tick < self._tick:  # the arm has started again
            self.__init__()
        self._tick = state.tick
        self._filter.update(state.time_s, dict(enumerate(state.temp_c)))
        before, self._before = self._before, state
        if not self._filter.bad:
            self._warning_c = state.headroom_k + max(state.temp_c, default=0.0)
            self._nodes_c = None
            return state
        possible, doubt_k = self._filter.temp_c, self._filter.doubt_k(state.time_s)
        if before is not None and len(possible) == len(state.tau) == len(before.tau) == JOINTS:
            likely_c, more_k = self._predicted(before, state)
            possible = possible | {joint: float(likely_c[joint]) for joint in self._filter.bad}
            doubt_k = min(doubt_k, TEMP_STEP_K + max(float(more_k[joint]) for joint in self._filter.bad))
        else:
            self._nodes_c = None
        hottest_c = max(possible.values(), default=self._warning_c)
        temp_c = tuple(possible.get(joint, hottest_c) for joint in range(len(state.temp_c)))
        doubtful_c = max((possible[joint] for joint in self._filter.bad if joint in possible), default=hottest_c)
        self._headroom_k = self._warning_c - max(hottest_c, doubtful_c + doubt_k)
        if len(possible) < len(temp_c):
            self._headroom_k = min(self._headroom_k, 0.0)
        return replace(state, temp_c=temp_c, headroom_k=self._headroom_k)

    def _predicted(self, before: State, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Likely motor temperatures and how much hotter those with bad sensors can be, °C and K, [joint]."""
        from fleet.heat.motor import friction_heat, reference_current
        from fleet.heat.thermal import HOUSING, WINDING, drive_heat

        motors, thermal = _nominal()
        possible_c = np.array([self._filter.temp_c[joint] for joint in range(JOINTS)])
        if self._nodes_c is None:  # a powered housing is about as warm as its winding, or cooler
            self._nodes_c = np.tile(np.append(possible_c, state.housing_c or possible_c), (2, 1))
            self._nodes_c[1, HOUSING] = possible_c
            self._nodes_c[1, WINDING] += self._filter.doubt_k(state.time_s)
        good = [joint for joint in range(JOINTS) if joint not in self._filter.bad]
        self._nodes_c[:, good] = possible_c[good]
        if (dt_s := max(state.time_s - before.time_s, 0.0)) > KNOWN_S:
            self._nodes_c[1, WINDING] += most_temp_change_k(dt_s)
        tau = np.clip([before.tau, state.tau], -TORQUE_NM, TORQUE_NM)
        qd = np.clip([each.qd or [0.0] * JOINTS for each in (before, state)], -SPEED_RAD_S, SPEED_RAD_S)
        current_sq = np.mean(reference_current(tau, qd, motors) ** 2, axis=0)
        friction_w = np.mean(friction_heat(qd, motors), axis=0)
        heat_w = HOTTER[:, None] * drive_heat(self._nodes_c, current_sq, friction_w, motors)
        ambient_c = AMBIENT_C if state.ambient_c is None else np.full(2, state.ambient_c)
        self._nodes_c = thermal.step(self._nodes_c, heat_w, ambient_c, dt_s)
        return self._nodes_c[0, WINDING], np.ptp(self._nodes_c[:, WINDING], axis=0)

    def check_quote(self, quote: Quote) -> Quote:
        """A quote with the headroom of the last state if a sensor is bad; without capacity if none is left."""
        if not self._filter.bad:
            return quote
        left = self._headroom_k > 0
        return replace(quote, headroom_k=self._headroom_k, capacity=quote.capacity if left else 0)


@cache
def _nominal() -> "tuple[Motors, ThermalModel]":
    from fleet.heat.motor import gen3_motors  # imported late: SciPy takes longer to load than all else here
    from fleet.heat.thermal import gen3_network, thermal_model

    return gen3_motors(), thermal_model(gen3_network())
