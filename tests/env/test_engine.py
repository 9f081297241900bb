"""The compiled engine against the plain kernel: the same shift, step by step, to rounding."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.memory import MemoryExchange
from fleet.env.compiled import CompiledShift
from fleet.env.episode import Episode
from fleet.env.observation import Layout
from fleet.env.plain import PlainShift
from fleet.env.reward import RewardWeights
from fleet.robot import ThermalLimits
from fleet.sim.noise import LEVELS, key_of, standard_normal

STEPS = 60


def both(small, episode, seed: int, near=None):
    """The same episode twice, through all of it, with actions legal and not; yields after every step."""
    weights = RewardWeights()
    layout = Layout(len(episode.world.arms), episode.world.slots, near)
    plain = PlainShift(episode, MemoryExchange(episode.world.arms), weights, None, None, layout)
    compiled = CompiledShift(episode, weights, layout)
    rng = np.random.default_rng(seed)
    yield plain, compiled, None
    for _ in range(min(STEPS, episode.world.ticks)):
        actions = np.array([rng.choice(np.flatnonzero(row)) for row in plain.mask])
        wild = rng.random(len(actions)) < 0.1
        actions[wild] = rng.integers(-2, episode.world.slots + 3, wild.sum())
        yield plain, compiled, (plain.step(actions), compiled.step(actions))


def compare(plain, compiled, results) -> None:
    np.testing.assert_array_equal(plain.mask, compiled.mask)
    np.testing.assert_allclose(compiled.vectors, plain.vectors, rtol=1e-6, atol=1e-5)
    assert (plain.tick, plain.messages) == (compiled.tick, compiled.messages)
    for name, expected in vars(plain.state).items():
        found = getattr(compiled.state, name)
        if expected.dtype.kind == "f":
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-7, err_msg=name)
        else:
            np.testing.assert_array_equal(found, expected, err_msg=name)
    for one, other in zip(plain.counts, compiled.counts, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7)
    if results is not None:
        (terms, finished), (found_terms, found_finished) = results
        np.testing.assert_allclose(found_terms, terms, rtol=1e-9, atol=1e-9)
        assert finished is found_finished


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    arms=st.integers(1, 4),
    jobs=st.integers(0, 9),
    slots=st.integers(1, 5),
    ambient_c=st.sampled_from([20.0, 45.0, 58.0]),
    power_off=st.booleans(),
    data=st.data(),
)
def test_it_does_what_the_plain_kernel_does(small, seed, arms, jobs, slots, ambient_c, power_off, data) -> None:
    peers = data.draw(st.none() | st.integers(0, arms - 1))
    shuffled = [data.draw(st.permutations([b for b in range(arms) if b != a])) for a in range(arms)]
    near = None if peers is None else tuple(tuple(others[:peers]) for others in shuffled)
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0, power_off_on_fault=power_off)
    make = small.Shifts(arms=arms, jobs=jobs, slots=slots, ticks=80, ambient_c=ambient_c, limits=limits)
    for each in both(small, make(np.random.SeedSequence(seed)), seed, near):
        compare(*each)


def test_the_shifts_of_that_comparison_are_hot_enough_to_fault_and_recover(small) -> None:
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)
    faults = recovered = returned = 0
    for seed in range(8):
        make = small.Shifts(arms=3, jobs=9, ticks=80, ambient_c=45.0, limits=limits)
        for plain, compiled, results in both(small, make(np.random.SeedSequence(seed)), seed):
            compare(plain, compiled, results)
        state = plain.state
        faults += int(state.faults.sum())
        recovered += int(((state.faults > 0) & (state.mode != 2)).sum())
        returned += int(state.returns.sum())
    assert min(faults, recovered, returned) > 0


@pytest.mark.parametrize(("pieces", "curve"), [(1, False), (3, False), (2, True)])
def test_risks_are_the_same(small, play, pieces, curve) -> None:
    content = [small.work(place, payload) for place in ("a", "b") for payload in (small.LIGHT, small.HOT)]
    arms = [
        small.arm(0, content, model=play.Learned(pieces, curve=curve)),
        small.arm(1, content[:2], model=play.Learned(1, curve=False)),
        small.arm(2, content),
    ]
    jobs = [small.job(f"j{i}", content[i % 4], release_s=50.0 * (i % 3)) for i in range(6)]
    world, plant = small.shop([jobs], arms=arms, ticks=STEPS)
    episode = Episode(world=world, plant=plant, twins=("t",) * 3, sensors=np.random.SeedSequence(1))
    seen: set[float] = set()
    for plain, compiled, results in both(small, episode, 3):
        compare(plain, compiled, results)
        seen |= set(np.round(plain.vectors.reshape(3, -1)[:, :], 6).ravel().tolist())
    assert len(seen) > 50


def test_noise_is_standard_normal_and_counts() -> None:
    values = standard_normal(key_of(np.random.SeedSequence(5)), 3, (200_000, 3))
    assert abs(values.mean()) < 0.005
    assert values.var() == pytest.approx(1.0, abs=0.01)
    assert np.mean(np.abs(values) < 1.0) == pytest.approx(0.6827, abs=0.005)
    assert np.mean(np.abs(values) > 3.0) == pytest.approx(0.0027, abs=0.0006)
    assert np.abs(np.corrcoef(values.T) - np.eye(3)).max() < 0.01
    assert len(np.unique(values)) > 0.9 * min(values.size, LEVELS**2 // 2) * 0.9
    again = standard_normal(key_of(np.random.SeedSequence(5)), 3, (200_000, 3))
    np.testing.assert_array_equal(values, again)
    assert not np.isclose(standard_normal(7, 0, (5,)), standard_normal(8, 0, (5,))).any()
    assert not np.isclose(standard_normal(7, 0, (5,)), standard_normal(7, 1, (5,))).any()
