"""A router, and clients of it."""

from contextlib import ExitStack

import pytest

from fleet.bus.client import BusClient
from fleet.bus.router import Router


@pytest.fixture
def bus():
    """The port of a router, and a function that opens clients of it."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        port = int(router.endpoint.rsplit(":", 1)[1])
        yield port, lambda: stack.enter_context(BusClient(router.endpoint, "f"))
