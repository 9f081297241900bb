"""Requests of people, in a fleet with an auctioneer and in one without: cancel, settle, change, pause, resume."""

import random
from contextlib import suppress

import pytest

from benchmarks.simulation.participants import AUCTIONEER
from fleet.bus.protocol.auction import Result
from fleet.bus.protocol.operator import Cancel, Change, Operation, Pause, Resume, Settle
from fleet.errors import Refused
from tests.live.simulated import LONG, SimulatedFleet, job, refused


def lose_in_last_cycle(fleet: SimulatedFleet) -> str:
    """Cut an arm off in the last cycle of job a, until the others report it as unfinished; return its name."""
    fleet.until(lambda: bool(fleet.begun))
    arm = fleet.holder("a")
    fleet.cut(arm)
    fleet.until(lambda: fleet.status("a").state == "unfinished")
    return arm


def test_a_waiting_job_is_cancelled_at_once_and_its_followers_are_given_up(fleet):
    waiting = job("a", release_s=1e6)
    fleet.submit(waiting, job("b", after=("a",)))
    reply = fleet.control(Cancel("a"), "one")
    assert (reply.changed, reply.job.state, reply.job.reason) == (True, "cancelled", "Cancelled by 'ann'.")
    fleet.until(lambda: fleet.is_everywhere("a", "cancelled") and fleet.is_everywhere("b", "given_up"))
    assert (fleet.status("a").arm, fleet.status("b").arm) == ("", "")
    for restarted in (False, True):
        if restarted:
            fleet.restart()
        assert not fleet.control(Cancel("a"), "one").changed
        assert not fleet.control(Cancel("a")).changed
        assert fleet.submit(waiting)[0].accepted, "the same job again is no other job"
        assert fleet.is_everywhere("a", "cancelled")
    assert refused(lambda: fleet.control(Cancel("x"))) == "There is no job 'x'."


def test_a_job_at_work_is_cancelled_after_the_cycle_in_progress_also_over_a_restart(fleet):
    fleet.submit(job("a"))
    fleet.until(lambda: fleet.status("a").cycles > 3)
    reply = fleet.control(Cancel("a"), "one")
    assert (reply.changed, reply.job.state, reply.job.repetitions) == (True, "awarded", 100)
    assert "ends the cycle" in reply.note
    fleet.restart(*(() if not fleet.alone else fleet.arms[-1:]))
    fleet.run(1.0)  # before it sees its peers, an arm may take itself for the first, which replies
    assert not fleet.control(Cancel("a"), "one").changed
    fleet.until(lambda: fleet.is_everywhere("a", "cancelled") and not fleet.away)
    assert "a" not in fleet.begun
    fleet.submit(job("b", 2))
    fleet.until(lambda: fleet.is_everywhere("b", "finished"))


@pytest.mark.parametrize("cancels", [True, False])
def test_the_cycle_in_progress_counts_when_a_job_is_stopped(fleet, cancels):
    fleet.submit(job("a", 3, **LONG))
    fleet.until(lambda: bool(fleet.away))
    fleet.run(1.5)
    fleet.control(Cancel("a") if cancels else Pause())
    fleet.run(6.0)
    assert fleet.states("a") == {"awarded"}
    fleet.until(lambda: fleet.is_everywhere("a", "cancelled" if cancels else "waiting"))
    fleet.run(1.0)
    assert {known["a"].cycles for known in fleet.known()} == {1}
    if not cancels:
        fleet.control(Resume())
        fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert fleet.finished == ({} if cancels else {"a": 1})


def test_a_job_in_its_last_cycle_is_finished_in_spite_of_a_cancellation(fleet):
    fleet.submit(job("a", 1, dwell_s=20.0))
    fleet.until(lambda: bool(fleet.begun))
    assert "last cycle" in fleet.control(Cancel("a")).note
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))


def test_an_arm_that_is_cut_off_carries_a_cancellation_out_when_it_is_online_again(fleet):
    fleet.submit(job("a"))
    fleet.until(lambda: bool(fleet.holder("a")))
    arm = fleet.holder("a")
    fleet.cut(arm)
    fleet.control(Cancel("a"))
    fleet.until(lambda: fleet.status("a").state == "cancelled")
    fleet.cut()
    fleet.until(lambda: fleet.is_everywhere("a", "cancelled") and not fleet.node(arm).executor.active)
    assert "a" not in fleet.begun


def test_an_unfinished_job_is_settled_as_done_and_stays_so(fleet):
    fleet.submit(job("a", 1, **LONG))
    lose_in_last_cycle(fleet)
    assert "settle it" in refused(lambda: fleet.control(Cancel("a")))
    fleet.until(lambda: fleet.finished == {"a": 1})  # the arm finishes it, and its report reaches no one yet
    done = fleet.control(Settle("a", "done")).job
    assert (done.state, done.cycles) == ("finished", 1)
    assert not fleet.control(Settle("a", "done")).changed
    assert "finished; only" in refused(lambda: fleet.control(Settle("a", "redo")))
    fleet.cut()
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    fleet.run(3.0)
    assert fleet.states("a") == {"finished"}
    assert fleet.finished == {"a": 1}


@pytest.mark.parametrize("delayed", [False, True])
def test_an_unfinished_job_is_redone_only_after_its_arm_was_stopped_and_cleared(fleet, delayed):
    """With a delay, the late report of the first arm, which is unsure, arrives while the job waits: nothing changes."""
    fleet.submit(job("a", 1, **LONG))
    arm = lose_in_last_cycle(fleet)
    assert f"'{arm}' may still do the last cycle" in refused(lambda: fleet.control(Settle("a", "redo")))
    fleet.move_home(arm)
    fleet.world.processes[arm].kill("is switched off")
    fleet.free_space(arm)
    assert fleet.status("a").state == "unfinished"
    if delayed:
        fleet.control(Pause())
    assert fleet.control(Settle("a", "redo"), "redo").job.state == "waiting"
    fleet.cut()
    fleet.world.processes[arm].start()
    if delayed:
        fleet.run(5.0)
        assert fleet.states("a") == {"waiting"}
        fleet.restart()
        fleet.control(Resume())
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert fleet.finished == {"a": 1}
    assert not fleet.control(Settle("a", "redo"), "redo").changed


def test_a_job_is_not_redone_while_its_arm_is_online_with_it_after_its_space_was_cleared(fleet):
    """Nobody stopped the process of the arm, which is still in the last cycle."""
    fleet.submit(job("a", 1, dwell_s=300.0))
    arm = lose_in_last_cycle(fleet)
    fleet.free_space(arm)
    fleet.cut()
    fleet.run(4.0)
    assert fleet.status("a").state == "unfinished"
    assert f"'{arm}' may still do the last cycle" in refused(lambda: fleet.control(Settle("a", "redo")))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert fleet.finished == {"a": 1}


def test_an_arm_that_is_paused_is_not_said_to_have_a_job(fleet):
    fleet.control(Pause("arm_1"))
    fleet.submit(job("a", **LONG), job("b", **LONG))
    fleet.until(lambda: bool(fleet.holder("a")) and bool(fleet.holder("b")))
    fleet.submit(job("c"))
    fleet.until(lambda: "arm_1 is paused by 'ann'" in fleet.status("c").reason)
    assert "arm_0 has a job" in fleet.status("c").reason


def test_a_paused_arm_gives_its_job_back_and_gets_none_until_it_is_resumed(fleet):
    fleet.submit(job("a", 1000))
    fleet.until(lambda: fleet.status("a").cycles > 3)
    arm = fleet.holder("a")
    assert fleet.control(Pause(arm)).paused == {arm: "ann"}
    second = fleet.control(Pause(arm), by="bob")
    assert (second.changed, second.paused) == (False, {arm: "bob" if fleet.alone else "ann"})
    before = "It was paused by 'ann' before; the latest" if fleet.alone else "Nothing changed: it is paused by 'ann'"
    assert second.note.startswith(before)
    assert [each.note for each in fleet.messages(Operation)] == ["", second.note]
    fleet.control(Pause(arm))
    fleet.restart(*(() if not fleet.alone else fleet.arms[-1:]))
    fleet.until(lambda: fleet.holder("a") not in ("", arm))
    last = fleet.holder("a")
    assert fleet.control(Pause()).paused == {arm: "ann", "*": "ann"}
    assert "All arms are paused" in refused(lambda: fleet.control(Resume(arm)))
    fleet.until(lambda: fleet.is_everywhere("a", "waiting"))
    fleet.submit(job("b"))
    fleet.run(3.0)
    assert {known["b"].reason for known in fleet.known()} == {"All arms are paused by 'ann'."}
    for restarted in (False, True):
        if restarted:
            fleet.restart()
            fleet.run(2.0)
        assert not fleet.holder("a")
        assert {known["a"].arm for known in fleet.known()} == {last}
        assert all(known["a"].reason.endswith(" paused by 'ann'.") for known in fleet.known())
    assert fleet.control(Resume()).paused == {}
    fleet.until(lambda: bool(fleet.holder("a")))
    assert "no arm 'x'" in refused(lambda: fleet.control(Pause("x")))
    fleet.control(Cancel("a"))
    fleet.until(lambda: fleet.is_everywhere("a", "cancelled"))
    assert all(known["a"].arm for known in fleet.known())


def test_due_date_and_value_change_and_the_job_stays_the_same_to_its_submitter(fleet):
    before = job("a", release_s=1e6, due_s=2e6, expires=True)
    fleet.submit(before)
    fleet.control(Change("a", due_s=3e6))
    fleet.control(Change("a", value=7.0))
    assert "due_s must be >= release_s" in refused(lambda: fleet.control(Change("a", due_s=5.0)))
    assert "value must be between" in refused(lambda: fleet.control(Change("a", value=-1.0)))
    fleet.run(3.0)
    for restarted in (False, True):
        if restarted:
            fleet.restart()
            fleet.run(2.0)
        assert {(known["a"].due_s, known["a"].value) for known in fleet.known()} == {(3e6, 7.0)}
        assert fleet.submit(before)[0].accepted


def test_a_changed_due_date_decides_when_a_job_expires(fleet):
    late = {"expires": True, "release_s": 400.0}
    fleet.submit(*(job(name, due_s=500.0, **late) for name in "abc"))
    fleet.control(Pause())
    fleet.control(Change("a", due_s=450.0))
    fleet.control(Change("b", due_s=None))
    clock = fleet.world.now_s
    fleet.run(47.0 - clock)
    fleet.until(lambda: fleet.is_everywhere("a", "given_up"))
    assert fleet.states("b") == fleet.states("c") == {"waiting"}
    fleet.until(lambda: fleet.is_everywhere("c", "given_up"))
    assert fleet.states("b") == {"waiting"}


@pytest.mark.parametrize("restarts", [0, 2])
def test_the_name_of_a_request_stands_for_one_request(fleet, restarts):
    """Also after restarts from records and from a snapshot."""
    fleet.submit(job("a", release_s=1e6), job("b", release_s=1e6))
    fleet.control(Cancel("a"), "one")
    for _ in range(restarts):
        fleet.restart()
        fleet.run(2.0)
    same = fleet.control(Cancel("a"), "one")
    assert (same.changed, same.note, same.job.state) == (False, "This request was carried out before.", "cancelled")
    for other in (Cancel("b"), Change("a", value=2.0), Pause()):
        assert "Another request of the name 'one'" in refused(lambda other=other: fleet.control(other, "one"))
    why = refused(lambda: fleet.control(Cancel("a"), "one", by="bob"))
    assert (
        """its action or `by` differs (got {"request":"one","action":{"action":"cancel","job":"a"},"by":"bob"})"""
        in why
    )
    assert fleet.status("b").state == "waiting"
    assert fleet.control(Cancel("b"), "two").changed


def test_every_request_is_published_once_by_each_that_records_it(fleet):
    fleet.submit(job("a", release_s=1e6))
    fleet.control(Pause(), "1")
    fleet.control(Cancel("a"), "2")
    fleet.control(Cancel("a"), "2")
    fleet.run(2.0)
    published = fleet.messages(Operation)
    assert sorted(each.request.request for each in published) == ["1", "2"]
    assert {each.request.by for each in published} == {"ann"}
    if not fleet.alone:
        fleet.restart()
        assert fleet.control(Resume(), "3").changed
        fleet.run(2.0)
        numbers = {each.request.request: each.number for each in fleet.messages(Operation)}
        assert numbers == {"1": 0, "2": 1, "3": 2}, "published again after the restart, with the same numbers"


@pytest.mark.parametrize("seed", range(2))
def test_a_result_has_what_the_status_of_that_moment_has(fleet_of, seed):
    fleet, compared = fleet_of(False, seed=seed), []
    record = fleet.world.bus.on_publish

    def compare(publisher, message):
        record(publisher, message)
        auctioneer = fleet.node(AUCTIONEER) and fleet.node(AUCTIONEER).auctioneer
        if isinstance(message, Result) and auctioneer and message.number == auctioneer.book.number - 1:
            (now,) = auctioneer.status((message.status.job,))
            compared.append(message.number)
            fields = ("cycles", "arm", "due_s", "value", "state")
            assert [getattr(message.status, name) for name in fields] == [getattr(now, name) for name in fields]

    fleet.world.bus.on_publish = compare
    rng = random.Random(seed)
    fleet.submit(*(job(f"j{i}", rng.randint(1, 30), due_s=500.0 + i, value=3.0) for i in range(4)))
    actions = [
        Cancel("j0"),
        Pause("arm_0"),
        Resume(),
        Change("j1", value=9.0),
        Change("j2", due_s=None),
        Settle("j3", "done"),
    ]
    for step in range(12):
        fleet.run(rng.uniform(0.2, 2.0))
        with suppress(Refused):
            fleet.control(rng.choice(actions))
        if step % 5 == 4:
            fleet.restart()
    assert len(compared) > 8
