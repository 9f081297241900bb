import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.profiles import examples
from twin.vae.config import TwinConfig
from twin.vae.inference import Networks, decode, posterior, reconstruct
from twin.vae.model import build, weights_of
from twin.vae.twin import save

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


def several(count, config, channels=3):
    return [build(config, seed, channels=channels) for seed in range(count)]


def drawn(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@examples(30)
@given(config=configs, count=st.integers(1, 7), joints=st.integers(1, 3), batch=st.integers(1, 28))
def test_windows_of_an_arm_go_through_each_network_alone(config, count, joints, batch):
    """`joints` of each network: 1 with a network per joint, all of the arm with one network."""
    nets, z = several(count, config, 3 * joints), drawn(batch, batch, config.window, count * joints, 3)
    apart = torch.from_numpy(z).reshape(batch, config.window, count, 3 * joints)
    with torch.inference_mode():
        outputs = [net(apart[:, :, n], torch.zeros(batch, config.latent)) for n, net in enumerate(nets)]
    want = np.stack([x_hat.numpy() for x_hat, _, _ in outputs], axis=2).reshape(z.shape)
    networks = Networks([weights_of(net) for net in nets])
    got = reconstruct(networks, z)[0]
    assert (got.shape, got.dtype) == (z.shape, np.float32)
    np.testing.assert_allclose(got, want, atol=2e-6)
    mu, sigma = posterior(networks, z)
    np.testing.assert_allclose(mu, np.stack([each.numpy() for _, each, _ in outputs], axis=1), atol=2e-6)
    variance = np.stack([each.exp().numpy() for _, _, each in outputs], axis=1)
    np.testing.assert_allclose(sigma, np.sqrt(variance), rtol=1e-5)
    np.testing.assert_allclose(decode(networks, mu, config.window), want, atol=2e-6)


@pytest.mark.parametrize("count", [2, 7])
def test_joints_share_no_numbers(count):
    networks, z = Networks([weights_of(net) for net in several(count, TwinConfig(hidden=8))]), drawn(1, 4, 50, count, 3)
    other = z.copy()
    other[:, :, -1] += 1.0
    before, after = reconstruct(networks, z)[0], reconstruct(networks, other)[0]
    np.testing.assert_array_equal(before[:, :, :-1], after[:, :, :-1])
    assert np.abs(before[:, :, -1] - after[:, :, -1]).max() > 1e-3


def test_many_windows_in_several_passes_are_each_window_alone():
    networks, z = Networks([weights_of(net) for net in several(2, TwinConfig(hidden=8))]), drawn(2, 600, 20, 2, 3)
    together = reconstruct(networks, z)[0]
    for i in (0, 63, 64, 599):
        np.testing.assert_allclose(together[i], reconstruct(networks, z[i : i + 1])[0][0], atol=2e-6)


def test_a_pickled_twin_scores_the_same(twin, plan):
    fresh = pickle.loads(pickle.dumps(twin))
    size = len(pickle.dumps(fresh))
    score = fresh.score(plan, 3).per_joint
    assert len(pickle.dumps(fresh)) == size
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fresh)).score(plan, 3).per_joint, score)


def test_a_saved_twin_scores_without_torch(twin, plan, tmp_path):
    save(twin, tmp_path)
    (tmp_path / "plan.pickle").write_bytes(pickle.dumps(plan))
    source = (
        "import pathlib, pickle, sys; from twin.vae.twin import load; folder = pathlib.Path(sys.argv[1]); "
        "score = load(folder).score(pickle.loads((folder / 'plan.pickle').read_bytes()), 3); "
        "print(score.total, 'torch' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", source, tmp_path], capture_output=True, text=True, check=True)
    total, torch_is_there = said.stdout.split()
    assert float(total) == pytest.approx(twin.score(plan, 3).total, rel=1e-5)
    assert torch_is_there == "False"
