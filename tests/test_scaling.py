"""The calculated load of a large fleet."""

import pytest

from benchmarks.scaling import load


@pytest.mark.parametrize(
    ("arms", "sites", "state_hz", "asked", "expected"),
    [
        (256, 2, 10.0, 0, (3_203, 8_966, 0.71, 0.10, 0.28, 47, 68)),
        (1_000, 10, 1.0, 6, (408, 5_082, 0.27, 0.06, 0.10, 18, 266)),
        (10_000, 100, 10.0, 0, (2_385, 338_500, 195, 7.2, 8.2, 1_832, 2_663)),
    ],
)
def test_the_calculated_load_is_pinned(arms, sites, state_hz, asked, expected):
    """As `python -m benchmarks.scaling` printed it on 23 November 2026; asked 0: all arms."""
    at = load.load_of(arms, sites, state_hz=state_hz, asked=asked)
    calculated = (at.site_router, at.hub_router, at.hub_mb, at.auctioneer, at.full_round_s, at.recorder_gb)
    assert (*calculated, at.journal_mb) == pytest.approx(expected, rel=0.04, abs=0.006)


def test_the_load_of_states_follows_from_their_number():
    """Without jobs to speak of: hub = one in and two out (auctioneer, recorder), and lease queries."""
    slow, fast = (load.load_of(1000, 10, state_hz=hz, asked=1) for hz in (0.0, 10.0))
    assert fast.hub_router - slow.hub_router == pytest.approx(3 * 10_000)
    assert fast.site_router - slow.site_router == pytest.approx(2 * 10_000 / 10)
    assert fast.auctioneer - slow.auctioneer == pytest.approx(10_000 * load.COSTS.state_s)
