"""What adapters are given is checked, so that no trainer fails on it later."""

import importlib
import sys

import numpy as np
import pytest

from fleet.env.adapters.arguments import check_batch, check_env
from fleet.env.allocation_v2 import parallel_env
from fleet.env.validation import check_choice


@pytest.mark.parametrize(
    ("trainer", "library", "install"),
    [
        *(("sb3", "stable_baselines3", "sb3"), ("rllib", "ray", "rllib"), ("tianshou", "tianshou", "tianshou")),
        *(("benchmarl", "benchmarl", "benchmarl"), ("torchrl", "tensordict", "learn")),
        ("torchrl", "torch", "learn"),
    ],
)
def test_an_adapter_without_its_trainer_names_the_command_that_installs_it(monkeypatch, trainer, library, install):
    constraints = "constraints.txt" if install == "learn" else rf"constraints/{install}\.txt"
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"fleet.env.adapters.{trainer}", raising=False)
    with pytest.raises(ModuleNotFoundError, match=rf"pip install -e '\.\[{install}\]' -c {constraints}"):
        importlib.import_module(f"fleet.env.adapters.{trainer}")


@pytest.mark.parametrize("mask_in", ["obs", "both"])
def test_an_environment_with_the_masks_in_the_observations_is_taken(small, mask_in) -> None:
    env = parallel_env(small.Shifts(), mask_in=mask_in)
    assert check_env("It", env) is env


def test_masks_must_be_in_the_observations(small) -> None:
    with pytest.raises(ValueError, match=r"It needs the masks in the observations: .*mask_in='obs'\."):
        check_env("It", parallel_env(small.Shifts(), mask_in="info"))


@pytest.mark.parametrize("given", [None, 3, "quickstart", np.zeros(3)])
def test_other_values_are_named(given) -> None:
    with pytest.raises(ValueError, match=r"It takes an environment made by thermofleet\.make_env\(\) \(got "):
        check_env("It", given)
    with pytest.raises(ValueError, match=r"It takes a batch made by thermofleet\.make_batch\(\) \(got "):
        check_batch("It", given)


@pytest.mark.parametrize("autoreset", [True, False])
def test_a_batch_must_reset_as_the_adapter_needs(small_batch, autoreset) -> None:
    batch = small_batch(num_envs=2, autoreset=autoreset)
    assert check_batch("It", batch) is check_batch("It", batch, autoreset=autoreset) is batch
    with pytest.raises(ValueError, match=f"It needs a batch made with autoreset={not autoreset} "):
        check_batch("It", batch, autoreset=not autoreset)


def test_a_choice_names_what_is_allowed() -> None:
    check_choice("masks", "list", ("list", "array"))
    with pytest.raises(ValueError, match=r"masks must be one of 'list', 'array' \(got 'tuple'\)\."):
        check_choice("masks", "tuple", ("list", "array"))
