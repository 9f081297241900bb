"""Policies by name: the rules that come along, an own class as `FILE.py:CLASS` or `MODULE:CLASS`, or the folder of a
trained one."""

import importlib
import importlib.util
import os
from pathlib import Path
from types import ModuleType

import numpy as np

from agents.policy import Policy
from agents.rules import RULES, make_policy
from fleet.errors import FleetError, nearest
from fleet.seeds import child


def policy_of(name: str) -> Policy:
    """A fresh policy.

    Raises:
        FleetError: no such rule, file, module, class or folder, or one that is no policy.
    """
    if Path(name).is_dir():
        from agents.learned.policy import load_policy  # loads torch

        return load_policy(Path(name))
    if ":" not in name:
        try:
            return make_policy(name)
        except ValueError as error:
            raise FleetError(f"{error} Or give an own one as FILE.py:CLASS, or the folder of a trained one.") from error
    where, _, kind = name.rpartition(":")
    module = _module(where, name)
    found = getattr(module, kind, None)
    if not isinstance(found, type):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        raise FleetError(f"No class '{kind}' in '{where}'{nearest(kind, classes)}")
    if not callable(getattr(found, "reset", None)) or not callable(getattr(found, "act", None)):
        raise FleetError(f"'{name}' is no policy: it needs the methods reset(rng) and act(observations).")
    return found()


def policy_at(name: str, seed: int) -> Policy:
    """A fresh policy at the beginning of the shift of a seed, with the chance that is its share of it.

    Raises:
        FleetError: as `policy_of`.
    """
    policy = policy_of(name)
    policy.reset(np.random.default_rng(child(np.random.SeedSequence([seed, 1]), 0)))
    return policy


def label(name: str) -> str:
    """How a table calls a policy: the rule, the class, or the last folder."""
    if Path(name).is_dir():
        return Path(os.path.abspath(name)).name
    return name.rpartition(":")[2]


def _module(where: str, name: str) -> ModuleType:
    if not where.endswith(".py"):
        try:
            return importlib.import_module(where)
        except ImportError as error:
            rules = ", ".join(RULES)
            raise FleetError(f"Policy '{name}': cannot import '{where}' ({error}). Rules: {rules}.") from error
    path = Path(where)
    spec = importlib.util.spec_from_file_location(f"own_policy_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FleetError(f"Policy '{name}': there is no file '{where}'.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
