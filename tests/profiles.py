"""Profiles of Hypothesis: few examples in `make test`, all of them in `make test-slow`."""

import os
from typing import Any

from hypothesis import settings

FEW = 20
"""Examples of a property in `make test`."""

# No deadline: a busy machine is no reason to fail.
settings.register_profile("thermofleet", deadline=None, max_examples=FEW)
settings.register_profile("ci", deadline=None, max_examples=FEW, derandomize=True, print_blob=True)
settings.register_profile("full", deadline=None, print_blob=True)
PROFILE = os.environ.get("HYPOTHESIS_PROFILE") or ("ci" if os.environ.get("CI") else "thermofleet")
settings.load_profile(PROFILE)


def examples(count: int, **options: Any) -> settings:
    """Return settings with `count` examples in the profile `full`, and at most `FEW` in the others."""
    return settings(max_examples=count if PROFILE == "full" else min(count, FEW), **options)
