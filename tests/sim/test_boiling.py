"""The moment at which a limit is passed, against the plain kernel's halving: warming and cooling."""

import numpy as np
import pytest

from fleet.sim.boiling import crossing_s, hottest_at, into_modes
from fleet.sim.faults import Leg, arm_model
from fleet.sim.tables import tables_of
from fleet.thermal import NODES

AIR_C, LENGTH_S = 25.0, 10.0
HALVED_S = LENGTH_S * 2.0**-30
"""How near the halving comes."""


@pytest.fixture(scope="module")
def world(small):
    return small.shop([[small.job("a")]])[0]


@pytest.mark.parametrize("start_c", [30.0, 80.0], ids=["warming", "cooling"])
def test_a_limit_is_passed_when_halving_says_so(world, start_c) -> None:
    """Also where the search hits the limit exactly, and then it is at it."""
    tables, model = tables_of(world)[0], arm_model(world, 0)
    rng = np.random.default_rng(3)
    heat_w = np.zeros(NODES)
    heat_w[1] = 90.0 if start_c < 50.0 else 0.0
    temp_c = np.full(NODES, start_c)
    temp_c[1] += 1.0
    modal = np.empty((2, NODES))
    into_modes(tables, 0, 0, temp_c, heat_w + tables.to_ambient[0, 0] * AIR_C, modal)
    leg = Leg(model, temp_c, heat_w, AIR_C, 0.0, LENGTH_S)
    first_c, last_c = (hottest_at(tables, 0, 0, modal, time_s) for time_s in (0.0, LENGTH_S))
    assert (last_c > first_c) == (start_c < 50.0)
    exact = 0
    for limit_c in rng.uniform(min(first_c, last_c), max(first_c, last_c), size=400).tolist():
        found_s = crossing_s(tables, 0, 0, modal, LENGTH_S, limit_c, first_c, last_c)
        assert found_s == pytest.approx(leg.crossing_s(limit_c), rel=0, abs=HALVED_S + 2e-9)
        there_c = hottest_at(tables, 0, 0, modal, found_s)
        exact += there_c == limit_c
        assert there_c == limit_c or (there_c > limit_c) == (last_c > first_c)
    assert exact > 3
