"""Observations of the nearest peers only."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from fleet.errors import ScenarioError
from scenarios.cell_layout import cell_of, near_of
from scenarios.prepare.fleet import make_batch, make_env
from scenarios.spec.load import load


@pytest.mark.parametrize("name", ["quickstart", "heat_wave"])
@pytest.mark.parametrize("peers", [1, 2])
def test_the_peers_are_the_nearest_in_space(name, peers) -> None:
    scenario = load(name)
    mounts_m = np.array(cell_of(scenario).mounts_m)
    far_m, _ = KDTree(mounts_m).query(mounts_m, k=peers + 1)
    near = near_of(scenario, peers)
    assert near is not None
    for a, own in enumerate(near):
        assert a not in own
        assert len(set(own)) == peers
        np.testing.assert_allclose(np.linalg.norm(mounts_m[list(own)] - mounts_m[a], axis=1), far_m[a, 1:])


def test_fields_of_the_nearest_peers_equal_those_of_all_peers(plans) -> None:
    options = {"difficulty": "blind", "cache": plans, "horizon_s": 600}
    all_, few = (make_batch("quickstart", 3, seed=5, peers=n, **options) for n in (None, 2))
    single = make_env("quickstart", peers=2, **options)
    all_.reset(), few.reset()
    alone, _ = single.reset(seed=5)
    near = near_of(load("quickstart"), 2)
    assert near is not None
    assert few.layout.size == all_.layout.size - (6 + 3 * few.layout.slots)
    rng = np.random.default_rng(0)
    for _ in range(40):
        whole, part = all_.knowledge(), few.knowledge()
        for name, values in vars(whole).items():
            if name.startswith("peer_"):
                place = [[b - (b > a) for b in own] for a, own in enumerate(near)]
                values = values[:, np.arange(len(near))[:, None], place]
            np.testing.assert_array_equal(getattr(part, name), values, err_msg=name)
        mask = whole.action_mask
        actions = (rng.random(mask.shape) * mask).argmax(-1)
        _, (obs, *_) = all_.step(actions), few.step(actions)
        alone, *_ = single.step(dict(zip(single.agents, actions[0], strict=True)))
        np.testing.assert_array_equal(alone["arm_2"]["observation"], obs["observation"][0, 2])


@pytest.mark.parametrize("peers", [-1, 4, 1.5, True, "all"])
def test_invalid_numbers_of_peers_are_refused(peers) -> None:
    for make in (lambda **more: make_batch("quickstart", 2, **more), lambda **more: make_env("quickstart", **more)):
        with pytest.raises(ScenarioError, match=r"peers must be None or an integer from 0 to 3 \(got "):
            make(difficulty="blind", peers=peers)
