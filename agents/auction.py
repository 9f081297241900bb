"""The auction algorithm: arms bid for jobs by price; the total is within a bound of the best assignment.

In a round every arm without a job bids for the job with the largest profit, benefit less price. It raises the price by
its profit over that of its second choice, plus ε, so that the job still is within ε of its best choice. An arm without
a profit leaves. At the end every arm is within ε of its best choice and no job without an arm has a price, therefore
the total benefit of n arms is within n · ε of the optimum.

Source: Bertsekas, The Auction Algorithm: A Distributed Relaxation Method for the Assignment Problem, Annals of
Operations Research 14, 1988; all arms without a job bid at once (Jacobi version).
"""

import numpy as np

from agents.heat_rules import Wsept

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

    `wsept` makes as many pairs as possible first. Scope central: the auctioneer compares the bids of all arms.
    """

    only_choices = True
    relative_epsilon = 0.01
    """ε as a share of the largest benefit."""

    def pairs(self, cost: Array, plans: int) -> list[tuple[int, int]]:
        """Pairs (arm, option) of a cost matrix [arm, option], for which the arms bid minus the cost."""
        benefit = np.where(np.isfinite(cost), -cost, 0.0).reshape(len(cost), -1, plans)
        best, by_slot = benefit.argmax(axis=2), benefit.max(axis=2)
        if not by_slot.max(initial=0.0) > 0:
            return []
        won = auction(by_slot, self.relative_epsilon * float(by_slot.max()))
        return [(arm, slot * plans + int(best[arm, slot])) for arm, slot in won]
