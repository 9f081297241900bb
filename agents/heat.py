"""Guards that wrap any policy, and rules that weigh value per time against heat.

Guards (a torque limiter, a thermal switch, a fuzzy speed control) react to measured temperatures, and need neither a
twin nor a thermal model. On a real arm they act on torque and speed within a motion. An allocation policy has no such
command, so they act by what the environment allows: they close claims, leave only the cooler of the two plans of a job,
and give the current job back after its cycle. The wrapped policy chooses among the claims that are left.

The rule `thermometer` reads measured temperatures, the `wsept` rules read predicted peak temperatures. Warning and
error limit follow from the observed headrooms.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from agents.policy import WAIT, ArmPolicy, Local, PlanningPolicy, Policy, per_option, plans_of
from agents.rules import Ahead, CentralRule, Matched
from fleet.observation import LazyObservation, Observation
from fleet.robot import RATING

Array = np.ndarray


class Guard(Protocol):
    """Claims and returns that the temperatures of an arm allow."""

    def claims(self, seen: Observation) -> Array:
        """Claims that it allows, of those that are legal, bool [option]."""
        ...

    def gives_back(self, seen: Observation, payload_kg: float) -> bool:
        """Whether the arm must return the job with this payload."""
        ...


class TorqueLimiter:
    """Torque limit that falls with the temperature: 1 up to `full_k` below the warning limit, 0 at the error limit.

    The torque of a job is that of joint 2 of a stretched arm with its payload, relative to that with the rated payload.
    An arm claims a job only below the limit, and gives its job back above.

    Source: thermal derating of the joint torque limit, as in the motor protection of Singh et al. (2021).
    """

    full_k: ClassVar = 10.0
    arm_kg: ClassVar = 2.65
    """Payload whose torque at joint 2 of the stretched Gen3 equals that of the arm itself: 23.5 N·m of 8.85 N·m/kg."""

    def limit(self, seen: Observation) -> float:
        """Torque limit as a share of the rated torque."""
        error_k, apart_k = float(seen.error_headroom_k), float(seen.error_headroom_k - seen.headroom_k)
        return float(np.clip(error_k / (self.full_k + apart_k), 0.0, 1.0))

    def torque(self, payload_kg: Array | float) -> Array:
        """Torque with a payload, as a share of the rated torque."""
        rated_kg = self.arm_kg + RATING.mid_range_kg
        return np.minimum((self.arm_kg + np.asarray(payload_kg)) / rated_kg, 1.0)

    def claims(self, seen: Observation) -> Array:
        """Claims of jobs whose torque is below the limit, bool [option]."""
        return per_option(seen, self.torque(seen.payload_kg)) <= self.limit(seen)

    def gives_back(self, seen: Observation, payload_kg: float) -> bool:
        """Whether the torque of the job is above the limit."""
        return bool(self.torque(payload_kg) > self.limit(seen))


class FuzzySpeed:
    """Speed from fuzzy rules about the temperature and its tendency.

    Inputs: headroom to the warning limit (cool, warm, hot), and the excess of a winding over its housing (steady,
    rising), which is proportional to the heat that flows into the housing. The speed is the mean of the rules' values,
    weighted by their truth (Takagi & Sugeno, IEEE Trans. SMC 15, 1985). At less than `fast` an arm takes the cooler of
    two plans, at less than `slow` it claims nothing, at less than `stop` it gives its job back.

    Source: fuzzy control of the speed by the motor temperature, as in Afaq et al.
    """

    warm_k, cool_k = 10.0, 20.0
    """Headroom at which an arm is just warm, and just cool; it is hot at 0."""
    steady_k, rising_k = 2.0, 10.0
    rules: ClassVar = {"cool": (1.0, 1.0), "warm": (0.8, 0.5), "hot": (0.3, 0.0)}
    """Speeds of a steady and of a rising temperature."""
    fast, slow, stop = 0.75, 0.4, 0.15

    def speed(self, headroom_k: float, excess_k: float) -> float:
        """Speed as a share of the full speed."""
        warm = np.interp(headroom_k, (0.0, self.warm_k, self.cool_k), (0.0, 1.0, 0.0))
        truth = {
            "cool": np.interp(headroom_k, (self.warm_k, self.cool_k), (0.0, 1.0)),
            "warm": warm,
            "hot": np.interp(headroom_k, (0.0, self.warm_k), (1.0, 0.0)),
        }
        rising = np.interp(excess_k, (self.steady_k, self.rising_k), (0.0, 1.0))
        return float(sum(t * np.dot((1.0 - rising, rising), self.rules[name]) for name, t in truth.items()))

    def _speed_of(self, seen: Observation) -> float:
        return self.speed(float(seen.headroom_k), float((seen.temp_c - seen.housing_c).max()))

    def claims(self, seen: Observation) -> Array:
        """All claims of a fast arm, the cooler plans of a slower one, none of a slow one, bool [option]."""
        speed, plans = self._speed_of(seen), plans_of(seen)
        allowed = seen.action_mask[1:-1].astype(bool).reshape(-1, plans)
        if speed < self.slow:
            allowed[:] = False
        elif speed < self.fast:
            allowed[:, :-1] &= ~allowed[:, -1:]
        return allowed.ravel()

    def gives_back(self, seen: Observation, payload_kg: float) -> bool:
        """Whether the speed is less than `stop`."""
        return self._speed_of(seen) < self.stop


class Shutdown:
    """Thermal switch: an arm above a temperature claims nothing until it has cooled by the hysteresis.

    It finishes its present job. The switch opens at the warning limit.

    Source: thermal protection of motors by a switch that resets at a lower temperature (IEC 60034-11).
    """

    hysteresis_k: ClassVar = 10.0

    def __init__(self) -> None:
        self._open = False

    def claims(self, seen: Observation) -> Array:
        """All claims of an arm whose switch is closed, else none, bool [option]; to be called at every step."""
        headroom_k = float(seen.headroom_k)
        self._open = headroom_k < (self.hysteresis_k if self._open else 0.0)
        return np.full(len(seen.action_mask) - 2, not self._open)

    def gives_back(self, seen: Observation, payload_kg: float) -> bool:
        """Never: the arm finishes its job."""
        return False


class _GuardOfArm:
    """A guard of one arm, with the payload of its present job."""

    def __init__(self, guard: Guard) -> None:
        self._guard, self._claimed_kg = guard, 0.0

    def narrow(self, seen: Observation) -> Observation:
        """The observation with the claims that the guard allows."""
        allowed = self._guard.claims(seen)  # also without a legal claim: a guard may remember temperatures
        if not seen.action_mask[1:-1].any():
            return seen
        narrower = seen.action_mask.copy()
        narrower[1:-1] &= allowed
        return LazyObservation(lambda name: getattr(seen, name), action_mask=narrower)

    def decide(self, seen: Observation, action: int) -> int:
        """The action of the wrapped policy, or that which gives the job back."""
        last = len(seen.action_mask) - 1
        if 0 < action < last:
            self._claimed_kg = float(seen.payload_kg[(action - 1) // plans_of(seen)])
        elif seen.action_mask[last] and self._guard.gives_back(seen, self._claimed_kg):
            return last
        return action


class GuardedArm:
    """An arm policy whose claims pass a guard."""

    def __init__(self, guard: Callable[[], Guard], policy: Any) -> None:
        self.scope = policy.scope
        self._make_guard, self._policy = guard, policy
        self._guards: dict[str, _GuardOfArm] = {}

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift."""
        self._guards = {}
        self._policy.reset(rng)

    def choose(self, observation: Observation, arm_index: int) -> int:
        """The choice of the policy among the claims that the guard allows."""
        guard = self._guards.setdefault("", _GuardOfArm(self._make_guard()))
        return guard.decide(observation, self._policy.choose(guard.narrow(observation), arm_index))


class GuardedFleet(GuardedArm):
    """A policy for all arms, with a guard for each of them. It plans if the policy does, in a simulator that knows of
    no guards."""

    def __init__(self, guard: Callable[[], Guard], policy: Any) -> None:
        super().__init__(guard, policy)
        if isinstance(policy, PlanningPolicy):
            self.plan_in = policy.plan_in

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """The actions of the policy among the claims that the guards allow."""
        for arm in observations:
            self._guards.setdefault(arm, _GuardOfArm(self._make_guard()))
        actions = self._policy.act({arm: self._guards[arm].narrow(seen) for arm, seen in observations.items()})
        return {arm: self._guards[arm].decide(seen, actions.get(arm, WAIT)) for arm, seen in observations.items()}


def guarded(guard: Callable[[], Guard], policy: Policy | ArmPolicy) -> Policy | ArmPolicy:
    """A policy, for one arm or for all, whose claims pass a guard."""
    return (GuardedFleet if hasattr(policy, "act") else GuardedArm)(guard, policy)  # pyright: ignore[reportReturnType]


Floats = Array | float
UNCHANGED: Sequence[Floats] = (1.0, 1.0, 1.0)


class Thermometer(Matched, CentralRule):
    """Matching by value per time, among claims for which the arm is cool enough. It needs no twin.

    An arm may claim a job if the headroom of joints 1 to 4, in K, is at least the payload in kg times
    min(duration / 15 min, 1).
    """

    def index(self, seen: Observation) -> Array:
        """Value per second of every option, [env, arm, option]; −inf for those that must not be claimed."""
        needed_k = per_option(seen, seen.payload_kg) * np.minimum(seen.duration_s, QUARTER_S) / QUARTER_S
        cool = (warning_of(seen) - seen.temp_c[..., :LARGE].max(axis=-1))[..., None] >= needed_k
        return np.where(cool, per_option(seen, seen.value) / np.maximum(seen.duration_s, 1.0), -np.inf)


QUARTER_S = 900.0
LARGE = 4
"""Joints 1 to 4 have the large motors, which carry payloads."""


class Dues(NamedTuple):
    """What the worth of jobs that begin later depends on, [n] each."""

    value: Array
    due_in_s: Array
    expires: Array
    """Whether the job expires if it still waits at its due date, bool."""
    left_s: Array
    """Time until the end of the shift, [n] or one for all."""


def dues_of(seen: Observation) -> Dues:
    """Of every option, [env, arm, option]."""
    value, due_in_s, expires = (per_option(seen, each) for each in (seen.value, seen.due_in_s, seen.expires > 0))
    return Dues(value, due_in_s, expires, seen.left_s[..., None])


class Wsept(Matched, CentralRule):
    """Matching by expected worth per time: weighted shortest expected processing time, with the cost of heat.

    The worth of a claim is the expected value of the job, less the expected cost of heat and of tardiness. The true
    peak is assumed to be normally distributed around `margin_k` below the predicted one. The probability of a fault is
    that of a true peak above the error limit. A fault costs the value of the job and `fault_price`, each minute above
    the warning limit `minute_price`. A job that cannot end before the shift does is worth nothing. Jobs that expire
    soon come first. An arm takes the plan of a job with the most worth per time, and makes no claim without a positive
    worth.

    Without a predicted peak, P(saturation) gives one; with neither, heat costs almost nothing.

    Source: Rothkopf, Management Science 12, 1966 (weighted expected processing times); the urgency follows Vepsalainen
    & Morton, Management Science 33, 1987.
    """

    fault_price: ClassVar = 20.0
    """In units of value; `thermofleet show` prints 14 to 27 for the scenarios of the library."""
    peak_sd_k: ClassVar = 4.0
    """Standard deviation of true peaks around their mean near the error limit."""
    margin_k: ClassVar = 3.0
    """Predicted peak less the mean of true peaks near the error limit."""
    minute_price: ClassVar = 0.05
    """Price of a minute above the warning limit, as in the default reward."""
    tardiness_price: ClassVar = 0.01
    """Price of a minute of tardiness for each unit of a job's value, as in the default reward."""
    urgent_s: ClassVar = 1200.0
    """Time until a job expires in which its urgency falls to 1/e; a job that expires now counts twice."""

    def index(self, seen: Observation) -> Array:
        """Expected worth per second of every option, [env, arm, option]; −inf for those that must not be claimed."""
        dues, duration_s = dues_of(seen), np.maximum(seen.duration_s, 1.0)
        worth = self.later_worth(self.worth(seen), duration_s, np.zeros(()), dues)
        return np.where(worth > 0, worth * self.urgency(dues) / duration_s, -np.inf)

    @classmethod
    def worth(cls, seen: Observation, cooler_k: Floats = 0.0, factors: Sequence[Floats] = UNCHANGED) -> Array:
        """Expected value less the expected cost of heat of every option, begun now, [env, arm, option].

        Args:
            cooler_k: Added to `margin_k`.
            factors: As in `worth_of`.
        """
        value, hottest_c = per_option(seen, seen.value), seen.temp_c.max(axis=-1)[..., None]
        warning_c, error_c = warning_of(seen)[..., None], error_of(seen)[..., None]
        peak_c = cls.predicted_peak_c(seen.peak_c, seen.p_saturation, warning_c)
        return cls.worth_of(
            value, seen.duration_s, peak_c, hottest_c, warning_c, error_c + cls.margin_k + cooler_k, factors
        )

    @classmethod
    def later_worth(cls, worth: Array, duration_s: Array, start_s: Array, dues: Dues) -> Array:
        """Worth less the cost of tardiness, [n]; 0 if the job expires before the start or the shift before the end.

        Args:
            worth: Without tardiness, [n].
            start_s: Time until the start, [n] or one for all.
        """
        late_s = np.maximum(start_s + duration_s - dues.due_in_s, 0.0)
        worth = worth - cls.tardiness_price / 60.0 * dues.value * late_s
        lost = (start_s > 0) & dues.expires & (start_s > dues.due_in_s)
        return np.where(lost | (start_s + duration_s > dues.left_s), 0.0, worth)

    @classmethod
    def urgency(cls, dues: Dues) -> Array:
        """Factor on the worth of jobs: 1 for those that do not expire, up to 2, [n]."""
        return 1.0 + np.where(dues.expires, np.exp(-np.maximum(dues.due_in_s, 0.0) / cls.urgent_s), 0.0)

    @classmethod
    def predicted_peak_c(cls, peak_c: Array, p_saturation: Array, warning_c: Floats) -> Array:
        """Predicted peaks, or those that P(saturation) gives where they are unknown (0), °C, [n]."""
        if (peak_c > 0).all():
            return peak_c
        from scipy.special import logit  # slow import that few processes need

        # An unknown peak is placed so far from the limit that its error gives P(saturation).
        margin_k = cls.peak_sd_k * logit(np.clip(p_saturation, LEAST_P, 1.0 - LEAST_P))
        return np.where(peak_c > 0, peak_c, warning_c + margin_k)

    @classmethod
    def worth_of(
        cls,
        value: Array,
        duration_s: Array,
        peak_c: Array,
        hottest_c: Floats,
        warning_c: Floats,
        error_c: Floats,
        factors: Sequence[Floats] = UNCHANGED,
    ) -> Array:
        """Expected value of jobs less the expected cost of heat, [n].

        Args:
            value, duration_s, peak_c: Of each job, [n], with the predicted peak.
            hottest_c: Hottest motor at the beginning, [n] or one for all.
            warning_c, error_c: The limits.
            factors: On `peak_sd_k`, `fault_price` and `minute_price`.
        """
        from scipy.special import ndtr  # slow import that few processes need

        spread, fault, minute = factors
        p_fault = ndtr((peak_c - error_c) / (cls.peak_sd_k * spread))
        # Approximation: the temperature rises linearly to its peak.
        above_share = np.clip((peak_c - warning_c) / np.maximum(peak_c - hottest_c, 1.0), 0.0, 1.0)
        heat = p_fault * cls.fault_price * fault + cls.minute_price * minute * above_share * duration_s / 60.0
        return (1.0 - p_fault) * value - heat


class WseptAhead(Ahead, Wsept):
    """As `wsept`, with arms that are home soon as well: a job waits for such an arm if that is worth more per time."""


class WseptLocal(Local):
    """As `wsept` for a fleet of one: every arm claims the job that is worth most per time to it."""

    central = Wsept
    only_choices = True


LEAST_P = 1e-3


def warning_of(seen: Observation) -> Array:
    """The warning limit, °C, [...]."""
    return seen.headroom_k + seen.temp_c.max(axis=-1)


def error_of(seen: Observation) -> Array:
    """The error limit, °C, [...]."""
    return seen.error_headroom_k + seen.temp_c.max(axis=-1)
