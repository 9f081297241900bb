"""P(saturation) from the thermal network: margins that are affine in the temperatures at the start, and one slope.

During a job the drive is that of its plan. Copper loss rises linearly with the winding's temperature; the magnets
(a percent per ten kelvin) are taken at their temperature halfway. So the temperature of each motor at each time is
affine in the motor temperatures at the start, and the worst margin is a maximum of affine pieces.
"""

from dataclasses import dataclass

import numpy as np

from fleet.difficulty import KNOWN, Forecast
from fleet.motion import Drive
from fleet.motor import Motors, copper_loss, magnet_factor
from fleet.robot import JOINTS
from fleet.thermal import NODES, WINDING, ThermalModel, node_heat
from twin.saturation.fit import check_outcomes, logistic

Array = np.ndarray

MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of a job's time at which margins are computed; under a constant drive a peak is at an end or flat."""
ROOM_K = 10.0
"""Scale of a margin without a predicted rise; prediction errors grow with the rise."""
_STRENGTH = 100.0
"""Inverse regularisation of a single slope: hardly any."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Scaled margins (predicted temperature − limit) / scale of one job: offset + weight @ measured temp_c."""

    offset: Array
    """[piece]."""
    weight: Array
    """1/K, [piece, joint]."""

    def margin(self, temp_c: Array) -> float:
        """The worst margin at motor temperatures [joint]."""
        return float((self.offset + self.weight @ temp_c).max())


@dataclass(frozen=True, kw_only=True)
class MarginHead:
    """P = logistic(intercept + slope · margin), fitted on past jobs."""

    intercept: float
    slope: float
    jobs: int
    passed: int

    @property
    def name(self) -> str:
        """Part of the twin's version."""
        return f"{self.intercept:.4g}+{self.slope:.4g}m"

    def risk(self, of_job: Pieces) -> Forecast:
        """The probability for any temperatures at the start."""
        weight = np.zeros((len(of_job.offset), KNOWN))
        weight[:, :JOINTS] = self.slope * of_job.weight
        return Forecast(self.intercept + self.slope * of_job.offset, weight)


def fit_head(margin: Array, passed: Array) -> MarginHead:
    """Logistic regression of the outcome of past jobs on their predicted margin, [job], with a slope >= 0.

    Raises:
        NotEnoughExperience: too few jobs, or hardly any of one kind.
    """
    passed = np.asarray(passed, dtype=bool)
    check_outcomes(passed)
    spread = max(float(margin.std()), 1e-9)
    slope, offset = logistic(margin[:, None] / spread, passed, np.array([True]), _STRENGTH)
    return MarginHead(
        intercept=float(offset), slope=float(slope[0] / spread), jobs=len(passed), passed=int(passed.sum())
    )


def affine_margins(
    load: Drive,
    duration_s: Array,
    *,
    magnets_c: Array,
    motors: Motors,
    thermal: ThermalModel,
    ambient_c: float,
    idle_c: Array,
    limit_c: float,
    start_of_windings: Array,
) -> list[Pieces]:
    """Margins of jobs with constant drives as affine functions of the motor temperatures at their start.

    Args:
        load: [job, joint].
        magnets_c: Housing temperature at which the magnets are taken, [job, joint].
        idle_c: Motor temperatures after long idling, [joint].
        start_of_windings: From measured motor temperatures to those of all nodes, [node, joint].
    """
    warm_sq = load.current_sq / magnet_factor(magnets_c, motors) ** 2
    at_zero = copper_loss(warm_sq, np.zeros_like(warm_sq), motors)
    slope = copper_loss(warm_sq, np.ones_like(warm_sq), motors) - at_zero  # W/K
    heat_w = node_heat(at_zero, motors.idle_w + load.friction_w) + thermal.to_ambient * ambient_c
    laplacian = thermal.laplacian - np.eye(NODES) * node_heat(slope, np.zeros(JOINTS))[:, None, :]
    root = np.sqrt(thermal.capacity)
    rates, modes = np.linalg.eigh(laplacian / np.outer(root, root))
    margins = []
    for job in range(len(duration_s)):
        phi, gamma = _affine(rates[job], modes[job], root, duration_s[job] * np.array(MOMENTS))
        forced = gamma @ heat_w[job]  # [moment, joint]
        by_start = phi @ start_of_windings
        # Errors of a prediction grow with the rise that the job itself adds to the idle temperature.
        scale = ROOM_K + np.maximum(forced + by_start @ idle_c - idle_c, 0.0)
        weight = (by_start / scale[..., None]).reshape(-1, JOINTS)
        margins.append(Pieces(((forced - limit_c) / scale).reshape(-1), weight))
    return margins


def _affine(rates: Array, modes: Array, root: Array, elapsed_s: Array) -> tuple[Array, Array]:
    """Windings after these times by start and by constant heat, each [time, joint, node]; rates may be negative."""
    exponent = -np.multiply.outer(elapsed_s, rates)
    decay = np.exp(exponent)
    safe = np.where(np.abs(rates) > 1e-12, rates, 1.0)
    gain = np.where(np.abs(rates) > 1e-12, -np.expm1(exponent) / safe, elapsed_s[:, None])
    left = (modes / root[:, None])[WINDING]
    return (left * decay[:, None]) @ (modes.T * root), (left * gain[:, None]) @ (modes.T / root)
