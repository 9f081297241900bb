"""The auction without an auctioneer: agreement, no conflict, and the outcome of one who knows every bid."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.auction import NOBODY, Belief, agree, bid, merge
from tests.profiles import examples

FEW = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, np.inf])
MANY = st.floats(-7, 7) | st.just(np.inf)


@st.composite
def auctions(draw, bids=FEW, connected: bool = True) -> tuple[np.ndarray, nx.Graph]:
    """Costs [arm, job] and an undirected graph over the arms."""
    arms, jobs = draw(st.integers(1, 7)), draw(st.integers(0, 6))
    cost = np.array(draw(st.lists(bids, min_size=arms * jobs, max_size=arms * jobs)), dtype=float).reshape(arms, jobs)
    graph = nx.Graph()
    graph.add_nodes_from(range(arms))
    if connected:  # a random tree, and some more
        graph.add_edges_from((a, draw(st.integers(0, a - 1))) for a in range(1, arms))
    pairs = st.tuples(st.integers(0, arms - 1), st.integers(0, arms - 1)).filter(lambda pair: pair[0] != pair[1])
    if arms > 1:
        graph.add_edges_from(draw(st.lists(pairs, max_size=arms)))
    return cost, graph


def greedy(cost: np.ndarray, arms: list[int]) -> dict[int, int]:
    """The cheapest pair first, among these arms; ties: the first job, then the first arm."""
    pairs = sorted((cost[a, j], j, a) for a in arms for j in range(cost.shape[1]) if np.isfinite(cost[a, j]))
    claims: dict[int, int] = {}
    for _, job, arm in pairs:
        if arm not in claims and job not in claims.values():
            claims[arm] = job
    return {arm: claims.get(arm, NOBODY) for arm in arms}


def matrix(graph: nx.Graph) -> np.ndarray:
    return nx.to_numpy_array(graph, nodelist=sorted(graph), dtype=bool).T


@examples(300)
@given(auctions())
def test_connected_arms_agree_in_time_without_conflict_on_what_the_greedy_one_would_choose(auction):
    """Choi, Brunet & How 2009: theorem 1 (rounds, agreement) and its corollary (the sequential greedy outcome)."""
    cost, graph = auction
    arms, jobs = cost.shape
    found = agree(cost, matrix(graph))
    claims = found.claims.tolist()
    assert dict(enumerate(claims)) == greedy(cost, list(range(arms)))
    assert found.rounds <= max(1, nx.diameter(graph)) * min(arms, jobs)
    assert (found.belief.winner == found.belief.winner[0]).all()  # everybody knows who does what
    assert (found.belief.cost == found.belief.cost[0]).all()
    taken = [job for job in claims if job != NOBODY]
    assert len(taken) == len(set(taken))
    assert all(np.isfinite(cost[arm, job]) for arm, job in enumerate(claims) if job != NOBODY)


@given(auctions(connected=False))
def test_each_part_of_a_broken_graph_agrees_as_if_the_others_were_not(auction):
    cost, graph = auction
    found = agree(cost, matrix(graph))
    for part in nx.connected_components(graph):
        members = sorted(part)
        assert {arm: int(found.claims[arm]) for arm in members} == greedy(cost, members)
        assert (found.belief.winner[members] == found.belief.winner[members[0]]).all()


@given(auctions(bids=MANY), st.randoms(use_true_random=False))
def test_relabelling_arms_and_jobs_relabels_the_outcome(auction, random):
    cost, graph = auction
    finite = cost[np.isfinite(cost)]
    if len(set(finite.tolist())) < finite.size:
        return  # ties are settled by place
    arms, jobs = cost.shape
    of_arm, of_job = random.sample(range(arms), arms), random.sample(range(jobs), jobs)
    moved = agree(cost[np.ix_(of_arm, of_job)], matrix(graph)[np.ix_(of_arm, of_arm)]).claims
    plain = agree(cost, matrix(graph)).claims
    for new, old in enumerate(of_arm):
        assert plain[old] == (of_job[moved[new]] if moved[new] != NOBODY else NOBODY)


@given(auctions(connected=False), st.data())
def test_links_that_carry_one_way_come_to_an_end_and_strong_ones_agree(auction, data):
    cost, graph = auction
    one_way = nx.DiGraph(graph.to_directed())
    one_way.remove_edges_from([edge for edge in list(one_way.edges()) if data.draw(st.booleans())])
    found = agree(cost, matrix(one_way))
    for part in nx.strongly_connected_components(one_way):
        members = sorted(part)
        assert (found.belief.winner[members] == found.belief.winner[members[0]]).all()


def test_news_must_cross_the_line():
    """The first arm is best at everything, so the last one cannot know before that word went all the way."""
    arms = 6
    cost = np.add.outer(np.arange(arms, dtype=float), 10.0 * np.arange(2))
    found = agree(cost, matrix(nx.path_graph(arms)))
    assert found.claims.tolist() == [0, 1, *[NOBODY] * 4]
    assert arms - 1 <= found.rounds <= 2 * (arms - 1)


def test_a_round_by_hand():
    """Two arms hear each other; both want job 0 most. The cheaper keeps it, the other bids for its next."""
    cost = np.array([[3.0, 5.0], [2.0, 9.0]])
    nothing = Belief(np.full((2, 2), np.inf), np.full((2, 2), NOBODY))
    said = bid(nothing, cost, np.arange(2))
    assert said.cost.tolist() == [[3.0, np.inf], [2.0, np.inf]]
    assert said.winner.tolist() == [[0, NOBODY], [1, NOBODY]]
    told = merge(said)  # one of the two, who heard both
    assert (told.cost.tolist(), told.winner.tolist()) == ([2.0, np.inf], [1, NOBODY])
    outbid = bid(told, cost[0], 0)
    assert (outbid.cost.tolist(), outbid.winner.tolist()) == ([2.0, 5.0], [1, 0])
    kept = bid(told, cost[1], 1)
    assert (kept.cost.tolist(), kept.winner.tolist()) == ([2.0, np.inf], [1, NOBODY])


def test_the_edges_of_a_directed_graph_carry_from_tail_to_head():
    cost = np.array([[1.0, 5.0], [2.0, 2.0]])
    assert agree(cost, matrix(nx.DiGraph([(0, 1)]))).claims.tolist() == [0, 1]
    assert agree(cost, matrix(nx.DiGraph([(1, 0)]))).claims.tolist() == [0, 0]


@pytest.mark.parametrize("cost", [[[]], [[], []], [[np.inf], [1.0]]])
def test_arms_that_can_do_nothing_claim_nothing(cost):
    claims = agree(np.array(cost), np.ones((len(cost), len(cost)), bool)).claims.tolist()
    assert claims == [0 if row == [1.0] else NOBODY for row in cost]
