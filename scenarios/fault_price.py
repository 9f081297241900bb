"""The price of a fault in a scenario: the default cost of a fault in the reward.

The two factors of `fleet.engine.reward.FaultPrice` follow from the scenario alone.

- Value rate: expected value of arriving jobs per second, over all streams.
- Downtime: time in which all motors of a nominal arm cool below `limits.restart_c`, plus `limits.clear_s`. The arm
  starts at the steady temperatures of a constant load on joint 2 that brings its winding to `limits.error_c`. The
  ambient temperature is the mean of the shift.
"""

import numpy as np

from fleet.engine.reward import FaultPrice, RewardWeights
from fleet.motor import gen3_motors
from fleet.robot import JOINTS, ThermalLimits
from fleet.thermal import NODES, WINDING, gen3_network, node_heat, thermal_model
from scenarios.schema import Scenario

CARRIER = 1
"""Index of joint 2, which carries most of the torque of an outstretched arm."""
AMBIENT_SAMPLES = 100


def weights_of(scenario: Scenario) -> RewardWeights:
    """Weights of the reward terms; the default of `faults` is minus the price of a fault."""
    given = scenario.reward
    faults = -fault_price(scenario).price if given.faults is None else given.faults
    return RewardWeights(**{**vars(given), "faults": faults})


def fault_price(scenario: Scenario) -> FaultPrice:
    """The price of a fault by value rate and downtime; it ignores `reward.faults` of the scenario."""
    value = sum(stream.value * stream.arrivals.expected(scenario.horizon_s) for stream in scenario.jobs)
    shift_s = scenario.horizon_s
    ambient_c = float(np.mean(scenario.ambient.at(np.linspace(0.0, shift_s, AMBIENT_SAMPLES))))
    return FaultPrice(value / shift_s, downtime_s(scenario.limits, ambient_c, most_s=shift_s))


def downtime_s(limits: ThermalLimits, ambient_c: float, *, most_s: float) -> float:
    """Time from a fault until the arm works again, s, at most `most_s`; see the module docstring.

    Args:
        ambient_c: Mean ambient temperature.
    """
    from scipy.optimize import brentq  # slow import that an arm does not need

    motors, thermal = gen3_motors(), thermal_model(gen3_network())
    idle_w = node_heat(np.zeros(JOINTS), motors.idle_w)
    rise_k = thermal.steady(np.eye(NODES)[CARRIER], 0.0)  # per W into the winding
    idle_c = thermal.steady(idle_w, ambient_c)
    fault_c = idle_c + (limits.error_c - idle_c[CARRIER]) / rise_k[CARRIER] * rise_k
    cooling_w = np.zeros(NODES) if limits.power_off_on_fault else idle_w

    def excess_k(time_s: float) -> float:
        return float(thermal.step(fault_c, cooling_w, ambient_c, time_s)[WINDING].max() - limits.restart_c)

    if excess_k(most_s) >= 0:
        return most_s
    cooled_s = brentq(excess_k, 0.0, most_s)
    assert isinstance(cooled_s, float)
    return min(most_s, cooled_s + limits.clear_s)
