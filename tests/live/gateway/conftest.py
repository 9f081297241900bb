"""A gateway, and the fleet of one arm behind it."""

import pytest

from fleet.bus.router import Router
from tests.live.gateway.served import Served, StandIn


@pytest.fixture(scope="module")
def router():
    with Router() as opened:
        yield opened.endpoint


@pytest.fixture(scope="module")
def arm(router):
    with StandIn(router) as standing:
        yield standing


@pytest.fixture(scope="module")
def gateway(router, arm):
    with Served(router) as served:
        yield served
