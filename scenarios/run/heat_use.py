"""What the heat of a shift does: insulation life that is used, drift of the tool points, surfaces too hot to touch."""

import numpy as np

from fleet.heat.insulation import arrhenius_rate, life_used
from fleet.heat.tool_drift import most_drift_m, segment_temperatures
from fleet.heat.touch import seconds_above, surface_c
from fleet.thermal import HOUSING, WINDING

Array = np.ndarray


class HeatUse:
    """Sums over the recorded temperatures of a shift, with any leading axes.

    Args:
        temp_c: Temperatures at the beginning, °C, [..., arm, node]. The tool points are calibrated there.
        burn_c: Temperature above which a surface is too hot to touch.
    """

    def __init__(self, temp_c: Array, burn_c: float) -> None:
        self._burn_c, self._surface_c = burn_c, surface_c(temp_c)
        self.surface_c = self._surface_c.copy()
        """Hottest surface of each arm so far, °C, [..., arm]."""
        self._hot_s = np.zeros_like(self._surface_c)
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
        now_c = surface_c(temp_c)
        self._hot_s += seconds_above(self._surface_c, now_c, self._burn_c, dt_s)
        np.maximum(self.surface_c, now_c, out=self.surface_c)
        self._surface_c = now_c

    @property
    def insulation_ppb(self) -> Array:
        """Billionths of the rated life that the most aged winding of each arm used, [..., arm]."""
        return 1e9 * self._used.max(axis=-1)

    @property
    def tool_drift_mm(self) -> Array:
        """The most that the tool point of the stretched arm drifted, mm, [..., arm]."""
        return 1e3 * self._drift_m

    @property
    def hot_surface_min(self) -> Array:
        """Time with a surface too hot to touch, min, [..., arm]."""
        return self._hot_s / 60.0
