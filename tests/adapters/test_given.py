"""What adapters are given is checked before a trainer stumbles over it."""

import numpy as np
import pytest

from fleet.env.adapters.given import batch_for, env_for
from fleet.env.allocation_v0 import parallel_env


def test_an_environment_with_the_masks_in_what_it_observes_is_taken(small) -> None:
    env = parallel_env(small.Shifts())
    assert env_for("It", env) is env


@pytest.mark.parametrize("place", ["info", "both"])
def test_only_masks_in_what_is_observed_are_found(small, place) -> None:
    env = parallel_env(small.Shifts(), mask_in=place)
    if place == "both":
        assert env_for("It", env) is env
        return
    with pytest.raises(ValueError, match=r"It needs the masks in the observations: .*mask_in='obs'\."):
        env_for("It", env)


@pytest.mark.parametrize("given", [None, 3, "quickstart", np.zeros(3)])
def test_what_is_no_environment_is_named(given) -> None:
    with pytest.raises(ValueError, match=r"It takes an environment, as scenarios\.make_env\(\) makes it \(got "):
        env_for("It", given)
    with pytest.raises(ValueError, match=r"It takes a batch, as scenarios\.make_batch\(\) makes it \(got "):
        batch_for("It", given)
