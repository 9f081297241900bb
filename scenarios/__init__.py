"""What to try: scenarios, and the composition root that puts fleet, twin and agents together."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.build import make_env as make_env

__all__ = ["make_env"]


def __getattr__(name: str) -> Any:
    """The public door, opened when it is used: the command line need not load MuJoCo to print its help."""
    if name != "make_env":
        raise AttributeError(f"module 'scenarios' has no attribute '{name}'.")
    from scenarios.build import make_env

    return make_env
