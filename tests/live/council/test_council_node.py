"""Arms on a real bus without an auctioneer: they do each job once, and nothing without a majority."""

import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from agents.auction import Consensus
from fleet.bus.client import AnotherReplies, BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobSpec, Submission, SubmissionReply
from fleet.bus.router import Router
from fleet.errors import BusError
from fleet.job import Place
from fleet.live.arm.awards import ArmHistory, ArmRecord, AwardExecutor, Closed, ExecutorConfig
from fleet.live.arm.body import SimulatedBody
from fleet.live.arm.estimator import Estimator, NominalPeaks
from fleet.live.arm.node import ArmConfig, ArmNode
from fleet.live.auction.knowledge import LiveFleet
from fleet.live.clock import FleetClock
from fleet.live.consensus import node as node_module
from fleet.live.consensus.node import ConsensusNode, Membership
from fleet.live.journal import Journal
from fleet.live.leases import Timing
from fleet.live.records import BookRecord
from fleet.robot import ThermalLimits
from scenarios.live.arm import refuse_auctioneer
from tests.waiting import PATIENCE_S

SPEED = 120.0
ROSTER = ("arm_0", "arm_1", "arm_2")
FLEET = LiveFleet(arms=ROSTER)
TIMING = Timing(lease_s=1.0, margin_s=0.1, window_s=0.3, pause_s=(0.1, 0.4))
PLACES = {name: Place(name=name, position_m=(0.5, 0.0, 0.2)) for name in ("bench", "rack", "shelf")}


def hold(name: str, place: str = "bench", repetitions: int = 3, **more) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(place,), repetitions=repetitions, **more)


@pytest.fixture
def bus(tmp_path, small):
    """A router, with functions that start, serve and kill arms."""
    with ExitStack() as stack:
        router = stack.enter_context(Router())
        arms: dict[str, SimpleNamespace] = {}
        outsider = stack.enter_context(BusClient(router.endpoint, "f"))
        finished: Counter[str] = Counter()
        outsider.subscribe(
            keys.of_every_arm("f", "event"),
            ArmEvent,
            lambda _, event: finished.update([event.job] if event.kind == "finish" else []),
        )

        def lose_journals(name):
            for kind in ("journal", "grants"):
                (tmp_path / f"{name}.{kind}").unlink()

        def arm(name, *, new_epoch=False, **membership):
            own = small.arm(ROSTER.index(name), [small.work(place) for place in PLACES])
            plans = {(work.kind, work.places[0].name): plans for work, plans in own.plans.items()}
            book = stack.enter_context(Journal(tmp_path / f"{name}.journal", ArmRecord, durable=False))
            grants = stack.enter_context(Journal(tmp_path / f"{name}.grants", BookRecord, durable=False))
            history = ArmHistory().replay(book.records()).after_restart(name, 0.0)
            book.rewrite(*history.compact())
            link = stack.enter_context(BusClient(router.endpoint, "f"))
            body = SimulatedBody(
                own, ThermalLimits(), lambda _: 25.0, dt_s=SPEED / 20, rng=np.random.default_rng(0), warm=False
            )
            member = Membership(fleet=FLEET, choose=Consensus().choose, timing=TIMING, **membership)
            node = ArmNode(
                link,
                body,
                AwardExecutor(name, book.append, history, nonce=str(history.boot), config=ExecutorConfig()),
                Estimator(own.model, lambda work: plans[work.kind, work.places[0].name], PLACES, NominalPeaks()),
                FleetClock(SPEED, time.monotonic()),
                ArmConfig(warning_c=60.0, rate_hz=20.0, boot=history.boot),
                partial(ConsensusNode, membership=member, journal=grants, boot=history.boot, new_epoch=new_epoch),
            )
            arms[name] = SimpleNamespace(node=node, link=link, book=book, grants=grants, work_source=node.work_source)
            return arms[name]

        def serve(condition):
            deadline_s = time.monotonic() + PATIENCE_S
            while not condition():
                if time.monotonic() > deadline_s:
                    return False
                for each in list(arms.values()):
                    each.node.serve(time.monotonic() + 0.005)
                outsider.serve(time.monotonic() + 0.001)
            return True

        def ask(key, request, kind):
            deadline_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline_s:  # no arm may be ready to reply yet
                got = []
                outsider.query(key, request, kind, got.append, timeout_s=PATIENCE_S)
                assert serve(partial(bool, got))
                if got[0].messages:
                    return next(iter(got[0].messages.values()))
                if got[0].refused:
                    return next(iter(got[0].refused.values()))
            raise AssertionError("no arm replies")

        def submit(*jobs):
            return ask(keys.of_jobs("f", "submit"), Submission(jobs), SubmissionReply)

        def kill(name):
            one = arms.pop(name)
            one.link.close()
            one.book.close()
            one.grants.close()

        def done_by_journals():
            done: Counter[str] = Counter()
            for name in [*arms]:
                kill(name)
            for path in tmp_path.glob("*.journal"):
                with Journal(path, ArmRecord) as book:
                    closed = [each.report for each in book.records() if isinstance(each, Closed)]
                done.update(report.job for report in closed if report.outcome == "finished")
            return done

        yield SimpleNamespace(
            arm=arm,
            arms=arms,
            serve=serve,
            ask=ask,
            endpoint=router.endpoint,
            submit=submit,
            kill=kill,
            lose_journals=lose_journals,
            finished=finished,
            done_by_journals=done_by_journals,
        )


def test_a_restarted_arm_knows_its_peers_before_it_replies_for_them(bus, monkeypatch):
    """`arm_0` replies for the fleet, also if the bid of a peer begins the fleet's time of a restarted arm first."""
    for name in ROSTER:
        bus.arm(name)
    assert bus.serve(lambda: all(one.work_source._begun for one in bus.arms.values()))
    bus.kill("arm_2")
    monkeypatch.setattr(node_module, "LISTEN_S", PATIENCE_S)
    restarted = bus.arm("arm_2").work_source
    restarted._begun = True
    with pytest.raises(AnotherReplies):
        restarted._check_first()


def test_an_arm_that_comes_later_takes_the_epoch_of_the_others_though_it_is_the_first_by_name(bus, monkeypatch):
    """And though it gets their replies before a bid."""
    monkeypatch.setattr(node_module, "PATIENCE_S", 0.5)
    for name in ROSTER[1:]:
        bus.arm(name)
    assert bus.serve(lambda: all(one.work_source._begun for one in bus.arms.values()))
    monkeypatch.setattr(ConsensusNode, "_apply_bid", lambda *_: None)
    late = bus.arm(ROSTER[0]).work_source
    assert bus.serve(lambda: late._begun)
    assert {one.work_source._epoch for one in bus.arms.values()} == {late._epoch}


def settled(bus, *names):
    """Return whether every present arm knows that these jobs are finished."""
    return all(all(map(one.work_source.book.is_settled, names)) for one in bus.arms.values())


@pytest.mark.ci_slow
def test_jobs_of_a_common_stream_are_done_until_the_end_of_the_shift_and_others_reported_unfinished(bus):
    stream = ((0.0, hold("brief")), (10.0, hold("later", "shelf")), (0.0, hold("long", "rack", repetitions=10_000)))
    for name in ROSTER:
        bus.arm(name, stream=stream, horizon_s=600.0)
    assert not any(one.work_source.over for one in bus.arms.values())
    assert bus.serve(lambda: all(one.work_source.over for one in bus.arms.values()))
    times = [one.node.clock.now_s(time.monotonic()) for one in bus.arms.values()]
    assert max(times) - min(times) < 0.5 * SPEED
    statuses = {each.job: each for each in bus.arms["arm_0"].work_source.statuses()}
    states = {name: each.state for name, each in statuses.items()}
    assert states == {"brief": "finished", "later": "finished", "long": "unfinished"}
    assert statuses["long"].reason == "The shift ended before it was done."
    assert not any(one.node.executor.active for one in bus.arms.values())
    assert bus.done_by_journals() == Counter(["brief", "later"])


@pytest.mark.ci_slow
def test_an_arm_that_lost_its_journals_does_not_join_unless_a_person_requests_it(bus):
    for name in ROSTER:
        bus.arm(name)
    bus.submit(hold("a"), hold("b", "rack"), hold("long", "shelf", repetitions=2000))
    assert bus.serve(lambda: settled(bus, "a", "b"))
    assert bus.serve(lambda: any(one.node.executor.active for one in bus.arms.values()))
    lost = next(name for name, one in bus.arms.items() if not one.node.executor.active)
    bus.kill(lost)
    bus.lose_journals(lost)
    for name in ROSTER:
        if name != lost:
            bus.kill(name)
    back = bus.arm(lost)  # before the others: it takes part only when it knows what they know
    for name in ROSTER:
        if name != lost:
            bus.arm(name)
    with pytest.raises(BusError, match=r"knows claims of 'arm_\d'.*2 finished job\(s\).*--new-epoch"):
        bus.serve(lambda: back.work_source._begun)
    bus.kill(lost)
    bus.lose_journals(lost)
    back = bus.arm(lost, new_epoch=True)
    assert bus.serve(lambda: back.work_source._begun)
    assert all(map(back.work_source.book.is_settled, "ab"))
    bus.submit(hold("a"), hold("c"))
    assert bus.serve(lambda: settled(bus, "c"))
    bus.kill(lost)
    bus.arm(lost)  # the same journals again
    bus.submit(hold("d", "rack"))
    assert bus.serve(lambda: settled(bus, "d"))
    assert bus.finished == Counter("abcd")


def test_arms_do_not_start_where_an_auctioneer_is_present(bus, token_reaches):
    with BusClient(bus.endpoint, "f") as link, BusClient(bus.endpoint, "f") as other:
        refuse_auctioneer(link)
        other.declare_token(keys.of_auction("f", "boss", "alive"))
        token_reaches(link, keys.of_auction("f", "boss", "alive"))
        with pytest.raises(BusError, match="has an auctioneer: 'boss'"):
            refuse_auctioneer(link)
