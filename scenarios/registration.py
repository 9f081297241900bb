"""The environment's name in PettingZoo's registry, which importing this module puts there.

`pettingzoo.make("parallel", "thermofleet/allocation_v0", scenario="quickstart")`; the same with "aec".
"""

from pathlib import Path
from typing import Any

import pettingzoo
from pettingzoo import AECEnv
from pettingzoo.utils import wrappers

from fleet.env.allocation_v0 import VERSION, AllocationEnv, InTurns
from scenarios.build import make_env
from scenarios.scenario import Scenario

NAME = f"thermofleet/{VERSION}"


def registered_parallel_env(scenario: str | Path | Scenario = "quickstart", **options: Any) -> AllocationEnv:
    """`make_env`, with a scenario to begin with."""
    return make_env(scenario, **options)


def registered_aec_env(scenario: str | Path | Scenario = "quickstart", **options: Any) -> AECEnv[str, Any, Any]:
    """The same as an `AECEnv`, with PettingZoo's order check."""
    return wrappers.OrderEnforcingWrapper(InTurns(make_env(scenario, **options)))


pettingzoo.register("parallel", NAME, f"{__name__}:registered_parallel_env")
pettingzoo.register("aec", NAME, f"{__name__}:registered_aec_env")
