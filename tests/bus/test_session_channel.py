"""Over Zenoh and in memory the fleet knows the same, whatever the channel does to its words."""

import networkx as nx
import pytest

from agents.registry import make_policy
from fleet.bus.exchange.channel import Channel, Partition
from fleet.bus.exchange.memory import MemoryExchange
from fleet.bus.exchange.zenoh import ZenohExchange
from fleet.env.allocation_v1 import parallel_env
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1", "arm_2", "arm_3")
CHANNELS = {
    "perfect": Channel(),
    "ring": Channel(
        topology="ring",
        delay_s=10.0,
        jitter_s=15.0,
        loss=0.2,
        partitions=(Partition(60.0, 120.0, (("arm_0", "arm_1"), ("arm_2", "arm_3"))),),
    ),
    "directed": Channel(topology=nx.DiGraph([("arm_0", "arm_1"), ("arm_1", "arm_2")]), loss=0.5),
    "silent": Channel(loss=1.0),
}


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_the_same_seed_gives_the_same_awards_over_either(small, channel):
    def shift(exchange: ZenohExchange | MemoryExchange) -> tuple[list[str], int]:
        env = parallel_env(small.Shifts(arms=4, jobs=20, ticks=60), exchange=exchange, keep_events=True)
        policy = make_policy("least_difficulty")
        env.reset(seed=3)
        while env.agents:
            env.step(policy.act(env.knowledge()))
        return [repr(event) for event in env.events], env.messages

    with ZenohExchange(ARMS, "trace", channel=channel, timeout_s=PATIENCE_S) as bus:
        over_zenoh = shift(bus)
    assert over_zenoh == shift(MemoryExchange(ARMS, channel))
    assert sum("award" in event for event in over_zenoh[0]) > 5
