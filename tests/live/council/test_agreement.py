"""Arms among themselves, with every word heard: they do what the agreement says, and know when all is done."""

import random

import networkx as nx
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agents.consensus import consensus
from agents.cost import Bids, thermal
from fleet.bus.trade import JobWord


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 7))
def test_with_every_word_heard_they_do_what_consensus_says(council, seed, arms, jobs):
    """The first job of every arm is that of `agents.consensus` on the same costs, where no two want one station."""
    rng = random.Random(seed)
    words = [JobWord(name=f"job {i}", kind="hold", places=(f"p{i}",), repetitions=50) for i in range(jobs)]
    fleet = council.Fleet([1.0] * arms, words)
    for name in rng.sample(fleet.names, rng.randrange(arms)):
        fleet.arms[name].hot = True
    fleet.calm(0.6)
    cool = [name for name, arm in fleet.arms.items() if not arm.hot]
    offers = {name: [fleet.offer(name, word) for word in words] for name in cool}
    cost = thermal(
        Bids(
            feasible=np.array([[offer.feasible for offer in offers[name]] for name in cool]),
            difficulty=np.array([[offer.d for offer in offers[name]] for name in cool]),
            p_saturation=np.full((len(cool), jobs), np.nan),
            peak_headroom_k=np.full((len(cool), jobs), np.nan),
            finish_s=np.full((len(cool), jobs), 10.0),
            tardiness_s=np.zeros((len(cool), jobs)),
            value=np.ones(jobs),
        )
    )
    bids = {name: dict(zip([w.name for w in words], row, strict=True)) for name, row in zip(cool, cost, strict=True)}
    bids = {name: {job: c for job, c in costs.items() if np.isfinite(c)} for name, costs in bids.items()}
    wanted = consensus(bids, nx.complete_graph(cool))
    has = {name: next((h.award.job.name for h in fleet.arms[name].contractor.held), None) for name in cool}
    assert has == wanted
    assert all(fleet.arms[name].council.rounds <= 2 for name in cool)


def test_who_is_cut_off_does_not_say_that_all_is_done(council):
    """Not even if all that is left is a job that another had leave to finish."""
    fleet = council.Fleet([1.0] * 3, [JobWord(name="j", kind="hold", places=("p",))])
    holder = fleet.busy(random.Random(0), leave=True)
    fleet.cut = {next(name for name in fleet.names if name != holder.name)}
    fleet.calm(8.0, but=holder.name)
    alone = fleet.arms[min(fleet.cut)]
    assert alone.council.left(alone.real_s) == []
    assert not alone.council.over(alone.real_s)
