"""Auctions of jobs: by price with a central auctioneer, and by consensus of the arms without one.

In a round of the auction algorithm every arm without a job bids for the job with the largest profit, benefit less
price. It raises the price by its profit over that of its second choice, plus ε, so that the job still is within ε of
its best choice. An arm without a profit leaves. At the end every arm is within ε of its best choice and no job without
an arm has a price, therefore the total benefit of n arms is within n · ε of the optimum.

Source: Bertsekas, The Auction Algorithm: A Distributed Relaxation Method for the Assignment Problem, Annals of
Operations Research 14, 1988; all arms without a job bid at once (Jacobi version).

In a round of the consensus-based auction algorithm for one job per arm every arm without a job bids for its cheapest
job among those where it beats the best bid it knows. Then it adopts, for every job, the best bid of its own and its
neighbours' beliefs, and loses its job if that bid is another arm's. After at most (diameter × the smaller number of
arms and jobs) rounds all connected arms agree, and no job has two winners. The outcome is that of the greedy choice of
the cheapest pair by a central auctioneer. Each component of a disconnected graph agrees separately.

Source: Choi, Brunet & How (2009), Consensus-Based Decentralized Auctions for Robust Task Allocation, IEEE T-RO 25(4),
algorithms 1 and 2 and theorem 1; here a bid is a cost, and the lower one wins.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from agents.heat import Wsept
from agents.policy import WAIT, legal_options
from agents.rules import LeastDifficulty, each_env, least_difficult
from agents.staleness import advantage, in_fleet
from fleet.observation import Observation
from fleet.robot import JOINTS

Array = np.ndarray

NOBODY = -1


def auction(benefit: Array, epsilon: float) -> list[tuple[int, int]]:
    """Pairs (arm, job) of a matrix of benefits, [arm, job], whose total is within arms · ε of the largest.

    Args:
        benefit: A pair of 0 or less is never made; an arm without a pair has the benefit 0.
        epsilon: > 0; the number of rounds grows with the largest benefit / ε.
    """
    if not epsilon > 0:
        raise ValueError(f"epsilon must be > 0 (got {epsilon}).")
    owner, price = np.full(benefit.shape[1], NOBODY), np.zeros(benefit.shape[1])
    bidders = np.flatnonzero((benefit > 0).any(axis=1))
    while bidders.size:
        profit = benefit[bidders] - price
        choice = profit.argmax(axis=1)
        rows = np.arange(len(bidders))
        best = profit[rows, choice]
        profit[rows, choice] = 0.0  # the second choice is at least to leave
        second = np.maximum(profit.max(axis=1), 0.0)
        stays = best > 0
        bidders, choice = bidders[stays], choice[stays]
        bids = price[choice] + (best - second)[stays] + epsilon
        if not bidders.size:
            break
        order = np.lexsort((-bidders, bids))  # the highest bid of a job comes last; ties: the first arm
        losers = []
        for i in order.tolist():
            job = int(choice[i])
            if owner[job] != NOBODY:
                losers.append(int(owner[job]))
            owner[job], price[job] = bidders[i], bids[i]
        bidders = np.array(losers, dtype=int)
    return [(int(owner[job]), int(job)) for job in np.flatnonzero(owner != NOBODY)]


class Auction(Wsept):
    """Batch auction of the open jobs by expected worth per time, as in `wsept`, within arms · ε of the best total.

    `wsept` makes as many pairs as possible first.
    """

    relative_epsilon = 0.01
    """ε as a share of the largest benefit."""

    def options(self, cost: Array, plans: int) -> Array:
        """The option of each arm or NONE, int [env, arm], for which the arms bid minus the cost."""
        return each_env(self._won, np.where(cost < 0, cost, np.inf), plans)

    def _won(self, cost: Array) -> list[tuple[int, int]]:
        benefit = np.where(np.isfinite(cost), -cost, 0.0)
        return auction(benefit, self.relative_epsilon * float(benefit.max()))


_UNKNOWN = JOINTS + 1.0
"""Cost of a feasible job without a score: above every score, because two scores differ by at most JOINTS."""


@dataclass(frozen=True, eq=False)
class Belief:
    """The best bid known for each job, and its bidder; leading axes [...] are those of the arms."""

    cost: Array
    """[..., job], inf without a bid."""
    winner: Array
    """Index of the arm, int [..., job], NOBODY without a bid. An arm has the job that it believes to have won."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Beliefs of the arms after the last round."""

    belief: Belief
    """[..., arm, job]."""
    rounds: int
    """Number of rounds in which some arm's belief changed."""

    @property
    def claims(self) -> Array:
        """The job each arm has by its own belief, int [..., arm], NOBODY for none."""
        winner = self.belief.winner
        if not winner.size:
            return np.full(winner.shape[:-1], NOBODY)
        won = winner == np.arange(winner.shape[-2])[:, None]
        return np.where(won.any(axis=-1), won.argmax(axis=-1), NOBODY)


def bid(belief: Belief, cost: Array, me: Array | int) -> Belief:
    """Beliefs after every arm without a job has bid for the cheapest one it can win; ties: the first job.

    Args:
        belief: [..., job].
        cost: Of each job to the arm, [..., job], inf for infeasible ones.
        me: Index of the arm, [...].
    """
    mine = np.asarray(me)[..., None]
    better = (cost < belief.cost) | ((cost == belief.cost) & (mine < belief.winner))
    idle = ~(belief.winner == mine).any(axis=-1, keepdims=True)
    winnable = np.where(idle & better, cost, np.inf)
    chosen = (winnable.argmin(axis=-1)[..., None] == np.arange(cost.shape[-1])) & np.isfinite(winnable)
    return Belief(np.where(chosen, cost, belief.cost), np.where(chosen, mine, belief.winner))


def merge(received: Belief) -> Belief:
    """The best of the beliefs [..., sender, job] received by an arm, its own included; ties: the first arm."""
    cost = received.cost.min(axis=-2)
    none = np.iinfo(received.winner.dtype).max
    winner = np.where(received.cost == cost[..., None, :], received.winner, none).min(axis=-2)
    return Belief(cost, winner)


def agree(cost: Array, links: Array) -> Agreement:
    """Rounds of bids and messages until no arm's belief changes; leading axes [...] are those of fleets.

    Args:
        cost: Of each job to each arm, [..., arm, job], inf for infeasible ones.
        links: Whether messages are delivered, bool, [..., receiver, sender].
    """
    arms, jobs = cost.shape[-2:]
    belief = Belief(np.full(cost.shape, np.inf), np.full(cost.shape, NOBODY))
    if not jobs:
        return Agreement(belief, 0)
    received = (links | np.eye(arms, dtype=bool))[..., None]  # [..., receiver, sender, 1]
    # Every change is a better bid for a job, or a forwarded bid, which bounds the rounds also with one-way links.
    for rounds in range(arms * (jobs * arms + 1)):
        sent = bid(belief, cost, np.arange(arms))
        heard = Belief(sent.cost[..., None, :, :], sent.winner[..., None, :, :])
        merged = merge(Belief(np.where(received, heard.cost, np.inf), np.where(received, heard.winner, NOBODY)))
        if np.array_equal(merged.cost, belief.cost) and np.array_equal(merged.winner, belief.winner):
            return Agreement(belief, rounds)
        belief = merged
    raise AssertionError("bids only improve, so the loop ends")


class Consensus(LeastDifficulty):
    """Arms bid their difficulty relative to the fleet's average, and agree on the allocation of jobs.

    Scope arm. With messages from all peers an arm can compute the agreement alone: the choice of `least_difficulty`. In
    simulation, `act` runs the rounds of bids along the links that delivered a message at this step, so distant arms
    agree through the arms between them. Late messages do not count: arms without a link claim independently. Rounds
    take no time and are not counted as messages.
    """

    only_choices = True

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Each arm's claim after the last round."""
        return self.act_in_fleet(observations)

    def actions(self, seen: Observation) -> Array:
        """Each arm's claim after the last round."""
        arm_index = np.arange(seen.action_mask.shape[1])
        online = (seen.peer_heard > 0) & (seen.peer_age_s <= 0)
        claims = agree(_bids(seen, arm_index), in_fleet(online, arm_index, False)).claims
        claimed = least_difficult(seen, np.maximum(claims, 0))
        return np.where(claims == NOBODY, WAIT, claimed + 1)


def _bids(seen: Observation, arm_index: Array) -> Array:
    """Cost of each slot to each arm, [env, arm, slot]; inf for those that it may not claim."""
    legal = np.any(legal_options(seen).reshape(*seen.offered.shape, -1), axis=-1)
    relative = advantage(seen, arm_index, np.asarray(legal))[:, arm_index, arm_index]
    return np.where(legal, np.where(np.isnan(relative), _UNKNOWN, relative), np.inf).round(9)
