"""Thermal ageing of winding insulation: rate of ageing at a temperature, and the rated life that a shift uses.

Two laws of one rate, relative to that at the temperature of the thermal class:

- Montsinger (Trans. AIEE 49, 1930): the life halves with every 10 K.
- Arrhenius (Dakin, Trans. AIEE 67, 1948; the law behind IEC 60216): rate = exp(E/k · (1/T_class − 1/T)). The activation
  energy E is the one for which the life halves 10 K above the temperature of the class.

Thermal classes are those of IEC 60085; 20,000 h is the time base of IEC 60216. Kinova does not publish the class of the
Gen3's windings. Class 155 (F) is assumed, which is usual for servo motors. Both laws are extrapolated far below the
temperatures of ageing tests; there Arrhenius gives the slower ageing, as its halving interval falls with T².
"""

from dataclasses import dataclass

import numpy as np

from fleet.errors import check_between, check_positive

Array = np.ndarray

KELVIN_AT_0_C = 273.15
BOLTZMANN_EV_PER_K = 8.617333262e-5


@dataclass(frozen=True, kw_only=True)
class Insulation:
    """Insulation system of a winding."""

    rated_c: float = 155.0
    """Temperature of the thermal class, °C."""
    rated_life_h: float = 20_000.0
    """Life at that temperature, h."""
    halving_k: float = 10.0
    """Rise above that temperature which halves the life, K."""

    def __post_init__(self) -> None:
        check_between(self, 0.0, 400.0, "rated_c")
        check_positive(self, "rated_life_h", "halving_k")

    @property
    def activation_k(self) -> float:
        """Activation energy over the Boltzmann constant, K."""
        rated_k = self.rated_c + KELVIN_AT_0_C
        return float(np.log(2.0)) * rated_k * (rated_k + self.halving_k) / self.halving_k

    @property
    def activation_ev(self) -> float:
        """Activation energy, eV."""
        return self.activation_k * BOLTZMANN_EV_PER_K


_LETTERS = {105: "A", 120: "E", 130: "B", 155: "F", 180: "H"}
CLASSES: dict[str, Insulation] = {
    f"{rated_c} ({letter})": Insulation(rated_c=float(rated_c)) for rated_c, letter in _LETTERS.items()
}
"""Thermal classes of IEC 60085."""
GEN3_INSULATION = CLASSES["155 (F)"]
"""Assumed; see the module docstring."""


def arrhenius_rate(winding_c: Array | float, insulation: Insulation = GEN3_INSULATION) -> Array:
    """Rate of ageing relative to that at the temperature of the class, [...]; 1 at that temperature.

    Args:
        winding_c: Temperatures of windings, °C, [...].
    """
    absolute_k = np.asarray(winding_c, dtype=float) + KELVIN_AT_0_C
    return np.exp(insulation.activation_k * (1.0 / (insulation.rated_c + KELVIN_AT_0_C) - 1.0 / absolute_k))


def montsinger_rate(winding_c: Array | float, insulation: Insulation = GEN3_INSULATION) -> Array:
    """As `arrhenius_rate`, with the same halving interval at every temperature."""
    return np.exp2((np.asarray(winding_c, dtype=float) - insulation.rated_c) / insulation.halving_k)


def life_used(
    before: Array | float, after: Array | float, dt_s: Array | float, insulation: Insulation = GEN3_INSULATION
) -> Array:
    """Share of the rated life that windings use in a time, by the trapezoidal rule, [...].

    Args:
        before, after: Rates of ageing at its beginning and end, [...].
        dt_s: Its length, s; short against the time constant of a winding, which is above a minute.
    """
    return (np.asarray(before) + after) / 2.0 * dt_s / (3600.0 * insulation.rated_life_h)
