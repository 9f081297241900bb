"""Rules that consider heat and value: one by measured temperatures, the others by predicted peak temperatures.

All take the jobs with the most value per time. Warning and error limit follow from the observed headrooms.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from agents.assignment import Ahead, Matching
from agents.policy import Local, per_option
from fleet.observation import Observation

Array = np.ndarray
Floats = Array | float


class Thermometer(Matching):
    """Matching by value per time, among claims for which the arm is cool enough. It needs no twin.

    An arm may claim a job if the headroom of joints 1 to 4, in K, is at least the payload in kg times
    min(duration / 15 min, 1). Scope central: it compares the arms' times.
    """

    scope: ClassVar = "central"
    only_choices = True

    def cost(self, observations: Sequence[Observation]) -> Array:
        """Minus value per second, [arm, option]; inf for claims that are not allowed."""
        return np.stack([-self._rate(seen) for seen in observations])

    def _rate(self, seen: Observation) -> Array:
        """Value per second of every option, [option]; −inf for those that must not be claimed."""
        needed_k = per_option(seen, seen.payload_kg) * np.minimum(seen.duration_s, QUARTER_S) / QUARTER_S
        cool = warning_of(seen) - seen.temp_c[:LARGE].max() >= needed_k
        return _per_second(seen, per_option(seen, seen.value), cool)


QUARTER_S = 900.0
LARGE = 4
"""Joints 1 to 4 have the large motors, which carry payloads."""


class Wsept(Thermometer):
    """Matching by expected worth per time: weighted shortest expected processing time, with the cost of heat.

    The worth of a claim is the expected value of the job, less the expected cost of heat. The true peak is assumed to
    be normally distributed around the predicted one. The probability of a fault is that of a true peak above the error
    limit. A fault costs the value of the job and `fault_price`, each minute above the warning limit `minute_price`. An
    arm takes the plan of a job with the most worth per time, and makes no claim without a positive worth.

    Without a predicted peak, P(saturation) gives one; with neither, heat costs almost nothing. Scope central: it
    compares the arms' worths.

    Source: Rothkopf, Management Science 12, 1966 (weighted expected processing times).
    """

    only_choices = True
    fault_price: ClassVar = 20.0
    """In units of value; `thermofleet show` prints 14 to 27 for the scenarios of the library."""
    peak_sd_k: ClassVar = 2.5
    """Standard deviation of true peaks around predicted ones near the error limit: chosen on the validation split of
    the suite among 1, 1.5, 2.5 and 5."""
    minute_price: ClassVar = 0.05
    """Price of a minute above the warning limit, as in the default reward."""
    tardiness_price: ClassVar = 0.01
    """Price of a minute of tardiness for each unit of a job's value, as in the default reward: for others, as the worth
    of `wsept` has no tardiness."""

    def _rate(self, seen: Observation) -> Array:
        """Expected worth per second of every option, [option]; −inf for those that must not be claimed."""
        value, hottest_c = per_option(seen, seen.value), float(seen.temp_c.max())
        warning_c, error_c = warning_of(seen), error_of(seen)
        peak_c = self.predicted_peak_c(seen.peak_c, seen.p_saturation, warning_c)
        worth = self.worth_of(value, seen.duration_s, peak_c, hottest_c, warning_c, error_c)
        return _per_second(seen, worth, worth > 0)

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
        factors: Sequence[Floats] = (1.0, 1.0, 1.0),
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
    """As `wsept`, with arms that are home soon as well: a job waits for such an arm if that is worth more per time.

    Scope central, as `wsept`.
    """

    only_choices = True


class WseptLocal(Local):
    """As `wsept` for a fleet of one: every arm claims the job that is worth most per time to it. Scope arm."""

    central = Wsept
    only_choices = True


LEAST_P = 1e-3


def warning_of(seen: Observation) -> float:
    """The warning limit, °C."""
    return float(seen.headroom_k) + float(seen.temp_c.max())


def error_of(seen: Observation) -> float:
    """The error limit, °C."""
    return float(seen.error_headroom_k) + float(seen.temp_c.max())


def _per_second(seen: Observation, worth: Array, allowed: Array) -> Array:
    """Worth over duration, [option]; −inf where it is not allowed or not legal."""
    rate = worth / np.maximum(seen.duration_s, 1.0)
    return np.where(seen.action_mask[1:-1].astype(bool) & allowed, rate, -np.inf).astype(float)
