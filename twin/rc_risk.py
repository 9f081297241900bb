"""From the thermal network to a probability: temperatures that are linear in their start, and one learned slope.

While a job goes on, the drive stays what its plan says; copper loss rises linearly with the winding's temperature, and
only the magnets, a percent per ten kelvin, are taken at the temperature they have halfway. So the temperature of each
motor at each time is affine in the motor temperatures at the start, and the worst margin a maximum of affine pieces.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fleet.difficulty import Risk
from fleet.motion import Drive
from fleet.motor import copper_loss, magnet_factor
from fleet.robot import JOINTS
from fleet.thermal import NODES, WINDING, node_heat
from twin.calibrate import LEAST_JOBS, LEAST_OF_EACH, NotEnoughExperience, logistic

if TYPE_CHECKING:
    from twin.rc import RcTwin

Array = np.ndarray

MOMENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Shares of a job's time at which the motors are looked at; under a constant drive a peak lies at an end or is flat."""
ROOM_K = 10.0
"""Errors of a prediction grow with the rise it predicts; this much error remains where there is none."""
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
        """The worst at motor temperatures [joint]."""
        return float((self.offset + self.weight @ temp_c).max())


@dataclass(frozen=True, kw_only=True)
class MarginHead:
    """P = logistic(intercept + slope · margin), learned from past jobs."""

    intercept: float
    slope: float
    jobs: int
    passed: int

    @property
    def name(self) -> str:
        """Short text for a version."""
        return f"{self.intercept:.4g}+{self.slope:.4g}m"

    def risk(self, of_job: Pieces) -> Risk:
        """The probability for any temperatures at the start."""
        return Risk(self.intercept + self.slope * of_job.offset, self.slope * of_job.weight)


def fit_head(margin: Array, passed: Array) -> MarginHead:
    """Logistic regression of what came of past jobs on their predicted margin, [job]; a slope never below zero.

    Raises:
        NotEnoughExperience: too few jobs, or hardly any of one kind.
    """
    count, some = len(passed), int(np.sum(passed))
    if count < LEAST_JOBS or min(some, count - some) < LEAST_OF_EACH:
        raise NotEnoughExperience(
            f"P(saturation) needs {LEAST_JOBS} past jobs, {LEAST_OF_EACH} of them passing the limit and "
            f"{LEAST_OF_EACH} not (got {count}, {some} passing). Let the arm work first, or rehearse in simulation."
        )
    spread = max(float(margin.std()), 1e-9)
    slope, offset = logistic(margin[:, None] / spread, np.asarray(passed, dtype=bool), np.array([True]), _STRENGTH)
    return MarginHead(intercept=float(offset), slope=float(slope[0] / spread), jobs=count, passed=some)


def pieces(twin: "RcTwin", load: Drive, duration_s: Array, magnets_c: Array) -> list[Pieces]:
    """Affine margins of jobs with constant drives.

    Args:
        load: [job, joint].
        magnets_c: Housing temperature at which the magnets are taken, [job, joint].
    """
    motors, thermal = twin.motors, twin.thermal
    warm_sq = load.current_sq / magnet_factor(magnets_c, motors) ** 2
    at_zero = copper_loss(warm_sq, np.zeros_like(warm_sq), motors)
    slope = copper_loss(warm_sq, np.ones_like(warm_sq), motors) - at_zero  # W/K
    heat_w = node_heat(at_zero, motors.idle_w + load.friction_w) + thermal.to_ambient * twin.ambient_c
    laplacian = thermal.laplacian - np.eye(NODES) * node_heat(slope, np.zeros(JOINTS))[:, None, :]
    root = np.sqrt(thermal.capacity)
    rates, modes = np.linalg.eigh(laplacian / np.outer(root, root))
    lift = twin.likely_start(np.eye(JOINTS)).T  # measured windings to nodes, linear
    out = []
    for job in range(len(duration_s)):
        phi, gamma = _affine(rates[job], modes[job], root, duration_s[job] * np.array(MOMENTS))
        forced = gamma @ heat_w[job]  # [moment, joint]
        by_start = phi @ lift
        # From the reference start: what this job adds, on which its errors grow.
        rise = np.maximum(forced + by_start @ twin.idle_c[WINDING] - twin.idle_c[WINDING], 0.0)
        scale = ROOM_K + rise
        out.append(
            Pieces(((forced - twin.warning_c) / scale).reshape(-1), (by_start / scale[..., None]).reshape(-1, JOINTS))
        )
    return out


def _affine(rates: Array, modes: Array, root: Array, elapsed_s: Array) -> tuple[Array, Array]:
    """Windings after these times by start and by constant heat, each [time, joint, node]; rates may be negative."""
    exponent = -np.multiply.outer(elapsed_s, rates)
    decay = np.exp(exponent)
    safe = np.where(np.abs(rates) > 1e-12, rates, 1.0)
    gain = np.where(np.abs(rates) > 1e-12, -np.expm1(exponent) / safe, elapsed_s[:, None])
    left = (modes / root[:, None])[WINDING]
    return (left * decay[:, None]) @ (modes.T * root), (left * gain[:, None]) @ (modes.T / root)
