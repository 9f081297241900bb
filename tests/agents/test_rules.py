"""Dispatching rules: each does what its name says, and a theorem says where one is the best."""

import pickle
from dataclasses import replace
from fractions import Fraction
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from agents.policy import WAIT, EveryArm, Local, for_all_arms, on_arrays, only_choices
from agents.registry import RULES, make_policy
from agents.rules import RandomLegal, Wspt, WsptCool
from fleet.env.allocation_v2 import parallel_env
from fleet.observation import LONG_S, Observation
from tests.agents.observations import NAMES, observation, with_peers
from tests.profiles import examples


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def fleet(
    difficulty: list[list[float]],
    *,
    mask: list[list[int]] | None = None,
    feasible: list[list[int]] | None = None,
    headroom_k: list[float] | None = None,
    free: list[int] | None = None,
) -> dict[str, Observation]:
    """What arms know that find the slots so difficult, [arm][slot] (NaN unknown), and told each other all of it."""
    d = np.array(difficulty, dtype=float)
    arms, slots = d.shape
    able = np.ones((arms, slots)) if feasible is None else np.array(feasible)
    idle = np.ones(arms) if free is None else np.array(free)
    legal = (able if mask is None else np.array(mask)) * idle[:, None]
    shared = np.where(~np.isnan(d) & (able > 0), d, -1.0)

    def seen(me: int) -> Observation:
        peers = [p for p in range(arms) if p != me]
        return observation(
            slots,
            peers=arms - 1,
            arm_index=me,
            legal=legal[me],
            working=1.0 - idle[me],
            value=np.ones(slots),
            duration_s=60.0 * able[me],
            difficulty=np.where(able[me] > 0, shared[me], 0.0),
            headroom_k=0.0 if headroom_k is None else headroom_k[me],
            error_headroom_k=15.0,
            peer_working=1.0 - idle[peers],
            peer_difficulty=shared[peers],
        )

    return {f"arm_{me}": seen(me) for me in range(arms)}


def act(name: str, *rounds: dict[str, Observation], seed: int = 0) -> list[list[int]]:
    policy = make_policy(name)
    policy.reset(rng(seed))
    return [list(policy.act(seen).values()) for seen in rounds]


ALONE = [name for name, rule in RULES.items() if not rule.plans]
"""Policies that need no simulator of their cell."""


@pytest.mark.parametrize("name", ALONE)
@pytest.mark.parametrize("arms", [1, 3])
def test_every_rule_plays_a_shift_legally_and_repeats_it_also_from_event_to_event(small, name, arms) -> None:
    """A rule that reads which claims were lost sees them at once, also where a step lasts until the next choice."""
    shifts = small.Shifts(arms=arms, jobs=12, ticks=90, ambient_c=38.0, crowding=0.3)
    finished_s = []
    for decisions in ("interval", "interval", "events"):
        env, policy = parallel_env(shifts, decisions=decisions, bids=True), make_policy(name)
        env.reset(seed=0)
        policy.reset(rng())
        while env.agents:
            actions = policy.act(env.knowledge())
            assert list(actions) == env.possible_agents
            assert all(type(action) is int for action in actions.values())
            env.step(actions)
        assert env.truth.illegal.sum() == 0
        # Two rules claim little in such ambient temperature.
        assert (env.truth.status == 2).sum() > (0 if name in ("wspt_cool", "thermometer") else 2)
        finished_s.append(env.truth.finished_s)
    np.testing.assert_array_equal(finished_s[:2], finished_s[1:])


@pytest.mark.parametrize("name", RULES)
def test_every_rule_waits_where_nothing_is_legal(name) -> None:
    assert act(name, fleet([[1.0, 2.0], [2.0, 1.0]], mask=[[0, 0], [0, 0]])) == [[WAIT, WAIT]]


@pytest.mark.parametrize("name", [name for name in ALONE if name != "least_loaded"])  # it must hear of lost claims
def test_a_rule_need_not_be_asked_where_nothing_is_legal(name) -> None:
    """It draws and remembers nothing then, as it says of itself."""
    policy = make_policy(name)
    policy.reset(rng())
    policy.act(fleet([[1.0, 2.0], [2.0, 1.0]]))
    assert only_choices(policy)
    before = pickle.dumps(policy)
    assert policy.act(fleet([[1.0, 2.0], [2.0, 1.0]], free=[0, 0])) == {"arm_0": WAIT, "arm_1": WAIT}
    assert pickle.dumps(policy) == before
    mine = type("Mine", (RULES[name].kind,), {})
    repeated = for_all_arms(mine)  # pyright: ignore[reportArgumentType]  # inherits the scope
    assert not only_choices(repeated)


@pytest.mark.parametrize("name", ALONE)
def test_every_rule_lets_a_single_free_arm_work(name) -> None:
    seen = fleet([[0.1] * 3, [6.0, 5.0, np.nan], [0.1] * 3], free=[0, 1, 0])
    ((first, second, third),) = act(name, seen)
    assert (first, third) == (WAIT, WAIT)
    assert second != WAIT


@pytest.mark.parametrize("name", ALONE)
def test_fleets_side_by_side_get_the_actions_of_each_alone(name) -> None:
    draw = rng(1)
    alone, together = ({e: make_policy(name) for e in range(4)} for _ in range(2))
    for e in range(4):
        alone[e].reset(rng(e))
        together[e].reset(rng(e))
    decide = on_arrays(together, ("arm_0", "arm_1", "arm_2"))
    if decide is None:
        assert name == "rolling_horizon"
        return
    for _ in range(12):
        envs = np.flatnonzero(draw.random(4) < 0.7)
        fleets = [
            fleet(np.where(draw.random((3, 5)) < 0.3, np.nan, draw.integers(0, 4, (3, 5))).tolist(),
                  mask=draw.integers(0, 2, (3, 5)).tolist(), headroom_k=draw.integers(0, 3, 3).tolist())
            for _ in envs
        ]  # fmt: skip
        if not len(envs):
            continue
        expected = [list(alone[e].act(seen).values()) for e, seen in zip(envs.tolist(), fleets, strict=True)]
        stacked = {
            name: np.stack([[getattr(seen, name) for seen in each.values()] for each in fleets]) for name in NAMES
        }
        assert decide(envs, Observation(**stacked)).tolist() == expected


def test_round_robin_rotates_and_passes_over_whom_it_cannot_ask() -> None:
    one_job = fleet([[1.0]] * 3)
    assert act("round_robin", *[one_job] * 4) == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]]
    # Two jobs, oldest first: arms 0 and 1, then 2 and 0.
    assert act("round_robin", *[fleet([[1.0, 1.0]] * 3)] * 2) == [[1, 2, 0], [2, 0, 1]]
    busy = fleet([[1.0]] * 3, free=[0, 1, 1])
    unable = fleet([[1.0]] * 3, feasible=[[1], [1], [0]])
    assert act("round_robin", busy, unable, fleet([[1.0]] * 3)) == [[0, 1, 0], [1, 0, 0], [0, 1, 0]]


def test_coolest_first_gives_the_oldest_job_to_the_most_headroom() -> None:
    seen = fleet([[1.0, 1.0]] * 3, headroom_k=[10.0, 30.0, 20.0])
    assert act("coolest_first", seen) == [[0, 1, 2]]
    assert act("coolest_first", fleet([[1.0, 1.0]] * 3, headroom_k=[10.0, 30.0, 20.0], free=[1, 0, 1])) == [[2, 0, 1]]
    assert act("coolest_first", fleet([[1.0]] * 2, headroom_k=[-5.0, -9.0])) == [[1, 0]]


def test_random_is_uniform_over_what_is_legal() -> None:
    seen = fleet([[1.0] * 5], mask=[[1, 0, 1, 1, 0]])
    policy = EveryArm(RandomLegal)
    policy.reset(rng(3))
    counts = np.bincount([policy.act(seen)["arm_0"] for _ in range(3000)], minlength=6)
    assert counts[[0, 2, 5]].tolist() == [0, 0, 0]
    assert stats.chisquare(counts[[1, 3, 4]]).pvalue > 0.01


def test_least_difficulty_waits_for_no_station() -> None:
    # The older job is easiest for arm 0, but its station is busy.
    assert act("least_difficulty", fleet([[0.1, 2.0], [0.2, 3.0]], mask=[[0, 1], [0, 1]])) == [[2, 0]]


def test_without_any_score_the_oldest_are_handed_out_in_order() -> None:
    assert act("least_difficulty", fleet([[np.nan, np.nan]])) == [[1]]
    assert act("least_difficulty", fleet([[np.nan, np.nan]] * 2)) == [[1, 2]]
    assert act("consensus", fleet([[np.nan, np.nan]] * 2)) == [[1, 2]]
    # A job without a score comes after all that have one.
    assert act("consensus", fleet([[np.nan, 5.0], [np.nan, 0.0]], free=[1, 0])) == [[2, 0]]


@pytest.mark.parametrize("name", ["least_difficulty", "consensus"])
@examples(300)
@given(st.data())
def test_by_advantage_agrees_with_one_who_sees_everything(name, data) -> None:
    """Greedy matching in exact fractions; so no two arms ever claim the same job."""
    arms, slots = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 5))
    rows = st.lists(st.sampled_from([0.5, 1.0, 1.0, 2.0, 3.5, 6.0]), min_size=slots, max_size=slots)
    bits = st.lists(st.integers(0, 1), min_size=slots, max_size=slots)
    d = np.array(data.draw(st.lists(rows, min_size=arms, max_size=arms)))
    able = np.array(data.draw(st.lists(bits, min_size=arms, max_size=arms)))
    free = np.array(data.draw(st.lists(st.integers(0, 1), min_size=arms, max_size=arms)))
    pairs = []
    for slot in range(slots):
        told = [Fraction(d[a, slot]) for a in range(arms) if able[a, slot]]
        pairs += [
            (Fraction(d[a, slot]) - sum(told) / len(told), slot, a) for a in range(arms) if able[a, slot] and free[a]
        ]
    expected, given_away = [0] * arms, set()
    for _, slot, arm in sorted(pairs):
        if not expected[arm] and slot not in given_away:
            expected[arm] = slot + 1
            given_away.add(slot)
    seen = fleet(d.tolist(), feasible=able.tolist(), free=free.tolist())
    assert act(name, seen) == [expected]


def cut(seen: dict[str, Observation], links: list[tuple[int, int]]) -> dict[str, Observation]:
    """The same, where only these pairs of arms ever heard each other."""
    out = {}
    for me, (arm, obs) in enumerate(seen.items()):
        peers = [p for p in range(len(seen)) if p != me]
        heard = np.array([(me, p) in links or (p, me) in links for p in peers])
        out[arm] = with_peers(
            obs,
            peer_difficulty=np.where(heard[:, None], obs.peer_difficulty, -1.0),
            peer_age_s=np.where(heard, obs.peer_age_s, LONG_S),
        )
    return out


def test_consensus_agrees_through_those_between_and_least_difficulty_cannot() -> None:
    """On a line 0 – 1 – 2, the two ends want the same job and do not hear each other; the middle is at work."""
    line = cut(fleet([[1.0, 1.5], [6.0, 6.0], [1.0, 1.2]], free=[1, 0, 1]), [(0, 1), (1, 2)])
    assert act("least_difficulty", line) == [[1, 0, 1]]
    assert act("consensus", line) == [[1, 0, 2]]


def test_consensus_lets_every_arm_bid_for_itself_where_words_are_late() -> None:
    late = {arm: with_peers(o, peer_age_s=np.full(2, 10.0)) for arm, o in fleet([[1.0, 2.0]] * 3).items()}
    assert act("consensus", late) == [[1, 1, 1]]


@examples(100)
@given(st.data())
def test_consensus_gives_no_job_twice_on_any_connected_graph(data) -> None:
    arms, slots = data.draw(st.integers(2, 5)), data.draw(st.integers(1, 4))
    scores = st.lists(st.sampled_from([0.0, 1.0, 2.0, np.nan]), min_size=slots, max_size=slots)
    d = data.draw(st.lists(scores, min_size=arms, max_size=arms))
    links = [(a, data.draw(st.integers(0, a - 1))) for a in range(1, arms)]
    (actions,) = act("consensus", cut(fleet(d), links))
    claims = [action for action in actions if action]
    assert len(claims) == len(set(claims)) == min(arms, slots)


def seen(value, duration_s, p, mask) -> dict[str, Observation]:
    rows = zip(np.array(value, float), np.array(duration_s, float), np.array(p, float), mask, strict=True)
    return {
        f"arm_{a}": observation(len(v), legal=may, value=v, duration_s=d, p_saturation=each)
        for a, (v, d, each, may) in enumerate(rows)
    }


def test_the_careful_one_rests_where_it_would_run_warm() -> None:
    warm = seen([[9, 1]], [[60, 60]], [[0.51, 0.5]], [[1, 1]])
    assert Wspt().act(warm) == {"arm_0": 1}
    assert WsptCool().act(warm) == {"arm_0": 2}
    assert WsptCool().act(seen([[9]], [[60]], [[0.9]], [[1]])) == {"arm_0": 0}


@examples(60)
@given(data=st.data(), arms=st.integers(1, 3), slots=st.integers(1, 3))
def test_no_other_first_pair_is_worth_more(data, arms, slots) -> None:
    def draw(low, high):
        return np.array(data.draw(st.lists(st.integers(low, high), min_size=arms * slots, max_size=arms * slots)))

    value, duration_s = draw(1, 9).reshape(arms, slots), 30 * draw(1, 9).reshape(arms, slots)
    mask = draw(0, 1).reshape(arms, slots)
    actions = list(Wspt().act(seen(value, duration_s, np.zeros((arms, slots)), mask)).values())
    claimed = [(a, k - 1) for a, k in enumerate(actions) if k]
    assert all(mask[a, k] for a, k in claimed)
    assert len({k for _, k in claimed}) == len(claimed)
    rate = np.where(mask, value / duration_s, -1.0)
    if mask.any():
        assert max(rate[a, k] for a, k in claimed) == rate.max()
    waiting = [a for a in range(arms) if not actions[a]]
    left = [k for k in range(slots) if k not in {k for _, k in claimed}]
    assert not mask[np.ix_(waiting, left)].any()  # nothing is left lying that a waiting arm could do


def queue(duration_s, due_s, value, now_s: float = 0.0, **fields) -> Observation:
    """What a free arm knows that may claim every job of a queue, the oldest first."""
    d = np.array(duration_s, dtype=float)
    known = {"duration_s": d, "due_in_s": np.array(due_s) - now_s, "value": np.array(value, dtype=float)}
    return observation(len(d), **known, **fields)


def sequence(name: str, duration_s, due_s, value) -> list[int]:
    policy, left, done, now_s = make_policy(name), list(range(len(duration_s))), [], 0.0
    while left:
        durations, dues, values = ([row[job] for job in left] for row in (duration_s, due_s, value))
        seen = queue(durations, dues, values, now_s)
        done.append(left.pop(policy.act({"arm": seen})["arm"] - 1))
        now_s += duration_s[done[-1]]
    return done


def finish_s(order, duration_s) -> np.ndarray:
    return np.cumsum([duration_s[job] for job in order])


jobs = st.lists(st.tuples(st.integers(1, 900), st.integers(1, 3000), st.integers(1, 9)), min_size=1, max_size=5)


@examples(60)
@given(jobs)
def test_on_one_arm_each_rule_is_the_best_of_all_sequences_for_its_criterion(drawn) -> None:
    """Smith 1956: spt for the sum of finish times, wspt for the weighted one. Jackson 1955: edd for the lateness."""
    duration_s, due_s, value = (list(row) for row in zip(*drawn, strict=True))

    def total(order) -> float:
        return float(finish_s(order, duration_s).sum())

    def weighted(order) -> float:
        return float(finish_s(order, duration_s) @ [value[job] for job in order])

    def lateness(order) -> float:
        return float((finish_s(order, duration_s) - [due_s[job] for job in order]).max())

    every = list(permutations(range(len(drawn))))
    for name, criterion in (("spt", total), ("wspt", weighted), ("edd", lateness)):
        assert criterion(sequence(name, duration_s, due_s, value)) == pytest.approx(min(map(criterion, every)))
    assert sequence("fifo", duration_s, due_s, value) == list(range(len(drawn)))


@examples(60)
@given(jobs)
def test_atc_is_wspt_when_everything_is_late_and_least_slack_when_all_else_is_equal(drawn) -> None:
    duration_s, due_s, value = (np.array(row, dtype=float) for row in zip(*drawn, strict=True))
    late = queue(duration_s, np.zeros(len(drawn)), value)
    assert make_policy("atc").act({"a": late}) == make_policy("wspt").act({"a": late})
    alike = queue(np.full(len(drawn), 500.0), due_s + 500.0, np.ones(len(drawn)))
    assert make_policy("atc").act({"a": alike})["a"] - 1 == int(due_s.argmin())


def test_the_quicker_arm_gets_the_job_of_fifo_and_edd_and_spt() -> None:
    slow, quick = queue([600.0, 300.0], [9e3, 9e3], [1, 1]), queue([500.0, 400.0], [9e3, 9e3], [1, 1])
    for name in ("fifo", "edd"):
        assert make_policy(name).act({"slow": slow, "quick": quick}) == {"slow": 2, "quick": 1}
    assert make_policy("spt").act({"slow": slow, "quick": quick}) == {"slow": 2, "quick": 1}


def test_the_arm_with_less_work_gets_the_next_job_and_a_lost_claim_is_no_work() -> None:
    long, short = queue([900.0], [9e3], [1]), queue([100.0], [9e3], [1])
    nothing = replace(long, action_mask=np.array([1, 0, 0], np.int8))
    policy = make_policy("least_loaded")
    assert policy.act({"a": long, "b": nothing}) == {"a": 1, "b": 0}
    assert [policy.act({"a": short, "b": short}) for _ in range(2)] == [{"a": 0, "b": 1}] * 2
    assert policy.act({"a": long, "b": nothing}) == {"a": 1, "b": 0}
    lost = replace(short, last_award=np.array(-1.0))
    assert policy.act({"a": lost, "b": nothing}) == {"a": 1, "b": 0}  # 900 s, and 100 s of this claim
    policy.act({"a": lost, "b": nothing})  # and once more lost, then nobody may claim
    assert policy.act({"a": replace(nothing, last_award=np.array(-1.0)), "b": nothing}) == {"a": 0, "b": 0}
    assert policy.act({"a": short, "b": nothing}) == {"a": 1, "b": 0}
    many = [policy.act({"a": short, "b": short}) for _ in range(9)]
    assert [claims["b"] for claims in many] == [1] * 8 + [0]  # from 200 s to 1000 s, which is equal: the first arm


def test_an_arm_that_the_central_policy_of_a_local_one_omits_waits() -> None:
    class Omits:
        def act(self, observations) -> dict[str, int]:
            return {}

    local = type("OmitsLocal", (Local,), {"central": Omits})()
    assert local.choose(queue([100.0], [9e3], [1]), 0) == WAIT
