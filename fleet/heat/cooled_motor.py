"""The motor of Zhu et al. under four ways of cooling, as a two-node network fitted to their published numbers.

C_w Tw' = P (1 + a_cu (Tw − T0)) − G_i (Tw − Th) − G_d (Tw − T0);  C_h Th' = G_i (Tw − Th) − G_o (Th − T0).
The numbers fix ratios only: every conductance and the heat are relative to the winding's capacity C_w. The current is
constant; coolant and start are at T0 = 26 °C. Numbers: tables 1 and 2 of E. Guiffo Kaigom, arXiv 2509.12740, after
Zhu et al.
"""

from dataclasses import dataclass, fields
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.optimize import brentq, least_squares

from fleet.motor import thermal_data
from fleet.robot import COOLING, Cooling
from fleet.thermal import ThermalModel, in_series, modal_model

Array = np.ndarray

Arrangement = Literal["no_interface", "forced_air", "forced_water", "immersion"]
ARRANGEMENTS: tuple[Arrangement, ...] = get_args(Arrangement)
"""Without thermal interface material; with it and forced air (40 mm fan); forced water; deionised water all around."""

_MEDIUM: dict[Arrangement, Cooling] = {
    "no_interface": "still_air",
    "forced_air": "forced_air",
    "forced_water": "liquid",
    "immersion": "immersion",
}

COOLANT_C, LIMIT_C = 26.0, 125.0
LONGEST_S = 1e5
"""Time after which a motor below its limit counts as never reaching it."""


class Published(NamedTuple):
    """Published figures of the motor."""

    limit_s: dict[Arrangement, float]
    """Time from 26 °C to 125 °C."""
    immersed_c: float
    """Temperature at which the immersed winding settles."""
    immersed_ratio: float
    """Conductance from winding to water of immersion relative to forced water."""


ZHU = Published({"no_interface": 3.6, "forced_air": 10.69, "forced_water": 11.59}, 85.0, 3.7)


@dataclass(frozen=True, kw_only=True)
class CooledMotor:
    """One motor; conductances and heat divided by the winding's heat capacity."""

    heating_k_per_s: float
    """Copper loss at 26 °C."""
    housing_capacity: float
    """Heat capacity of the housing relative to the winding."""
    bare_per_s: float
    """Winding to housing without interface material."""
    interface_per_s: float
    """Winding to housing with it."""
    water_per_s: float
    """Housing to forced water; forced and still air have the ratios of `fleet.robot.COOLING`."""
    direct_per_s: float
    """Winding to the water around it in immersion."""

    def outer_per_s(self, arrangement: Arrangement) -> float:
        """Conductance from housing to coolant."""
        medium = COOLING[_MEDIUM[arrangement]]
        return self.water_per_s * medium.ambient_factor / COOLING["liquid"].ambient_factor

    def conductance_per_s(self, arrangement: Arrangement) -> float:
        """Whole conductance from winding to coolant at rest."""
        inner = self.bare_per_s if arrangement == "no_interface" else self.interface_per_s
        through = in_series(inner, self.outer_per_s(arrangement))
        return through + (self.direct_per_s if arrangement == "immersion" else 0.0)

    def model(self, arrangement: Arrangement) -> ThermalModel:
        """Exact steps of winding and housing, with the rise of copper loss as a negative conductance at the winding."""
        inner = self.bare_per_s if arrangement == "no_interface" else self.interface_per_s
        direct = self.direct_per_s if arrangement == "immersion" else 0.0
        outer = self.outer_per_s(arrangement)
        rise = self.heating_k_per_s * float(thermal_data()["alpha_cu_per_k"])
        laplacian = np.array([[inner + direct - rise, -inner], [-inner, inner + outer]])
        return modal_model(np.array([1.0, self.housing_capacity]), laplacian, np.array([direct, outer]))

    def temperatures(self, arrangement: Arrangement, time_s: float) -> Array:
        """Temperatures of winding and housing after a time under load from 26 °C, °C, [2]."""
        _, gamma = self.model(arrangement).step_matrices(time_s)
        return COOLANT_C + gamma @ np.array([self.heating_k_per_s, 0.0])

    def steady_c(self, arrangement: Arrangement) -> float:
        """Temperature at which the winding settles, °C; inf for a thermal runaway."""
        model = self.model(arrangement)
        if model.rates.min() <= 0:
            return np.inf
        return COOLANT_C + float(np.linalg.solve(model.laplacian, np.array([self.heating_k_per_s, 0.0]))[0])

    def limit_s(self, arrangement: Arrangement) -> float:
        """Time until the winding reaches 125 °C, s; inf if it never does."""

        def excess(time_s: float) -> float:
            return float(self.temperatures(arrangement, time_s)[0]) - LIMIT_C

        if self.steady_c(arrangement) <= LIMIT_C:
            return np.inf
        late_s = 1.0
        while excess(late_s) < 0:
            late_s *= 2
            if late_s > LONGEST_S:
                return np.inf
        return float(brentq(excess, 0.0, late_s))  # pyright: ignore[reportArgumentType]

    def figures(self) -> dict[str, float]:
        """The published figures as this motor has them, see `published`."""
        ratio = self.conductance_per_s("immersion") / self.conductance_per_s("forced_water")
        times = {f"{each}_s": self.limit_s(each) for each in ZHU.limit_s}
        return {**times, "immersed_c": self.steady_c("immersion"), "immersed_ratio": ratio}


def published() -> dict[str, float]:
    """The published figures by the names of `CooledMotor.figures`."""
    times = {f"{each}_s": value for each, value in ZHU.limit_s.items()}
    return {**times, "immersed_c": ZHU.immersed_c, "immersed_ratio": ZHU.immersed_ratio}


ZHU_MOTOR = CooledMotor(
    heating_k_per_s=25.840,
    housing_capacity=3.4667,
    bare_per_s=0.068938,
    interface_per_s=0.77130,
    water_per_s=0.17979,
    direct_per_s=0.39368,
)
"""The result of `fit_motor`."""

CAPACITY_PRIOR, BARE_PRIOR = (3.0, 0.5), (0.1, 1.0)
"""Medians and standard deviations of the logarithm: stator core and shell weigh about three times the copper; a gap of
air with a few contact points conducts about a tenth of one that is filled. The five figures leave two numbers open."""
_FIGURE_SD = 0.01


class Fit(NamedTuple):
    """Result of `fit_motor`."""

    motor: CooledMotor
    relative_sd: dict[str, float]
    """Standard deviation of each parameter's logarithm, by name; about that of its prior where the figures say
    nothing."""


def fit_motor() -> Fit:
    """The most probable motor given the published figures (1 %) and the two priors."""

    def residuals(x: Array) -> Array:
        motor = _motor(x)
        got, wanted = motor.figures(), published()
        figures = [np.log(min(got[name], LONGEST_S) / wanted[name]) / _FIGURE_SD for name in wanted]
        (core, core_sd), (bare, bare_sd) = CAPACITY_PRIOR, BARE_PRIOR
        gap = np.log(motor.bare_per_s / motor.interface_per_s / bare) / bare_sd
        return np.array([*figures, np.log(motor.housing_capacity / core) / core_sd, gap])

    start = np.log([23.0, 3.0, 0.03, 0.3, 0.3, 0.35])
    solution = least_squares(residuals, start, xtol=1e-12, ftol=1e-12)
    sd = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    names = [field.name for field in fields(CooledMotor)]
    return Fit(_motor(solution.x), dict(zip(names, sd.tolist(), strict=True)))


def _motor(x: Array) -> CooledMotor:
    """The motor with these logarithms, [parameter]."""
    names = (field.name for field in fields(CooledMotor))
    return CooledMotor(**dict(zip(names, np.exp(x).tolist(), strict=True)))
