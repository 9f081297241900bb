"""Thermal drift of the tool point: links grow with the temperature of the housings at their ends.

Linear expansion ΔL = α L ΔT of every link of the chain, as in Sigron, Aschwanden & Bambach, "Compensation of geometric,
backlash, and thermal drift errors using a universal industrial robot model" (IEEE Trans. Automation Science and
Engineering). Only the lengths change here: bending by a temperature gradient across a link is left out.

Kinova does not publish the material of the load path. Aluminium is assumed; a shell of carbon fibre grows by less than
a tenth of that, so the figures are upper bounds.
"""

import numpy as np

from fleet.robot import JOINTS

Array = np.ndarray

ALUMINIUM_PER_K = 23.6e-6
"""Linear expansion of aluminium 6061 at 20 to 100 °C, 1/K (ASM Handbook 2)."""
SEGMENTS = JOINTS + 1
"""From the base to joint 1, between neighbouring joints, and from joint 7 to the flange."""
GEN3_SEGMENTS_M = (0.15643, 0.12849, 0.21048, 0.21048, 0.20853, 0.10593, 0.10593, 0.06153)
"""Lengths of the segments of a Gen3, as in `fleet/physics/assets/gen3.xml`."""


def segment_temperatures(housing_c: Array) -> Array:
    """Temperatures of the segments, °C, [..., segment]: the mean of the housings at the two ends.

    The segment of the base has the temperature of the first housing, that of the flange the last one's.

    Args:
        housing_c: Temperatures of the housings, °C, [..., joint].
    """
    housing_c = np.asarray(housing_c, dtype=float)
    between = (housing_c[..., :-1] + housing_c[..., 1:]) / 2.0
    return np.concatenate([housing_c[..., :1], between, housing_c[..., -1:]], axis=-1)


def drift_m(segments_m: Array, rise_k: Array, expansion_per_k: float = ALUMINIUM_PER_K) -> Array:
    """Displacement of the tool point by thermal expansion in a posture, m, [..., 3].

    Args:
        segments_m: Vectors from joint to joint in that posture, m, [..., segment, 3].
        rise_k: Temperatures of the segments above those at which the arm was calibrated, K, [..., segment].
    """
    return expansion_per_k * (np.asarray(rise_k)[..., None] * segments_m).sum(axis=-2)


def most_drift_m(rise_k: Array, lengths_m: Array | None = None, expansion_per_k: float = ALUMINIUM_PER_K) -> Array:
    """Least upper bound of the drift over all directions of the segments, m, [...]: all of them in line.

    A stretched arm comes close to it. It needs no posture.

    Args:
        rise_k: As in `drift_m`.
        lengths_m: Lengths of the segments, m, [segment]; default: those of a Gen3.
    """
    lengths = np.asarray(GEN3_SEGMENTS_M if lengths_m is None else lengths_m)
    return expansion_per_k * (np.abs(rise_k) * lengths).sum(axis=-1)
