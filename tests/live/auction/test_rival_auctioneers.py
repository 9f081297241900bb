"""Two auctioneers in one fleet: the second one is refused; after a network cut neither accepts or awards jobs."""

import re
import threading
import time

import pytest

from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, Status, StatusRequest, Submission, SubmissionReply
from fleet.errors import BusError, Refused
from fleet.live.auction import node as auction_node
from fleet.live.auction.node import AuctionNode
from fleet.live.monitor.snapshot import FleetListener
from tests.waiting import PATIENCE_S


def test_a_fleet_has_one_auctioneer(bus, token_reaches):
    node = bus.auctioneer("one")
    token_reaches(bus.link(), keys.of_auction("f", "one", "alive"))
    # While the second one starts, the first is not served, as if it were stopped: only its token is present.
    with pytest.raises(BusError, match=r"has an auctioneer already: 'one'. A fleet has one"):
        bus.auctioneer("two")
    with pytest.raises(BusError, match=r"has an auctioneer 'one' already: its token is present. Stop that one first"):
        bus.auctioneer("one", folder="elsewhere")
    bus.kill(node)
    assert bus.states(bus.auctioneer("one")) == []


def test_a_participant_that_replies_without_a_token_counts_as_an_auctioneer(bus, token_reaches):
    early = bus.link()
    early.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: Status("one", 0.0, ()))
    early.watch_tokens(keys.of_every_arm("f", "alive"), lambda *_: None)
    with pytest.raises(BusError, match="has an auctioneer already, which does not reply"):
        bus.auctioneer("two")
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            early.serve(time.monotonic() + 0.05)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with pytest.raises(BusError, match="has an auctioneer already: 'one'"):
            bus.auctioneer("two")
        with bus.link() as arm:
            arm.declare_token(keys.of_arm("f", "one", "alive"))
            token_reaches(early, keys.of_arm("f", "one", "alive"))
            with pytest.raises(BusError, match=r"allocate the jobs themselves; 'one' replies .* Stop them first"):
                bus.auctioneer("two")
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def test_two_auctioneers_detect_each_other_and_accept_no_jobs(bus, monkeypatch):
    """Both start while the network is cut, and meet after it."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one, two = bus.auctioneer("one"), bus.auctioneer("two")
    arm = bus.arm("arm_0")
    bus.until(lambda: one.rivals == {"two"} and two.rivals == {"one"} and one.present == {"arm_0"})
    replies = bus.ask(keys.of_jobs("f", "submit"), Submission(bus.jobs("a")), SubmissionReply)
    assert not replies.messages
    assert (
        sorted(replies.refused.values())
        == ["Fleet 'f' has more than one auctioneer (one, two): no jobs are accepted until one is stopped."] * 2
    )
    with pytest.raises(Refused, match="more than one auctioneer"):
        one.submit(Submission(bus.jobs("a")))
    status = bus.ask(keys.of_jobs("f", "status"), StatusRequest(), Status)
    assert sorted(reply.auctioneer for reply in status.messages.values()) == ["one", "two"]
    assert len(bus.ask(keys.of_clock("f"), ClockRequest(), Clock).messages) == 2
    bus.kill(two)
    bus.until(lambda: not one.rivals)
    one.submit(Submission(bus.jobs("a")))
    bus.until(lambda: bus.states(one) == ["finished"])
    assert arm.done == ["a"]


def test_two_auctioneers_of_one_name_detect_each_other_and_award_nothing(bus, monkeypatch):
    """Both start at the same moment, and share one token."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one, two = bus.auctioneer("one"), bus.auctioneer("one", folder="elsewhere")
    for node in (one, two):  # before either is served
        node.submit(Submission(bus.jobs("a")))
    arm = bus.arm("arm_0")
    bus.until(lambda: one.rivals == two.rivals == {"one"} and one.present == two.present == {"arm_0"})
    error = "Fleet 'f' has more than one auctioneer (one, one): no jobs are accepted until one is stopped."
    with pytest.raises(Refused, match=re.escape(error)):
        one.submit(Submission(bus.jobs("b")))
    bus.serve_for(0.5)
    assert bus.states(one) == bus.states(two) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: bus.states(one) == ["finished"])
    assert arm.done == ["a"]


def test_an_auctioneer_without_a_recent_check_for_others_awards_nothing(bus, monkeypatch):
    """It awards nothing before its first check, nor long after its last."""
    alone = bus.auctioneer("one")
    arm = bus.arm("arm_0")
    monkeypatch.setattr(AuctionNode, "_check_rivals", lambda self, real_s: None)
    alone.submit(Submission(bus.jobs("a")))
    bus.until(lambda: alone.present == {"arm_0"})
    bus.serve_for(0.3)
    assert not arm.awards
    monkeypatch.undo()
    bus.until(lambda: bus.states(alone) == ["finished"])
    monkeypatch.setattr(auction_node, "ALONE_S", 0.0)  # as if it had been stopped for longer than that
    alone.submit(Submission(bus.jobs("b")))
    bus.serve_for(0.3)
    assert arm.done == ["a"]


def test_jobs_accepted_before_a_second_auctioneer_started_are_awarded_after_it_stopped(bus, monkeypatch):
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    one = bus.auctioneer("one")
    one.submit(Submission(bus.jobs("a")))
    two = bus.auctioneer("two")
    bus.until(lambda: one.rivals == {"two"})
    arm = bus.arm("arm_0")
    bus.until(lambda: one.present == {"arm_0"})
    listener = FleetListener(bus.link())
    bus.until(
        lambda: {each.auctioneer for each in listener.view.snapshot(0.0).auctioneers if each.token} == {"one", "two"}
    )
    bus.serve_for(0.5)
    assert bus.states(one) == ["waiting"]
    assert not arm.awards
    bus.kill(two)
    bus.until(lambda: bus.states(one) == ["finished"])
