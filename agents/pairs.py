"""A learned score of pairs of arm and option: `wsept` with learned weights, matched as `wsept` matches.

score = rate · exp(f) + g · mean rate, where `rate` is the expected worth per time with learned prices (`Worth`), and f
and g are weighted sums of the pair's numbers. All parameters are one vector; zeros give `wsept` without due dates and
with the deviation `PEAK_SD_K`.

Numbers of one option come from one arm's observation; numbers of the set (alternatives of the job, other jobs of the
arm, arms that are home soon) come from the observations of all arms. They do not depend on the order or number of arms
and slots.
"""

import json
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agents.heat import Wsept
from agents.policy import Local, plans_of, without_empty
from agents.rules import CentralRule, Matched
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.observation import Observation

Array = np.ndarray

PAIR_FEATURES, FILLS = 28, 26
"""Numbers of a pair; the one of them that is 1 for a job that ends just before the shift does."""
SOON_S = 180.0
"""Time until home of arms whose claim a job might wait for."""
MOST = 4.0
"""Bound of every number of a pair."""
PEAK_SD_K = 2.5
"""Standard deviation of true peaks around predicted ones, if `Worth.spread` is 0."""


class _Trained(Wsept):
    """`wsept` with the deviation of true peaks that trainings begin with."""

    peak_sd_k = PEAK_SD_K


class Worth(NamedTuple):
    """Learned parameters of the worth per time, [env] each."""

    margin: Array
    """Predicted peaks may be this much higher, in units of 10 K."""
    spread: Array
    """Logarithm of the factor on the deviation of true peaks."""
    fault: Array
    """Logarithm of the factor on the price of a fault."""
    minute: Array
    """Logarithm of the factor on the price of a minute above the warning limit."""
    tardiness: Array
    """Factor on the price of tardiness."""
    end: Array
    """Share of the value that a claim loses if it cannot end before the shift does."""
    overhead: Array
    """Time of every job besides its duration, in units of 2 min."""


Places = tuple[Array, Array, Array]
"""Env, arm and option of pairs, int [pair] each."""


class Pairs(NamedTuple):
    """The legal pairs of an instant, in the order of their envs."""

    at: Places
    rate: Array
    """Worth per second, [pair]."""
    scale: Array
    """Mean size of the rates in the env of a pair, [pair]."""
    features: Array
    """[pair, PAIR_FEATURES]."""


def worth_per_second(seen: Observation, at: Places, learned: Worth) -> Array:
    """Expected worth per second of some pairs, [pair].

    Args:
        seen: Observations [env, arm].
        at: Env, arm and option of each pair.
    """
    env, arm, option = at
    value, duration_s = seen.value[env, arm, option // plans_of(seen)], seen.duration_s[at].astype(float)
    hottest_c = seen.temp_c.max(axis=-1)[env, arm]
    warning_c = seen.headroom_k[env, arm] + hottest_c
    peak_c = _Trained.predicted_peak_c(seen.peak_c[at], seen.p_saturation[at], warning_c)
    error_c = seen.error_headroom_k[env, arm] + hottest_c + 10.0 * learned.margin[env]
    ends = _step((seen.left_s[env, arm] - duration_s) / 20.0)
    value_left = value * (1.0 - np.clip(learned.end[env], 0.0, 1.0) * (1.0 - ends))
    factors = [np.exp(each[env]) for each in (learned.spread, learned.fault, learned.minute)]
    worth = _Trained.worth_of(value_left, duration_s, peak_c, hottest_c, warning_c, error_c, factors)
    late = Wsept.tardiness_price * value * np.maximum(-seen.slack_s[at], 0.0) / 60.0
    duration_s = duration_s + 120.0 * np.maximum(learned.overhead[env], -0.2)
    return (worth - learned.tardiness[env] * late) / np.maximum(duration_s, 1.0)


def pairs_of(seen: Observation, learned: Worth) -> Pairs:
    """The legal pairs of arms and options; arguments as of `worth_per_second`."""
    legal = seen.action_mask[..., 1:-1] > 0
    env, arm, option = np.nonzero(legal)
    at = env, arm, option
    rate = worth_per_second(seen, at, learned)
    count = np.maximum(np.bincount(env, minlength=len(legal)), 1)
    scale = np.maximum(np.bincount(env, np.abs(rate), len(legal)) / count, 1e-6)
    return Pairs(at, rate, scale[env], _features(seen, at, learned, rate, scale))


def _features(seen: Observation, at: Places, learned: Worth, rate: Array, scale: Array) -> Array:
    env, arm, option = at
    plans = plans_of(seen)
    envs, arms, options = seen.duration_s.shape
    slots, slot = seen.offered.shape[-1], option // plans
    duration_s, slack_s, left_s = np.maximum(seen.duration_s[at], 1.0), seen.slack_s[at], seen.left_s[env, arm]
    value = seen.value[env, arm, slot]
    hottest_c = seen.temp_c.max(axis=-1)[env, arm]
    warning_c = seen.headroom_k[env, arm] + hottest_c
    peak_c = np.where(seen.peak_c[at] > 0, seen.peak_c[at], hottest_c)
    relative = np.full((envs, arms, options), -MOST)
    relative[at] = own = rate / scale[env]
    best = relative.reshape(envs, arms, slots, plans).max(axis=-1)
    soonest = _best_soon(seen, learned, scale)
    can = (seen.feasible > 0).reshape(envs, arms, slots, plans).any(axis=-1)
    waiting_s = np.maximum(slack_s + duration_s, 0.0)
    offered, free = seen.offered[:, 0].sum(axis=-1), seen.idle.sum(axis=1)
    mean_value = np.maximum((seen.value[:, 0] * seen.offered[:, 0]).sum(axis=-1) / np.maximum(offered, 1.0), 1e-6)
    fastest_s = np.full((envs, slots), np.inf)
    np.minimum.at(fastest_s, (env, slot), duration_s)
    mean_s = np.bincount(env, duration_s, envs) / np.maximum(np.bincount(env, minlength=envs), 1)
    columns = (
        seen.expires[env, arm, slot] * np.exp(-waiting_s / 300.0),
        np.exp(-np.maximum(slack_s, 0.0) / 600.0),
        np.tanh(slack_s / 1800.0),
        np.maximum(slack_s, 0.0) / (2.0 * mean_s[env]),
        _step(slack_s / 60.0),
        np.log1p(seen.age_s[env, arm, slot] / 60.0) / 3.0,
        (peak_c - warning_c) / 10.0,
        (hottest_c - warning_c) / 10.0,
        (peak_c - hottest_c) / 10.0,
        np.log(duration_s / 240.0),
        np.log(np.maximum(value, 1e-6) / mean_value[env]),
        seen.payload_kg[env, arm, slot] / 4.0,
        np.maximum(seen.difficulty[at], 0.0),
        np.log(duration_s / fastest_s[env, slot]),
        own - _best_of_others(best, axis=1)[env, arm, slot],
        own - _best_of_others(best, axis=2)[env, arm, slot],
        own - soonest[env, slot],
        can.mean(axis=1)[env, slot],
        np.log1p(can.sum(axis=-1))[env, arm] / 3.0,
        np.log((offered + 1.0) / (free + 1.0))[env],
        (free / arms)[env],
        np.exp(-left_s / 900.0),
        duration_s / np.maximum(left_s, 60.0),
        option % plans > 0,
        seen.returns[env, arm, slot],
        (seen.headroom_k.mean(axis=1) / 10.0)[env],
        np.where(duration_s <= left_s, np.exp((duration_s - left_s) / 120.0), 0.0),
        _step((duration_s - left_s) / 20.0),
    )
    features = np.empty((len(env), PAIR_FEATURES))
    for k, column in enumerate(columns):
        features[:, k] = column
    return np.clip(features, -MOST, MOST, out=features)


def _best_soon(seen: Observation, learned: Worth, scale: Array) -> Array:
    """Largest worth per second of arms that are home soon, relative to a scale [env], for each job, [env, slot]."""
    soon = (seen.working > 0) & (seen.busy_s <= SOON_S)
    env, arm, option = np.nonzero(soon[..., None] & (seen.feasible > 0))
    at = env, arm, option
    best = np.zeros((len(scale), seen.offered.shape[-1]))
    if len(env):
        duration_s, busy_s = np.maximum(seen.duration_s[at], 1.0), seen.busy_s[env, arm]
        rate = np.maximum(worth_per_second(seen, at, learned), 0.0) * duration_s / (duration_s + busy_s)
        np.maximum.at(best, (env, option // plans_of(seen)), rate / scale[env])
    return best


def _step(values: Array) -> Array:
    """Logistic function: 0 for values far below 0, 1 far above."""
    return 1.0 / (1.0 + np.exp(np.clip(-values, -30.0, 30.0)))


def _best_of_others(values: Array, axis: int) -> Array:
    """Largest value of the others along an axis, at least 0, in the shape of the values."""
    if values.shape[axis] < 2:
        return np.zeros_like(values)
    ordered = np.partition(values, -2, axis=axis)
    best = np.take(ordered, [-1], axis=axis)
    second = np.take(ordered, [-2], axis=axis)
    return np.maximum(np.where(values == best, second, best), 0.0)


PAIRS, PAIRS_CARD = "pairs.npy", "pairs.json"
OUTPUTS = 2
PARAMETERS = len(Worth._fields) + PAIR_FEATURES * OUTPUTS
"""Length of the vector of parameters."""


def first_parameters() -> Array:
    """Initial parameters of a training, float [PARAMETERS]: zeros, except for the end of the shift and faults.

    A job that cannot end before the shift does has no value, and one that just can has twice the score. A predicted
    peak may be 4 K above the error limit, and deviates twice as much.
    """
    parameters = np.zeros(PARAMETERS)
    first = Worth(0.4, np.log(2.0), 0.0, 0.0, 0.0, end=1.0, overhead=0.0)  # pyright: ignore[reportArgumentType]
    parameters[: len(first)] = first
    parameters[len(Worth._fields) + FILLS * OUTPUTS] = 0.7
    return parameters


def scores(seen: Observation, parameters: Array) -> Array:
    """Scores of all options, [env, arm, option]; −inf where a claim is not legal or not wanted.

    Args:
        seen: Observations [env, arm].
        parameters: [env, PARAMETERS].
    """
    worth, weights = np.split(parameters, [len(Worth._fields)], axis=-1)
    pairs = pairs_of(without_empty(seen), Worth(*worth.T))
    each = weights.reshape(-1, PAIR_FEATURES, OUTPUTS)[pairs.at[0]]
    f, g = np.clip(np.einsum("pk,pko->op", pairs.features, each), -3.0, 3.0)
    score = pairs.rate * np.exp(f) + g * pairs.scale
    result = np.full(seen.duration_s.shape, -np.inf)
    result[pairs.at] = np.where(score > 0, score, -np.inf)
    return result


class PairPolicy(Matched, CentralRule):
    """Matching by learned scores of arms and jobs.

    Args:
        parameters: float [PARAMETERS], as a training found them.
    """

    only_choices = True

    def __init__(self, parameters: Array) -> None:
        self._parameters = np.asarray(parameters, dtype=float)

    def cost(self, seen: Observation) -> Array:
        """Minus the scores, [env, arm, option]; inf for claims that are not wanted."""
        return -scores(seen, np.broadcast_to(self._parameters, (len(seen.action_mask), PARAMETERS)))


PAIRS_FORMAT = 4
"""Increase it when the numbers of a pair or the network change."""


def save_pairs(parameters: Array, folder: Path, **details: object) -> None:
    """Write parameters as a policy into a folder, made if need be; each file is written atomically.

    Args:
        details: Additional JSON values of the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / PAIRS) as draft, draft.open("wb") as file:
        np.save(file, parameters.astype(np.float32))
    with atomic_path(folder / PAIRS_CARD) as draft:
        card = {"format": PAIRS_FORMAT, **details}
        draft.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def load_pairs(folder: Path) -> PairPolicy:
    """The policy that `save_pairs` wrote.

    Raises:
        CheckpointError: a file is missing, damaged or of another format.
    """
    return PairPolicy(_parameters(folder))


def _parameters(folder: Traversable) -> Array:
    """Parameters in a folder; errors as of `load_pairs`."""
    try:
        found = json.loads((folder / PAIRS_CARD).read_text(encoding="utf-8"))["format"]
        with (folder / PAIRS).open("rb") as opened:
            parameters = np.load(opened, allow_pickle=False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"There is no policy over pairs in '{folder}' ({error}).") from error
    if found != PAIRS_FORMAT:
        raise CheckpointError(f"{folder / PAIRS_CARD}: format {found} is not {PAIRS_FORMAT}. Train the policy again.")
    if parameters.shape != (PARAMETERS,) or not np.isfinite(parameters).all():
        raise CheckpointError(f"{folder / PAIRS}: must be {PARAMETERS} finite numbers (shape {parameters.shape}).")
    return parameters


@cache
def shipped_parameters() -> Array:
    """The parameters that come with the project: the best on the validation split of several trainings."""
    return _parameters(resources.files("agents") / "weights")


class WseptLearned(PairPolicy):
    """As `wsept`, by scores that were learned on the training split of the suite with the true state."""

    only_choices = True

    def __init__(self) -> None:
        super().__init__(shipped_parameters())


class WseptUntrained(PairPolicy):
    """As `wsept_learned`, with the parameters that a training begins with: its ablation."""

    only_choices = True

    def __init__(self) -> None:
        super().__init__(first_parameters())


class WseptLearnedLocal(Local):
    """As `wsept_learned` for a fleet of one: every arm claims the job with the highest score for it."""

    central = WseptLearned
    only_choices = True
