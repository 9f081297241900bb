"""Temperature of the surfaces that people touch, and the burn thresholds of skin on hot metal.

The surface of a link has the temperature of its housing node: for an aluminium shell of 5 mm in still air the Biot
number h·L/k is below 0.001, so less than a thousandth of the rise falls across the shell (Incropera & DeWitt, ch. 5.1).
The joints of a Gen3 are normally covered in plastic rings (user guide p. 16), which only make the surface cooler.
"""

from typing import NamedTuple

import numpy as np

from fleet.thermal import HOUSING

Array = np.ndarray


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
