"""An arm of a scenario as generation gets it: its own cool motion, and nobody else's twin."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fleet.errors import FleetError
from scenarios.motion.generate import peak_of
from scenarios.motion.recover import known_arm
from scenarios.spec.load import load
from scenarios.spec.parse import override

LEFT: Any = SimpleNamespace(arm="left")


def test_an_arm_begins_from_what_it_found_to_stay_cool(small_toml, plans):
    known = known_arm(load(small_toml), twin=LEFT, cache=plans)
    assert known.arm.robot.name == "left"
    assert len(known.sources) > 2
    asked = known.verification
    assert (asked.ambient_c, asked.cool_c, asked.horizon_s) == (22.0, 40.0, 1800.0)
    for plan in known.sources:
        assert plan.arm == "left"
        peak_c = peak_of(plan, known.arm.motors, known.arm.thermal, asked.ambient_c, asked.horizon_s)
        assert np.all(peak_c <= 40.0)


def test_an_unknown_arm_and_anothers_twin_are_refused(small_toml, plans):
    scenario = load(small_toml)
    with pytest.raises(FleetError, match=r"No arm 'lefd' in heat; did you mean 'left'\? Allowed: left, right"):
        known_arm(scenario, "lefd", twin=LEFT, cache=plans)
    with pytest.raises(FleetError, match="twin of arm 'left', not of 'right'"):
        known_arm(scenario, "right", twin=LEFT, cache=plans)


def test_an_arm_without_cool_motion_says_what_to_change(small_toml, plans):
    hot = override(load(small_toml), twin={"cool_c": 22.5})
    with pytest.raises(FleetError, match=r"no motion that stays below 22.5 °C.*Raise twin.cool_c"):
        known_arm(hot, "left", twin=LEFT, cache=plans)
