"""Bid-price control: arms bid for jobs, and the time of an arm that others cannot replace has a price.

1. `bids_of`: the expected worth and the duration of each job for each arm, free or not.
2. `price_of`: what an arm's time costs, from the bids for the jobs of the last hour. The advantage of an arm in a job
   is its worth for this arm less the mean of the others. While an arm works, it misses jobs that expire before it is
   free. An option costs the advantage that the arm is expected to miss during it.
3. `gain_of` and `best_pairs`: one matching of jobs with each arm's next job and the one after it. Only a free arm's
   next job is claimed. So an arm that is good for what others cannot do stays free for it while others can do the rest.

All are functions of bids, wherever these come from.

Source of the prices: Talluri & van Ryzin, An Analysis of Bid-Price Controls for Network Revenue Management, Management
Science 44, 1998.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from agents.heat import Dues, Wsept, dues_of
from agents.policy import WAIT, CentralArrayPolicy, Shared, legal_options, plans_of, without_empty
from agents.staleness import EXPIRY_S
from fleet.observation import LONG_S, Observation

Array = np.ndarray


class Bids(NamedTuple):
    """Bids of arms for jobs, one bid of each arm for each job."""

    worth: Array
    """Expected worth without tardiness, [..., arm, job]; 0 for a job that the arm cannot or should not do, NaN where it
    is unknown."""
    duration_s: Array
    """[..., arm, job]."""


def bids_of(worth: Array, duration_s: Array, plans: int) -> Bids:
    """The bids by the plan with the most worth.

    Args:
        worth, duration_s: Of every option, [..., arm, option].
        plans: Number of options of a job.
    """
    shape = (*worth.shape[:-1], -1, plans)
    by_job = worth.reshape(shape)
    best = by_job.argmax(axis=-1)[..., None]
    worth, duration_s = (
        np.take_along_axis(each, best, axis=-1)[..., 0] for each in (by_job, duration_s.reshape(shape))
    )
    return Bids(np.maximum(worth, 0.0), np.maximum(duration_s, 1.0))


class TimePrice(NamedTuple):
    """Price of the time of each arm."""

    patience_s: Array
    """Time until recent jobs expired, ascending, [job]."""
    advantage: Array
    """Advantage per second in the first k of these jobs, [job + 1, arm]."""
    spared: Array
    """The same, each job times its patience, [job + 1, arm]: what is not missed in work that is longer."""
    most: Array
    """Highest price per second, [arm]."""

    def of(self, duration_s: Array) -> Array:
        """Advantage that each arm misses in work of some durations, in the shape of the durations, [arm, option]."""
        count = np.searchsorted(self.patience_s, duration_s)
        arm = np.arange(duration_s.shape[0])[:, None]
        missed = self.advantage[count, arm] * duration_s - self.spared[count, arm]
        return np.minimum(missed, self.most[:, None] * duration_s)


LEAST_ADVANTAGE = 0.05
"""Smaller advantages do not count; as a share of the best bid for the job."""
MOST_OF_RATE = 0.8
"""Highest price, as a share of the worth per time of the arm's advantages: below 1, so that the price alone
does not make an arm refuse the jobs that it is kept free for."""


def price_of(bids: Bids, patience_s: Array, over_s: float, most_of_rate: float = MOST_OF_RATE) -> TimePrice:
    """Prices by the bids for recent jobs.

    An arm with an unknown bid counts as equal to each arm that it is compared with.

    Args:
        bids: [job, arm] each.
        patience_s: Time from the arrival of each job until it expires, inf for others, [job].
        over_s: Time in which the jobs arrived.
    """
    worth, duration_s = bids
    arms, known = worth.shape[1], ~np.isnan(worth)
    worth = np.where(known, worth, 0.0)
    # The worth less that of each other arm with a bid; 0 for the arms without one.
    total = known.sum(axis=1, keepdims=True) * worth - worth.sum(axis=1, keepdims=True)
    advantage = np.where(known, total, 0.0) / max(arms - 1, 1)
    counts = (advantage > LEAST_ADVANTAGE * worth.max(axis=1, keepdims=True)) & np.isfinite(patience_s)[:, None]
    advantage = np.where(counts, advantage, 0.0)
    most = most_of_rate * advantage.sum(axis=0) / np.maximum(np.where(counts, duration_s, 0.0).sum(axis=0), 1.0)
    order = np.argsort(patience_s, kind="stable")
    # One of the arms with an advantage gets the job.
    share = (advantage / np.maximum(counts.sum(axis=1, keepdims=True), 1) / over_s)[order]
    patience_s = patience_s[order]
    spared = share * np.where(np.isfinite(patience_s), patience_s, 0.0)[:, None]
    return TimePrice(patience_s, _sums(share), _sums(spared), most)


def _sums(rows: Array) -> Array:
    """Sums of the first 0, 1, … rows, [row + 1, …]."""
    return np.concatenate([np.zeros((1, *rows.shape[1:])), rows.cumsum(axis=0)])


LATER_S = 7200.0
"""Time in which the worth of a later start falls to 1/e."""


class Weights(NamedTuple):
    """Changes of the gain of options: their worth per second is multiplied and increased."""

    factor: Any
    added: Any


UNWEIGHTED = Weights(1.0, 0.0)


def gain_of(
    bids: Bids,
    dues: Dues,
    start_s: Array,
    cost: Array,
    crowd: Array,
    weights: Weights = UNWEIGHTED,
) -> Array:
    """Worth per second of jobs less the price of the arms' time, at least 0, in the shape of the bids.

    Args:
        start_s: Time until the start; like the others in a shape that fits that of the bids.
        cost: Price of the arm's time for the job, as of `TimePrice.of`.
        crowd: Share of the time until the start that counts as time of the arm.
        weights: Applied after the costs.
    """
    worth, duration_s = bids
    later = Wsept.later_worth(worth * np.exp(-start_s / LATER_S), duration_s, start_s, dues)
    rate = (later - cost) / (duration_s + crowd * start_s) * Wsept.urgency(dues)
    gain = rate * weights.factor + weights.added
    return np.where((worth > 0) & (later > 0), np.maximum(gain, 0.0), 0.0)


def best_pairs(gain: Array) -> list[tuple[int, int]]:
    """The next jobs of the arms in a matching with the largest total gain, as pairs (arm, job).

    Args:
        gain: Gain of each job as an arm's first, second, … from now, [place, arm, job]; 0 is never paired.
    """
    from scipy.optimize import linear_sum_assignment  # slow import that few processes need

    arms = gain.shape[1]
    rows = gain.reshape(-1, gain.shape[2])
    pairs = zip(*(each.tolist() for each in linear_sum_assignment(rows, maximize=True)), strict=True)
    return [(row, job) for row, job in pairs if row < arms and rows[row, job] > 0]


class BidPrice(CentralArrayPolicy):
    """Matching by expected worth per time, less what the arm's time costs, over the next two jobs of each arm.

    See the module. It differs from `wsept` in three ways: arms at work take part, a job may wait for an arm that will
    be free, and an arm stays free for jobs that others can hardly do. Worths and urgency are those of `wsept`.
    """

    only_choices = True
    window_s: ClassVar = 3600.0
    """Jobs that arrived earlier do not count."""
    renew_s: ClassVar = 300.0
    """Time for which prices hold."""
    prior_s: ClassVar = 600.0
    """Time without jobs before the shift that is assumed."""
    price_share: float = 1.0
    """Share of the price of an arm's time that counts."""
    most_of_rate: float = MOST_OF_RATE
    """As in `price_of`."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a shift: no job has been seen."""
        self._arms: tuple[str, ...] = ()
        self._left_s = self._first_s = self._priced_s = 0.0
        self._jobs: list[tuple[float, Array, Array, float]] = []
        self._price: TimePrice | None = None

    @classmethod
    def decide(cls, policies: Sequence[Any], seen: Observation, arms: Sequence[str]) -> Array:
        """The claims of the best pairs."""
        seen, plans = without_empty(seen), plans_of(seen)
        duration_s = np.maximum(seen.duration_s, 1.0).astype(float)
        worth = np.where(seen.feasible, cls.worths(policies, seen), 0.0)
        bids = bids_of(worth, duration_s, plans)
        cost = cls._prices(policies, seen, bids, duration_s, tuple(arms))
        weights = cls.weights(policies, seen, Bids(worth, duration_s), cost)
        delay_s = np.where(seen.faulted > 0, LONG_S, np.where(seen.working > 0, seen.busy_s, 0.0))[..., None]
        able = worth > 0
        mean_s = np.where(able, duration_s, 0.0).sum(axis=-1) / np.maximum(able.sum(axis=-1), 1)
        # With more jobs than arms a later start costs time as well as patience.
        crowd = np.clip(seen.offered[:, 0].sum(axis=-1) / len(arms) - 1.0, 0.0, 1.0)[:, None, None]
        dues, legal = dues_of(seen), legal_options(seen)

        def gain(start_s: Array) -> Array:
            return gain_of(Bids(worth, duration_s), dues, start_s, cost, crowd, weights)

        now = np.where((delay_s > 0) | legal, gain(delay_s), 0.0)
        gains = np.stack([now, gain(delay_s + mean_s[..., None])], axis=1)
        gains = gains.reshape(*gains.shape[:-1], -1, plans)
        best, option = gains.max(axis=-1), gains[:, 0].argmax(axis=-1)
        actions = np.full(seen.action_mask.shape[:2], WAIT)
        for env in np.flatnonzero(legal.any(axis=(1, 2))).tolist():
            for arm, job in best_pairs(best[env]):
                if delay_s[env, arm, 0] <= 0:
                    actions[env, arm] = 1 + job * plans + option[env, arm, job]
        return actions

    @classmethod
    def worths(cls, policies: Sequence[Any], seen: Observation) -> Array:
        """Expected worth of every option without tardiness, [env, arm, option]."""
        return Wsept.worth(seen)

    @classmethod
    def weights(cls, policies: Sequence[Any], seen: Observation, bids: Bids, cost: Array) -> Weights:
        """Changes of the gain of every option, in shapes that fit [env, arm, option]; arguments as of `gain_of`."""
        return UNWEIGHTED

    @classmethod
    def _prices(
        cls, policies: Sequence[Any], seen: Observation, bids: Bids, duration_s: Array, arms: tuple[str, ...]
    ) -> Array:
        """Price of every option, [env, arm, option]."""
        cost = np.zeros(duration_s.shape)
        left_s, age_s = seen.left_s[:, 0].tolist(), seen.age_s[:, 0]
        lasts_s = np.where(seen.expires[:, 0] > 0, seen.due_in_s[:, 0] + age_s, np.inf)
        first = seen.offered[:, 0] & (seen.returns[:, 0] == 0)
        messages_s = cls.ages_s(seen)
        current = messages_s < EXPIRY_S
        settled_s = np.where(current, messages_s, 0.0).max(axis=-1).tolist()
        known = np.where(current[..., None], bids.worth, np.nan)
        for env, policy in enumerate(policies):
            least_s, since_s = policy._ages_of_new(left_s[env], settled_s[env], arms)
            new = first[env] & (age_s[env] >= least_s) & (age_s[env] < since_s)
            if new.any():
                rows = zip(known[env].T[new], bids.duration_s[env].T[new], lasts_s[env, new], strict=True)
                policy._jobs += [(left_s[env], *row) for row in rows]
            price = policy._current(left_s[env], float(age_s[env].max()))
            if price.most.any():
                cost[env] = policy.price_share * price.of(duration_s[env])
        return cost

    @classmethod
    def ages_s(cls, seen: Observation) -> Array:
        """Age of what is known of each arm, [env, arm]."""
        return np.zeros(seen.left_s.shape)

    def _ages_of_new(self, left_s: float, settled_s: float, arms: tuple[str, ...]) -> tuple[float, float]:
        """Least and greatest age of the jobs that count from this decision on."""
        before_s = self._left_s - ROUNDING_S
        self._left_s = min(self._left_s, left_s + settled_s)
        if arms != self._arms or left_s >= LONG_S:
            # Other arms begin anew. Without an end of the shift there is no clock: only the open jobs count.
            self._arms, self._jobs, self._first_s, self._price = arms, [], left_s, None
            before_s, self._left_s = np.inf, left_s + settled_s
        return self._left_s - left_s - ROUNDING_S, before_s - left_s

    def _current(self, left_s: float, oldest_s: float) -> TimePrice:
        """The prices, renewed if they are old."""
        if self._price is not None and self._priced_s - left_s < self.renew_s:
            return self._price
        self._priced_s = left_s
        self._jobs = [job for job in self._jobs if job[0] < left_s + self.window_s]
        past_s = oldest_s if left_s >= LONG_S else self._first_s - left_s
        _, worth, duration_s, patience_s = zip(*self._jobs, strict=True) if self._jobs else ((),) * 4
        shape = (len(self._jobs), len(self._arms))
        recent = Bids(np.reshape(worth, shape), np.reshape(duration_s, shape))
        over_s = min(self.window_s, past_s + self.prior_s)
        self._price = price_of(recent, np.array(patience_s, float), over_s, self.most_of_rate)
        return self._price


class BidPriceByMessages(BidPrice):
    """As `bid_price`, for bids that arrive by messages."""

    @classmethod
    def ages_s(cls, seen: Observation) -> Array:
        """Age of the last message of each arm, [env, arm]."""
        return seen.fleet_age_s[:, 0]


class BidPriceShared(Shared):
    """As `bid_price`, decided by every arm for itself from what its peers share."""

    central = BidPriceByMessages
    only_choices = True


ROUNDING_S = 0.01
"""Ages of jobs that are equal up to rounding."""
