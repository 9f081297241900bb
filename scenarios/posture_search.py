"""The search for an easier posture: candidates near a hold, ranked by the arm's twin, checked by what the arm knows.

Candidates are drawn from two neighbourhoods: of the latent of the hold as the twin sees it, decoded to positions, and
of the posture itself in joint space; then again around the best of them. They are ranked by one number of the twin,
the one-sided torque error of the motor that is hottest by measurement. It was chosen among nine scores by their rank
correlation (Spearman) with the true temperature after ten minutes, over candidates near ten holds of two arms:

- the one-sided torque error of the hottest motor .95 to 1.00,
- the paper's d of that motor .29 to .96,
- the paper's d, the sum over all joints, −.34 to .52: most of it says that a posture is new,
- the largest torque over nominal 1.00: this baseline without a twin is better than any score of the twin.

So the twin proposes, and the arm's thermal knowledge decides: a posture is taken only if the hottest motor is
predicted to end cooler than it was, and no motor to end as warm as it. The prediction needs the housings, which have
no sensor. As warm as their windings (`twin.rc.RcTwin.likely_start`) they would make it refuse every posture; with all
heat of a winding flowing on into its housing they come out 3 to 5 K too cold, and some recoveries end warmer. So the
arm first watches for half a minute how fast its windings warm, which tells what flows on.
"""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fleet.errors import FleetError, InfeasibleJob
from fleet.motion import Plan
from fleet.motor import Motors, reference_current
from fleet.robot import JOINTS
from fleet.sim.exercise import exercise
from fleet.sim.models import ArmModel
from fleet.thermal import HOUSING, WINDING, ThermalModel, advance, drive_heat
from scenarios.generate import Verification
from twin.measures import Features
from twin.score import Twin

Array = np.ndarray

INSTANT_S = 0.02
"""An exercise takes up its payload at the end of the first stop, so that lasts one sample, and the watch follows."""
BEST = 10
"""So many of the candidates are looked around once more."""
ROUNDS = 3
"""The magnets are as warm as the housings that are sought, but weaken by a thousandth per kelvin: it converges fast."""
CLOSER = 0.3
"""The second look goes so much less far than the first."""


class RecoveryError(FleetError):
    """A posture recovery that cannot be done as asked, or that finds nothing better near; says why."""


@dataclass(frozen=True, kw_only=True)
class Nearby:
    """How far a recovery may go, and how it looks around."""

    joint_rad: float = 0.6
    """Most that one joint may turn."""
    tool_m: float = 0.3
    """Most that the tool may move."""
    candidates: int = 600
    """Postures drawn from each neighbourhood."""
    latent_scale: float = 4.0
    """Largest perturbation of the latent, in posterior standard deviations."""
    cooling_k: float = 2.0
    """By how much the hottest motor must be predicted to cool: what an arm knows of its heat is not exact."""
    watch_s: float = 30.0
    """So long the arm stays and watches its motors warm before it goes: twice as long warms them longer, half as long
    doubles what 0.05 K of noise does to the housings, 0.2 K."""
    speed: float = 0.5
    """Share of the joint limits at which the arm goes there."""

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
    """How far the tool would move."""
    error: float
    """One-sided torque error of the hottest motor, z units: orders also where the difficulty has saturated."""


@dataclass(frozen=True, eq=False)
class Found:
    """What a search comes back with."""

    candidate: Candidate
    plan: Plan
    """Home, the old posture while it watches, the new one for the rest of the time, and back."""
    passed_over: dict[str, int]
    """Easier candidates that were not taken, by reason."""
    best_error: dict[str, float]
    """Least one-sided torque error of the hottest motor by neighbourhood, at the first look."""


@dataclass(frozen=True, eq=False)
class Search:
    """One arm that holds a payload, and how far it may go."""

    twin: Twin
    model: ArmModel
    known: Verification
    """What the arm knows of its heat."""
    near: Nearby
    q: Array
    """rad, [joint]."""
    payload_kg: float
    before_c: Array
    """Winding temperatures as measured when the arm began to watch, [joint]."""
    winding_c: Array
    """As measured now, `Nearby.watch_s` later, [joint]."""
    hold_s: float
    """How long it has still to hold from now."""

    @property
    def hottest(self) -> int:
        """The hottest motor, index 0..6."""
        return int(np.argmax(self.winding_c))

    def best(self, rng: np.random.Generator) -> Found:
        """The easiest candidate that stands every check.

        Raises:
            RecoveryError: there is none.
        """
        now = float(holding(self.twin, self.model, self.q[None], self.payload_kg).one_sided[0, self.hottest])
        first = self._near(self._latent(rng), "latent") + self._near(self._around(rng), "joint space")
        leaders = sorted(first, key=lambda candidate: candidate.error)[:BEST]
        ranked = sorted(first + self._again(leaders, rng), key=lambda candidate: candidate.error)
        passed_over = Counter[str]()
        for candidate in ranked:
            if candidate.error >= now:
                break
            plan = self._plan_or_why(candidate.q)
            if isinstance(plan, Plan):
                return Found(candidate, plan, dict(passed_over), _best_by_origin(first))
            passed_over[plan] += 1
        raise RecoveryError(self._nothing(len(ranked), passed_over))

    def _plan_or_why(self, posture: Array) -> Plan | str:
        """The plan of going there and holding on, or why that will not do."""
        if why := self._too_warm(posture):
            return why
        try:
            return exercise(
                self.model,
                np.stack([self.q, self.q, posture]),
                dwell_s=[INSTANT_S, self.near.watch_s, self.hold_s],
                payload_kg=self.payload_kg,
                speed=self.near.speed,
                name="recovery",
            )
        except InfeasibleJob as error:
            return error.reason.split(":")[0]

    def _nothing(self, count: int, passed_over: Counter[str]) -> str:
        reasons = ", ".join(f"{reason} {times}" for reason, times in passed_over.most_common())
        return (
            f"No better posture near: of {count} within {self.near.joint_rad:g} rad per joint and "
            f"{self.near.tool_m:g} m of the tool, {passed_over.total()} are easier for motor {self.hottest + 1}"
            + (f", and none of them will do ({reasons})" if reasons else "")
            + ". Allow more displacement, or put the payload down."
        )

    def _latent(self, rng: np.random.Generator) -> Array:
        """Postures that the twin decodes around the latent of this hold, or part of the way there."""
        tau = self.model.gravity_torque(self.q, self.payload_kg)
        mu, sigma = self.twin.posterior(_windows(self.twin, self.q[None], tau[None]))
        count = self.near.candidates
        scale = rng.uniform(0.0, self.near.latent_scale, (count, 1, 1))
        latent = mu + scale * rng.standard_normal((count, *mu.shape[1:])) * sigma
        decoded = self.twin.decode(latent.astype(np.float32))[..., 0].mean(axis=1)
        away = decoded - self.q
        endless = np.isinf(self.model.position_range).any(axis=1)
        away -= np.where(endless, 2 * np.pi * np.round(away / (2 * np.pi)), 0.0)
        return self.q + rng.uniform(0.0, 1.0, (count, 1)) * away

    def _around(self, rng: np.random.Generator) -> Array:
        return self.q + self.near.joint_rad * rng.uniform(-1.0, 1.0, (self.near.candidates, JOINTS))

    def _again(self, leaders: list[Candidate], rng: np.random.Generator) -> list[Candidate]:
        """A closer look around the easiest candidates, at the borders of what is near too."""
        found: list[Candidate] = []
        for leader in leaders:
            step = CLOSER * self.near.joint_rad * rng.standard_normal((self.near.candidates // BEST + 1, JOINTS))
            away = np.clip(leader.q + step - self.q, -self.near.joint_rad, self.near.joint_rad)
            found += self._near(self.q + away, leader.origin)
        return found

    def _near(self, postures: Array, origin: str) -> list[Candidate]:
        """Those of the postures that are near and within the joint stops, with what the twin says of them."""
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

    def _too_warm(self, posture: Array) -> str | None:
        """Why the arm's thermal knowledge is against a posture, None if it is not."""
        known, tau = self.known, self.model.gravity_torque(posture, self.payload_kg)
        end_c = course(self._start_c, tau, known.motors, known.thermal, known.ambient_c, self.hold_s)[-1]
        if end_c[self.hottest] > self.before_c[self.hottest] - self.near.cooling_k:
            return "would not cool"
        return "another motor as hot" if end_c.max() >= self.before_c.max() else None

    @cached_property
    def _start_c(self) -> Array:
        """What the arm takes its nodes' temperatures to be, °C, [node]."""
        known, tau = self.known, self.model.gravity_torque(self.q, self.payload_kg)
        housing_c = housing_estimate(
            self.before_c, self.winding_c, self.near.watch_s, tau, known.motors, known.thermal, known.ambient_c
        )
        return np.concatenate([self.winding_c, housing_c])


def _best_by_origin(candidates: list[Candidate]) -> dict[str, float]:
    best: dict[str, float] = {}
    for candidate in candidates:
        best[candidate.origin] = min(candidate.error, best.get(candidate.origin, np.inf))
    return best


def holding(twin: Twin, model: ArmModel, q: Array, payload_kg: float) -> Features:
    """What the twin says of standing in postures [posture, joint] with a payload, [posture, joint, part]."""
    tau = np.stack([model.gravity_torque(posture, payload_kg) for posture in q])
    return twin.window_features(_windows(twin, q, tau))


def _windows(twin: Twin, q: Array, tau: Array) -> Array:
    """Windows of standing still, [posture, time, joint, channel]."""
    still = np.stack([q, np.zeros_like(q), tau], axis=-1)[:, None]
    return np.repeat(still, twin.config.window, axis=1)


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

    What heat a winding does not keep flows into its housing, C Tw' = P − (Tw − Th) / R, in the mean over the time
    between the readings. Never colder than the air. Exact but for the housing's drift and the bend of the winding's
    course in that time, some tenths of a kelvin; readings rounded to 1 K would cost 2 K here over half a minute.

    Args:
        before_c: Winding temperatures at the first reading, °C, [joint].
        winding_c: The same `watched_s` later.
    """
    mean_c = 0.5 * (before_c + winding_c)
    conductance = -np.diagonal(thermal.laplacian[WINDING, HOUSING])
    kept_w = thermal.capacity[WINDING] * (winding_c - before_c) / watched_s
    rest, housing_c = np.zeros(JOINTS), mean_c
    current_sq = reference_current(tau, rest, motors) ** 2
    for _ in range(ROUNDS):
        loss_w = drive_heat(np.concatenate([mean_c, housing_c]), current_sq, rest, motors)[WINDING]
        housing_c = np.maximum(mean_c - (loss_w - kept_w) / conductance, ambient_c)
    return housing_c


def course(start_c: Array, tau: Array, motors: Motors, thermal: ThermalModel, ambient_c: float, hold_s: float) -> Array:
    """Winding temperatures of holding `tau` N·m, [joint], every ten seconds or so, °C, [time, joint]."""
    steps = max(1, int(np.ceil(hold_s / 10.0)))
    phi, gamma = thermal.step_matrices(hold_s / steps)
    rest = np.zeros(JOINTS)
    current_sq = reference_current(tau, rest, motors) ** 2
    temps = [np.asarray(start_c, dtype=float)]
    for _ in range(steps):
        heat_w = drive_heat(temps[-1], current_sq, rest, motors)
        temps.append(advance(temps[-1], heat_w, ambient_c, phi, gamma, thermal.to_ambient))
    return np.stack(temps)[:, WINDING]
