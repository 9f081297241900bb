"""Learned corrections of `bid_price`: of its prices, and of the gain of each pair of arm and option.

gain' = gain · exp(f) + g · mean rate, where f and g are weighted sums of the pair's numbers, and the gain follows from
worths and prices with learned parameters (`Prices`). All parameters are one vector; zeros give `bid_price`.

Numbers of one option come from one arm's observation; numbers of the set (alternatives of the job, other jobs of the
arm, peers) come from the observations of all arms. They do not depend on the order or number of arms and slots.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.heat import Wsept, warning_of
from agents.policy import per_option, plans_of
from agents.prices import BidPrice, Bids, Weights
from fleet.errors import CheckpointError
from fleet.files import atomic_path
from fleet.json_file import read_card, write_card
from fleet.observation import Observation

Array = np.ndarray

PAIR_FEATURES = 26
"""Numbers of a pair."""
MOST = 4.0
"""Bound of every number of a pair."""
MOST_PARAMETER = 20.0
"""Bound of every parameter of a stored policy."""


class Prices(NamedTuple):
    """Learned parameters of worths and prices, [env] each or one; 0 changes nothing."""

    margin: Any
    """Predicted peaks may be this much higher, in units of 10 K."""
    spread: Any
    """Logarithm of the factor on the deviation of true peaks."""
    fault: Any
    """Logarithm of the factor on the price of a fault."""
    minute: Any
    """Logarithm of the factor on the price of a minute above the warning limit."""
    time: Any
    """Logarithm of the factor on the price of an arm's time."""
    most: Any
    """Logarithm of the factor on the highest price."""


PARAMETERS = len(Prices._fields) + 2 * PAIR_FEATURES
"""Length of the vector of parameters."""


def features_of(seen: Observation, bids: Bids, cost: Array, relative: Array) -> Array:
    """Numbers of all pairs of arm and option, float [env, arm, option, PAIR_FEATURES]; 0 for what an arm cannot do.

    Args:
        seen: Observations [env, arm].
        bids, cost: Of every option, as of `agents.prices.gain_of`.
        relative: Worth per second of every option over the mean of the fleet.
    """
    plans, can = plans_of(seen), bids.worth > 0
    own = np.where(can, relative, -MOST)

    def by_job(values: Array) -> Array:
        return values.reshape(*values.shape[:2], -1, plans)

    best, able = by_job(own).max(axis=-1), by_job(can).any(axis=-1)

    def of_job(values: Array) -> Array:
        return np.broadcast_to(values, best.shape).repeat(plans, axis=-1)

    duration_s, hottest_c = bids.duration_s, seen.temp_c.max(axis=-1)[..., None]
    warning_c, left_s = warning_of(seen)[..., None], seen.left_s[..., None]
    peak_c = np.where(seen.peak_c > 0, seen.peak_c, hottest_c)
    waiting_s = np.maximum(per_option(seen, seen.due_in_s), 0.0)
    slack_s, value = seen.slack_s, per_option(seen, seen.value)
    offered, free = seen.offered[:, 0].sum(axis=-1), seen.idle.sum(axis=1)
    count = np.maximum(can.sum(axis=(1, 2), keepdims=True), 1)
    mean_value = np.where(can, value, 0.0).sum(axis=(1, 2), keepdims=True) / count
    fastest_s = by_job(np.where(can, duration_s, np.inf)).min(axis=(1, 3))[:, None]
    others = np.maximum(able.sum(axis=1, keepdims=True) - able, 1)
    positive = np.where(able, best, 0.0)
    mean_of_others = (positive.sum(axis=1, keepdims=True) - positive) / others
    columns = (
        per_option(seen, seen.expires) * np.exp(-waiting_s / 300.0),
        np.exp(-np.maximum(slack_s, 0.0) / 600.0),
        np.tanh(slack_s / 1800.0),
        _step(slack_s / 60.0),
        np.log1p(per_option(seen, seen.age_s) / 60.0) / 3.0,
        (peak_c - warning_c) / 10.0,
        (hottest_c - warning_c) / 10.0,
        (peak_c - hottest_c) / 10.0,
        np.log(duration_s / 240.0),
        np.log(np.maximum(value, 1e-6) / np.maximum(mean_value, 1e-6)),
        per_option(seen, seen.payload_kg) / 4.0,
        np.maximum(seen.difficulty, 0.0),
        np.log(duration_s / of_job(np.where(np.isfinite(fastest_s), fastest_s, 1.0))),
        own - of_job(_best_of_others(best, axis=1)),
        own - of_job(_best_of_others(best, axis=2)),
        own - of_job(mean_of_others),
        of_job(able.mean(axis=1, keepdims=True)),
        np.log1p(able.sum(axis=-1, keepdims=True)) / 3.0,
        np.log((offered + 1.0) / (free + 1.0))[:, None, None],
        (free / can.shape[1])[:, None, None],
        np.exp(-left_s / 900.0),
        duration_s / np.maximum(left_s, 60.0),
        np.arange(can.shape[-1]) % plans > 0,
        per_option(seen, seen.returns),
        cost / np.maximum(bids.worth, 1e-6),
        (seen.headroom_k.mean(axis=1) / 10.0)[:, None, None],
    )
    features = np.empty((*can.shape, PAIR_FEATURES))
    for k, column in enumerate(columns):
        features[..., k] = column
    np.clip(features, -MOST, MOST, out=features)
    return np.where(can[..., None], features, 0.0)


def rates_of(bids: Bids) -> tuple[Array, Array]:
    """Worth per second of every option, [env, arm, option], and its mean over those that are worth anything,
    [env, 1, 1]."""
    can = bids.worth > 0
    rate = np.where(can, bids.worth / bids.duration_s, 0.0)
    scale = rate.sum(axis=(1, 2), keepdims=True) / np.maximum(can.sum(axis=(1, 2), keepdims=True), 1)
    return rate, np.maximum(scale, 1e-6)


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


class LearnedPrices(BidPrice):
    """`bid_price` with learned parameters.

    Args:
        parameters: float [PARAMETERS], as a training found them.
    """

    def __init__(self, parameters: Array) -> None:
        self.parameters = np.asarray(parameters, dtype=float)
        learned = Prices(*self.parameters[: len(Prices._fields)].tolist())
        self.price_share = BidPrice.price_share * float(np.exp(learned.time))
        self.most_of_rate = BidPrice.most_of_rate * float(np.exp(learned.most))
        super().__init__()

    @classmethod
    def worths(cls, policies: Sequence[Any], seen: Observation) -> Array:
        """As of `bid_price`, with the learned prices of heat."""
        parameters = np.stack([each.parameters for each in policies]).astype(np.float32)  # as the observation
        learned = Prices(*parameters.T[: len(Prices._fields), :, None, None])
        factors = [np.exp(each) for each in (learned.spread, learned.fault, learned.minute)]
        return Wsept.worth(seen, 10.0 * learned.margin, factors)

    @classmethod
    def weights(cls, policies: Sequence[Any], seen: Observation, bids: Bids, cost: Array) -> Weights:
        """The learned factor and shift of the gain of every option."""
        learned = np.stack([each.parameters[len(Prices._fields) :] for each in policies])
        rate, scale = rates_of(bids)
        each = features_of(seen, bids, cost, rate / scale) @ learned.reshape(len(policies), 1, PAIR_FEATURES, 2)
        f, g = np.moveaxis(np.clip(each, -3.0, 3.0), -1, 0)
        return Weights(np.exp(f), g * scale)


PAIRS_FORMAT = 5
"""Increase it when the parameters change their meaning."""


def save_pairs(parameters: Array, folder: Path, **details: object) -> None:
    """Write parameters as a policy into a folder, made if need be; each file is written atomically.

    Args:
        details: Additional JSON values of the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / PAIRS) as draft, draft.open("wb") as file:
        np.save(file, parameters.astype(np.float32))
    write_card({"format": PAIRS_FORMAT, **details}, folder / PAIRS_CARD)


def load_pairs(folder: Path) -> LearnedPrices:
    """The policy that `save_pairs` wrote.

    Raises:
        CheckpointError: a file is missing, damaged or of another format.
    """
    read_card(folder / PAIRS_CARD, dict, format_=PAIRS_FORMAT, what="policy over pairs")
    try:
        with (folder / PAIRS).open("rb") as opened:
            parameters = np.load(opened, allow_pickle=False)
    except Exception as error:  # whatever it is, the files are missing or damaged
        reason = f"{type(error).__name__}: {error}"
        raise CheckpointError(f"There is no policy over pairs in '{folder}' ({reason}).") from error
    shape, kind = np.shape(parameters), getattr(parameters, "dtype", None)
    if shape != (PARAMETERS,) or kind != np.float32 or not (np.abs(parameters) <= MOST_PARAMETER).all():
        raise CheckpointError(
            f"{folder / PAIRS}: must be {PARAMETERS} finite numbers, float32, from {-MOST_PARAMETER:g} to "
            f"{MOST_PARAMETER:g} (got shape {shape}, {kind}). Train the policy again."
        )
    return LearnedPrices(parameters)
