"""Fleets in simulated time."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from benchmarks.simulation.participants import simulated_system
from tests.live.simulated import SimulatedFleet


@pytest.fixture
def fleet_of() -> Iterator[Any]:
    """Function that starts a simulated fleet; its arguments are those of `SimulatedFleet`."""
    with ExitStack() as stack:

        def start(alone: bool, arms: int = 3, *, only: tuple[str, ...] = (), **options: Any) -> SimulatedFleet:
            fleet = SimulatedFleet(alone, arms, **options)
            stack.enter_context(simulated_system(fleet.world))
            fleet.start(*only)
            return fleet

        yield start


@pytest.fixture(params=[False, True], ids=["auctioneer", "alone"])
def fleet(request: pytest.FixtureRequest, fleet_of: Any) -> SimulatedFleet:
    """Three arms, with an auctioneer and without one."""
    return fleet_of(request.param)
