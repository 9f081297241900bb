"""Burn thresholds by their sources, surfaces as housings, and the time above a limit by quadrature."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.heat.effects import burn_threshold_c, seconds_above, surface_c
from fleet.robot import JOINTS
from scenarios.run.metrics import HeatUse

TEMPERATURES = st.floats(20.0, 80.0)


@pytest.mark.parametrize(("contact_s", "burn_c"), [(1.0, 65.0), (60.0, 51.0), (600.0, 48.0), (28800.0, 43.0)])
def test_uncoated_metal_has_the_thresholds_of_the_standard(contact_s, burn_c):
    """DIN EN 563, quoted in BGV D34 § 12: 1 s 65 to 70 °C, 1 min 51, 10 min 48, 8 h 43."""
    assert burn_threshold_c(contact_s) == pytest.approx(burn_c)


@given(st.floats(1.0, 28800.0), st.floats(1.0, 28800.0))
def test_a_longer_contact_burns_at_a_lower_temperature(one, other):
    assert burn_threshold_c(min(one, other)) >= burn_threshold_c(max(one, other))


@pytest.mark.parametrize("contact_s", [0.5, 28801.0, float("nan")])
def test_other_contact_times_have_no_value(contact_s):
    with pytest.raises(ValueError, match=r"between 1 and 28800 s \(got"):
        burn_threshold_c(contact_s)


@given(TEMPERATURES, TEMPERATURES, TEMPERATURES)
def test_the_time_above_a_limit_is_that_of_a_straight_line(before_c, after_c, limit_c):
    course = np.linspace(before_c, after_c, 20_001)
    wanted = 10.0 * np.mean(course > limit_c)
    assert seconds_above(np.array(before_c), np.array(after_c), limit_c, 10.0) == pytest.approx(wanted, abs=0.01)


def test_surfaces_are_housings_and_their_hot_minutes_add_up():
    """A housing that rises by 1 K a minute from 40 °C to 60 °C is above 48 °C for 12 minutes."""
    temp_c = np.full((2, 2 * JOINTS), 40.0)
    temp_c[:, :JOINTS] = 90.0  # windings, which nobody can touch
    heat = HeatUse(temp_c, 48.0)
    for minute in range(1, 21):
        temp_c = temp_c.copy()
        temp_c[1, JOINTS + 2] = 40.0 + minute
        heat.add(temp_c, 60.0)
    np.testing.assert_allclose(heat.hot_surface_min, [0.0, 12.0])
    np.testing.assert_allclose(heat.surface_c, [40.0, 60.0])
    np.testing.assert_allclose(surface_c(temp_c), [40.0, 60.0])
