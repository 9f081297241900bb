"""Scenarios, and everything that combines fleet, twin and agents."""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.prepare.batch import make_batch as make_batch
    from scenarios.prepare.fleet import make_env as make_env

__all__ = ["make_batch", "make_env"]


def __getattr__(name: str) -> Any:  # one of several functions
    """Import the public functions when they are used, so that the command line prints its help without MuJoCo."""
    if name not in __all__:
        raise AttributeError(f"module 'scenarios' has no attribute '{name}'.")
    import_module("scenarios.prepare.env_registration")
    from scenarios.prepare import batch, fleet

    return batch.make_batch if name == "make_batch" else fleet.make_env


if "pettingzoo" in sys.modules:  # `pettingzoo.make` then knows the environment
    import_module("scenarios.prepare.env_registration")
