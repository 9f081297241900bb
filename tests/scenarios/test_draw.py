"""What is drawn quickly is what NumPy's generators draw."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.draw import QuickSource, children_of, pcg64
from scenarios.jobs import JobSource
from scenarios.load import load
from scenarios.scenario import ArrivalSpec, Scenario

seeds = st.builds(
    lambda entropy, key: np.random.SeedSequence(entropy, spawn_key=key),
    st.one_of(st.integers(0, 2**160), st.lists(st.integers(0, 2**70), min_size=1, max_size=6)),
    st.lists(st.integers(0, 2**40), max_size=3).map(tuple),
)


@given(seed=seeds, child=st.integers(0, 1000))
def test_a_generator_in_the_state_of_a_child_is_the_childs(seed, child) -> None:
    own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 1, child))
    (words,) = children_of(seed, np.array([[1, child]]))
    assert words == own.generate_state(4, np.uint64).tolist()
    assert pcg64(*words) == np.random.PCG64(own).state


def chained(scenario: Scenario) -> Scenario:
    """With a batch, a trace, jobs that come together, jobs that wait for others, and things not to be chosen."""
    first, second, *others = scenario.jobs
    batch = ArrivalSpec(kind="batch", count=3, every_s=500.0)
    trace = ArrivalSpec(kind="trace", times_s=(0.0, 500.0, 500.0, 900.0))
    return replace(
        scenario,
        jobs=(
            replace(first, arrivals=batch, repetitions=(4, 4), after=(second.name,)),
            replace(second, arrivals=trace, payload_kg=second.payload_kg[:1]),
            *others,
            replace(others[-1], name="another", repetitions=(1, 900), after=(first.name, others[0].name)),
        ),
    )


@pytest.mark.parametrize("change", [lambda scenario: scenario, chained])
@pytest.mark.parametrize("often", [1.0, 2.3])
def test_the_jobs_are_those_of_the_slow_way(change, often) -> None:
    scenario = change(load("quickstart"))
    slow, quick = JobSource(scenario), QuickSource(scenario)
    lowest = np.array([stream.repetitions[0] for stream in scenario.jobs])
    for number in range(60):
        seed = np.random.SeedSequence(number, spawn_key=(7,) * (number % 3))
        expected = slow.draw(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0)), often)
        found = quick.draw(seed, often)
        assert len(expected.stream) > 10
        for name in ("stream", "payload", "release_s", "after"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        np.testing.assert_array_equal(found.more, expected.repetitions - lowest[expected.stream])


def test_a_shift_without_jobs_is_drawn() -> None:
    scenario = load("quickstart")
    never = ArrivalSpec(kind="trace", times_s=())
    empty = replace(scenario, jobs=tuple(replace(stream, arrivals=never) for stream in scenario.jobs))
    assert len(QuickSource(empty).draw(np.random.SeedSequence(1)).stream) == 0


def test_another_numpy_is_noticed_and_done_without(monkeypatch) -> None:
    scenario, seed = load("quickstart"), np.random.SeedSequence(5)
    expected = QuickSource(scenario).draw(seed)
    monkeypatch.setattr("scenarios.draw.pcg64", lambda *words: pcg64(*words[::-1]))  # draws other numbers
    found = QuickSource(scenario).draw(seed)
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value)
