"""The calculated load of a large fleet."""

import pytest

from benchmarks.scaling import load


def test_the_load_of_states_follows_from_their_number():
    """Without jobs to speak of: hub = one in and two out (auctioneer, recorder), and lease queries."""
    slow, fast = (load.load_of(1000, 10, state_hz=hz, asked=1) for hz in (0.0, 10.0))
    assert fast.hub_router - slow.hub_router == pytest.approx(3 * 10_000)
    assert fast.site_router - slow.site_router == pytest.approx(2 * 10_000 / 10)
    assert fast.auctioneer - slow.auctioneer == pytest.approx(10_000 * load.COSTS.state_s)
