"""Run fleets of robot arms, compare allocation policies, train digital twins, connect to the bus.

    import thermofleet as tf

    shift = tf.run("quickstart", policy="wsept", seed=3)
    shift.telemetry.to_pandas()
    tf.compare("quickstart", ["wspt", "mine.py:Mine"]).table

Each name is imported when it is first used, so `import thermofleet` loads no simulator.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.policy import Policy as Policy
    from fleet.bus.client import BusClient as BusClient
    from scenarios.evaluate.comparison import compare as compare
    from scenarios.prepare.batch import make_batch as make_batch
    from scenarios.prepare.fleet import make_env as make_env
    from scenarios.prepare.fleet import prepare as prepare
    from scenarios.prepare.twins import train_log as train_twin  # noqa: F401 -- a public name
    from scenarios.run.log import open_run as open_run
    from scenarios.run.shift import run as run
    from scenarios.spec.load import load as load
    from scenarios.spec.schema import Scenario as Scenario
    from twin.thermal.forecast import forecast as forecast
    from twin.thermal.identify import identify as identify

_HOMES = {
    "BusClient": "fleet.bus.client",
    "Policy": "agents.policy",
    "Scenario": "scenarios.spec.schema",
    "compare": "scenarios.evaluate.comparison",
    "forecast": "twin.thermal.forecast",
    "identify": "twin.thermal.identify",
    "load": "scenarios.spec.load",
    "make_batch": "scenarios.prepare.batch",
    "make_env": "scenarios.prepare.fleet",
    "open_run": "scenarios.run.log",
    "prepare": "scenarios.prepare.fleet",
    "run": "scenarios.run.shift",
    "train_twin": "scenarios.prepare.twins:train_log",
}
"""Module of each public name, with `:NAME` if it has another name there."""
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll] the names are those of the table
_PACKAGES = ("fleet", "agents", "twin", "scenarios")


def __getattr__(name: str) -> Any:  # functions and classes
    if name == "__version__":
        from importlib.metadata import version

        return version("thermofleet")
    if name not in _HOMES:
        raise AttributeError(f"module 'thermofleet' has no attribute '{name}'; it has {', '.join(sorted(_HOMES))}.")
    _check_packages()
    module, _, attribute = _HOMES[name].partition(":")
    value = globals()[name] = getattr(import_module(module), attribute or name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


def _check_packages() -> None:
    """Check that no file of the user has the name of one of our packages.

    Raises:
        ImportError: one has, and Python finds it first.
    """
    for package in _PACKAGES:
        spec = find_spec(package)
        origin = Path(spec.origin).resolve() if spec and spec.origin else None
        if origin != Path(__file__).resolve().parent / package / "__init__.py":
            raise ImportError(
                f"Python finds '{origin or package}' instead of thermofleet's package '{package}': rename your file or "
                "folder, or start Python in another folder."
            )


if "pettingzoo" in sys.modules:  # `pettingzoo.make` then knows the environment
    _check_packages()
    import_module("scenarios")
