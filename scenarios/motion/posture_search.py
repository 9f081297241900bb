"""Search for an easier posture: candidates near a hold, ranked by the arm's twin and checked by its thermal model.

Candidates are drawn near the latent of the hold (decoded to positions) and near the posture in joint space, then again
around the best of them. They are ranked by the twin's one-sided torque error of the hottest measured motor. That score
was chosen among nine by rank correlation (Spearman) with the true temperature after ten minutes, over candidates near
ten holds of two arms:

- the one-sided torque error of the hottest motor .95 to 1.00,
- the paper's d of that motor .29 to .96,
- the paper's d, the sum over all joints, −.34 to .52: most of it is novelty of the posture,
- the largest torque over nominal 1.00: this baseline without a twin is better than every score of the twin.

The thermal model then accepts a posture only if the hottest motor is predicted to cool, and no motor to become as warm
as it was. The prediction needs housing temperatures, which have no sensor. If they equal the winding temperatures
(`twin.thermal.thermal_twin.RcTwin.likely_start`), every posture is rejected. If all heat of a winding flows into its
housing, they are 3 to 5 K too low, and some recoveries end warmer. Therefore the arm first measures for half a minute
how fast its windings warm, which determines that heat flow.
"""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleet.errors import FleetError, InfeasibleJob
from fleet.motion import Plan, static_drive
from fleet.motor import Motors
from fleet.physics.models import ArmModel
from fleet.planning.random_motions import plan_motion
from fleet.robot import JOINTS
from fleet.thermal import HOUSING, WINDING, ThermalModel, drive_heat, simulate_temperatures
from scenarios.motion.generate import Verification
from twin.vae.measures import Features
from twin.vae.twin import Twin

Array = np.ndarray

INSTANT_S = 0.02
"""Duration of the first stop, one sample: the payload is grasped at its end, then the observation begins."""
BEST = 10
"""Number of candidates with a second search around them."""
ROUNDS = 3
"""Fixed-point iterations; the magnets weaken by only 0.1 % per kelvin of the housing, so they converge fast."""
CLOSER = 0.3
"""Size of the second search relative to the first."""


class RecoveryError(FleetError):
    """A posture recovery that is out of range or has no better posture."""


@dataclass(frozen=True, kw_only=True)
class Nearby:
    """Limits and sampling of the search."""

    joint_rad: float = 0.6
    """Largest displacement of a joint."""
    tool_m: float = 0.3
    """Largest displacement of the tool."""
    candidates: int = 600
    """Postures drawn from each neighbourhood."""
    latent_scale: float = 4.0
    """Largest perturbation of the latent, in posterior standard deviations."""
    cooling_k: float = 2.0
    """Least predicted cooling of the hottest motor, because the prediction is not exact."""
    watch_s: float = 30.0
    """Observation time before the arm moves. Twice as long heats the motors longer; half as long doubles the housing
    error of 0.2 K that 0.05 K of noise causes."""
    speed: float = 0.5
    """Share of the joint limits at which the arm moves."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise ValueError(f"Nearby.{name} must be > 0 (got {value}).")
        if self.speed > 1:
            raise ValueError(f"Nearby.speed must be a share of the limits in (0, 1] (got {self.speed}).")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A posture near the hold."""

    q: Array
    """rad, [joint]."""
    origin: str
    """latent or joint space."""
    tool_m: float
    """Displacement of the tool."""
    error: float
    """One-sided torque error of the hottest motor, z units; it also ranks where the difficulty has saturated."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search."""

    candidate: Candidate
    plan: Plan
    """From home to the old posture while watching, to the new one for the rest of the time, and back."""
    passed_over: dict[str, int]
    """Easier candidates that were rejected, by reason."""
    best_error: dict[str, float]
    """Smallest one-sided torque error of the hottest motor by origin, in the first search."""


@dataclass(frozen=True, eq=False)
class Search:
    """Search for one arm that holds a payload."""

    twin: Twin
    model: ArmModel
    known: Verification
    """The arm's thermal parameters."""
    near: Nearby
    q: Array
    """rad, [joint]."""
    payload_kg: float
    before_c: Array
    """Winding temperatures as measured when the arm began to watch, [joint]."""
    winding_c: Array
    """As measured now, `Nearby.watch_s` later, [joint]."""
    hold_s: float
    """Remaining time of the hold."""

    @property
    def hottest(self) -> int:
        """The hottest motor, index 0..6."""
        return int(np.argmax(self.winding_c))

    def best(self, rng: np.random.Generator) -> SearchResult:
        """The easiest candidate that passes every check.

        Raises:
            RecoveryError: no candidate passes.
        """
        now = float(holding(self.twin, self.model, self.q[None], self.payload_kg).one_sided[0, self.hottest])
        first = self._candidates(self._decoded(rng), "latent")
        around = self.q + self.near.joint_rad * rng.uniform(-1.0, 1.0, (self.near.candidates, JOINTS))
        first += self._candidates(around, "joint space")
        leaders = sorted(first, key=lambda candidate: candidate.error)[:BEST]
        ranked = sorted(first + self._refined(leaders, rng), key=lambda candidate: candidate.error)
        passed_over = Counter[str]()
        for candidate in ranked:
            if candidate.error >= now:
                break
            plan = self._plan_or_reason(candidate.q)
            if isinstance(plan, Plan):
                return SearchResult(candidate, plan, dict(passed_over), _best_by_origin(first))
            passed_over[plan] += 1
        raise RecoveryError(self._failure(len(ranked), passed_over))

    def _plan_or_reason(self, posture: Array) -> Plan | str:
        """The plan of moving there and holding, or the reason of a rejection."""
        if reason := self._thermal_objection(posture):
            return reason
        try:
            return plan_motion(
                self.model,
                np.stack([self.q, self.q, posture]),
                dwell_s=[INSTANT_S, self.near.watch_s, self.hold_s],
                payload_kg=self.payload_kg,
                speed=self.near.speed,
                name="recovery",
            )
        except InfeasibleJob as error:
            return error.reason.split(":")[0]

    def _failure(self, count: int, passed_over: Counter[str]) -> str:
        reasons = ", ".join(f"{reason} {times}" for reason, times in passed_over.most_common())
        return (
            f"No better posture near: of {count} within {self.near.joint_rad:g} rad per joint and "
            f"{self.near.tool_m:g} m of the tool, {passed_over.total()} are easier for joint {self.hottest + 1}"
            + (f", and all of them were rejected ({reasons})" if reasons else "")
            + ". Allow more displacement, or put the payload down."
        )

    def _decoded(self, rng: np.random.Generator) -> Array:
        """Postures decoded around the latent of this hold, or between the hold and those."""
        mu, sigma = self.twin.posterior(_windows(self.twin, self.model, self.q[None], self.payload_kg))
        count = self.near.candidates
        scale = rng.uniform(0.0, self.near.latent_scale, (count, 1, 1))
        latent = mu + scale * rng.standard_normal((count, *mu.shape[1:])) * sigma
        decoded = self.twin.decode(latent.astype(np.float32))[..., 0].mean(axis=1)
        away = decoded - self.q
        endless = np.isinf(self.model.position_range).any(axis=1)
        away -= np.where(endless, 2 * np.pi * np.round(away / (2 * np.pi)), 0.0)
        return self.q + rng.uniform(0.0, 1.0, (count, 1)) * away

    def _refined(self, leaders: list[Candidate], rng: np.random.Generator) -> list[Candidate]:
        """Candidates near the easiest ones, including the border of the allowed range."""
        refined: list[Candidate] = []
        for leader in leaders:
            step = CLOSER * self.near.joint_rad * rng.standard_normal((self.near.candidates // BEST + 1, JOINTS))
            away = np.clip(leader.q + step - self.q, -self.near.joint_rad, self.near.joint_rad)
            refined += self._candidates(self.q + away, leader.origin)
        return refined

    def _candidates(self, postures: Array, origin: str) -> list[Candidate]:
        """Postures within the limits and joint stops, with the twin's score."""
        low, high = self.model.position_range.T
        here = self.model.tool_pose(self.q)[0]
        turned = np.abs(postures - self.q).max(axis=1) <= self.near.joint_rad + 1e-9
        postures = postures[turned & ((postures >= low) & (postures <= high)).all(axis=1)]
        tool_m = np.array([np.linalg.norm(self.model.tool_pose(posture)[0] - here) for posture in postures])
        kept = tool_m <= self.near.tool_m
        if not kept.any():
            return []
        error = holding(self.twin, self.model, postures[kept], self.payload_kg).one_sided[:, self.hottest]
        rows = zip(postures[kept], tool_m[kept].tolist(), error.tolist(), strict=True)
        return [Candidate(q, origin, far, e) for q, far, e in rows]

    def _thermal_objection(self, posture: Array) -> str | None:
        """Reason why the predicted temperatures exclude a posture, or None."""
        end_c = self._end_temperatures(posture)
        if end_c[self.hottest] > self.before_c[self.hottest] - self.near.cooling_k:
            return "would not cool"
        return "another motor as hot" if end_c.max() >= self.before_c.max() else None

    def _end_temperatures(self, posture: Array) -> Array:
        """Predicted winding temperatures after the rest of the hold in this posture, °C, [joint]."""
        known, tau = self.known, self.model.gravity_torque(posture, self.payload_kg)
        simulated = simulate_temperatures(
            static_drive(tau, known.motors),
            [self.hold_s],
            motors=known.motors,
            thermal=known.thermal,
            start_c=self._start_c,
            ambient_c=known.ambient_c,
        )
        return simulated.end_c[0, WINDING]

    @cached_property
    def _start_c(self) -> Array:
        """Estimated temperatures of the nodes, °C, [node]."""
        known, tau = self.known, self.model.gravity_torque(self.q, self.payload_kg)
        housing_c = housing_estimate(
            self.before_c, self.winding_c, self.near.watch_s, tau, known.motors, known.thermal, known.ambient_c
        )
        return np.concatenate([self.winding_c, housing_c])


def _best_by_origin(candidates: list[Candidate]) -> dict[str, float]:
    origins = dict.fromkeys(candidate.origin for candidate in candidates)
    return {origin: min(c.error for c in candidates if c.origin == origin) for origin in origins}


def holding(twin: Twin, model: ArmModel, q: Array, payload_kg: float) -> Features:
    """Twin features of standing in postures [posture, joint] with a payload, [posture, joint, part]."""
    return twin.window_features(_windows(twin, model, q, payload_kg))


def _windows(twin: Twin, model: ArmModel, q: Array, payload_kg: float) -> Array:
    """Windows of standing still, [posture, time, joint, channel]."""
    tau = np.stack([model.gravity_torque(posture, payload_kg) for posture in q])
    return np.repeat(np.stack([q, np.zeros_like(q), tau], axis=-1)[:, None], twin.config.window, axis=1)


def housing_estimate(
    before_c: Array,
    winding_c: Array,
    watched_s: float,
    tau: Array,
    motors: Motors,
    thermal: ThermalModel,
    ambient_c: float,
) -> Array:
    """Housing temperatures of an arm that holds `tau` N·m, °C, [joint], from two readings of its windings.

    Heat that a winding does not store flows into its housing, C Tw' = P − (Tw − Th) / R, averaged over the time between
    the readings. The result is never below the ambient temperature. It neglects the housing's drift and the curvature
    of the winding temperature, some tenths of a kelvin. Readings rounded to 1 K would cause 2 K over half a minute.

    Args:
        before_c: Winding temperatures at the first reading, °C, [joint].
        winding_c: The same `watched_s` later.
    """
    mean_c = 0.5 * (before_c + winding_c)
    conductance = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    kept_w = thermal.capacity[WINDING] * (winding_c - before_c) / watched_s
    load, housing_c = static_drive(tau, motors), mean_c
    for _ in range(ROUNDS):
        loss_w = drive_heat(np.concatenate([mean_c, housing_c]), load.current_sq, load.friction_w, motors)[WINDING]
        housing_c = np.maximum(mean_c - (loss_w - kept_w) / conductance, ambient_c)
    return housing_c
