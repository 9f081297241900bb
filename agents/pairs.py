"""Pairs of arm and option in numbers: what a network over pairs is given, for many envs at once.

Numbers of one option come from one arm's observation; numbers of the set (alternatives of the job, other jobs of the
arm, arms that are home soon) come from the observations of all arms. They do not depend on the order or number of arms
and slots.
"""

from typing import NamedTuple

import numpy as np

from agents.heat_rules import LEAST_P, Wsept
from agents.policy import per_option, plans_of
from fleet.observation import Observation

Array = np.ndarray

PAIR_FEATURES = 24
"""Numbers of a pair."""
SOON_S = 180.0
"""Time until home of arms whose claim a job might wait for."""
MOST = 4.0
"""Bound of every number of a pair."""


class Worth(NamedTuple):
    """What a learned worth per time has beyond `wsept`, [env] each; zeros give `wsept`."""

    spread: Array
    """Logarithm of the factor on the deviation of true peaks."""
    fault: Array
    """Logarithm of the factor on the price of a fault."""
    minute: Array
    """Logarithm of the factor on the price of a minute above the warning limit."""
    tardiness: Array
    """Factor on the price of tardiness, which `wsept` leaves out."""
    end: Array
    """Share of the value that a claim loses if it cannot end before the shift does."""
    overhead: Array
    """Time of every job besides its duration, in units of 2 min."""


class Pairs(NamedTuple):
    """All pairs of an instant."""

    legal: Array
    """bool [env, arm, option]."""
    rate: Array
    """Worth per second, [env, arm, option]."""
    scale: Array
    """Mean size of the rates of legal pairs, [env, 1, 1]."""
    features: Array
    """float [env, arm, option, PAIR_FEATURES]; zeros where a pair is not legal."""


TARDINESS_PRICE = 0.01
"""Per unit of value and minute, as in the default reward."""


def worth_per_second(seen: Observation, learned: Worth) -> Array:
    """Expected worth per second of all options, [env, arm, option], of observations [env, arm]."""
    from scipy.special import logit, ndtr  # slow import that few processes need

    def each(values: Array) -> Array:
        return values[:, None, None]

    value, duration_s = per_option(seen, seen.value), seen.duration_s
    hottest_c = seen.temp_c.max(axis=-1)[..., None]
    warning_c = seen.headroom_k[..., None] + hottest_c
    peak_c = seen.peak_c
    if (peak_c <= 0).any():
        # As `Wsept.predicted_peak_c` of one arm.
        margin_k = Wsept.peak_sd_k * logit(np.clip(seen.p_saturation, LEAST_P, 1.0 - LEAST_P))
        peak_c = np.where(peak_c > 0, peak_c, warning_c + margin_k)
    error_c = seen.error_headroom_k[..., None] + hottest_c
    p_fault = ndtr((peak_c - error_c) / (Wsept.peak_sd_k * np.exp(each(learned.spread))))
    above_share = np.clip((peak_c - warning_c) / np.maximum(peak_c - hottest_c, 1.0), 0.0, 1.0)
    minute_price = Wsept.minute_price * np.exp(each(learned.minute))
    heat = p_fault * Wsept.fault_price * np.exp(each(learned.fault)) + minute_price * above_share * duration_s / 60.0
    ends = 1.0 / (1.0 + np.exp(np.clip((duration_s - seen.left_s[..., None]) / 20.0, -30.0, 30.0)))
    value_left = value * (1.0 - np.clip(each(learned.end), 0.0, 1.0) * (1.0 - ends))
    late = TARDINESS_PRICE * value * np.maximum(-seen.slack_s, 0.0) / 60.0
    worth = (1.0 - p_fault) * value_left - heat - each(learned.tardiness) * late
    return worth / np.maximum(duration_s + 120.0 * np.maximum(each(learned.overhead), -0.2), 1.0)


def pairs_of(seen: Observation, learned: Worth) -> Pairs:
    """All pairs of arms and options; arguments as of `worth_per_second`."""
    legal = seen.action_mask[..., 1:-1] > 0
    rate = worth_per_second(seen, learned)
    count = np.maximum(legal.sum(axis=(1, 2), keepdims=True), 1)
    scale = np.maximum(np.abs(np.where(legal, rate, 0.0)).sum(axis=(1, 2), keepdims=True) / count, 1e-6)
    return Pairs(legal, rate, scale, _features(seen, legal, rate, scale))


def _features(seen: Observation, legal: Array, rate: Array, scale: Array) -> Array:
    plans = plans_of(seen)
    envs, arms, options = legal.shape
    duration_s, left = np.maximum(seen.duration_s, 1.0), seen.left_s[..., None]
    value = per_option(seen, seen.value)
    hottest_c = seen.temp_c.max(axis=-1)[..., None]
    warning_c = seen.headroom_k[..., None] + hottest_c
    peak_c = np.where(seen.peak_c > 0, seen.peak_c, hottest_c)
    relative = np.where(legal, rate / scale, -MOST)

    def of_slots(values: Array) -> Array:
        return np.repeat(values, plans, axis=-1)

    best = relative.reshape(envs, arms, -1, plans).max(axis=-1)
    other_arm = of_slots(_best_of_others(best, axis=1))
    other_job = of_slots(_best_of_others(best, axis=2))
    working, busy_s = seen.working[..., None] > 0, seen.busy_s[..., None]
    soon = working & (busy_s <= SOON_S) & (seen.feasible > 0)
    later = np.where(soon, np.maximum(rate, 0.0) * duration_s / (duration_s + busy_s) / scale, 0.0)
    soonest = of_slots(later.reshape(envs, arms, -1, plans).max(axis=(1, 3))[:, None, :])
    can = (seen.feasible > 0).reshape(envs, arms, -1, plans).any(axis=-1)
    waiting_s = np.maximum(seen.slack_s + duration_s, 0.0)
    offered = seen.offered[:, 0].sum(axis=-1)
    free = seen.idle.sum(axis=1)
    mean_value = np.maximum((seen.value[:, 0] * seen.offered[:, 0]).sum(axis=-1) / np.maximum(offered, 1.0), 1e-6)
    fastest_s = of_slots(np.where(legal, duration_s, np.inf).reshape(envs, arms, -1, plans).min(axis=(1, 3))[:, None])
    pressure = np.log((offered + 1.0) / (free + 1.0))
    columns = (
        of_slots(seen.expires) * np.exp(-waiting_s / 300.0),
        np.exp(-np.maximum(seen.slack_s, 0.0) / 600.0),
        np.tanh(seen.slack_s / 1800.0),
        np.log1p(of_slots(seen.age_s) / 60.0) / 3.0,
        (peak_c - warning_c) / 10.0,
        (hottest_c - warning_c) / 10.0,
        (peak_c - hottest_c) / 10.0,
        np.log(duration_s / 240.0),
        np.log(np.maximum(value, 1e-6) / mean_value[:, None, None]),
        of_slots(seen.payload_kg) / 4.0,
        seen.difficulty,
        np.log(duration_s / np.where(np.isfinite(fastest_s), fastest_s, duration_s)),
        relative - other_arm,
        relative - other_job,
        relative - soonest,
        of_slots(can.mean(axis=1)[:, None, :]),
        np.log1p(can.sum(axis=-1))[..., None] / 3.0,
        pressure[:, None, None],
        (free / arms)[:, None, None],
        np.exp(-left / 900.0),
        duration_s / np.maximum(left, 60.0),
        np.tile(np.arange(plans) > 0, options // plans),
        of_slots(seen.returns),
        (seen.headroom_k.mean(axis=1) / 10.0)[:, None, None],
    )
    features = np.empty((envs, arms, options, PAIR_FEATURES))
    for k, column in enumerate(columns):
        features[..., k] = column
    np.clip(features, -MOST, MOST, out=features)
    features[~legal] = 0.0
    return features


def _best_of_others(values: Array, axis: int) -> Array:
    """Largest value of the others along an axis, at least 0, in the shape of the values."""
    if values.shape[axis] < 2:
        return np.zeros_like(values)
    ordered = np.partition(values, -2, axis=axis)
    best = np.take(ordered, [-1], axis=axis)
    second = np.take(ordered, [-2], axis=axis)
    return np.maximum(np.where(values == best, second, best), 0.0)
