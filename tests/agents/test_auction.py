"""Assignment rules against every assignment there is, and the cost matrix against what its presets promise."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.auction import ASSIGNMENTS, Lot, assignment_by_name, matching, sequential
from agents.cost import COSTS, RISK, Bids, cost_by_name, quickest, thermal

INF = np.inf


def lot(cost, capacity=None, stations=None) -> Lot:
    """Arms a0, a1, … and jobs j0, j1, …; every job at a station of its own."""
    array = np.array(cost, dtype=float)
    arms, jobs = array.shape
    return Lot(
        arms=tuple(f"a{i}" for i in range(arms)),
        jobs=tuple(f"j{i}" for i in range(jobs)),
        cost=array,
        capacity=tuple(capacity or [1] * arms),
        stations=tuple(frozenset(s) for s in (stations or [[f"s{i}"] for i in range(jobs)])),
    )


@st.composite
def lots(draw, shared: bool = True) -> Lot:
    arms, jobs = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    cell = st.sampled_from([-2.0, 0.0, 0.5, 0.5, 1.0, 3.0, 10.0, INF])
    cost = draw(st.lists(st.lists(cell, min_size=jobs, max_size=jobs), min_size=arms, max_size=arms))
    capacity = draw(st.lists(st.integers(0, 2), min_size=arms, max_size=arms))
    places = st.frozensets(st.sampled_from("xyz"), min_size=1, max_size=2)
    stations = draw(st.lists(places, min_size=jobs, max_size=jobs)) if shared else None
    return lot(cost, capacity, stations)


def allowed(problem: Lot, assignment: dict[str, str]) -> bool:
    taken = [station for job in assignment for station in problem.stations[problem.jobs.index(job)]]
    room = dict(zip(problem.arms, problem.capacity, strict=True))
    return (
        np.isfinite(problem.total(assignment))
        and len(taken) == len(set(taken))
        and all(list(assignment.values()).count(arm) <= room[arm] for arm in room)
    )


def every_assignment(problem: Lot):
    """All that are allowed, by trying every arm, or none, for every job."""
    for choice in product((None, *problem.arms), repeat=len(problem.jobs)):
        out = {job: arm for job, arm in zip(problem.jobs, choice, strict=True) if arm is not None}
        if allowed(problem, out):
            yield out


def worth(problem: Lot, assignment: dict[str, str]) -> tuple[int, float]:
    return -len(assignment), problem.total(assignment)


@settings(max_examples=200, deadline=None)
@given(lots(shared=False))
def test_matching_is_the_best_of_all_assignments(problem):
    best = min(worth(problem, out) for out in every_assignment(problem))
    assert worth(problem, matching(problem)) == pytest.approx(best)


@settings(max_examples=300, deadline=None)
@given(lots())
def test_matching_is_never_worse_than_sequential(problem):
    count, cost = worth(problem, matching(problem))
    greedy_count, greedy_cost = worth(problem, sequential(problem))
    assert count < greedy_count or (count == greedy_count and cost <= greedy_cost + 1e-9)


@pytest.mark.parametrize("rule", ASSIGNMENTS.values(), ids=ASSIGNMENTS)
@settings(max_examples=200, deadline=None)
@given(problem=lots())
def test_no_rule_gives_what_may_not_be(rule, problem):
    assert allowed(problem, rule(problem))


@settings(max_examples=200, deadline=None)
@given(lots())
def test_sequential_leaves_nothing_that_somebody_could_have(problem):
    given_away = sequential(problem)
    for job, arm in product(set(problem.jobs) - set(given_away), problem.arms):
        assert not allowed(problem, {**given_away, job: arm})


@pytest.mark.parametrize("rule", ASSIGNMENTS.values(), ids=ASSIGNMENTS)
@settings(max_examples=150, deadline=None)
@given(problem=lots(), seed=st.integers(0, 99))
def test_the_order_of_arms_and_jobs_changes_nothing(rule, problem, seed):
    rng = np.random.default_rng(seed)
    a, j = rng.permutation(len(problem.arms)), rng.permutation(len(problem.jobs))
    mixed = Lot(
        arms=tuple(problem.arms[i] for i in a),
        jobs=tuple(problem.jobs[i] for i in j),
        cost=problem.cost[np.ix_(a, j)],
        capacity=tuple(problem.capacity[i] for i in a),
        stations=tuple(problem.stations[i] for i in j),
    )
    assert rule(mixed) == rule(problem)


def test_sequential_takes_the_cheapest_pair_first_and_names_settle_ties():
    assert sequential(lot([[1.0, 2.0], [0.0, 9.0]])) == {"j0": "a1", "j1": "a0"}
    assert sequential(lot([[1.0, 1.0], [1.0, 1.0]])) == {"j0": "a0", "j1": "a1"}


def test_matching_sees_what_the_greedy_rule_does_not():
    # The cheapest pair (0) leaves the dear one (10); together 1 + 1 is less.
    problem = lot([[0.0, 1.0], [1.0, 10.0]])
    assert sequential(problem) == {"j0": "a0", "j1": "a1"}
    assert matching(problem) == {"j0": "a1", "j1": "a0"}


def test_a_large_matching_beats_a_cheap_small_one():
    # Only a0 can do j1; the cheap j0 must go to a1.
    assert matching(lot([[0.0, 5.0], [100.0, INF]])) == {"j0": "a1", "j1": "a0"}


@pytest.mark.parametrize("rule", ASSIGNMENTS.values(), ids=ASSIGNMENTS)
def test_a_station_serves_one_job(rule):
    assert rule(lot([[1.0, 2.0], [3.0, 1.5]], stations=[["rack"], ["rack", "bin"]])) == {"j0": "a0"}


@pytest.mark.parametrize("rule", ASSIGNMENTS.values(), ids=ASSIGNMENTS)
def test_nothing_is_given_where_nobody_can_or_nobody_is(rule):
    assert rule(lot([[INF, INF]])) == {}
    assert rule(lot(np.zeros((0, 2)))) == {}
    assert rule(lot(np.zeros((2, 0)))) == {}


def test_a_lot_must_fit_together():
    with pytest.raises(ValueError, match="needs so many capacities"):
        lot([[1.0]], capacity=[1, 1])
    with pytest.raises(ValueError, match="is a number"):
        lot([[np.nan]])


def test_an_unknown_name_tells_the_nearest():
    with pytest.raises(ValueError, match="No assignment 'match'; did you mean 'matching'"):
        assignment_by_name("match")
    with pytest.raises(ValueError, match="No rule 'quick'; did you mean 'quickest'"):
        cost_by_name("quick")


# cost


def bids(difficulty, **other) -> Bids:
    """Everybody can, nothing else is known and no job is late."""
    d = np.array(difficulty, dtype=float)
    unknown = np.full(d.shape, np.nan)
    told = {name: np.array(value, dtype=float) for name, value in other.items()}
    base = {
        "feasible": np.ones(d.shape, bool),
        "difficulty": d,
        "p_saturation": np.zeros(d.shape),
        "peak_headroom_k": unknown,
        "finish_s": unknown,
        "tardiness_s": unknown,
        "value": np.ones(d.shape[1]),
    }
    return Bids(**{**base, **told})


def test_thermal_is_difficulty_against_the_average_of_that_job():
    # Job 0 is new to both twins; what counts is who finds it easier.
    assert thermal(bids([[5.0, 1.0], [5.5, 0.2]])).tolist() == [[-0.25, 0.4], [0.25, -0.4]]


def test_thermal_weighs_difficulty_by_the_probability_of_saturation():
    # Alike but for the risk: 1·(1 + RISK·0.5) against 1.
    cost = thermal(bids([[1.0], [1.0]], p_saturation=[[0.5], [0.0]]))
    assert cost[:, 0].tolist() == [RISK / 4, -RISK / 4]


def test_what_is_not_known_is_judged_by_the_peak_or_counts_as_average():
    nan = np.nan
    unsure = {"p_saturation": [[nan], [nan], [nan]], "peak_headroom_k": [[-1.0], [2.0], [nan]]}
    hot, cool, nothing = thermal(bids([[1.0], [1.0], [1.0]], **unsure))[:, 0]
    assert hot - cool == pytest.approx(RISK)
    assert nothing - cool == pytest.approx(RISK / 2)
    assert thermal(bids([[2.0], [nan], [4.0]]))[:, 0].tolist() == [-1.0, 0.0, 1.0]


def test_where_nobody_has_a_score_the_earlier_finish_wins():
    cost = thermal(bids([[np.nan], [np.nan]], finish_s=[[600.0], [60.0]]))
    assert cost[1, 0] < cost[0, 0]


def test_late_and_valuable_work_comes_first():
    late = {"tardiness_s": [[3600.0, 0.0, 3600.0]], "value": [1.0, 1.0, 4.0]}
    cost = thermal(bids([[1.0, 1.0, 1.0]], **late))[0]
    assert cost[2] < cost[0] < cost[1]


def test_quickest_is_the_time_until_the_finish():
    cost = quickest(bids([[9.0, 0.0]], finish_s=[[5.0, np.nan]]))
    assert cost.tolist() == [[5.0, 5.0]]


unknown_or = st.one_of(st.just(np.nan), st.floats(0, 7))


@pytest.mark.parametrize("cost", COSTS.values(), ids=COSTS)
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_every_preset_is_infinite_exactly_where_it_may_not_be(cost, data):
    arms, jobs = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))

    def table(values):
        return np.array([[data.draw(values) for _ in range(jobs)] for _ in range(arms)], dtype=float)

    some = bids(
        table(unknown_or),
        feasible=table(st.integers(0, 1)),
        p_saturation=table(st.one_of(st.just(np.nan), st.floats(0, 1))),
        finish_s=table(unknown_or),
        tardiness_s=table(unknown_or),
    )
    matrix = cost(some)
    assert not np.isnan(matrix).any()
    assert (np.isposinf(matrix) == (some.feasible == 0)).all()


@settings(max_examples=150, deadline=None)
@given(st.lists(st.floats(0, 7), min_size=2, max_size=5), st.data())
def test_more_risk_never_makes_an_arm_cheaper_than_before(difficulty, data):
    p = data.draw(st.lists(st.floats(0, 0.5), min_size=len(difficulty), max_size=len(difficulty)))
    before = thermal(bids([[d] for d in difficulty], p_saturation=[[x] for x in p]))[:, 0]
    p[0] += data.draw(st.floats(0, 0.5))
    after = thermal(bids([[d] for d in difficulty], p_saturation=[[x] for x in p]))[:, 0]
    assert (after[0] - after[1:] >= before[0] - before[1:] - 1e-8).all()


def test_bids_must_fit_together():
    with pytest.raises(ValueError, match=r"Bids\.finish_s must be"):
        bids([[1.0, 2.0]], finish_s=[[1.0]])
