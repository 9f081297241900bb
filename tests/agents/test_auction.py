"""Assignments and auctions, with and without an auctioneer, against every assignment and the Hungarian method."""

from dataclasses import replace
from functools import partial
from itertools import product

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from agents.auction import NOBODY, agree, auction
from agents.policy import one_fleet
from agents.registry import RULES, make_policy
from agents.rules import NONE, RISK, cheapest_options, each_env, matching, quickest, thermal
from fleet.observation import LONG_S, Layout, Observation
from tests.agents.observations import NAMES, observation
from tests.profiles import examples

INF = np.inf
ASSIGNMENTS = {"ssi": cheapest_options, "matching": partial(each_env, matching)}
COSTS = {"thermal": thermal, "quickest": quickest}


CELL = st.sampled_from([-2.0, 0.0, 0.5, 0.5, 1.0, 3.0, 10.0, INF])


@st.composite
def costs(draw) -> np.ndarray:
    arms, jobs = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    return np.array(draw(st.lists(st.lists(CELL, min_size=jobs, max_size=jobs), min_size=arms, max_size=arms)))


def allowed(cost: np.ndarray, pairs: list[tuple[int, int]]) -> bool:
    arms, jobs = [a for a, _ in pairs], [j for _, j in pairs]
    once = len(set(arms)) == len(arms) and len(set(jobs)) == len(jobs)
    return once and all(np.isfinite(cost[a, j]) for a, j in pairs)


def every_assignment(cost: np.ndarray):
    """All that are allowed, by trying every arm, or none, for every job."""
    for choice in product((None, *range(len(cost))), repeat=cost.shape[1]):
        pairs = [(arm, job) for job, arm in enumerate(choice) if arm is not None]
        if allowed(cost, pairs):
            yield pairs


def worth(cost: np.ndarray, pairs: list[tuple[int, int]]) -> tuple[int, float]:
    return -len(pairs), float(sum(cost[a, j] for a, j in pairs))


def pairs_of(options: np.ndarray) -> list[tuple[int, int]]:
    return [(arm, option) for arm, option in enumerate(options.tolist()) if option != NONE]


@examples(200)
@given(costs())
def test_matching_is_the_best_of_all_assignments(cost):
    best = min(worth(cost, pairs) for pairs in every_assignment(cost))
    pairs = pairs_of(each_env(matching, cost, 1))
    assert allowed(cost, pairs)
    assert worth(cost, pairs) == pytest.approx(best)


@examples(200)
@given(st.data(), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3), st.integers(1, 3))
def test_ssi_takes_the_cheapest_pair_first_in_each_of_many_fleets_and_settles_ties_by_order(
    data, envs, arms, slots, plans
):
    cells = st.lists(CELL, min_size=envs * arms * slots * plans, max_size=envs * arms * slots * plans)
    cost = np.array(data.draw(cells)).reshape(envs, arms, slots * plans)
    found = cheapest_options(cost, plans)
    for env in range(envs):
        expected, jobs = {}, set()
        for _, option, arm in sorted((cost[env, a, o], o, a) for a, o in np.argwhere(cost[env] < INF).tolist()):
            if arm not in expected and option // plans not in jobs:
                expected[arm] = option
                jobs.add(option // plans)
        assert dict(pairs_of(found[env])) == expected


@pytest.mark.parametrize("rule", ASSIGNMENTS.values(), ids=ASSIGNMENTS)
def test_nothing_is_given_where_nothing_is_possible(rule):
    assert rule(np.array([[INF, INF]]), 1).tolist() == [NONE]
    assert rule(np.zeros((0, 2)), 1).tolist() == []
    assert rule(np.zeros((2, 0)), 1).tolist() == [NONE, NONE]


def fleet(difficulty, **other) -> list[Observation]:
    """What the arms know that find the jobs so difficult, [arm][slot], NaN unknown; every arm may claim every job."""
    d = np.array(difficulty, dtype=float)
    arms, slots = d.shape
    base = {
        "difficulty": np.nan_to_num(d, nan=-1.0),
        "slack_s": np.full(d.shape, LONG_S),
        "value": np.ones(d.shape),
        **{name: np.broadcast_to(np.array(value, dtype=float), d.shape) for name, value in other.items()},
    }
    return [
        observation(slots, peers=arms - 1, **{name: value[arm] for name, value in base.items()}) for arm in range(arms)
    ]


def test_thermal_cost_is_difficulty_against_the_average_by_probability_and_unknown_is_average():
    # Job 0 is new to both twins; what counts is who finds it easier.
    assert thermal(one_fleet(fleet([[5.0, 1.0], [5.5, 0.2]])))[0].tolist() == [[-0.25, 0.4], [0.25, -0.4]]
    # Alike but for the risk: 1·(1 + RISK·0.5) against 1.
    cost = thermal(one_fleet(fleet([[1.0], [1.0]], p_saturation=[[0.5], [0.0]])))[0]
    assert cost[:, 0].tolist() == [RISK / 4, -RISK / 4]
    nan = np.nan
    assert thermal(one_fleet(fleet([[2.0], [nan], [4.0]])))[0][:, 0].tolist() == [-1.0, 0.0, 1.0]
    cost = thermal(one_fleet(fleet([[np.nan], [np.nan]], duration_s=[[600.0], [60.0]])))[0]
    assert cost[1, 0] < cost[0, 0]


def test_late_and_valuable_work_comes_first_and_quickest_is_the_time_until_the_finish():
    late = {"slack_s": [[-3600.0, 0.0, -3600.0]], "value": [1.0, 1.0, 4.0]}
    cost = thermal(one_fleet(fleet([[1.0, 1.0, 1.0]], **late)))[0][0]
    assert cost[2] < cost[0] < cost[1]
    one, two = fleet([[9.0, 0.0], [0.0, 0.0]], duration_s=[[5.0, 7.0], [5.0, 7.0]])
    assert quickest(one_fleet([one, replace(two, busy_s=np.float32(10.0))]))[0].tolist() == [[5.0, 7.0], [15.0, 17.0]]


@pytest.mark.parametrize("cost", COSTS.values(), ids=COSTS)
@examples(150)
@given(data=st.data())
def test_every_cost_is_infinite_exactly_where_an_arm_may_not_claim(cost, data):
    arms, jobs = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))

    def table(values):
        return np.array([[data.draw(values) for _ in range(jobs)] for _ in range(arms)], dtype=float)

    some = fleet(
        table(st.one_of(st.just(np.nan), st.floats(0, 7))),
        p_saturation=table(st.floats(0, 1)),
        duration_s=table(st.floats(0, 1e4)),
        slack_s=table(st.floats(-1e4, 1e4)),
    )
    legal = table(st.integers(0, 1))
    some = [
        replace(seen, action_mask=np.pad(row, 1, constant_values=(1, 0)).astype(np.int8))
        for seen, row in zip(some, legal, strict=True)
    ]
    matrix = cost(one_fleet(some))[0]
    assert not np.isnan(matrix).any()
    assert (np.isposinf(matrix) == (legal == 0)).all()


@examples(150)
@given(st.lists(st.floats(0, 7), min_size=2, max_size=5), st.data())
def test_more_risk_never_makes_an_arm_cheaper_than_before(difficulty, data):
    p = data.draw(st.lists(st.floats(0, 0.5), min_size=len(difficulty), max_size=len(difficulty)))
    before = thermal(one_fleet(fleet([[d] for d in difficulty], p_saturation=[[x] for x in p])))[0][:, 0]
    p[0] += data.draw(st.floats(0, 0.5))
    after = thermal(one_fleet(fleet([[d] for d in difficulty], p_saturation=[[x] for x in p])))[0][:, 0]
    assert (after[0] - after[1:] >= before[0] - before[1:] - 1e-8).all()


def test_the_arm_that_would_get_hot_does_not_get_the_job():
    one_job = fleet([[1.0], [1.1]], p_saturation=[[0.9], [0.0]], duration_s=[[10.0], [20.0]])
    seen = dict(zip("hc", one_job, strict=True))
    for name in ("ssi", "matching"):
        assert make_policy(name).act(seen) == {"h": 0, "c": 1}
        assert make_policy(f"quickest_{name}").act(seen) == {"h": 1, "c": 0}


def test_a_job_waits_for_the_arm_that_is_home_soon_and_finishes_it_first() -> None:
    """A free arm needs 900 s; another one 100 s, once it is home."""
    free, busy = fleet([[1.0], [1.0]], duration_s=[[900.0], [100.0]], value=[4.0])
    busy = replace(busy, working=np.array(1.0))
    none, stations = np.array([1, 0, 0], np.int8), np.ones(1)

    def claim(name: str, busy_s: float, station_free=stations, **changes) -> dict[str, int]:
        other = replace(busy, action_mask=none, busy_s=np.array(busy_s), station_free=station_free, **changes)
        return make_policy(name).act({"free": free, "busy": other})

    assert claim("wsept_ahead", 60.0) == {"free": 0, "busy": 0}
    assert claim("wsept_ahead", 900.0) == {"free": 1, "busy": 0}
    assert claim("wsept_ahead", 60.0, duration_s=np.array([850.0])) == {"free": 1, "busy": 0}
    assert claim("wsept_ahead", 60.0, np.zeros(1)) == {"free": 1, "busy": 0}
    assert claim("wsept", 60.0) == {"free": 1, "busy": 0}
    # Late by 2 min, a job of value 4 costs 0.13 of difficulty: 0.8 is still better than 1, 0.9 is not.
    late = {"due_in_s": np.array([900.0]), "duration_s": np.array([900.0])}
    assert claim("matching_ahead", 120.0, difficulty=np.array([0.8]), **late) == {"free": 0, "busy": 0}
    assert claim("matching_ahead", 120.0, difficulty=np.array([0.9]), **late) == {"free": 1, "busy": 0}


@pytest.mark.parametrize("name", [name for name, rule in RULES.items() if rule.scope == "central" and not rule.plans])
@examples(25)
@given(seed=st.integers(0, 2**32))
def test_a_central_policy_reads_no_messages(name, seed):
    rng, layout = np.random.default_rng(seed), Layout(3, 4)
    mask = np.pad(rng.integers(0, 2, (3, 4)), ((0, 0), (1, 1)), constant_values=((0, 0), (1, 0))).astype(np.int8)
    low, high = layout.bounds
    vectors = rng.uniform(np.maximum(low, -100.0), np.minimum(high, 100.0), (2, 3, layout.size)).astype(np.float32)
    modes = np.eye(3)[rng.integers(0, 3, 3)]  # an arm is idle, working or faulted
    alike = {"working": modes[:, 1], "faulted": modes[:, 2]}
    first, other = (
        [Observation(**{field: getattr(seen, field)[arm] for field in NAMES}) for arm in range(3)]
        for seen in (replace(layout.read(each, mask), **alike) for each in vectors)
    )
    told = [
        replace(one, **{field: value for field, value in vars(two).items() if field.startswith("fleet_")})
        for one, two in zip(first, other, strict=True)
    ]
    named = [dict(zip("abc", seen, strict=True)) for seen in (first, told)]
    assert make_policy(name).act(named[0]) == make_policy(name).act(named[1])


def total(benefit: np.ndarray, pairs) -> float:
    return float(sum(benefit[arm, job] for arm, job in pairs))


@examples(150)
@given(st.integers(1, 8), st.integers(1, 12), st.integers(0, 2**32), st.sampled_from([0.3, 0.05, 0.01]))
def test_the_total_is_within_arms_times_epsilon_of_the_optimum(arms, jobs, seed, epsilon) -> None:
    rng = np.random.default_rng(seed)
    benefit = np.where(rng.random((arms, jobs)) < 0.7, rng.random((arms, jobs)), 0.0)
    pairs = auction(benefit, epsilon)
    assert len({arm for arm, _ in pairs}) == len({job for _, job in pairs}) == len(pairs)
    assert all(benefit[pair] > 0 for pair in pairs)
    best = benefit[linear_sum_assignment(benefit, maximize=True)].sum()
    assert best - arms * epsilon - 1e-9 <= total(benefit, pairs) <= best + 1e-9


def test_nothing_is_given_where_nothing_gains_and_epsilon_must_be_positive() -> None:
    assert auction(np.zeros((2, 3)), 0.1) == auction(np.full((2, 1), -1.0), 0.1) == auction(np.zeros((2, 0)), 0.1) == []
    with pytest.raises(ValueError, match="epsilon must be > 0"):
        auction(np.ones((1, 1)), 0.0)


FEW = st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, np.inf])


@st.composite
def auctions(draw, connected: bool = True) -> tuple[np.ndarray, nx.Graph]:
    """Costs [arm, job] and an undirected graph over the arms."""
    arms, jobs = draw(st.integers(1, 7)), draw(st.integers(0, 6))
    cost = np.array(draw(st.lists(FEW, min_size=arms * jobs, max_size=arms * jobs)), dtype=float).reshape(arms, jobs)
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
@given(auctions() | auctions(connected=False))
def test_connected_arms_agree_in_time_without_conflict_on_what_the_greedy_one_would_choose(auction):
    """Choi, Brunet & How 2009: theorem 1 (rounds, agreement) and its corollary (the sequential greedy outcome).

    Each component of a graph agrees as if the others did not exist.
    """
    cost, graph = auction
    found, bound = agree(cost, matrix(graph)), 0
    for part in nx.connected_components(graph):
        members = sorted(part)
        claims = {arm: int(found.claims[arm]) for arm in members}
        assert claims == greedy(cost, members)
        belief = found.belief
        assert (belief.winner[members] == belief.winner[members[0]]).all()  # every member knows who does what
        assert (belief.cost[members] == belief.cost[members[0]]).all()
        taken = [job for job in claims.values() if job != NOBODY]
        assert len(taken) == len(set(taken))
        assert all(np.isfinite(cost[arm, job]) for arm, job in claims.items() if job != NOBODY)
        bound = max(bound, max(1, nx.diameter(graph.subgraph(part))) * min(len(members), cost.shape[1]))
    assert found.rounds <= bound


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


def test_the_edges_of_a_directed_graph_carry_from_tail_to_head():
    cost = np.array([[1.0, 5.0], [2.0, 2.0]])
    assert agree(cost, matrix(nx.DiGraph([(0, 1)]))).claims.tolist() == [0, 1]
    assert agree(cost, matrix(nx.DiGraph([(1, 0)]))).claims.tolist() == [0, 0]
