"""An identified arm tried on a recording it has not seen: only what is hidden at its start is free."""

from dataclasses import dataclass

import numpy as np

from fleet.robot import JOINTS
from fleet.thermal import HOUSING, WINDING
from twin.heat_log import Source, heat_logs
from twin.identified import Identified
from twin.recording import Recording
from twin.thermal_fit import Noise, Problem
from twin.thermal_values import Body, Layout

Array = np.ndarray

_ROUNDS = 3
"""Resistance and magnets follow the simulated temperatures, not the measured ones: three rounds settle that."""


@dataclass(frozen=True, eq=False)
class Replay:
    """Simulated against measured motor temperatures of one recording."""

    time_s: Array
    """[time]."""
    temp_c: Array
    """Simulated nodes, [time, node]."""
    error_k: Array
    """Simulated minus measured, [time, joint]."""

    @property
    def rms_k(self) -> Array:
        """Root mean square of the error, [joint]."""
        return np.sqrt(np.mean(self.error_k**2, axis=0))


def replay(
    body: Body | Identified, recording: Recording, *, ambient_c: float, source: Source = "current", step_s: float = 0.0
) -> Replay:
    """The recording's heat through a network; initial temperatures by least squares, in each stretch between gaps.

    Args:
        source: "torque" takes the current from the motor law, as for a motion that is only planned.
        step_s: 0 keeps every sample.

    Raises:
        ValueError: no temperatures, no currents where they are the source, or fewer than three samples.
    """
    arm = body.body if isinstance(body, Identified) else body
    logs = heat_logs(recording, arm.motors, source, step_s=step_s)
    if not logs:
        raise ValueError(f"Recording '{recording.name}' has no stretch of three samples without a gap.")
    layout = Layout(arm)
    problem = Problem(logs, ambient_c, 0.0, layout, Noise(np.full(JOINTS, 0.01), np.ones(JOINTS)))
    temp_c = problem.temperatures(layout.mean)
    for _ in range(_ROUNDS - 1):
        problem.winding_c = [_middle(temp[:, WINDING]) for temp in temp_c]
        problem.housing_c = [_middle(temp[:, HOUSING]) for temp in temp_c]
        temp_c = problem.temperatures(layout.mean)
    simulated, measured = np.concatenate(temp_c), np.concatenate([log.temp_c for log in logs])
    return Replay(np.concatenate([log.time_s for log in logs]), simulated, simulated[:, WINDING] - measured)


def _middle(edges: Array) -> Array:
    return (edges[1:] + edges[:-1]) / 2.0
