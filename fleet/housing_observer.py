"""An observer of the housing temperatures, which have no sensor, from the measured motor temperatures.

The housings' part of the thermal network is driven by the measured windings, the ambient and the friction of the
motion: C_h Th' = −L_hh Th + G_wh Tw + g Ta + P_h, stepped exactly for constant inputs. It is a reduced-order observer
(Luenberger, IEEE Trans. Automatic Control 16, 1971) without correction: an initial error decays with the housings' time
constants.
"""

from typing import NamedTuple

import numpy as np

from fleet.motor import Motors
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, NODES, WINDING, ThermalModel

Array = np.ndarray


class HousingObserver(NamedTuple):
    """Matrices of one step; leading axes for several arms."""

    keep: Array
    """Share of each housing's temperature that remains, [..., joint, joint]."""
    gain: Array
    """Warming by constant heat, K/W, [..., joint, joint]."""
    from_winding: Array
    """Conductance between winding and housing, W/K, [..., joint]."""
    from_ambient: Array
    """Conductance between ambient and housing, W/K, [..., joint]."""
    idle_w: Array
    """Heat of the powered motor without load, W, [..., joint]."""

    def step(self, housing_c: Array, motor_c: Array, ambient_c: Array | float, friction_w: Array | float) -> Array:
        """Estimated housing temperatures after the step of a powered arm, °C, [..., joint].

        Args:
            housing_c: Estimate before, [..., joint].
            motor_c: Mean measured motor temperatures in the step, [..., joint].
            ambient_c: [...].
            friction_w: Mean friction heat in the step, [..., joint].
        """
        load = self.from_winding * motor_c + self.from_ambient * np.asarray(ambient_c, dtype=float)[..., None]
        load = load + self.idle_w + friction_w
        return (self.keep @ housing_c[..., None] + self.gain @ load[..., None])[..., 0]


def housing_observer(thermal: ThermalModel, motors: Motors, dt_s: float) -> HousingObserver:
    """The observer that follows from what is known of an arm, for steps of `dt_s`."""
    inner = thermal.laplacian[HOUSING, HOUSING]
    root = np.sqrt(thermal.capacity[HOUSING])
    rates, modes = np.linalg.eigh(inner / np.outer(root, root))
    left, right = modes / root[:, None], modes.T
    keep = (left * np.exp(-rates * dt_s)) @ (right * root)
    gain = (left * (-np.expm1(-rates * dt_s) / rates)) @ (right / root)
    from_winding = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    return HousingObserver(keep, gain, from_winding.copy(), thermal.to_ambient[HOUSING], motors.idle_w)


assert NODES == 2 * JOINTS, "each joint has a winding and a housing"
