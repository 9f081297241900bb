"""Estimate the housing temperatures, which have no sensor, from the measured motor temperatures.

The inputs of the housings' part of the thermal network are the measured windings, the ambient temperature, and idle and
friction heat: C_h Th' = −L_hh Th + G_wh Tw + g Ta + P_h, stepped exactly for constant inputs. It is a reduced-order
observer (Luenberger, IEEE Trans. Automatic Control 16, 1971) without correction: an initial error decays with the
housings' time constants.
"""

from typing import NamedTuple

import numpy as np

from fleet.motor import Motors
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, NODES, WINDING, ThermalModel

Array = np.ndarray


class HousingObserver(NamedTuple):
    """Matrices of one step of the observer; leading axes for several arms."""

    keep: Array
    """Transition matrix of the housing temperatures, [..., joint, joint]."""
    gain: Array
    """Temperature change per constant heat, K/W, [..., joint, joint]."""
    from_winding: Array
    """Conductance between winding and housing, W/K, [..., joint]."""
    from_ambient: Array
    """Conductance between ambient and housing, W/K, [..., joint]."""
    idle_w: Array
    """Heat of the powered motor without load, W, [..., joint]."""

    def step(self, housing_c: Array, motor_c: Array, ambient_c: Array | float, friction_w: Array | float) -> Array:
        """Estimated housing temperatures of a powered arm after the step, °C, [..., joint].

        Args:
            housing_c: Estimate before, [..., joint].
            motor_c: Mean measured motor temperatures in the step, [..., joint].
            ambient_c: [...].
            friction_w: Mean friction heat in the step, [..., joint].
        """
        load = self.from_winding * motor_c + self.from_ambient * np.asarray(ambient_c, dtype=float)[..., None]
        load = load + self.idle_w + friction_w
        return (self.keep @ housing_c[..., None] + self.gain @ load[..., None])[..., 0]


def housing_observer(thermal: ThermalModel, motors: Motors, dt_s: Array | float) -> HousingObserver:
    """The observer of an arm with this thermal model and these motors.

    Args:
        dt_s: Length of the step; [...] for one observer per element.
    """
    dt = np.asarray(dt_s, dtype=float)[..., None, None]
    inner = thermal.laplacian[HOUSING, HOUSING]
    root = np.sqrt(thermal.capacity[HOUSING])
    rates, modes = np.linalg.eigh(inner / np.outer(root, root))
    left, right = modes / root[:, None], modes.T
    keep = (left * np.exp(-rates * dt)) @ (right * root)
    gain = (left * (-np.expm1(-rates * dt) / rates)) @ (right / root)
    from_winding = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    return HousingObserver(keep, gain, from_winding.copy(), thermal.to_ambient[HOUSING], motors.idle_w)


assert NODES == 2 * JOINTS, "each joint has a winding and a housing"
