"""The physical twin: an arm's thermal network, nominal or identified, with predicted peaks and P(saturation) of plans.

In each phase of a plan the drive is constant. Heat is linearised about a warm motor: copper loss is linear in the
winding's temperature anyway, and that of the magnets changes it by a percent per five kelvin. So the temperature of
each motor at each moment is affine in the temperatures known at the start, and the peak is a maximum of affine pieces.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np

from fleet.difficulty import KNOWN, SETTLING_S, Difficulty, Forecast, difficulty_of_error
from fleet.errors import FleetError
from fleet.heat.motor import Motors, copper_loss, magnet_factor
from fleet.heat.thermal import NODES, STEP_S, WINDING, ThermalModel, node_heat, temperature_steps
from fleet.motion import Drive, Plan, drives
from fleet.robot import JOINTS, Cooling, ThermalLimits
from twin.thermal.identify import AMBIENT_C, HeatModel, Identified, nominal_heat_model
from twin.vae.window import PlanCache, check_jobs

if TYPE_CHECKING:  # needs the extra `twin`
    from twin.vae.twin import Twin


Array = np.ndarray

MOMENTS_S = (SETTLING_S, 480.0)
"""Moments of a plan at which its motors are predicted, besides its end: they warm or cool steadily in between."""
AROUND_C = 50.0, 42.0
"""Temperatures of winding and housing about which heat is linearised: those of a motor that comes near its limit."""
ROUNDING_K = 0.5
"""Error of a peak that is accepted for fewer pieces."""
_STARTS = 512
"""Number of realistic starts by which pieces that are never the maximum are dropped."""
_LEVELS = np.array([0.003, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 0.997])
"""Probabilities at the knots of a curve."""
BAND_K = 12.0
"""Past jobs whose predicted peak is this close to the limit show how far off a prediction is there."""
LEAST_JOBS = 30
"""Least past jobs from which P(saturation) is fitted."""


class NotEnoughExperience(FleetError):
    """Too few past jobs to fit P(saturation)."""


@dataclass(frozen=True, eq=False)
class LinearHeat:
    """Temperatures under constant drives as T' = V diag(rates) V⁻¹ T + B [ambient, 1, excess], arrays [phase, ...].

    excess is the heat of the load over that of these drives, less 1, to first order.
    """

    rates: Array
    """1/s, [phase, mode]; positive beyond thermal runaway."""
    modes: Array
    """[phase, node, mode]."""
    inverse: Array
    """[phase, mode, node]."""
    forcing: Array
    """By 1 °C of ambient temperature, by the heat at 0 °C, and by the heat of the load, K/s, [phase, node, 3]."""

    @classmethod
    def of(cls, load: Drive, motors: Motors, thermal: ThermalModel) -> "LinearHeat":
        """From drives [phase, joint]."""
        winding_c, housing_c = AROUND_C
        factor = magnet_factor(np.full(JOINTS, housing_c), motors)
        warm_sq = load.current_sq / factor**2
        loss_w = copper_loss(warm_sq, np.full(JOINTS, winding_c), motors)
        by_winding = loss_w - copper_loss(warm_sq, np.full(JOINTS, winding_c - 1.0), motors)  # W/K
        by_housing = -2.0 * motors.alpha_kt_per_k / factor * loss_w  # W/K
        at_zero = loss_w - by_winding * winding_c - by_housing * housing_c
        joints, slope = np.arange(JOINTS), np.zeros((len(loss_w), NODES, NODES))
        slope[:, joints, joints], slope[:, joints, joints + JOINTS] = by_winding, by_housing
        rates, modes = np.linalg.eig((slope - thermal.laplacian) / thermal.capacity[:, None])
        heat = node_heat(at_zero, motors.idle_w + load.friction_w)
        of_load = node_heat(loss_w, load.friction_w)
        forcing = np.stack(np.broadcast_arrays(thermal.to_ambient, heat, of_load), axis=-1) / thermal.capacity[:, None]
        # A tree of nodes: the matrix is similar to a symmetric one, so its modes are real.
        rates, modes = np.real(rates), np.real(modes)
        return cls(rates, modes, np.linalg.inv(modes), forcing)

    def courses(self, elapsed_s: Array) -> Array:
        """Temperatures as affine functions of the start: [moment, node, NODES + 3] for nodes, ambient, 1 and excess.

        Args:
            elapsed_s: Time spent in each phase until each moment, [moment, phase].
        """
        course = np.broadcast_to(np.eye(NODES, NODES + 3), (len(elapsed_s), NODES, NODES + 3))
        for phase, rates in enumerate(self.rates):
            exponent = np.multiply.outer(elapsed_s[:, phase], rates)  # [moment, mode]
            safe = np.where(np.abs(rates) > 1e-12, rates, 1.0)
            gain = np.where(np.abs(rates) > 1e-12, np.expm1(exponent) / safe, elapsed_s[:, phase, None])
            inner = self.inverse[phase] @ course * np.exp(exponent)[..., None]
            inner[..., NODES:] += gain[..., None] * (self.inverse[phase] @ self.forcing[phase])
            course = self.modes[phase] @ inner
        return course


def peak_forecast(heat: LinearHeat, lasts_s: Array, curve: Array | None = None) -> Forecast:
    """Hottest motor from `SETTLING_S` after the start of a plan, or its earlier end, until its end, °C.

    Args:
        lasts_s: Time of the phases, s, [phase].
        curve: From the predicted peak to P(saturation), [knot, 2].
    """
    total_s = float(lasts_s.sum())
    # The cycles end hotter than the retreat, which is short and without load.
    working_s = max(float(lasts_s[:-1].sum()), min(SETTLING_S, total_s))
    moments_s = np.array([*(t for t in MOMENTS_S if t < working_s), working_s])
    until = np.cumsum(lasts_s)
    elapsed_s = np.clip(moments_s[:, None] - (until - lasts_s), 0.0, lasts_s)
    pieces = heat.courses(elapsed_s)[:, WINDING]  # [moment, joint, ...]
    values = pieces[..., : KNOWN + 1] @ _starts().T  # [moment, joint, start]
    # A piece stays if it decides somewhere, by more than rounding against earlier moments: later ones may not come.
    of_moment = values.max(axis=1)
    before = np.maximum.accumulate(np.vstack([np.full_like(of_moment[:1], -np.inf), of_moment[:-1]]))
    decides = (of_moment >= before + ROUNDING_K)[:, None]
    stays = ((values == of_moment[:, None]) & decides).any(axis=-1)
    time_s = np.broadcast_to(np.append(0.0, moments_s[1:])[:, None], stays.shape)
    kept = pieces[stays]
    # Of the joint that rises most, since more heat may also make another joint the hottest.
    gain = np.broadcast_to(pieces[..., KNOWN + 1].max(axis=1, keepdims=True), stays.shape)
    return Forecast(kept[:, KNOWN].copy(), kept[:, :KNOWN].copy(), curve, time_s[stays], gain[stays])


@cache
def _starts() -> Array:
    """Realistic temperatures at the start of a plan, with a 1, [start, KNOWN + 1].

    From an arm at ambient temperature, over idle arms, to arms with some or all joints hot.
    """
    rng = np.random.default_rng(0)
    ambient = rng.uniform(10.0, 42.0, (_STARTS, 1))
    most_k = 30.0 * rng.uniform(0.0, 1.0, (2, _STARTS, 1)) ** 2
    rise_k = most_k * rng.uniform(0.0, 1.0, (2, _STARTS, JOINTS))
    housing = ambient + rise_k[0]
    winding = np.minimum(housing - 1.0 + rise_k[1], 90.0)
    return np.concatenate([winding, housing, ambient, np.ones((_STARTS, 1))], axis=1)


@dataclass(frozen=True, kw_only=True)
class PeakCurve:
    """From the predicted peak of a plan to the probability that its motors pass the warning limit."""

    knots: tuple[tuple[float, float], ...]
    """Predicted peak, °C, and probability."""
    jobs: int
    """Past jobs whose errors it is made of."""

    @property
    def name(self) -> str:
        """Part of the twin's version: where the probability is a half, and how far it is from .1 to .9."""
        at, p = np.array(self.knots).T
        low, half, high = np.interp((0.1, 0.5, 0.9), p, at)
        return f"{half:.2f}~{high - low:.2f}"


def fit_curve(predicted_c: Array, peak_c: Array, limit_c: float) -> PeakCurve:
    """The curve from past jobs: the chance that a prediction's error takes the true peak over the limit.

    The errors are those of jobs that come near the limit, smoothed by a Gaussian kernel (Silverman's width).

    Args:
        predicted_c: Predicted peak of each job, [job].
        peak_c: Its true peak, [job].

    Raises:
        NotEnoughExperience: too few jobs.
    """
    from scipy.special import ndtr

    if len(peak_c) < LEAST_JOBS:
        raise NotEnoughExperience(f"P(saturation) needs {LEAST_JOBS} past jobs, better 200 (got {len(peak_c)}).")
    distance_k = np.abs(predicted_c - limit_c)
    near = distance_k <= max(BAND_K, float(np.sort(distance_k)[LEAST_JOBS - 1]))
    error_k = (peak_c - predicted_c)[near]
    width = 1.06 * max(float(error_k.std()), 0.05) * len(error_k) ** -0.2
    grid = np.linspace(error_k.min() - 4 * width, error_k.max() + 4 * width, 400)
    below = ndtr((grid[:, None] - error_k) / width).mean(axis=1)  # P(error < grid)
    at = limit_c - np.interp(1.0 - _LEVELS, below, grid)
    knots = tuple((float(x), float(p)) for x, p in zip(at, _LEVELS, strict=True))
    return PeakCurve(knots=knots, jobs=len(error_k))


@dataclass(frozen=True, kw_only=True, eq=False)
class RcTwin:
    """One arm's resistance-capacitance network as a twin; implements `fleet.difficulty.DifficultyModel`.

    d_k = 1 − exp(−rise_k / room_k): the predicted rise of motor k above its idle temperature over the room from there
    to the warning limit.
    """

    arm: str
    heat_model: HeatModel
    ambient_c: float
    """Assumed ambient temperature."""
    base: str
    """Version of the nominal or identified network."""
    warning_c: float = ThermalLimits().warning_c
    curve: PeakCurve | None = None
    """From predicted peaks to P(saturation); None without past jobs."""
    _heat: PlanCache[LinearHeat] = field(default_factory=PlanCache, init=False, repr=False)

    @classmethod
    def nominal(cls, arm: str = "arm", *, ambient_c: float = AMBIENT_C, cooling: Cooling = "still_air") -> "RcTwin":
        """A Gen3 with the default parameters."""
        return cls(arm=arm, heat_model=nominal_heat_model(cooling), ambient_c=ambient_c, base="rc-nominal")

    @classmethod
    def of(cls, identified: Identified) -> "RcTwin":
        """The twin of an identified arm."""
        shared = {name: getattr(identified, name) for name in ("arm", "heat_model", "ambient_c")}
        return cls(base=identified.version, **shared)

    @property
    def version(self) -> str:
        """Parameters, ambient temperature, limit, and the curve if there is one, as a name."""
        return f"{self.base}-{self.ambient_c:g}-{self.warning_c:g}" + (f"-{self.curve.name}" if self.curve else "")

    @property
    def motors(self) -> Motors:
        """The arm's motors."""
        return self.heat_model.motors

    @cached_property
    def thermal(self) -> ThermalModel:
        """The arm's network as matrices."""
        return self.heat_model.thermal()

    @cached_property
    def idle_c(self) -> Array:
        """Steady temperatures of the powered arm without load, °C, [node]."""
        return self.thermal.steady(node_heat(np.zeros(JOINTS), self.motors.idle_w), self.ambient_c)

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty of the repeated plan, and its peak as a function of the temperatures at the start.

        Raises:
            ValueError: repetitions < 1, or a plan without motion or with other joints.
        """
        peak = self.peaks([plan], [repetitions], start_c=self.idle_c)[0]
        idle = self.idle_c[WINDING]
        rise = np.maximum(peak - idle, 0.0) / np.maximum(self.warning_c - idle, 1.0)
        # Beyond this 1 − exp(−e) rounds to one; d_k stays below it.
        per_joint = difficulty_of_error(np.minimum(rise, 30.0))
        return Difficulty(per_joint, peak=self.peak(plan, repetitions))

    def peaks(self, plans: Sequence[Plan], repetitions: Sequence[int], *, start_c: Array) -> Array:
        """Hottest temperature of each motor during each job, °C, [plan, joint].

        Args:
            start_c: [node], or [plan, node].
        """
        self._check(plans, repetitions)
        square, friction = np.zeros((2, len(plans), JOINTS))
        for i, (plan, times) in enumerate(zip(plans, repetitions, strict=True)):
            share, phases = plan.weights(times), drives([phase.profile for phase in plan.phases], self.motors)
            square[i], friction[i] = share @ phases.current_sq, share @ phases.friction_w
        duration_s = [plan.duration_s(times) for plan, times in zip(plans, repetitions, strict=True)]
        return self.simulate(Drive(square, friction), np.array(duration_s), start_c)[..., WINDING].max(axis=0)

    def simulate(self, load: Drive, duration_s: Array, start_c: Array) -> Array:
        """Node temperatures under constant drives [job, joint], °C, [step + 1, job, node].

        Every job has the same number of steps, equal within it, at most `fleet.heat.thermal.STEP_S` long.
        """
        steps = max(1, int(np.ceil(np.max(duration_s, initial=0.0) / STEP_S)))
        rows = temperature_steps(
            repeat(load, steps),
            np.asarray(duration_s, dtype=float) / steps,
            motors=self.motors,
            thermal=self.thermal,
            start_c=np.broadcast_to(start_c, (len(duration_s), NODES)).astype(float),
            ambient_c=self.ambient_c,
        )
        return np.stack(list(rows))

    def peak(self, plan: Plan, repetitions: int) -> Forecast:
        """Hottest motor during a job, °C, from the temperatures at its start; with the curve to P(saturation)."""
        if plan not in self._heat:
            self._check([plan], [repetitions])
            load = drives([phase.profile for phase in plan.phases], self.motors)
            self._heat[plan] = LinearHeat.of(load, self.motors, self.thermal)
        lasts_s = plan.duration_s(repetitions) * plan.weights(repetitions)
        return peak_forecast(self._heat[plan], lasts_s, self.curve and np.array(self.curve.knots))

    def with_past_jobs(
        self, plans: Sequence[Plan], repetitions: Iterable[int], *, known_c: Array, peak_c: Array
    ) -> "RcTwin":
        """The same twin with P(saturation) from the errors of its predictions for past jobs.

        Args:
            known_c: Temperatures known at the start, [job, KNOWN].
            peak_c: Hottest motor during the job, counted as in `fleet.difficulty.SETTLING_S`, [job].

        Raises:
            NotEnoughExperience: too few jobs.
        """
        jobs = zip(plans, repetitions, known_c, strict=True)
        predicted_c = [float(self.peak(plan, int(times)).value(known)) for plan, times, known in jobs]
        return replace(self, curve=fit_curve(np.array(predicted_c), peak_c, self.warning_c))

    def _check(self, plans: Sequence[Plan], repetitions: Sequence[int]) -> None:
        check_jobs(plans, repetitions, least=0)
        for plan in plans:
            if plan.cycle.profile.shape[-1] != JOINTS:
                raise ValueError(f"The thermal network has {JOINTS} joints (got {plan.cycle.profile.shape[-1]}).")


@dataclass(frozen=True, eq=False)
class CalibratedTwin:
    """A learned twin with a thermal network; implements `fleet.difficulty.DifficultyModel`."""

    twin: "Twin"
    """Gives the difficulty d."""
    heat: RcTwin
    """Gives the predicted peak and, if it has a curve, P(saturation)."""

    @property
    def version(self) -> str:
        """Versions of the models that give difficulty and predicted peak."""
        return f"d:{self.twin.version}+peak:{self.heat.version}"

    def score(self, plan: Plan, repetitions: int) -> Difficulty:
        """Difficulty and predicted peak of the repeated plan."""
        difficulty = self.twin.features([plan], [repetitions]).difficulty[0]
        return Difficulty(difficulty, peak=self.heat.peak(plan, repetitions), weight=self.twin.joint_weight)
