"""A fleet of one arm."""

from types import SimpleNamespace

import pytest

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent
from fleet.bus.protocol.messages import DifficultyScores
from fleet.bus.router import Router
from tests.live.monitor.messages import state


@pytest.fixture
def fleet():
    """A fleet of one arm that says its words whenever it is asked to."""
    with Router() as router, BusClient(router.endpoint, "f") as link:
        link.declare_token(keys.of_arm("f", "a", "alive"))
        event = link.publisher(keys.of_arm("f", "a", "event"), ArmEvent)

        def say():
            link.publish(keys.of_arm("f", "a", "state"), state(headroom_k=7.5))
            link.publish(
                keys.of_arm("f", "a", "difficulty"), DifficultyScores("a", 1, 1.0, "t", ("j",), (0.5,), (None,))
            )

        yield SimpleNamespace(endpoint=router.endpoint, say=say, link=link, event=event)
