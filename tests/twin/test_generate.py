"""Generated motion against closed forms of minimum-jerk motion, the limits, and a twin that reconstructs exactly."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.errors import ArgumentError
from fleet.motion import RATE_HZ, Phase
from fleet.robot import GEN3
from twin.vae.config import TwinConfig
from twin.vae.generate import OVERLAP, rest_to_rest, time_spline, vary

LIMITS = [np.array(limit) for limit in (GEN3.velocity, GEN3.acceleration, GEN3.jerk)]
PEAKS = (15 / 8, 10 / np.sqrt(3), 60.0)
"""Largest speed, acceleration and jerk of a minimum-jerk motion over distance / time^order (Flash & Hogan 1985)."""


def minimum_jerk(share):
    return 10 * share**3 - 15 * share**4 + 6 * share**5


def exact_twin(latents=None, turn=0.0, sigma=0.0):
    """Its latent is the window itself, so nothing is lost; decodes joint 1 a whole turn away if told so."""
    config = TwinConfig()

    def posterior(windows):
        mu = windows.transpose(0, 2, 1, 3).reshape(len(windows), 7, -1)
        return mu, np.full(mu.shape, sigma)

    def decode(latent):
        if latents is not None:
            latents.append(latent)
        windows = latent.astype(float).reshape(len(latent), 7, config.window, 3).transpose(0, 2, 1, 3).copy()
        windows[..., 0, 0] += turn
        return windows

    return SimpleNamespace(
        config=config, posterior=posterior, decode=decode, scaler=SimpleNamespace(std=np.full((7, 3), 0.5))
    )


@pytest.fixture
def source(make_plan, rng):
    """Home to A, A to B and back with a payload on the way there, A to home; minimum jerk, 3 s a move."""
    home, a, b = rng.uniform(-0.6, 0.6, (3, 7)).cumsum(axis=0)

    def go(start, end, seconds=3.0):
        share = np.arange(round(seconds * RATE_HZ))[:, None] / (seconds * RATE_HZ)
        q = start + (end - start) * minimum_jerk(share)
        return np.stack([q, np.gradient(q, 1 / RATE_HZ, axis=0), 5 * np.sin(q)], axis=1)

    plan = make_plan(go(home, a), np.concatenate([go(a, b), go(b, a)]), go(a, home))
    carried = np.repeat([1.5, 0.0], 150).astype(np.float32)
    return replace(plan, cycle=Phase(plan.cycle.profile.astype(np.float32), carried))


@given(st.integers(0, 2**31), st.floats(0.6, 9.0))
def test_a_minimum_jerk_path_comes_out_as_it_is(seed, duration_s):
    begin, end = np.random.default_rng(seed).uniform(-2, 2, (2, 7))
    moments = np.arange(0.04, duration_s, 0.08)
    path = begin + (end - begin) * minimum_jerk(moments / duration_s)[:, None]
    # The path is bent to meet the ends, by as much as it misses them at its first and last sample.
    moments[[0, -1]] = 0.0, duration_s
    path[[0, -1]] = begin, end
    spline = rest_to_rest(moments, path, begin, end, duration_s)
    dense = np.linspace(0, duration_s, 50)
    expected = begin + (end - begin) * minimum_jerk(dense / duration_s)[:, None]
    np.testing.assert_allclose(spline(dense), expected, atol=1e-6)


@given(st.integers(0, 2**31), st.floats(0.1, 20.0))
def test_any_path_starts_and_ends_at_rest_where_it_is_told(seed, duration_s):
    rng = np.random.default_rng(seed)
    begin, end = rng.uniform(-2, 2, (2, 7))
    moments = (np.arange(int(duration_s * 12.5)) + 0.5) / 12.5
    spline = rest_to_rest(moments, rng.normal(size=(len(moments), 7)), begin, end, duration_s)
    np.testing.assert_allclose(spline([0.0, duration_s]), [begin, end], atol=1e-9)
    for order in (1, 2):
        scale = np.abs(spline.derivative(order)(np.linspace(0, duration_s, 100))).max() + 1e-9
        np.testing.assert_allclose(spline.derivative(order)([0.0, duration_s]) / scale, 0.0, atol=1e-9)


@given(st.floats(0.001, 3.0), st.integers(0, 6), st.floats(0.3, 1.0), st.floats(0.02, 4.0))
def test_time_is_the_least_that_the_limits_allow(distance, joint, speed, duration_s):
    end = np.zeros(7)
    end[joint] = distance
    spline = rest_to_rest(np.zeros(0), np.zeros((0, 7)), np.zeros(7), end, 0.5)  # one piece: minimum jerk
    least = max(
        (peak * distance / (speed * limit[joint])) ** (1 / order)
        for order, (peak, limit) in enumerate(zip(PEAKS, LIMITS, strict=True), start=1)
    )
    motion = time_spline(spline, 0.5, speed)
    assert motion.shape[1] == pytest.approx(np.ceil(max(0.5, least) * RATE_HZ), abs=1)
    for order, limit in ((1, LIMITS[0]), (2, LIMITS[1])):
        assert np.all(np.abs(motion[order]) <= speed * limit * (1 + 1e-6))


def test_what_a_twin_knows_exactly_comes_back_nearly_as_it_was(source):
    made = vary(exact_twin(), source, 0.0, np.random.default_rng(0))
    assert made.distance_rad < 0.02
    assert made.distance_z == pytest.approx(made.distance_rad / 0.5)
    for stretch, phase in zip(made.phases, source.phases, strict=True):
        assert len(stretch.q) == pytest.approx(len(phase.profile), rel=0.15)


def test_a_joint_decoded_a_whole_turn_away_comes_back(source):
    straight, turned = (vary(exact_twin(turn=turn), source, 0.0, np.random.default_rng(0)) for turn in (0, -2 * np.pi))
    np.testing.assert_allclose(turned.phases[1].q, straight.phases[1].q, atol=1e-5)


def test_windows_share_noise_as_they_share_time(source, make_plan, motion):
    told = []
    plan = make_plan(*(motion(np.random.default_rng(i), 30.0) for i in range(3)))
    twin = exact_twin(told, sigma=1.0)
    vary(twin, plan, 2.0, np.random.default_rng(0))
    still = []
    vary(exact_twin(still), plan, 0.0, np.random.default_rng(0))
    noise = told[1] - still[1]
    assert noise.std() == pytest.approx(2.0, rel=0.03)
    shared = 1 - (twin.config.window // OVERLAP) / twin.config.window
    assert np.mean(noise[1:] * noise[:-1]) / np.mean(noise**2) == pytest.approx(shared, abs=0.03)


@settings(max_examples=6)
@given(s=st.floats(0.0, 6.0), seed=st.integers(0, 2**31))
def test_motion_can_be_executed_from_home_to_home(twin, records, make_plan, s, seed):
    phases = [Phase(r.copy(), np.repeat([0.5, 0.0], [len(r) // 3, len(r) - len(r) // 3])) for r in records[:3]]
    approach, cycle, retreat = phases
    plan = replace(make_plan(*records[:3]), speed=0.8, approach=approach, cycle=cycle, retreat=retreat)
    made = vary(twin, plan, s, np.random.default_rng(seed))
    home = plan.approach.profile[0, 0]
    approach, cycle, retreat = made.phases
    np.testing.assert_allclose(approach.q[0], home, atol=1e-6)
    np.testing.assert_allclose(cycle.q[0], retreat.q[0], atol=1e-9)
    for part, then in ((approach, cycle), (cycle, cycle), (cycle, retreat)):
        # One more sample, and the next begins.
        np.testing.assert_allclose(part.q[-1], then.q[0], atol=2e-3)
        assert np.abs(part.qd[-1]).max() < 0.05
    for part in made.phases:
        assert np.all(np.abs(part.qd) <= LIMITS[0] * plan.speed * (1 + 1e-6))
        assert np.all(np.abs(part.qdd) <= LIMITS[1] * plan.speed * (1 + 1e-6))
        np.testing.assert_allclose(np.diff(part.q, axis=0) * RATE_HZ, (part.qd[1:] + part.qd[:-1]) / 2, atol=0.02)
        changes = np.flatnonzero(np.diff(part.payload_kg)) + 1
        assert len(changes) == 1
        assert np.abs(part.qd[changes]).max() < 1e-9


def test_the_farther_the_noise_the_farther_the_motion(twin, plan):
    scales, seeds = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0), range(5)
    made = {(s, seed): vary(twin, plan, s, np.random.default_rng(seed)) for s in scales for seed in seeds}
    far = np.array([[made[s, seed].distance_z for seed in seeds] for s in scales]).mean(axis=1)
    assert np.all(np.diff(far) > 0)
    assert far[1] < 1.1 * far[0]
    # Without noise every seed reconstructs alike.
    assert len({made[0.0, seed].distance_rad for seed in seeds}) == 1
    still = made[0.0, 0].phases[1].q
    apart = [np.abs(np.mean(made[s, 0].phases[1].q, axis=0) - still.mean(axis=0)).max() for s in scales]
    assert apart[0] == 0.0
    assert apart[1] < apart[-1]


def test_the_same_seed_makes_the_same_motion(twin, plan):
    one, same, other = (vary(twin, plan, 1.0, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.phases[1].q, same.phases[1].q)
    assert one.distance_rad != other.distance_rad


@pytest.mark.parametrize("s", [-0.1, np.nan, np.inf])
def test_a_perturbation_is_a_number_of_zero_or_more(twin, plan, s):
    with pytest.raises(ArgumentError, match=r"s must be a number >= 0"):
        vary(twin, plan, s, np.random.default_rng(0))


def test_an_autoencoder_reconstructs_only(source):
    twin = exact_twin()
    twin.config = TwinConfig(kind="ae")
    assert vary(twin, source, 0.0, np.random.default_rng(0)).distance_rad < 0.02
    with pytest.raises(ArgumentError, match=r"no posterior to draw from: give s = 0 \(--s 0\)"):
        vary(twin, source, 1.0, np.random.default_rng(0))


def test_a_plan_without_a_cycle_cannot_be_varied(twin, plan):
    empty = Phase(plan.cycle.profile[:0], plan.cycle.payload_kg[:0])
    with pytest.raises(ArgumentError, match="no cycle"):
        vary(twin, replace(plan, cycle=empty), 1.0, np.random.default_rng(0))
