"""A gateway with its page, and the fleet of one arm behind it."""

import pytest

from fleet.bus.router import Router
from scenarios.live.gateway import LivePage
from tests.live.gateway.moving_fleet import MovingFleet
from tests.live.gateway.served import Served


@pytest.fixture(scope="module")
def router():
    with Router() as opened:
        yield opened.endpoint


@pytest.fixture(scope="module")
def arm(router):
    """A paused fleet of one arm whose name has a character that keys escape."""
    moving = MovingFleet(router, ("a+1",), fleet="f")
    moving.temp_c["a+1"], moving.paused["*"] = 41.5, "ann"
    with moving:
        yield moving


@pytest.fixture(scope="module")
def gateway(router, arm):
    with Served(router, page=LivePage()) as served:
        yield served
