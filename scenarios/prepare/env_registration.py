"""Registers the environment in PettingZoo when it is imported.

`pettingzoo.make("parallel", "thermofleet/allocation_v2", scenario="quickstart")` then works, and so does "aec".
"""

from pathlib import Path
from typing import Any

import pettingzoo
from pettingzoo import AECEnv
from pettingzoo.utils import wrappers

from fleet.env.allocation_v2 import VERSION, AllocationEnv, InTurns
from scenarios.prepare.fleet import make_env
from scenarios.spec.schema import Scenario

NAME = f"thermofleet/{VERSION}"


def registered_parallel_env(scenario: str | Path | Scenario = "quickstart", **options: Any) -> AllocationEnv:
    """`make_env` with a default scenario; options (Any) are passed on."""
    return make_env(scenario, **options)


def registered_aec_env(scenario: str | Path | Scenario = "quickstart", **options: Any) -> AECEnv[str, Any, Any]:
    """The same environment as an `AECEnv`, with PettingZoo's order check; Any: its observations are dicts."""
    return wrappers.OrderEnforcingWrapper(InTurns(make_env(scenario, **options)))


pettingzoo.register("parallel", NAME, f"{__name__}:registered_parallel_env")
pettingzoo.register("aec", NAME, f"{__name__}:registered_aec_env")
