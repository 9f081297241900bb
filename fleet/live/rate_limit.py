"""Warnings about one arm at a limited rate; a module without other imports of the project."""

import logging
import math
import time

_LOG = logging.getLogger(__name__)

WARNING_S = 10.0
"""Real seconds between two warnings about the same thing."""


class RateLimitedWarnings:
    """Logs warnings about an arm, or with "" about no particular one, each kind at most once in `WARNING_S`."""

    def __init__(self, arm: str) -> None:
        self._arm = arm
        self._logged_s: dict[str, float] = {}

    def __call__(self, kind: str, sentence: str) -> None:
        """Log a warning; `sentence` continues after the name of the arm, if there is one."""
        if (now_s := time.monotonic()) >= self._logged_s.get(kind, -math.inf) + WARNING_S:
            self._logged_s[kind] = now_s
            _LOG.warning("%s%s", f"Arm '{self._arm}' " if self._arm else "", sentence)
