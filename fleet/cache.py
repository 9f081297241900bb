"""Where things are kept that are costly to make again: plans and twins, and compiled code."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """Of plans and twins: $THERMOFLEET_CACHE, else thermofleet in $XDG_CACHE_HOME or ~/.cache."""
    own = os.environ.get("THERMOFLEET_CACHE")
    return Path(own) if own else users_folder()


def users_folder() -> Path:
    """Of compiled code, which is the same for every study: thermofleet in $XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "thermofleet"
