"""Rules of the textbook against every sequence on one machine, where a theorem says which is the best."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.registry import make_policy
from fleet.observation import Layout, Observation
from tests.profiles import examples


def queue(duration_s, due_s, value, now_s: float = 0.0, **fields) -> Observation:
    """What a free arm knows that may claim every job of a queue, the oldest first."""
    d = np.array(duration_s, dtype=float)
    layout = Layout(1, len(d))
    blank = layout.read(np.zeros(layout.size, np.float32), np.array([1] * (len(d) + 1) + [0], np.int8))
    known = {"duration_s": d, "slack_s": np.array(due_s) - now_s - d, "value": np.array(value, dtype=float)}
    return replace(blank, offered=np.ones(len(d)), feasible=np.ones(len(d)), **known, **fields)


def sequence(name: str, duration_s, due_s, value) -> list[int]:
    """Jobs in the order in which one arm does them by a rule."""
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
