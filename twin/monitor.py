"""What a twin and a thermal network make of the motion of a live arm."""

import math

import numpy as np

from fleet.errors import FleetError
from fleet.heat.motor import magnet_factor
from fleet.heat.thermal import HOUSING, WINDING, drive_heat, housing_observer
from fleet.robot import JOINTS
from twin.log_windows import WindowFeed, join
from twin.logs.recording import STEP_S, Recording, heat_logs, source_of
from twin.thermal.identify import Identified
from twin.vae.twin import Twin

Array = np.ndarray

SETTLED_S = 1e7
"""A step of this length leads to the steady state."""


POSSIBLE_C = (-100.0, 500.0)
"""Range of expected temperatures."""


class Monitor:
    """Difficulty of the last window of motion, and expected temperatures; see `fleet.live.arm.body.MotionMonitor`.

    The expected temperatures begin with the measured ones, and with housings that have been at these for long. A gap of
    more than `HEAT_GAP_S` begins anew, and so do readings that lead to no possible temperature.

    Args:
        every_s: Time from one window to the next.

    Raises:
        FleetError: a twin of another number of joints than seven.
    """

    def __init__(self, twin: Twin | None, network: Identified | None, *, every_s: float = 0.5) -> None:
        if twin is not None and twin.joints != JOINTS:
            raise FleetError(f"The twin of '{twin.arm}' has {twin.joints} joints; the arm has {JOINTS}.")
        self._twin, self._network = twin, network
        self._feed = None if twin is None else WindowFeed(twin, every_s)
        self._heat: list[Recording] = []
        """Readings since the last expected temperatures."""
        self._temp_c: Array | None = None
        self._end_s = -np.inf
        """Expected temperatures, [node], and their time."""
        versions = ("d", twin), ("temperatures", network)
        self.version = "+".join(f"{what}:{model.version}" for what, model in versions if model is not None)
        self.scores: tuple[float | None, tuple[float, ...]] = (None, ())

    def add(
        self, time_s: Array, temp_c: Array, q: Array, qd: Array, tau: Array, current_a: Array | None = None
    ) -> None:
        """Take readings that are later than those before, as in `fleet.live.arm.body.SensorLog`."""
        piece = Recording(name="live", time_s=time_s, q=q, qd=qd, tau=tau, current_a=current_a, temp_c=temp_c)
        difficulty, expected_c = self.scores
        if self._feed is not None and self._twin is not None and (parts := self._feed.add(piece)):
            *_, features = parts[-1]
            d = float(features.difficulty[-1] @ self._twin.joint_weight)
            difficulty = d if math.isfinite(d) else None
        if self._network is not None:
            self._expect(piece, self._network)
            expected_c = () if self._temp_c is None else tuple(self._temp_c[WINDING].tolist())
        self.scores = difficulty, expected_c

    def _expect(self, piece: Recording, network: Identified) -> None:
        """Advance the expected temperatures by the whole steps of `STEP_S` since the last ones."""
        self._heat.append(piece)
        if piece.time_s[-1] - self._heat[0].time_s[0] < 2 * STEP_S:  # `heat_logs` needs two
            return
        joined, motors, thermal = join(self._heat), network.heat_model.motors, network.heat_model.thermal()
        temp_c, end_s = self._temp_c, float(joined.time_s[-1])
        for log in heat_logs(joined, motors, source_of([joined])):
            if temp_c is None or log.time_s[0] != self._end_s:
                settled = housing_observer(thermal, motors, SETTLED_S)
                housing_c = settled.step(log.temp_c[0], log.temp_c[0], network.ambient_c, 0.0)
                temp_c = np.concatenate([log.temp_c[0], housing_c])
            current_sq = log.current_sq(motors.coulomb_nm, motors.viscous_nms_per_rad)
            friction_w = log.friction_w(motors.coulomb_nm, motors.viscous_nms_per_rad)
            for i, dt_s in enumerate(log.dt_s.tolist()):
                warm = magnet_factor(temp_c[HOUSING], motors) ** 2 if log.source == "current" else 1.0
                heat_w = drive_heat(temp_c, current_sq[i] * warm, friction_w[i], motors)
                temp_c = thermal.step(temp_c, heat_w, network.ambient_c, dt_s)
            if not (temp_c == np.clip(temp_c, *POSSIBLE_C)).all():
                temp_c = None
            self._end_s = end_s = float(log.time_s[-1])
        self._temp_c, self._heat = temp_c, [joined.part(joined.time_s >= end_s)]
