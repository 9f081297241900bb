"""What the heat of a shift does to the arms: insulation life that is used, and drift of the tool points."""

import numpy as np

from fleet.heat.insulation import arrhenius_rate, life_used
from fleet.heat.tool_drift import most_drift_m, segment_temperatures
from fleet.thermal import HOUSING, WINDING

Array = np.ndarray


class HeatUse:
    """Sums over the recorded temperatures of a shift, with any leading axes.

    Args:
        temp_c: Temperatures at the beginning, °C, [..., arm, node]. The tool points are calibrated there.
    """

    def __init__(self, temp_c: Array) -> None:
        self._start_c = segment_temperatures(temp_c[..., HOUSING])
        self._rate = arrhenius_rate(temp_c[..., WINDING])
        self._used = np.zeros_like(self._rate)
        self._drift_m = np.zeros(self._rate.shape[:-1])

    def add(self, temp_c: Array, dt_s: float) -> None:
        """Take the temperatures `dt_s` later, °C, [..., arm, node]."""
        rate = arrhenius_rate(temp_c[..., WINDING])
        self._used += life_used(self._rate, rate, dt_s)
        self._rate = rate
        rise_k = segment_temperatures(temp_c[..., HOUSING]) - self._start_c
        np.maximum(self._drift_m, most_drift_m(rise_k), out=self._drift_m)

    @property
    def insulation_ppb(self) -> Array:
        """Billionths of the rated life that the most aged winding of each arm used, [..., arm]."""
        return 1e9 * self._used.max(axis=-1)

    @property
    def tool_drift_mm(self) -> Array:
        """The most that the tool point of the stretched arm drifted, mm, [..., arm]."""
        return 1e3 * self._drift_m
