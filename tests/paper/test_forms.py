"""Forms of the twin's network: what they can explain, by construction."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.paper.forms import CONFIG, FORMS, Net, errors_of, fitted, inputs_of


def motion(rng: np.random.Generator, factor: float) -> np.ndarray:
    """Random walks of 7 joints with a torque that the velocity determines, z-scores [batch, time, joint, channel]."""
    walk = np.cumsum(rng.normal(0.0, 0.3, (256, CONFIG.window, 7, 2)), axis=1)
    tau = factor * walk[..., 1:]
    return np.concatenate([walk, tau], axis=-1).astype(np.float32)


@pytest.mark.parametrize("name", ["dynamics", "motion"])
def test_a_network_that_knows_the_motion_explains_its_torque_and_no_other(name) -> None:
    rng = np.random.default_rng(0)
    known, payload = motion(rng, 1.0), np.zeros(256)
    net = fitted(FORMS[name], known, payload, 1, np.zeros(3), 0, replace(CONFIG, epochs=50))
    usual, hotter = (errors_of(net, motion(rng, factor), payload, 1).mean() for factor in (1.0, 3.0))
    assert usual < 0.25 * np.abs(known[..., 1, 2]).mean()
    assert hotter > 2.0 * usual


def test_an_error_with_a_variance_is_the_negative_log_likelihood() -> None:
    z, payload = motion(np.random.default_rng(1), 1.0)[:4], np.zeros(4)
    form = FORMS["motion_likelihood"]
    x, given = inputs_of(form, z, payload, 2)
    torch.manual_seed(0)
    net = Net(form, given.shape[2], 8).eval()
    with torch.no_grad():
        net.out.weight.zero_()
        net.out.bias.copy_(torch.tensor([0.5, np.log(4.0)]))
    expected = -torch.distributions.Normal(0.5, 2.0).log_prob(x[..., 2:]) - 0.5 * np.log(2.0 * np.pi)
    assert errors_of(net, z, payload, 2) == pytest.approx(expected.numpy(), abs=1e-5)


def test_the_decoder_is_given_what_its_form_says() -> None:
    z, payload = motion(np.random.default_rng(2), 1.0)[:3], np.array([0.0, 1.0, 2.0])
    sizes = {name: inputs_of(form, z, payload, 0)[1].shape[2] for name, form in FORMS.items()}
    assert (sizes["paper"], sizes["payload"], sizes["motion"], sizes["motion_all"]) == (0, 1, 2, 14)
    _, given = inputs_of(FORMS["motion_payload"], z, payload, 0)
    assert given.shape[2] == 15
    assert given[:, :, -1].numpy().tolist() == [[kg] * CONFIG.window for kg in payload]
