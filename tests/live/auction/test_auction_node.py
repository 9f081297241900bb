"""An auctioneer in simulated time: what it logs, its journal, lost journals, rivals and a full disk."""

import re
from copy import deepcopy
from functools import partial
from typing import Any

import pytest
from msgspec.structs import replace

from benchmarks.simulation.participants import AUCTIONEER, CLIENT
from fleet.bus.client import AnotherReplies, Replies
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    JobSpec,
    Lease,
    LeaseEntry,
    LeaseRequest,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
    Submission,
    SubmissionReply,
)
from fleet.bus.protocol.consensus import History
from fleet.bus.protocol.keys import HISTORY
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import ControlRequest, Operation, Pause, Settle
from fleet.errors import JournalFull, Refused
from fleet.live.auction import node as auction_node
from fleet.live.auction.auctioneer import Auctioneer
from fleet.live.auction.node import HOLD_S, AuctionNode
from fleet.live.book import JobBook
from fleet.live.epochs import adopted, kept_time_s
from fleet.live.journal import EpochBegun, JobsAccepted, Journal
from tests.live.simulated import LONG, SPEED, TIMING, SimulatedFleet, job, refused

STATUS = keys.of_jobs("f", "status")


@pytest.fixture
def one(fleet_of: Any) -> SimulatedFleet:
    """One arm and an auctioneer, whose log is traced."""
    return fleet_of(alone=False, arms=1, trace=True)


def boss(fleet: SimulatedFleet) -> Any:
    """The auctioneer."""
    return fleet.node(AUCTIONEER)


def within(fleet: SimulatedFleet, call: Any, process: str = AUCTIONEER) -> Any:
    """Call a function as the auctioneer does; return its result."""
    results: list[Any] = []
    fleet.call(process, lambda: results.append(call()))
    return results[0]


def lose_journal(fleet: SimulatedFleet) -> None:
    """End the auctioneer without its journal: its grants are not known, and its results are numbered anew."""
    fleet.world.processes[AUCTIONEER].kill("is killed")
    fleet.world.processes[AUCTIONEER].disk.names.clear()
    fleet.world.after_run = fleet.world.bus.on_publish = lambda *_: None


def restore(fleet: SimulatedFleet, copy: Any) -> None:
    """Give the auctioneer an older copy of its journal."""
    lose_journal(fleet)
    fleet.world.processes[AUCTIONEER].disk.names = deepcopy(copy)
    fleet.auctioneer()


def begun_after_copy(fleet_of: Any, spec: JobSpec) -> tuple[SimulatedFleet, Any, str]:
    """A fleet, a copy of the auctioneer's journal in which a job waits, and the arm that has left home for it."""
    fleet = fleet_of(alone=False, only=(AUCTIONEER,))
    fleet.submit(spec)
    copy = deepcopy(fleet.world.processes[AUCTIONEER].disk.names)
    for arm in fleet.arms:
        fleet.world.processes[arm].start()
    fleet.until(lambda: bool(fleet.away))
    (arm,) = fleet.away
    return fleet, copy, arm


def of_arm(fleet: SimulatedFleet) -> list[str]:
    """What the auctioneer has logged about the arm."""
    return fleet.logged("Arm 'arm_0' ")


def malformed(quote):
    raise Refused("Not a thermofleet.Quote.v4: Expected `float` >= 0")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda quote: replace(quote, auction="x"), "quoted for another round"),
        (malformed, "gave no valid quote: Not a thermofleet.Quote"),
        (lambda quote: replace(quote, estimates=()), "did not quote"),
    ],
)
def test_what_is_wrong_with_a_quote_is_logged_once_and_is_the_reason_of_the_job(one, change, says):
    one.intercept("arm_0", "quote", lambda request, reply_to: change(reply_to(request)))
    one.submit(job("a"))
    one.until(lambda: says in one.status("a").reason)
    one.run(3.0)
    (line,) = of_arm(one)
    assert says in line


def test_an_arm_without_valid_quotes_is_named_in_the_status_until_it_gives_one(one):
    bad = [True]
    one.intercept("arm_0", "quote", lambda request, reply_to: (malformed if bad[0] else replace)(reply_to(request)))
    one.submit(job("a", 200))
    one.until(lambda: "gave no valid quote: Not a" in boss(one)._left_out().get("arm_0", ""))
    bad[0] = False
    one.until(lambda: not boss(one)._left_out())


def test_quotes_under_no_valid_key_are_logged_at_a_limited_rate(one):
    refusal = Replies(refused={"thermofleet/v4/f/arm/.dot/quote": "'…/.dot/quote' is no key of this bus."})
    for _ in range(3):
        one.call(AUCTIONEER, lambda: boss(one)._end_quotes("r", frozenset(), refusal))
    assert one.logged("No quote") == ["No quote: '…/.dot/quote' is no key of this bus."]


def test_an_arm_that_does_not_quote_in_time_is_logged_and_named_in_the_status(one):
    def say_nothing(request, reply_to):
        raise AnotherReplies

    one.intercept("arm_0", "quote", say_nothing)
    one.submit(job("a"))
    late = "has not quoted within 0.3 s"
    one.until(lambda: f"{late} in the last 3 rounds" in boss(one)._left_out().get("arm_0", ""))
    assert of_arm(one) == [f"Arm 'arm_0' {late}: it is awarded no job."]


def test_a_refused_award_is_logged_with_its_reason(one):
    one.intercept("arm_0", "award", lambda award, reply_to: Ack("arm_0", award.award, False, "Too windy."))
    one.submit(job("a"))
    one.until(lambda: "has refused it" in one.status("a").reason)
    (award,) = boss(one).book.jobs["a"].grants
    assert of_arm(one) == [f"Arm 'arm_0' refuses award '{award}': Too windy."]


def test_impossible_cycles_do_not_count_and_are_logged_once_as_is_a_report_that_is_refused_again(one):
    one.submit(job("a", 3, **LONG))
    one.until(lambda: bool(one.holder("a")))
    award = one.status("a").award
    one.stop("arm_0")
    for cycles in (50, 19):
        request = LeaseRequest("arm_0", (LeaseEntry(award, "a", cycles, "working"),))
        assert one.ask(keys.asked_by("f", AUCTIONEER, "lease", "arm_0"), request, Lease).granted == (award,)
    assert one.status("a").cycles == 2
    report, key = Report("arm_0", award, "b", "finished", 1, 0.0), keys.asked_by("f", AUCTIONEER, "report", "arm_0")
    for _ in range(3):
        assert refused(lambda: one.ask(key, report, Receipt))
    cycles, vain = of_arm(one)
    assert cycles == "Arm 'arm_0' reports 50 cycles of 'a', which has 3: only 2 count."
    assert vain.startswith(f"Arm 'arm_0' reports in vain: Award '{award}'")


def test_a_late_subscriber_gets_the_last_results(one):
    one.submit(job("a", 2))
    one.until(lambda: one.is_everywhere("a", "finished"))
    results, rounds, late = [], [], one.world.processes[CLIENT].client
    late.subscribe(keys.of_every_auction("f", "result"), Result, lambda _, result: results.append(result), history=True)
    late.subscribe(keys.of_every_auction("f", "announce"), Announcement, lambda _, it: rounds.append(it), history=True)
    one.until(lambda: len(results) == 4 and bool(rounds))
    assert [result.status.state for result in results] == ["waiting", "awarded", "finishing", "finished"]
    assert [result.number for result in results] == [0, 1, 2, 3]
    assert [[offer.arm for offer in result.offers] for result in results] == [[], ["arm_0"], [], []]
    assert rounds[0].jobs == ("a",)


def test_an_arm_with_a_token_but_without_a_state_is_not_present(one):
    one.world.processes[CLIENT].client.declare_token(keys.of_arm("f", "silent", "alive"))
    one.until(lambda: "silent" in boss(one)._tokens)
    assert within(one, lambda: boss(one).present) == {"arm_0"}


def test_a_state_without_a_token_takes_no_space_unless_the_arm_is_of_the_cell(fleet_of):
    """Any process could stop the fleet: an arm outside the cell may be anywhere, and would be in everybody's way."""
    fleet = fleet_of(alone=False, arms=1, excludes=lambda *_: True)
    outsider, key = fleet.world.processes[CLIENT].client, keys.of_arm("f", "nobody", "state")
    said = State("nobody", 1, 0.0, "working", (30.0,), 30.0, space="s")
    for _ in range(3):
        outsider.publish(key, said)
        fleet.run(1.0)
    assert "nobody" not in boss(fleet).book.taken_space()
    outsider.declare_token(keys.of_arm("f", "nobody", "alive"))
    fleet.until(lambda: "nobody" in boss(fleet)._tokens)
    outsider.publish(key, said)
    fleet.until(lambda: "nobody" in boss(fleet).book.taken_space())


def test_another_job_may_not_have_the_name_of_a_job_of_the_scenario_that_is_released_later(one):
    own = job("load-004")
    one.auctioneer(reserved={own.name: own})
    replies = one.submit(replace(own, places=("bin",)), job("b", after=("load-004",)), job("load-4"))
    assert [each.reason for each in replies] == [
        "The scenario has another job 'load-004', released later; give this one another name.",
        "It waits for 'load-004', which is unknown or was not accepted.",
        "",
    ]
    assert within(one, lambda: boss(one).submit(Submission((own,)))).jobs[0].accepted
    assert one.submit(own)[0].accepted  # the same job
    assert boss(one).book.jobs["load-004"].spec == own


# Its journal


def refuse(*_records, **_options):
    raise JournalFull("no room")


def test_the_journal_is_compacted_at_the_start_unless_that_is_impossible(one, monkeypatch):
    def kinds() -> list[str]:
        return [type(record).__name__ for record in boss(one)._recorder._journal.records()]

    one.submit(job("a", release_s=1e6))
    twice = ["Started", "Started"]  # of the owner, which compaction keeps, and of the start
    before = kinds()
    with monkeypatch.context() as full:
        full.setattr(Journal, "rewrite", refuse)
        one.restart()
    assert one.logged("is not compacted: no room")
    assert [each for each in kinds() if each != "ClockTick"] == [*before, "Started"]
    assert one.states("a") == {"waiting"}
    one.restart()
    assert kinds() == ["BookSnapshot", *twice]
    assert one.states("a") == {"waiting"}


def auctioneer_of(book: JobBook) -> Auctioneer:
    return Auctioneer("boss", book, allocate=lambda _: {}, keep=lambda *_: None, boot="1", real_s=0.0)


def test_a_restart_publishes_as_much_again_as_was_cached():
    """Or what a recorder had not yet received when the auctioneer ended is lost."""
    before = auctioneer_of(JobBook().replay([EpochBegun("e")]))
    for start in range(0, 2 * HISTORY, 128):
        jobs = tuple(JobSpec(name=str(start + i), kind="hold", places=("rack",)) for i in range(128))
        before.book.record(JobsAccepted(jobs, "bob", 1.0))
    before.set_present(frozenset(["arm_0"]))
    for number in range(3):
        before.control(ControlRequest(str(number), Pause("arm_0"), "ann"), 2.0)
    after = auctioneer_of(JobBook().replay(before.book.compact()))
    for kind in (Result, Operation):
        sent, again = ([message for message in each.out if isinstance(message, kind)] for each in (before, after))
        assert [message.number for message in sent] == list(range(len(sent)))
        assert {message.epoch for message in sent} == {"e"}
        assert again == sent[-HISTORY:]


def test_an_empty_journal_is_refused_beside_arms_that_know_an_epoch(one):
    one.submit(job("a", 2), job("b", 2))
    one.until(lambda: one.finished == {"a": 1, "b": 1})
    before = boss(one).epoch
    one.run(2.0)
    lose_journal(one)
    one.world.processes[AUCTIONEER].start()
    assert one.logged("'arm_0' knows the epoch '" + before + "', 2 finished job(s), the last ones a, b")
    one.auctioneer(new_epoch=True)
    one.until(lambda: bool(boss(one).auctioneer.rounds.present) and len(boss(one).book.jobs) == 2)
    assert [each.accepted for each in one.submit(job("a", 2), job("b", 2), job("c", 2))] == [True] * 3
    epoch = boss(one).epoch
    assert before != epoch == one.ask(STATUS, StatusRequest(), Status).epoch
    one.until(lambda: one.is_everywhere("c", "finished"))
    assert one.finished == dict.fromkeys("abc", 1)
    one.auctioneer()
    assert boss(one).epoch == epoch


def test_jobs_are_refused_when_arms_of_an_older_epoch_come_later(one):
    one.submit(job("a", 2))
    one.until(lambda: one.is_everywhere("a", "finished"))
    one.world.processes["arm_0"].kill("is killed")
    lose_journal(one)
    one.run(3.0)
    one.auctioneer()
    one.world.processes["arm_0"].start()
    one.until(lambda: boss(one)._epochs.objection)
    reason = refused(lambda: one.submit(job("a", 2)))
    assert "the journal has the epoch" in reason
    assert reason.endswith("Or stop 'arm_0', if it alone is wrong.")
    assert within(one, lambda: boss(one)._epochs.admitted(["arm_0"])) == frozenset()
    assert "put this one aside and start with --new-epoch" in reason
    lose_journal(one)
    one.auctioneer(new_epoch=True)
    one.until(lambda: one.is_everywhere("a", "finished"))


def test_an_award_that_an_arm_still_has_is_adopted(one, monkeypatch):
    one.submit(job("a", 3, **LONG))
    one.until(lambda: bool(one.away))
    award = one.status("a").award
    lose_journal(one)
    with monkeypatch.context() as before:  # a lease of an unknown award is revoked
        before.setattr(one.world, "send", one.world.send)
        one.lose("lease")
        one.auctioneer(new_epoch=True)
        one.until(lambda: one.states("a") == {"awarded"})
    assert one.status("a").award == award
    one.until(lambda: one.is_everywhere("a", "finished"))
    assert one.submit(job("a", 3, **LONG))[0].accepted
    one.run(3.0)
    assert (one.finished, one.status("a").award) == ({"a": 1}, award)


def test_an_older_copy_of_the_journal_learns_what_is_finished(one):
    disk = one.world.processes[AUCTIONEER].disk
    one.submit(job("a", 3))
    one.until(lambda: bool(one.away))
    one.submit(job("b", 2))
    copy = deepcopy(disk.names)
    one.until(lambda: one.is_everywhere("a", "finished") and one.is_everywhere("b", "finished"))
    lose_journal(one)
    disk.names = copy
    one.auctioneer()
    one.until(lambda: one.is_everywhere("a", "finished") and one.is_everywhere("b", "finished"))
    one.run(3.0)
    assert one.finished == {"a": 1, "b": 1}


def test_an_older_copy_learns_that_a_job_was_finished_before_it_was_late(fleet_of):
    """The auctioneer abandons it before its arm replies."""
    fleet, copy, _ = begun_after_copy(fleet_of, job("a", 1, due_s=150.0, expires=True))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    fleet.run(150.0 / SPEED)
    restore(fleet, copy)
    fleet.until(lambda: fleet.states("a") == {"given_up"})
    fleet.until(lambda: fleet.states("a") == {"finished"})


def test_a_history_corrects_an_abandoned_job_that_has_left_the_book():
    book, spec = JobBook(), job("a", 1)
    book.past.add(spec, finished=False)
    assert not adopted(book, History("arm_0", finished=(job("a", 2),)))  # another job of that name
    book.record(*adopted(book, History("arm_0", finished=(spec,))))
    assert book.past.is_finished("a")


def test_an_older_copy_of_the_journal_learns_of_a_permission_to_commit(fleet_of):
    """Its arm is cut off in the last cycle, right after it was asked for its history: no other arm begins that one."""
    fleet = fleet_of(alone=False)
    disk = fleet.world.processes[AUCTIONEER].disk
    fleet.submit(job("a", 2, **LONG))
    fleet.until(lambda: bool(fleet.away))
    (arm,), copy = fleet.away, deepcopy(disk.names)
    fleet.until(lambda: bool(fleet.begun))
    lose_journal(fleet)
    disk.names = copy
    fleet.lose("lease")
    fleet.auctioneer()
    fleet.until(lambda: arm in boss(fleet).auctioneer.rounds.present)
    fleet.cut(arm)
    fleet.until(lambda: fleet.states("a") == {"unfinished"})
    fleet.run(3 * TIMING.lease_s)
    assert not boss(fleet).book.waiting
    fleet.cut()
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert fleet.finished == {"a": 1}


def test_an_older_copy_learns_from_an_unsure_report_on_an_award_that_it_does_not_know(fleet_of):
    fleet, copy, arm = begun_after_copy(fleet_of, job("a", 1, **LONG))
    fleet.until(lambda: bool(fleet.begun))
    fleet.world.processes[arm].kill("is killed")
    restore(fleet, copy)
    fleet.world.processes[arm].start()
    fleet.run(20.0)
    assert fleet.states("a") == {"unfinished"}
    assert fleet.submit(job("a", 1, **LONG))[0].accepted


def test_an_unsure_report_on_a_job_that_is_not_known_leaves_it_unfinished(one):
    report = Report("arm_0", "9:a", "a", "returned", 2, 1.0, "crashed", unsure=True)
    one.ask(keys.asked_by("f", AUCTIONEER, "report", "arm_0"), report, Receipt)
    assert one.submit(job("a", 3))[0].accepted
    one.run(5.0)
    assert (one.status("a").state, one.begun, one.away) == ("unfinished", {}, {})


def test_an_older_copy_counts_the_cycles_of_an_award_that_it_does_not_know(fleet_of):
    fleet, copy, arm = begun_after_copy(fleet_of, job("a", 60, dwell_s=20.0))
    fleet.run(40.0)
    machine: Any = fleet.builders[arm].machine
    done = machine.cycles
    restore(fleet, copy)
    fleet.run(20.0)
    assert fleet.status("a").cycles >= done > 5


@pytest.mark.parametrize("settled", [False, True])
def test_an_older_copy_learns_of_an_unsure_report_that_was_received_before(fleet_of, settled):
    fleet, copy, arm = begun_after_copy(fleet_of, job("a", 1, **LONG))
    fleet.until(lambda: bool(fleet.begun))
    fleet.restart(arm)
    fleet.until(lambda: fleet.states("a") == {"unfinished"})
    if settled:
        fleet.control(Settle("a", "done"))
    fleet.run(3.0)
    restore(fleet, copy)
    fleet.run(20.0)
    assert fleet.states("a") == {"unfinished"}
    fleet.control(Settle("a", "redo"))
    fleet.begun.clear()
    fleet.auctioneer()
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))


def test_an_older_copy_of_the_journal_of_an_arm_without_permission_to_commit_leaves_the_job_unfinished(fleet_of):
    fleet = fleet_of(alone=False)
    fleet.submit(job("a", 2, **LONG))
    fleet.until(lambda: bool(fleet.away))
    (arm,) = fleet.away
    process = fleet.world.processes[arm]
    copy = deepcopy(process.disk.names)
    fleet.until(lambda: bool(fleet.begun))
    process.kill("is killed")
    process.disk.names = copy
    process.start()
    fleet.until(lambda: fleet.is_everywhere("a", "unfinished"))
    assert f"The journal of '{arm}' lacks its permission to commit 'a'" in fleet.status("a").reason


def test_an_older_copy_in_which_a_job_is_finishing_learns_that_its_arm_has_finished_it(one):
    one.submit(job("a", 1, **LONG))
    one.until(lambda: bool(one.begun))
    copy = deepcopy(one.world.processes[AUCTIONEER].disk.names)
    one.until(lambda: one.is_everywhere("a", "finished"))
    one.run(3.0)
    restore(one, copy)
    one.until(lambda: one.is_everywhere("a", "finished"))


def test_an_auctioneer_of_another_name_leaves_a_last_cycle_in_progress_unfinished(fleet_of):
    fleet = fleet_of(alone=False)
    fleet.submit(job("a", 1, **LONG))
    fleet.until(lambda: bool(fleet.begun))
    lose_journal(fleet)
    fleet.run(3.0)
    fleet.auctioneer(name="boss_2", new_epoch=True)
    fleet.until(lambda: fleet.states("a") == {"unfinished"})
    assert "from another auctioneer, 'auctioneer'." in fleet.status("a").reason
    assert fleet.submit(job("a", 1, **LONG))[0].accepted
    fleet.run(20.0)
    assert (fleet.begun, fleet.states("a")) == ({"a": 1}, {"unfinished"})


@pytest.mark.parametrize("case", ["late", "absent", "rival"])
def test_an_older_copy_awards_nothing_before_all_arms_have_told_what_they_have_done(fleet_of, monkeypatch, case):
    fleet, copy, arm = begun_after_copy(fleet_of, job("a", 1, **LONG))
    others = [each for each in fleet.arms if each != arm]
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    fleet.run(3.0)
    if case == "absent":
        for each in fleet.arms:
            fleet.world.processes[each].kill("loses power")
        restore(fleet, copy)
        for each in others:
            fleet.world.processes[each].start()
    else:
        with monkeypatch.context() as before:
            before.setattr(fleet.world, "send", fleet.world.send)
            fleet.lose(f"{arm}/history")
            restore(fleet, copy)
            fleet.run(0.2)
            if case == "rival":  # it asks no arm while another auctioneer is online
                boss(fleet).rivals.add("boss_2")
                fleet.run(HOLD_S + 5.0)
                boss(fleet).rivals.clear()
            fleet.run(3.0)
    fleet.until(lambda: bool(boss(fleet)._epochs._replied))
    fleet.run(3.0)
    assert arm in fleet.status("a").reason
    if case == "absent":
        fleet.world.processes[arm].start()
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    fleet.submit(job("b", 1))
    fleet.until(lambda: fleet.is_everywhere("b", "finished"))
    assert fleet.begun == {"a": 1, "b": 1}


def test_an_auctioneer_waits_for_an_arm_that_stays_away_a_limited_time(fleet_of):
    fleet = fleet_of(alone=False, only=(AUCTIONEER, "arm_0"))
    fleet.submit(job("a", 1))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    fleet.auctioneer()
    start_s = fleet.world.now_s
    fleet.submit(job("b", 1))
    fleet.until(lambda: "have been done by arm_1, arm_2." in fleet.status("b").reason)
    fleet.until(lambda: fleet.is_everywhere("b", "finished"))
    assert HOLD_S < fleet.world.now_s - start_s < HOLD_S + 5.0


def test_an_arm_with_a_malformed_history_stops_no_other_and_is_named(fleet_of):
    fleet, updated = fleet_of(alone=False), list[str]()
    fleet.intercept("arm_0", "history", lambda request, reply_to: (reply_to if updated else malformed)(request))
    fleet.auctioneer()
    fleet.submit(job("a", 1))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    status = fleet.ask(STATUS, StatusRequest(), Status)
    assert "gives no valid history (Not a" in status.left_out["arm_0"]
    assert "arm_0" not in boss(fleet).auctioneer.rounds.present
    updated.append("arm_0")
    fleet.until(lambda: "arm_0" in boss(fleet).auctioneer.rounds.present)
    assert fleet.ask(STATUS, StatusRequest(), Status).left_out == {}


def test_fleet_time_continues_as_the_arms_have_kept_it_while_there_was_no_auctioneer(fleet_of):
    """The median of the arms that know its epoch; others may keep another time."""
    fleet = fleet_of(alone=False)
    fleet.submit(job("a", 2))
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    epoch = boss(fleet).epoch
    for arm, time_s in zip(fleet.arms, (1e9, 5000.0, 4800.0), strict=True):
        said = History(arm, epoch, time_s=time_s)
        fleet.intercept(arm, "history", lambda request, reply_to, said=said: said)
    fleet.auctioneer()
    assert 5000.0 <= boss(fleet).book.time_s <= within(fleet, lambda: boss(fleet).time_s) < 5100.0
    others = [History(arm, known, time_s=2000.0) for arm, known in zip("abc", ("other", "", "other"), strict=True)]
    assert kept_time_s(others, epoch) == kept_time_s([], epoch) == 0.0


def test_a_full_disk_is_told_as_the_trouble_and_as_the_reason_of_waiting_jobs(fleet_of):
    fleet = fleet_of(alone=False, only=(AUCTIONEER,))
    fleet.submit(job("a", 2))

    def status() -> tuple[str, str]:
        reply = fleet.ask(STATUS, StatusRequest(), Status)
        return reply.trouble, reply.jobs[0].reason

    fleet.world.processes[AUCTIONEER].disk.full = True
    fleet.until(lambda: bool(status()[0]))
    fleet.world.processes["arm_0"].start()
    fleet.until(lambda: bool(boss(fleet).auctioneer.rounds.present))
    full = "Journal 'auction' cannot be written: no space left on the disk."
    assert status() == (f"No jobs are accepted or awarded: {full}",) * 2
    fleet.world.processes[AUCTIONEER].disk.full = False
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))
    assert status()[0] == ""


# Other auctioneers


def test_a_fleet_has_one_auctioneer(one):
    """One that is stopped only shows its token."""
    one.world.processes[AUCTIONEER].pause(1.0)
    one.auctioneer("second", name="two")
    assert one.logged("exits: ")[-1].endswith(f"has an auctioneer already: '{AUCTIONEER}'. A fleet has one.")
    one.world.processes[AUCTIONEER].pause(1.0)
    one.auctioneer("second", name=AUCTIONEER)
    stop = f"has an auctioneer '{AUCTIONEER}' already: its token is present. Stop that one first"
    assert stop in one.logged("exits: ")[-1]
    one.world.processes[AUCTIONEER].kill("is killed")
    one.auctioneer("second", name="two")
    assert one.node("second") is not None


@pytest.mark.parametrize(
    ("replies", "token", "says"),
    [
        (False, False, "has an auctioneer already, which does not reply"),
        (True, False, "has an auctioneer already: 'one'"),
        (True, True, "allocate the jobs themselves; 'one' replies for them. Stop them first"),
    ],
)
def test_a_participant_that_replies_without_a_token_counts_as_an_auctioneer(one, replies, token, says):
    client = one.world.processes[CLIENT].client
    client.reply_to(STATUS, StatusRequest, lambda _: Status("one", 0.0, ()))
    if token:
        client.declare_token(keys.of_arm("f", "one", "alive"))
    if not replies:
        one.stop(CLIENT)
    one.auctioneer()
    assert says in one.logged("exits: ")[-1]


@pytest.mark.parametrize("other", ["two", AUCTIONEER])
def test_two_auctioneers_detect_each_other_and_neither_accept_nor_award_jobs(one, monkeypatch, other):
    """Both start while the network is cut, and meet after it; those of one name share one token."""
    monkeypatch.setattr(AuctionNode, "_check_no_auctioneer", lambda self: None)
    lose_journal(one)
    one.world.processes["arm_0"].kill("is killed")
    one.auctioneer()
    one.auctioneer("second", name=other)
    for process in (AUCTIONEER, "second"):  # before either is served
        within(one, lambda process=process: one.node(process).submit(Submission((job("a", 2),))), process)
    two = one.node("second")
    one.until(lambda: (boss(one).rivals, two.rivals) == ({other}, {AUCTIONEER}))
    one.world.processes["arm_0"].start()
    one.run(3.0)
    names = ", ".join(sorted([AUCTIONEER, other]))
    error = f"Fleet 'f' has more than one auctioneer ({names}): no jobs are accepted until one is stopped."
    assert refused(lambda: one.submit(job("b", 2))) == error
    with pytest.raises(Refused, match=re.escape(error)):
        boss(one).submit(Submission((job("b", 2),)))
    replies: list[Any] = []
    query = partial(one.world.processes[CLIENT].client.query, timeout_s=2.0)
    query(keys.of_jobs("f", "submit"), Submission((job("b", 2),)), SubmissionReply, replies.append)
    one.run(3.0)
    both = replies.pop()
    assert ([*both.refused.values()], both.temporary) == ([error, error], True)
    query(STATUS, StatusRequest(), Status, replies.append)
    one.run(3.0)
    trouble = error.replace("accepted until", "accepted or awarded until")
    troubles = [(each.auctioneer, each.trouble, each.jobs[0].reason) for each in replies[0].messages.values()]
    assert {*troubles} == {(name, trouble, trouble) for name in (AUCTIONEER, other)}
    assert not boss(one).book.open
    assert not two.book.open
    one.world.processes["second"].kill("is killed")
    one.until(lambda: one.is_everywhere("a", "finished"))
    assert one.finished == {"a": 1}


def test_an_auctioneer_without_a_recent_check_for_others_awards_nothing(one, monkeypatch):
    """It awards nothing before its first check, nor long after its last."""
    with monkeypatch.context() as unchecked:
        unchecked.setattr(AuctionNode, "_check_rivals", lambda self, real_s: None)
        one.auctioneer()
        one.submit(job("a", 2))
        one.run(3.0)
        assert within(one, lambda: boss(one).present) == {"arm_0"}
        assert not boss(one).book.open
    one.until(lambda: one.is_everywhere("a", "finished"))
    monkeypatch.setattr(auction_node, "ALONE_S", 0.0)  # as if it had been stopped for longer than that
    one.submit(job("b", 2))
    one.run(3.0)
    assert not boss(one).book.open
    assert one.finished == {"a": 1}
