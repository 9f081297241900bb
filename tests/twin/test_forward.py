import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.forward import FEW, NARROW, Networks
from twin.grouped import Grouped
from twin.model import LstmVae, TwinConfig, build

configs = st.builds(
    TwinConfig,
    kind=st.sampled_from(["vae", "ae"]),
    latent=st.integers(1, 5),
    hidden=st.integers(1, 40),
    layers=st.integers(1, 3),
    window=st.integers(2, 60),
    stride=st.just(1),
    score_stride=st.just(1),
)


def said(net, x):
    """What the network itself makes of windows [batch, time, channel]."""
    with torch.inference_mode():
        return net.eval()(torch.from_numpy(np.ascontiguousarray(x)), torch.zeros(len(x), net.mu.out_features))[
            0
        ].numpy()


def several(count, config, channels=3):
    return [build(config, seed, channels=channels) for seed in range(count)]


def drawn(seed, *shape, size=1.0):
    return (size * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


@settings(max_examples=30, deadline=None)
@given(config=configs, count=st.integers(1, 7), batch=st.integers(1, FEW + 4), seed=st.integers(0, 99))
def test_any_number_of_windows_gives_what_each_network_says_alone(config, count, batch, seed):
    nets, z = several(count, config), drawn(seed, batch, config.window, count, 3)
    want = np.stack([said(net, z[:, :, n]) for n, net in enumerate(nets)], axis=2)
    got = Networks(nets).reconstruct(z)
    assert (got.shape, got.dtype) == (z.shape, np.float32)
    np.testing.assert_allclose(got, want, atol=2e-6)


@settings(max_examples=20, deadline=None)
@given(config=configs, channels=st.integers(1, 21), count=st.integers(1, 3), size=st.sampled_from([1e-3, 1.0, 1e3]))
def test_all_at_once_is_each_alone_for_any_channels_and_sizes(config, channels, count, size):
    """Large inputs drive the gates to their ends, where a sigmoid by tanh must still be one."""
    nets = [net.requires_grad_(False) for net in several(count, config, channels)]
    x = drawn(0, count, config.window, 5, channels, size=size)
    want = np.stack([said(net, x[n].swapaxes(0, 1)).swapaxes(0, 1) for n, net in enumerate(nets)])
    np.testing.assert_allclose(Grouped(nets).reconstruct(x), want, atol=2e-6)


@pytest.mark.parametrize("count", [2, 7])
def test_joints_share_no_numbers(count):
    networks, z = Networks(several(count, TwinConfig(hidden=8))), drawn(1, 4, 50, count, 3)
    other = z.copy()
    other[:, :, -1] += 1.0
    before, after = networks.reconstruct(z), networks.reconstruct(other)
    np.testing.assert_array_equal(before[:, :, :-1], after[:, :, :-1])
    assert np.abs(before[:, :, -1] - after[:, :, -1]).max() > 1e-3


@pytest.mark.parametrize(
    ("joints", "config", "windows", "by_torch"),
    [
        (7, TwinConfig(), 1, False),
        (7, TwinConfig(), FEW, False),
        (7, TwinConfig(), FEW + 1, True),
        (7, TwinConfig(hidden=NARROW + 1), 1, True),
        (1, TwinConfig(), 1, True),
    ],
)
def test_few_windows_of_several_small_networks_do_without_torch(monkeypatch, joints, config, windows, by_torch):
    calls = []
    encode = LstmVae.encode
    monkeypatch.setattr(LstmVae, "encode", lambda net, x: calls.append(len(x)) or encode(net, x))
    Networks(several(joints, config)).reconstruct(drawn(0, windows, config.window, joints, 3))
    assert bool(calls) == by_torch


def test_a_trained_twin_scores_windows_alike_on_both_sides_of_the_crossover(twin, motion, rng):
    windows = np.stack([motion(rng, 4.0)[::4] for _ in range(FEW + 1)]).transpose(0, 1, 3, 2).astype(float)
    together, few = twin.window_features(windows), twin.window_features(windows[:-1])
    alone = np.concatenate([twin.window_features(window[None]).packed for window in windows])
    np.testing.assert_allclose(together.packed, alone, rtol=2e-6, atol=2e-5)
    np.testing.assert_allclose(together.difficulty[:-1], few.difficulty, atol=1e-6)


def test_what_is_prepared_for_few_windows_is_not_pickled(twin, plan):
    fresh = pickle.loads(pickle.dumps(twin))
    size = len(pickle.dumps(fresh))
    score = fresh.score(plan, 3).per_joint
    assert len(pickle.dumps(fresh)) == size
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fresh)).score(plan, 3).per_joint, score)
