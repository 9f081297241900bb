"""Which arm gets which job in a fleet without an auctioneer: choices of arms by their policies, grants, epochs."""

import random
import re
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import islice

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from agents.auction import Consensus
from agents.registry import RULES
from benchmarks.simulation.machine import SimulatedEstimator
from benchmarks.simulation.participants import CLIENT, simulated_system
from benchmarks.simulation.simulated_fleet import FIRST
from fleet.bus.client import AnotherReplies
from fleet.bus.protocol.auction import Ack, Award, Status, StatusRequest
from fleet.bus.protocol.keys import of_arm, of_jobs
from fleet.bus.protocol.operator import Pause, Settle
from fleet.errors import BusError
from fleet.live.consensus.node import ConsensusNode
from fleet.live.space import ANYWHERE
from scenarios.live.arm import refuse_auctioneer
from tests.live.simulated import LONG, SPEED, SimulatedFleet, job, refused
from tests.profiles import examples

ARM_POLICIES = [name for name, rule in RULES.items() if rule.scope == "arm"]


def offers(arm: str, jobs: list) -> dict[str, float]:
    """Difficulty of each job that an arm can do."""
    estimates = SimulatedEstimator(arm, FIRST).estimate(tuple(jobs), None, 0.0, {})
    return {each.job: each.least.difficulty for each in estimates if each.feasible}


def greedy(difficulty: dict[str, dict[str, float]], able: list[str]) -> dict[str, str | None]:
    """Assign the pair with the least difficulty relative to the average of the job first, to able arms only."""
    pairs = []
    for name in sorted({name for row in difficulty.values() for name in row}):
        scores = {arm: row[name] for arm, row in difficulty.items() if name in row}
        average = sum(scores.values()) / len(scores)
        pairs += [(score - average, name, arm) for arm, score in scores.items() if arm in able]
    out: dict[str, str | None] = {}
    for _, name, arm in sorted(pairs):
        if arm not in out and name not in out.values():
            out[arm] = name
    return {arm: out.get(arm) for arm in able}


@example(29830, 2, 1)  # the bid of one arm came later than the other had chosen
@example(15098, 5, 3)  # an arm chose by a bid of a peer from before the grant to that peer
@example(118385827, 2, 2)  # so did that of a faulted arm, by which its peer knows how well each job suits it
@examples(8)
@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 4))
def test_without_message_loss_the_allocation_is_that_of_a_central_policy(seed, arms, jobs):
    """The first job of every arm, where every job has a separate station; some arms are faulted."""
    rng, jobs = random.Random(seed), [job(f"job {seed} {number}", 400, release_s=60.0) for number in range(jobs)]
    fleet = SimulatedFleet(True, arms, seed=seed, choose=Consensus().choose)
    with simulated_system(fleet.world):
        fleet.start()
        faulted = rng.sample(fleet.arms, rng.randrange(arms))
        for arm in faulted:
            fleet.fault(arm, 1e3)
        fleet.submit(*jobs)
        fleet.run(8.0)
        able = [arm for arm in fleet.arms if arm not in faulted]
        has = {active.job: arm for arm in able for active in fleet.node(arm).executor.active}
        wanted = greedy({arm: offers(arm, jobs) for arm in fleet.arms}, able)
        assert has == {name: arm for arm, name in wanted.items() if name}


@pytest.mark.parametrize("name", ARM_POLICIES)
@examples(2)
@given(seed=st.integers(0, 2**32), jobs=st.integers(1, 5))
def test_every_arm_policy_completes_all_jobs(name, seed, jobs):
    rng = random.Random(seed)
    fleet = SimulatedFleet(True, 3, seed=seed, choose=RULES[name].kind().choose)
    with simulated_system(fleet.world):
        fleet.start()
        names = [f"job {number}" for number in range(jobs)]
        fleet.submit(*(job(each, 2, place=rng.choice("xyz")) for each in names))
        fleet.until(lambda: all(fleet.is_everywhere(each, "finished") for each in names), 120.0)
        assert fleet.finished == dict.fromkeys(names, 1)


def second_plan(observation, arm: int) -> int:
    """Claim the second plan of the job of the slot with the number of the arm, where that is legal."""
    option, legal = 2 * arm + 1, observation.action_mask[1:-1]
    return option + 1 if option < len(legal) and legal[option] else 0


def both_second(arm: str, space: str, other: str, other_space: str) -> bool:
    return space.endswith(":1") and other_space.endswith(":1")


def drop_choice(handle, arm: str, bid) -> None:
    if not bid.choice:
        handle(arm, bid)


def test_an_award_has_the_time_at_which_it_was_granted(fleet_of):
    """Not that of the last record before it."""
    fleet = fleet_of(True)
    fleet.submit(job("a", 1, release_s=200.0))
    fleet.until(lambda: len(fleet.finished) == 1)
    times = {each.status.state: each.time_s for arm in fleet.arms for each in fleet.node(arm).work_source.book.recent}
    assert 200.0 <= times["awarded"] <= times["finished"]


def offered(arm: str, name: str) -> tuple:
    return SimulatedEstimator(arm, FIRST).plans(job(name))


@pytest.mark.parametrize("seed", range(2))
def test_a_claim_covers_the_space_of_the_plan_that_was_chosen(fleet_of, seed):
    """No arm receives the choice of another: the grants alone keep two second plans apart, which exclude each other."""
    fleet = fleet_of(True, choose=second_plan, excludes=both_second, seed=seed)
    fleet.world.late_s, fleet.world.base_s = 0.0, 1e-4  # all arms claim at the same time
    for client in fleet.world.bus.clients.values():
        for each in client.subscriptions:
            if "/bid" in each.expression:
                each.handle = partial(drop_choice, each.handle)
    names = (f"j{number}" for number in range(1000))
    of_two_plans = (n for n in names if all(len(offered(arm, n)) == 2 for arm in fleet.arms))
    fleet.submit(*(job(name, 3, release_s=30.0) for name in islice(of_two_plans, 3)))
    fleet.until(lambda: len(fleet.finished) == 3)


def test_an_isolated_arm_does_not_report_that_all_jobs_are_settled(fleet_of):
    """Not even if the only open job is one that another arm was permitted to commit."""
    fleet = fleet_of(True)
    fleet.submit(job("a", 1, dwell_s=300.0))
    fleet.until(lambda: bool(fleet.begun))
    isolated = next(arm for arm in fleet.arms if arm != fleet.holder("a"))
    fleet.cut(isolated)
    fleet.run(15.0)
    participant = fleet.node(isolated).work_source.participant
    real_s = fleet.world.processes[isolated].real_s
    assert participant.open_jobs() == []
    assert not participant.all_settled(real_s)


def test_an_auctioneer_may_not_award_jobs_to_such_an_arm(fleet_of):
    fleet = fleet_of(True)
    award = Award("w", "r", "x", "q", job("a"))
    assert "allocate jobs together with my peers" in refused(
        lambda: fleet.ask(of_arm("f", "arm_0", "award"), award, Ack)
    )


# Starts, restarts and ends


def begun(fleet: SimulatedFleet, *arms: str) -> bool:
    return all(fleet.node(arm).work_source._begun for arm in arms or fleet.arms)


def test_an_arm_does_not_start_where_an_auctioneer_is_present(fleet):
    link = fleet.world.processes[CLIENT].client
    with nullcontext() if fleet.alone else pytest.raises(BusError, match="has an auctioneer: 'auctioneer'"):
        refuse_auctioneer(link)


def test_a_restarted_arm_knows_its_peers_before_it_replies_for_them(fleet_of):
    """`arm_0` replies for the fleet, also if the bid of a peer begins the fleet's time of a restarted arm first."""
    fleet = fleet_of(True)
    fleet.until(lambda: begun(fleet))
    fleet.restart("arm_2")
    restarted = fleet.node("arm_2").work_source
    assert not restarted._tokens
    restarted._begun = True

    def check() -> None:
        with pytest.raises(AnotherReplies):
            restarted._check_first()

    fleet.call("arm_2", check)


def test_an_arm_that_comes_later_takes_the_epoch_of_the_others_though_it_is_the_first_by_name(fleet_of, monkeypatch):
    """And though its first request to them is lost, and it gets their replies to the next one before a bid."""
    fleet = fleet_of(True, only=("arm_1", "arm_2"))
    fleet.until(lambda: begun(fleet, "arm_1", "arm_2"))
    monkeypatch.setattr(ConsensusNode, "_apply_bid", lambda *_: None)
    with monkeypatch.context() as first:
        first.setattr(fleet.world, "send", fleet.world.send)
        fleet.lose("history")
        fleet.world.processes["arm_0"].start()
    fleet.until(lambda: begun(fleet, "arm_0"))
    assert len({fleet.node(arm).work_source.book.epoch for arm in fleet.arms}) == 1


def test_jobs_of_a_common_stream_are_done_until_the_end_of_the_shift_and_others_reported_unfinished(fleet_of):
    stream = ((0.0, job("brief", 3)), (10.0, job("later", 3)), (0.0, job("long", 10_000)))
    fleet = fleet_of(True, stream=stream, horizon_s=600.0)

    def over() -> list[bool]:
        ends: list[bool] = []
        for arm in fleet.arms:
            fleet.call(arm, lambda arm=arm: ends.append(fleet.node(arm).work_source.over))
        return ends

    assert not any(over())
    fleet.until(lambda: all(over()), 120.0)
    times_s = [fleet.node(arm).clock.now_s(fleet.world.processes[arm].real_s) for arm in fleet.arms]
    assert max(times_s) - min(times_s) < 0.5 * SPEED
    for known in fleet.known():
        assert {name: each.state for name, each in known.items()} == {
            "brief": "finished",
            "later": "finished",
            "long": "unfinished",
        }
        assert known["long"].reason == "The shift ended before it was done."
    assert not any(fleet.node(arm).executor.active for arm in fleet.arms)
    assert fleet.finished == {"brief": 1, "later": 1}


def test_an_arm_that_lost_its_journals_does_not_join_unless_a_person_requests_it(fleet_of):
    fleet = fleet_of(True)
    processes, trace = fleet.world.processes, list[str]()
    fleet.submit(job("a", 2), job("b", 2), job("long", 2000))
    fleet.until(lambda: all(fleet.is_everywhere(name, "finished") for name in "ab") and bool(fleet.holder("long")))
    lost = next(arm for arm in fleet.arms if arm != fleet.holder("long"))
    for arm in fleet.arms:
        processes[arm].kill("is killed")
    processes[lost].disk.names.clear()
    fleet.world.bus.on_publish = lambda *_: None  # its events begin their numbers again
    fleet.world.trace = trace
    for arm in sorted(fleet.arms, key=lambda arm: arm != lost):  # it takes part only when it knows what they know
        processes[arm].start()
    fleet.until(lambda: not processes[lost].up)
    assert re.search(r"exits: 'arm_\d' knows claims of 'arm_\d'.*2 finished job\(s\).*--new-epoch", "\n".join(trace))
    processes[lost].disk.names.clear()
    fleet.builders[lost].new_epoch = True
    processes[lost].start()
    fleet.until(lambda: begun(fleet, lost))
    assert all(map(fleet.node(lost).work_source.book.is_settled, "ab"))
    fleet.submit(job("a", 2), job("c", 2))
    fleet.until(lambda: fleet.is_everywhere("c", "finished"))
    fleet.builders[lost].new_epoch = False
    fleet.restart(lost)  # with the same journals again
    fleet.submit(job("d", 2))
    fleet.until(lambda: fleet.is_everywhere("d", "finished"))
    assert fleet.finished == dict.fromkeys("abcd", 1)


# Journals that are lost or older, and the last cycle


def lose_files(fleet: SimulatedFleet, arm: str, prefix: str = "") -> None:
    """Remove the files of a killed arm whose names begin so; its events begin their numbers again."""
    disk = fleet.world.processes[arm].disk
    disk.names = {name: file for name, file in disk.names.items() if not name.startswith(prefix)}
    disk._durable = dict(disk.names)
    fleet.world.bus.on_publish = lambda *_: None


def killed_in_last_cycle(fleet: SimulatedFleet) -> str:
    """Return the arm that was killed in the last cycle of job a, which this submits."""
    fleet.submit(job("a", 1, **LONG))
    return killed(fleet)


def killed(fleet: SimulatedFleet) -> str:
    """Return the arm that was killed in the last cycle of the only job."""
    fleet.until(lambda: bool(fleet.begun))
    (arm,) = fleet.away
    fleet.world.processes[arm].kill("is killed")
    return arm


@pytest.mark.parametrize("absent_s", [0.0, 6.0])
def test_a_last_cycle_is_not_begun_again_if_its_arm_lost_only_its_awards(fleet_of, absent_s):
    fleet = fleet_of(True)
    arm = killed_in_last_cycle(fleet)
    lose_files(fleet, arm, "awards")
    fleet.run(absent_s)
    fleet.world.processes[arm].start()
    fleet.run(30.0)
    assert (fleet.begun, fleet.states("a")) == ({"a": 1}, {"unfinished"})


@pytest.mark.parametrize("next_fault", ["none", "crash", "cut"])
@pytest.mark.parametrize("absent_s", [0.0, 6.0])
def test_a_last_cycle_is_not_begun_again_if_its_arm_lost_all_journals(fleet_of, absent_s, next_fault):
    """Also if its second claim after the start with `new_epoch` reaches nobody."""
    fleet = fleet_of(True)
    arm = killed_in_last_cycle(fleet)
    lose_files(fleet, arm)
    fleet.run(absent_s)
    fleet.builders[arm].new_epoch = True
    fleet.world.processes[arm].start()

    def claims():
        return fleet.node(arm) and fleet.node(arm).work_source.participant.claimant._sent

    assert fleet.world.run(fleet.world.now_s + 10.0, claims)
    if next_fault == "crash":
        fleet.world.processes[arm].kill("is killed again")
    elif next_fault == "cut":
        fleet.world.after(0.001, fleet.cut, arm)
    fleet.run(30.0)
    assert (fleet.begun, fleet.states("a")) == ({"a": 1}, {"unfinished"})


@pytest.mark.parametrize("is_copy", [True, False])
def test_an_arm_without_the_journals_that_its_peers_know_is_refused_at_every_start(fleet_of, is_copy):
    """A refused start is counted in its journal, too; with a new epoch it needs no further request."""
    fleet = fleet_of(True)
    process = fleet.world.processes["arm_2"]
    fleet.until(lambda: begun(fleet, *fleet.arms))
    process.kill("is stopped")
    copy = process.disk.copy() if is_copy else {}
    process.start()
    fleet.until(lambda: begun(fleet, *fleet.arms))
    process.kill("is stopped")
    process.disk.restore(copy)
    for _ in range(3):
        process.start()
        fleet.run(3.0)
        assert not process.up
    for new_epoch in (True, False):
        fleet.builders["arm_2"].new_epoch = new_epoch
        process.kill("is stopped")
        process.start()
        fleet.until(lambda: process.node.work_source._joined)


@pytest.mark.parametrize("is_copy", [True, False])
@pytest.mark.parametrize("repeats", [True, False])
def test_a_new_epoch_begins_with_unknown_positions_until_each_peer_repeats_its_claim(fleet_of, is_copy, repeats):
    """All peers were at home when the journals were copied, and one has left since."""
    fleet = fleet_of(True)
    process = fleet.world.processes["arm_2"]
    fleet.until(lambda: begun(fleet, *fleet.arms))
    process.kill("is stopped")
    copy = process.disk.copy() if is_copy else {}
    fleet.submit(job("a", 400))
    fleet.until(lambda: bool(fleet.away))
    process.start()
    fleet.run(5.0)  # it replies to the last claims of its peers
    fleet.forget("arm_2")
    process.kill("is stopped")
    process.disk.restore(copy)
    if not repeats:
        fleet.lose("claim")
    fleet.builders["arm_2"].new_epoch = True
    process.start()
    fleet.until(lambda: process.node.work_source._joined)
    fleet.run(3.0)
    spaces = fleet.node("arm_2").work_source.book.taken_space()
    away = {frozenset([space]) for space in fleet.away.values()}
    expected = {frozenset(), *away} if repeats else {frozenset([ANYWHERE])}
    assert {spaces[arm] for arm in ("arm_0", "arm_1")} == expected


@pytest.mark.parametrize("witness_first", [True, False])
def test_a_restored_copy_of_a_granter_from_before_its_last_start_is_noticed(fleet_of, witness_first):
    """By the peer that has forgotten all but the first claim of that start."""
    fleet = fleet_of(True, trace=True)
    processes = fleet.world.processes
    fleet.submit(job("a", 1, release_s=100.0, **LONG))
    fleet.run(3.0)
    *others, witness = fleet.arms
    for arm in others:
        processes[arm].kill("is stopped")
    copies = {arm: processes[arm].disk.copy() for arm in others}
    for arm in others:
        processes[arm].start()
    fleet.run(2.0)
    processes[witness].kill("is killed")
    fleet.until(lambda: bool(fleet.begun))
    (holder,) = fleet.away
    (granter,) = {*others} - {holder}
    fleet.cut(holder)
    processes[granter].kill("is killed")
    processes[granter].disk.restore(copies[granter])
    fleet.run(8.0)
    for arm in (witness, granter) if witness_first else (granter, witness):
        processes[arm].start()
        fleet.run(3.0)
    fleet.run(40.0)
    assert fleet.logged("'arm_2' knows claims of")
    assert (processes[granter].up, fleet.begun) == (False, {"a": 1})


@pytest.mark.parametrize("new_epoch", [False, True])
def test_an_arm_that_lost_its_grants_does_not_take_the_epoch_from_a_minority(fleet_of, new_epoch):
    """Else it would join without the jobs that it has lost: `arm_4` knows the epoch, but no claim of `arm_0`."""
    fleet = fleet_of(True, 5, trace=True, only=("arm_1", "arm_2", "arm_3", "arm_4"))
    processes = fleet.world.processes
    fleet.until(lambda: begun(fleet, "arm_1", "arm_2", "arm_3", "arm_4"))
    processes["arm_4"].kill("is stopped")
    processes["arm_0"].start()
    fleet.run(5.0)
    processes["arm_3"].kill("is stopped")
    fleet.run(3.0)
    fleet.submit(job("a", 1))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    for arm in ("arm_0", "arm_1", "arm_2"):
        processes[arm].kill("is stopped")
    lose_files(fleet, "arm_0", "grants")
    fleet.builders["arm_0"].new_epoch = new_epoch
    processes["arm_4"].start()
    fleet.run(3.0)
    processes["arm_0"].start()
    fleet.run(5.0)
    assert not fleet.node("arm_0").work_source.book.epoch
    processes["arm_1" if new_epoch else "arm_3"].start()
    if new_epoch:
        fleet.until(lambda: begun(fleet, "arm_0", "arm_1", "arm_4"))
        assert fleet.node("arm_0").work_source.book.is_settled("a")
        assert "finished already" in fleet.submit(job("a", 1))[0].reason
    else:
        fleet.until(lambda: not processes["arm_0"].up)
        assert fleet.logged("exits: 'arm_3' knows claims of 'arm_0' that its journals do not")
    assert fleet.begun == {"a": 1}


@pytest.mark.parametrize("outcome", ["done", "redo"])
@pytest.mark.parametrize("cleared", ["never", "before", "after"])
def test_a_job_lost_in_its_last_cycle_is_settled_at_an_arm_that_was_cut_off_meanwhile(fleet_of, cleared, outcome):
    """At first that arm requests the job itself; its peer names the arm that has permission to commit."""
    fleet = fleet_of(True)
    fleet.submit(job("a", 1, release_s=80.0, **LONG))
    fleet.run(3.0)
    fleet.cut("arm_0")
    arm = killed(fleet)
    fleet.move_home(arm)
    fleet.run(8.0)
    if cleared == "before":
        fleet.free_space(arm)
    fleet.cut()
    fleet.run(20.0)
    assert fleet.is_everywhere("a", "unfinished")
    if cleared != "after" and outcome == "redo":
        assert "may still do the last cycle" in refused(lambda: fleet.control(Settle("a", outcome)))
    if cleared == "after" or outcome == "redo":
        fleet.free_space(arm)
    fleet.begun.clear()
    fleet.control(Settle("a", outcome))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert fleet.begun == ({} if outcome == "done" else {"a": 1})


@pytest.mark.parametrize("compacted", [False, True])
def test_an_arm_does_not_start_with_journals_of_a_fleet_of_other_arms(fleet_of, compacted):
    """A majority of five arms may have no arm in common with a majority of the three before."""
    fleet = fleet_of(True, trace=True)
    fleet.submit(*(job(f"job {number}", 2, value=1.0) for number in range(20 if compacted else 1)))
    fleet.until(lambda: fleet.is_everywhere("job 0", "finished"))
    builder, process = fleet.builders["arm_0"], fleet.world.processes["arm_0"]
    three = builder.membership
    builder.membership = replace(three, fleet=replace(three.fleet, arms=(*fleet.arms, "arm_3", "arm_4")))
    fleet.restart("arm_0")
    assert not process.up
    (line,) = fleet.logged("exits")
    assert "are of a fleet of the arms arm_0, arm_1, arm_2, not of arm_0, arm_1, arm_2, arm_3, arm_4" in line
    builder.membership = three
    process.start()
    fleet.until(lambda: begun(fleet, "arm_0"))


def test_without_a_majority_no_job_is_accepted(fleet_of):
    """Both sides of a cut could accept a job of one name, and only one of these would be done."""
    fleet = fleet_of(True)
    fleet.world.split({"arm_2": 1, CLIENT: 1})
    fleet.run(12.0)
    here, there = (job("a", 2, place=place, release_s=1000.0) for place in ("here", "there"))
    reason = "1 of 3 arms present: a majority, 2, is needed. Submit it again then."
    assert refused(lambda: fleet.submit(here)) == reason
    assert fleet.known() == [{}, {}, {}]
    fleet.world.split({"arm_2": 1})
    assert fleet.submit(there)[0].accepted
    fleet.cut()
    fleet.until(lambda: fleet.is_everywhere("a", "waiting"))
    assert not fleet.submit(here)[0].accepted


def test_a_job_that_the_first_arm_refuses_is_kept_by_no_other_arm(fleet_of):
    """Another one knows what it waits for, and would accept it."""
    fleet = fleet_of(True)
    fleet.run(12.0)
    fleet.cut("arm_2")
    fleet.node("arm_2").work_source.participant.granter.add_jobs([job("a", release_s=1e6)])
    fleet.world.split({})
    assert fleet.submit(job("b", after=("a",), release_s=1e6))[0].reason.startswith(
        "It waits for 'a', which is unknown"
    )
    fleet.until(lambda: fleet.is_everywhere("a", "waiting"))
    assert "b" not in {name for known in fleet.known() for name in known}


def test_an_arm_that_restarts_without_a_majority_replies_to_clients_and_neither_claims_nor_grants(fleet_of):
    fleet = fleet_of(True, 5)
    fleet.submit(job("a", 1, release_s=1000.0))
    for arm in fleet.arms[2:]:
        fleet.world.processes[arm].kill("is killed")
    fleet.run(12.0)
    fleet.restart("arm_0")
    fleet.run(5.0)
    assert fleet.status("a").state == "waiting"
    assert not fleet.node("arm_0").work_source.participant.claimant._sent
    fleet.world.processes["arm_2"].start()
    fleet.until(lambda: bool(fleet.node("arm_0").work_source.participant.claimant._sent))


def status_of(fleet: SimulatedFleet) -> Status:
    return fleet.ask(of_jobs("f", "status"), StatusRequest(), Status)


def test_the_first_arms_of_a_fleet_say_that_they_are_too_few():
    """Before a majority has begun the fleet's time, clients get the reason instead of no reply."""
    fleet = SimulatedFleet(True, 4)
    with simulated_system(fleet.world):
        for name in (CLIENT, "arm_1", "arm_2"):
            fleet.world.processes[name].start()
        fleet.run(12.0)
        reason = "2 of 4 arms present: a majority, 3, is needed."
        reply = status_of(fleet)
        assert (reply.auctioneer, reply.trouble, reply.time_s) == ("arm_1", reason, 0.0)
        assert refused(lambda: fleet.submit(job("a", 1))) == f"{reason} Submit it again then."
        assert refused(lambda: fleet.control(Pause("arm_1"))) == f"{reason} Ask again then."
        fleet.world.processes["arm_0"].start()
        fleet.until(lambda: begun(fleet, "arm_0"))
        assert status_of(fleet).trouble == ""
        assert fleet.submit(job("a", 1))[0].accepted


def names_at(fleet: SimulatedFleet) -> list[int]:
    """Number of jobs that each arm knows."""
    return [len(jobs) for jobs in fleet.known()]


@pytest.mark.parametrize("loses_claims", [False, True])
def test_every_arm_gets_all_jobs_of_a_submission(fleet_of, loses_claims):
    """Also those that have no room in a bid, by which they would be noticed as missing, or in one claim."""
    fleet = fleet_of(True)
    fleet.run(12.0)
    send = fleet.world.send
    if loses_claims:
        fleet.lose("claim")
    assert all(each.accepted for each in fleet.submit(*(job(f"job {k}", release_s=1e6) for k in range(100))))
    fleet.run(2.0)
    assert names_at(fleet)[1:] == [0, 0] or not loses_claims
    fleet.world.send = send
    fleet.run(10.0)
    fleet.world.processes["arm_0"].kill("is destroyed")
    assert names_at(fleet) == [100, 100]


def test_an_arm_whose_journal_is_full_renews_leases_whatever_jobs_are_submitted(fleet_of):
    fleet = fleet_of(True)
    fleet.run(12.0)
    fleet.submit(job("long", 2, dwell_s=300.0))
    fleet.until(lambda: bool(fleet.holder("long")))
    holder = fleet.holder("long")
    full, absent = (fleet.world.processes[arm] for arm in fleet.arms if arm != holder)
    absent.kill("is stopped")
    full.disk.full = True
    for number in range(40):
        fleet.submit(job(f"job {number}", release_s=1e6))
        fleet.run(0.4)
        assert fleet.holder("long") == holder


def test_the_first_arm_accepts_and_carries_out_nothing_before_it_has_joined(fleet_of):
    """With an older copy of its journals it would accept a job of a name that is taken."""
    fleet = fleet_of(True)
    process = fleet.world.processes["arm_0"]
    fleet.until(lambda: begun(fleet, *fleet.arms))
    process.kill("is stopped")
    copy = process.disk.copy()
    process.start()
    fleet.submit(job("a", 1))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    before = fleet.status("a")
    process.kill("is stopped")
    fleet.forget("arm_0")
    process.disk.restore(copy)
    fleet.builders["arm_0"].new_epoch = True
    process.start()
    fleet.run(1.0)
    reason = (
        "'arm_0' has not joined: a majority has to reply what it knows; with --new-epoch, a lease has to end first."
    )
    assert status_of(fleet).trouble == reason
    assert refused(lambda: fleet.submit(job("a", 2, place="elsewhere"))) == f"{reason} Submit it again then."
    assert refused(lambda: fleet.control(Pause("arm_1"))) == f"{reason} Ask again then."
    fleet.until(lambda: process.node.work_source._joined)
    fleet.run(10.0)
    assert not fleet.submit(job("a", 2, place="elsewhere"))[0].accepted
    assert {(known["a"].arm, known["a"].award, known["a"].finished_s) for known in fleet.known()} == {
        (before.arm, before.award, before.finished_s)
    }
