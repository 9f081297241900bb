"""The rolling horizon against every plan there is, and its heat against a network with one time constant."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from agents.planners import NONE, RollingHorizon, Sequences, pack
from agents.policy import WAIT
from fleet.observation import Layout, Observation
from tests.profiles import examples

WARNING_C = 60.0


def seen(
    duration_s,
    value,
    peak_c: ArrayLike = 0.0,
    *,
    due_s: ArrayLike = 9e4,
    temp_c=40.0,
    station_free=1.0,
    busy_s=0.0,
    **fields,
):
    """What an arm knows that has one plan for each job."""
    d = np.array(duration_s, dtype=float)
    layout, idle = Layout(1, len(d)), busy_s == 0.0
    legal = (np.broadcast_to(station_free, d.shape) > 0) & idle
    blank = layout.read(np.zeros(layout.size, np.float32), np.pad(legal, 1, constant_values=(1, 0)).astype(np.int8))
    known = {
        "idle": np.array(float(idle)),
        "working": np.array(float(not idle)),
        "busy_s": np.array(busy_s),
        "offered": np.ones(len(d)),
        "feasible": np.ones(len(d)),
        "space_free": np.full(len(d), float(idle)),
        "station_free": np.broadcast_to(station_free, d.shape),
        "duration_s": d,
        "value": np.array(value, dtype=float),
        "slack_s": np.broadcast_to(due_s, d.shape) - d,
        "peak_c": np.broadcast_to(peak_c, d.shape),
        "p_saturation": np.full(len(d), 0.001),
        "temp_c": np.full(7, temp_c),
        "ambient_c": np.array(25.0),
        "headroom_k": np.array(WARNING_C - temp_c),
        "error_headroom_k": np.array(75.0 - temp_c),
    }
    return replace(blank, **{**known, **fields})


def act(*fleet: Observation) -> list[int]:
    return list(RollingHorizon().act({f"arm_{i}": each for i, each in enumerate(fleet)}).values())


@examples(40)
@given(st.integers(0, 2**32))
def test_the_program_finds_the_best_of_all_selections(seed) -> None:
    rng, arms, jobs = np.random.default_rng(seed), 3, 4
    rows = []
    for _ in range(arms):
        first = rng.integers(0, jobs, 4)
        second = np.where(rng.random(4) < 0.5, (first + rng.integers(1, jobs, 4)) % jobs, NONE)
        rows.append(Sequences(first, second, np.zeros(4, bool), rng.random(4) + 0.01))
    best = 0.0
    for choice in product(range(-1, 4), repeat=arms):
        taken = [job for row, i in zip(rows, choice, strict=True) if i >= 0 for job in (row.first[i], row.second[i])]
        taken = [job for job in taken if job != NONE]
        if len(set(taken)) == len(taken):
            best = max(best, sum(float(row.worth[i]) for row, i in zip(rows, choice, strict=True) if i >= 0))
    solution = pack(rows, jobs, 1, 5.0, 10**6)
    assert solution.worth == pytest.approx(best)
    assert solution.gap == pytest.approx(0.0, abs=1e-4)


def test_without_time_for_the_solver_the_sequences_are_still_compatible() -> None:
    row = Sequences(np.array([0, 0, 1]), np.array([NONE, 1, NONE]), np.zeros(3, bool), np.array([1.0, 1.5, 0.9]))
    solution = pack([row, row], 2, 1, 0.0, 10**6)
    jobs = [job for i in solution.chosen for job in (row.first[i % 3], row.second[i % 3]) if job != NONE]
    assert solution.chosen
    assert len(set(jobs)) == len(jobs)


def test_two_jobs_go_to_two_arms_and_the_dear_one_before_the_cheap_one() -> None:
    assert sorted(act(seen([600.0, 600.0], [1, 4]), seen([600.0, 600.0], [1, 4]))) == [1, 2]
    assert act(seen([600.0, 600.0], [1, 4])) == [2]
    assert act(seen([600.0, 600.0], [1, 1], due_s=[9e4, 700.0])) == [2]


def test_a_job_waits_for_the_arm_that_does_it_at_once_when_it_is_home_soon() -> None:
    """The free arm needs an hour for the job, the other five minutes from in a minute on."""
    slow, quick = seen([3600.0], [4]), seen([300.0], [4], busy_s=60.0)
    assert act(slow, quick) == [WAIT, WAIT]
    assert act(slow, seen([300.0], [4], busy_s=3500.0)) == [1, WAIT]


def test_a_sure_fault_is_no_plan_and_a_hot_job_leaves_no_second_one() -> None:
    assert act(seen([600.0], [4], [95.0])) == [WAIT]
    policy = RollingHorizon()
    cool, hot = (policy.sequences(seen([600.0, 600.0], [4, 4], peak), 0.0) for peak in (50.0, 72.0))
    assert (cool.second != NONE).sum() == 2
    assert (hot.second != NONE).sum() == 0


@examples(50)
@given(st.floats(60, 3000), st.floats(60, 3000), st.floats(40, 90), st.floats(40, 90), st.floats(20, 40))
def test_the_second_peak_is_that_of_a_network_with_one_time_constant(first_s, second_s, one_c, two_c, start_c) -> None:
    """dT/dt = (T∞ − T) / τ, T∞ of each job at least the start: peaks from the start, and one job after the other."""
    tau_s = RollingHorizon.tau_s

    def run(begin_c, steady_c, time_s):
        return steady_c + (begin_c - steady_c) * np.exp(-time_s / tau_s)

    predicted = np.array([run(start_c, one_c, first_s), run(start_c, two_c, second_s)])
    one = seen([first_s, second_s], [4, 4], predicted, temp_c=start_c)
    policy = RollingHorizon()
    after_c = run(start_c, one_c, first_s)
    _, peak_c = policy._earn(one, predicted, np.array([first_s]), np.array([after_c]), start_c, np.array([1]))
    assert peak_c[0] == pytest.approx(max(after_c, run(after_c, two_c, second_s)), abs=1e-3)
