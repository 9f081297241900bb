"""What to try: scenarios, and the composition root that puts fleet, twin and agents together."""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.batch import make_batch as make_batch
    from scenarios.build import make_env as make_env

__all__ = ["make_batch", "make_env"]


def __getattr__(name: str) -> Any:
    """The public doors, opened when they are used: the command line need not load MuJoCo to print its help."""
    if name not in __all__:
        raise AttributeError(f"module 'scenarios' has no attribute '{name}'.")
    import_module("scenarios.registration")
    from scenarios import batch, build

    return batch.make_batch if name == "make_batch" else build.make_env


if "pettingzoo" in sys.modules:  # whoever works with it finds the environment under its name
    import_module("scenarios.registration")
