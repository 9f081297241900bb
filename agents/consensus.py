"""Agreement without anybody in the middle: arms bid, tell their neighbours the best bids they know of, and yield.

The consensus-based auction algorithm for one job per arm. In a round every arm without a job bids for the one that
costs it least among those where it beats the best bid it knows of; then it takes over, for every job, the best bid
that it or a neighbour knows of, and lets go of its job where that is not its own. After at most (diameter × the fewer
of arms and jobs) rounds all arms that are connected agree, no job is given twice, and the outcome is that of choosing
the cheapest pair of arm and job first, as one who knows every bid would. Arms that are not connected agree in their
own part each.

Source: Choi, Brunet & How (2009), Consensus-Based Decentralized Auctions for Robust Task Allocation, IEEE T-RO 25(4),
algorithms 1 and 2 and theorem 1; here a bid is a cost, and the lower one wins.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np

from agents.hearsay import Trust, advantage
from agents.policy import WAIT
from fleet.env.observation import Observation
from fleet.robot import JOINTS

Array = np.ndarray

NOBODY = -1
"""The winner of a job that nobody bids for."""
_UNKNOWN = JOINTS + 1.0
"""Cost of a job that an arm can do but has no score for: behind every score, which lies at most JOINTS from another."""


@dataclass(frozen=True, eq=False)
class Belief:
    """The best bid that arms know of for each job, and whose it is; leading axes [...] are those of the arms."""

    cost: Array
    """[..., job], inf where nobody bids."""
    winner: Array
    """Index of the arm, int [..., job], NOBODY where nobody bids. An arm has the job that it believes it won."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What the arms believe in the end."""

    belief: Belief
    """[arm, job]."""
    rounds: int
    """Rounds in which some arm's belief changed."""

    @property
    def claims(self) -> Array:
        """The job each arm has by its own belief, int [arm], NOBODY for none."""
        won = self.belief.winner == np.arange(len(self.belief.winner))[:, None]
        return np.where(won.any(axis=1), won.argmax(axis=1) if won.size else NOBODY, NOBODY)


def bid(belief: Belief, cost: Array, me: Array | int) -> Belief:
    """What arms believe after those without a job bid for the cheapest one they can win; ties: the first job.

    Args:
        belief: [..., job].
        cost: Of each job to the arm, [..., job], inf where it cannot do it.
        me: Index of the arm, [...].
    """
    mine = np.asarray(me)[..., None]
    better = (cost < belief.cost) | ((cost == belief.cost) & (mine < belief.winner))
    idle = ~(belief.winner == mine).any(axis=-1, keepdims=True)
    winnable = np.where(idle & better, cost, np.inf)
    chosen = (winnable.argmin(axis=-1)[..., None] == np.arange(cost.shape[-1])) & np.isfinite(winnable)
    return Belief(np.where(chosen, cost, belief.cost), np.where(chosen, mine, belief.winner))


def hear(known: Belief) -> Belief:
    """The best of the beliefs [..., teller, job] that reached an arm, its own among them; ties: the first arm."""
    cost = known.cost.min(axis=-2)
    none = np.iinfo(known.winner.dtype).max
    winner = np.where(known.cost == cost[..., None, :], known.winner, none).min(axis=-2)
    return Belief(cost, winner)


def agree(cost: Array, hears: Array) -> Agreement:
    """Rounds of bidding and hearing until no arm's belief changes.

    Args:
        cost: Of each job to each arm, [arm, job], inf where it cannot do it.
        hears: Who hears whom, bool, [receiver, sender].
    """
    arms, jobs = cost.shape
    belief = Belief(np.full((arms, jobs), np.inf), np.full((arms, jobs), NOBODY))
    if not jobs:
        return Agreement(belief, 0)
    ear = (hears | np.eye(arms, dtype=bool))[..., None]  # [receiver, sender, 1]
    # Every change is a better bid for a job somewhere, or a bid that travels: one-way links cannot make more.
    for done in range(arms * (jobs * arms + 1)):
        said = bid(belief, cost, np.arange(arms))
        told = hear(Belief(np.where(ear, said.cost, np.inf), np.where(ear, said.winner, NOBODY)))
        if np.array_equal(told.cost, belief.cost) and np.array_equal(told.winner, belief.winner):
            return Agreement(belief, done)
        belief = told
    raise AssertionError("bids only ever get better, so there is an end")


def consensus(bids: Mapping[str, Mapping[str, float]], graph: nx.Graph) -> dict[str, str | None]:
    """The job that each arm comes to have, by name, None for none; ties by name of job, then of arm.

    Args:
        bids: What each job would cost each arm; a job that an arm does not name it cannot do.
        graph: Who hears whom; an arm that is no node of it hears nobody.
    """
    arms, jobs = sorted(bids), sorted({job for costs in bids.values() for job in costs})
    cost = np.array([[bids[arm].get(job, np.inf) for job in jobs] for arm in arms], dtype=float)
    known = nx.Graph() if not graph.is_directed() else nx.DiGraph()
    known.add_nodes_from(arms)
    known.add_edges_from((a, b) for a, b in graph.edges() if a in bids and b in bids)
    hears = nx.to_numpy_array(known, nodelist=arms).T > 0
    claims = agree(cost.reshape(len(arms), len(jobs)), hears).claims
    return {arm: jobs[claim] if claim != NOBODY else None for arm, claim in zip(arms, claims.tolist(), strict=True)}


class Consensus:
    """Arms bid how much harder than the fleet on average they find a job, and agree on who does it.

    A bid is an arm's own number: its difficulty against the average of what it heard, faded by age. Bids go along the
    links over which this moment's word came, so arms that do not hear each other agree through those between them;
    where words are late no link is fit to agree over, and every arm bids for itself. Rounds of bids take no time and
    are not counted as messages. With everybody in earshot the claims are those of `least_difficulty`.
    """

    only_choices = True

    def __init__(self, trust: Trust | None = None) -> None:
        self._trust = trust or Trust()

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def act(self, observations: Mapping[str, Observation]) -> dict[str, int]:
        """Each arm's claim after as many rounds as it takes."""
        seen = list(observations.values())
        cost = np.array([self._bids(obs, place) for place, obs in enumerate(seen)])
        if not np.isfinite(cost).any():
            return dict.fromkeys(observations, WAIT)
        online = [(obs.peer_heard > 0) & (obs.peer_age_s <= 0) for obs in seen]
        hears = np.array([np.insert(row, place, False) for place, row in enumerate(online)], dtype=bool)
        claims = agree(cost, hears).claims.tolist()
        return {arm: WAIT if claim == NOBODY else claim + 1 for arm, claim in zip(observations, claims, strict=True)}

    def _bids(self, observation: Observation, place: int) -> Array:
        """What each slot would cost this arm, inf where it may not claim it, [slot]."""
        legal = observation.action_mask[1:] > 0
        if not legal.any():
            return np.full(len(legal), np.inf)
        harder = advantage(observation, place, legal, self._trust)[place]
        return np.where(legal, np.where(np.isnan(harder), _UNKNOWN, harder), np.inf).round(9)
