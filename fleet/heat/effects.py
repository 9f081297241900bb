"""Effects of heat besides faults: ageing of winding insulation, surfaces that people touch, drift of the tool point.

Ageing follows Arrhenius (Dakin, Trans. AIEE 67, 1948; the law behind IEC 60216): rate = exp(E/k · (1/T_class − 1/T)),
relative to that at the temperature of the thermal class. The activation energy E is the one for which the life halves
10 K above that temperature. Thermal classes are those of IEC 60085; 20,000 h is the time base of IEC 60216. Kinova does
not publish the class of the Gen3's windings. Class 155 (F) is assumed, which is usual for servo motors. The law is
extrapolated far below the temperatures of ageing tests.

The surface of a link has the temperature of its housing node: for an aluminium shell of 5 mm in still air the Biot
number h·L/k is below 0.001, so less than a thousandth of the rise falls across the shell (Incropera & DeWitt, ch. 5.1).
The joints of a Gen3 are normally covered in plastic rings (user guide p. 16), which only make the surface cooler.

Links grow with the temperature of the housings at their ends by ΔL = α L ΔT, as in Sigron, Aschwanden & Bambach,
"Compensation of geometric, backlash, and thermal drift errors using a universal industrial robot model" (IEEE Trans.
Automation Science and Engineering). Bending by a temperature gradient across a link is left out.

Kinova does not publish the material of the load path. Aluminium is assumed; a shell of carbon fibre grows by less than
a tenth of that, so the figures are upper bounds.
"""

from typing import NamedTuple

import numpy as np

from fleet.heat.thermal import HOUSING
from fleet.robot import JOINTS

Array = np.ndarray

KELVIN_AT_0_C = 273.15
RATED_C, RATED_LIFE_H = 155.0, 20_000.0
"""Temperature of the thermal class, and the life of a winding at it."""
HALVING_K = 10.0
"""Rise above that temperature which halves the life."""
_RATED_K = RATED_C + KELVIN_AT_0_C
ACTIVATION_K = float(np.log(2.0)) * _RATED_K * (_RATED_K + HALVING_K) / HALVING_K
"""Activation energy over the Boltzmann constant."""


def arrhenius_rate(winding_c: Array | float) -> Array:
    """Rate of ageing relative to that at the temperature of the class, [...]; 1 at that temperature.

    Args:
        winding_c: Temperatures of windings, °C, [...].
    """
    return np.exp(ACTIVATION_K * (1.0 / _RATED_K - 1.0 / (np.asarray(winding_c, dtype=float) + KELVIN_AT_0_C)))


def life_used(before: Array | float, after: Array | float, dt_s: Array | float) -> Array:
    """Share of the rated life that windings use in a time, by the trapezoidal rule, [...].

    Args:
        before, after: Rates of ageing at its beginning and end, [...].
        dt_s: Its length, s; short against the time constant of a winding, which is above a minute.
    """
    return (np.asarray(before) + after) / 2.0 * dt_s / (3600.0 * RATED_LIFE_H)


class Threshold(NamedTuple):
    """Burn threshold of smooth uncoated metal at one contact time."""

    contact_s: float
    burn_c: float
    source: str


_EN_563 = "DIN EN 563:1994 as quoted in BGV D34 (DGUV Vorschrift 79), § 12"
_READING = "DIN EN ISO 13732-1:2008, its curve as read by a maker of insulation mats (berührungsschutz.com)"
THRESHOLDS = (
    Threshold(1.0, 65.0, _EN_563),
    Threshold(2.0, 60.0, _READING),
    Threshold(5.0, 56.0, _READING),
    Threshold(60.0, 51.0, _EN_563),
    Threshold(600.0, 48.0, _EN_563),
    Threshold(28800.0, 43.0, _EN_563),
)
"""Below these a burn is not expected. Up to 5 s the standard gives a range (65–70, 60–64, 56–61 °C); here its low end.

EN ISO 13732-1 continues EN 563 with the same values for metal. The second source reads 62 °C at 1 s. From 1 min on the
value of a minute holds for coated metal as well, and from 10 min on for every material.
"""
SHORTEST_CONTACT_S, LONGEST_CONTACT_S = THRESHOLDS[0].contact_s, THRESHOLDS[-1].contact_s


def burn_threshold_c(contact_s: float) -> float:
    """Surface temperature of uncoated metal below which a contact of this length does not burn skin, °C.

    Linear in the logarithm of time between the values of `THRESHOLDS`.

    Raises:
        ValueError: the contact is shorter than 1 s or longer than 8 h, for which there are no values.
    """
    if not SHORTEST_CONTACT_S <= contact_s <= LONGEST_CONTACT_S:
        raise ValueError(
            f"A contact time must be between {SHORTEST_CONTACT_S:g} and {LONGEST_CONTACT_S:g} s (got {contact_s:g})."
        )
    times_s, limits_c, _ = zip(*THRESHOLDS, strict=True)
    return float(np.interp(np.log(contact_s), np.log(times_s), limits_c))


def surface_c(temp_c: Array) -> Array:
    """Hottest surface of each arm that can be touched, °C, [...], from its temperatures [..., node]."""
    return temp_c[..., HOUSING].max(axis=-1)


def seconds_above(before_c: Array, after_c: Array, limit_c: float, dt_s: float) -> Array:
    """Time above a limit in a step, s, [...], for temperatures that change linearly in it.

    Args:
        before_c, after_c: At its beginning and end, °C, [...].
        dt_s: Its length, s; short against the time constant of a housing, which is above half an hour.
    """
    low, high = np.minimum(before_c, after_c), np.maximum(before_c, after_c)
    steady = np.array(high > limit_c, dtype=float)
    share = np.divide(high - limit_c, high - low, out=steady, where=high > low)
    return dt_s * np.clip(share, 0.0, 1.0)


ALUMINIUM_PER_K = 23.6e-6
"""Linear expansion of aluminium 6061 at 20 to 100 °C, 1/K (ASM Handbook 2)."""
SEGMENTS = JOINTS + 1
"""From the base to joint 1, between neighbouring joints, and from joint 7 to the flange."""
GEN3_SEGMENTS_M = (0.15643, 0.12849, 0.21048, 0.21048, 0.20853, 0.10593, 0.10593, 0.06153)
"""Lengths of the segments of a Gen3, as in `fleet/arm/assets/gen3.xml`."""


def segment_temperatures(housing_c: Array) -> Array:
    """Temperatures of the segments, °C, [..., segment]: the mean of the housings at the two ends.

    The segment of the base has the temperature of the first housing, that of the flange the last one's.

    Args:
        housing_c: Temperatures of the housings, °C, [..., joint].
    """
    housing_c = np.asarray(housing_c, dtype=float)
    between = (housing_c[..., :-1] + housing_c[..., 1:]) / 2.0
    return np.concatenate([housing_c[..., :1], between, housing_c[..., -1:]], axis=-1)


def most_drift_m(rise_k: Array) -> Array:
    """Least upper bound of the displacement of the tool point over all postures, m, [...]: all segments in line.

    A stretched arm comes close to it.

    Args:
        rise_k: Temperatures of the segments above those at which the arm was calibrated, K, [..., segment].
    """
    return ALUMINIUM_PER_K * (np.abs(rise_k) * np.asarray(GEN3_SEGMENTS_M)).sum(axis=-1)
