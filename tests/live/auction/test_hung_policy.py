"""A live fleet whose policy is another process that hangs: the fleet goes on, and awards nothing until it replies."""

from contextlib import ExitStack

from fleet.bus.protocol.auction import Submission
from fleet.bus.router import open_client
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.policy_client import PolicyClient
from scenarios.live.auctioneer import ON_BUS_S, CentralAllocation
from tests.bus.test_policy_client import Server
from tests.waiting import PATIENCE_S

ARMS = ("arm_0", "arm_1")


def test_nothing_is_awarded_and_the_arms_stay_present_until_the_policy_replies(bus, caplog):
    policy = PolicyClient("mine", fleet="f", endpoint=bus.endpoint, limit_s=ON_BUS_S)
    node = bus.auctioneer(allocate=CentralAllocation(policy, LiveFleet(arms=ARMS)))
    for arm in ARMS:
        bus.arm(arm)
    bus.until(lambda: node.present == set(ARMS))
    with ExitStack() as stack:
        hung = Server(stack.enter_context(open_client(bus.endpoint, timeout_s=PATIENCE_S)), None)
        node.submit(Submission(bus.jobs("a")))
        for asked in range(1, 4):
            bus.until(lambda asked=asked: hung.requests.qsize() >= asked)
            assert bus.states(node) == ["waiting"]
            assert node.present == set(ARMS)
        node.submit(Submission(bus.jobs("b")))  # it still replies
        assert caplog.text.count("Nothing is awarded until the policy replies") == 1
        assert "did not reply and finish the query" in caplog.text
    Server(bus.stack.enter_context(open_client(bus.endpoint, timeout_s=PATIENCE_S)), '{"actions": {"arm_0": 1}}')
    bus.until(lambda: bus.states(node) == ["finished", "finished"])
    assert caplog.text.count("The policy replies again.") == 1
    assert not any(arm.done for arm in bus.arms[1:])
