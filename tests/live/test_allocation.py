"""Who gets which job, in a fleet with an auctioneer and in one without: leases, space, faults, full disks, restarts.

After every event the simulation checks its rules: no last cycle is done twice, no two arms have one job, and no two are
away from home on plans that exclude each other.
"""

import re
from functools import partial

import pytest

from benchmarks.simulation import machine
from benchmarks.simulation.machine import SimulatedEstimator
from benchmarks.simulation.participants import AUCTIONEER
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import (
    Ack,
    Announcement,
    Lease,
    LeaseEntry,
    LeaseRequest,
    PlanQuote,
    Receipt,
    Report,
    Result,
    Status,
    StatusRequest,
)
from fleet.bus.protocol.operator import ALL_ARMS, Clear, Operation, Pause, Resume, Settle
from fleet.job import reason_to_give_up
from fleet.live import book as book_module
from fleet.live.auction.rounds import Assignment
from fleet.live.leases import Timing
from fleet.live.monitor.health import check_jobs
from fleet.live.monitor.snapshot import FleetSnapshot
from fleet.live.space import ANYWHERE
from tests.live.simulated import LONG, SPEED, TIMING, SimulatedFleet, job, refused


def always(arm: str, space: str, other: str, other_space: str) -> bool:
    return True


def unless_known(arm: str, space: str, other: str, other_space: str) -> bool:
    return ANYWHERE in (space, other_space)


@pytest.fixture
def auctioned(fleet_of):
    """Three arms and an auctioneer."""
    return fleet_of(alone=False)


@pytest.fixture(params=[False, True], ids=["auctioneer", "alone"])
def alone(request):
    return request.param


# Jobs


def test_jobs_are_done_once_each_in_their_order(fleet):
    first, second = job("a", 2), job("b", 2, after=("a",))
    assert [each.accepted for each in fleet.submit(first, second, *(job(name, 2) for name in "cde"))] == [True] * 5
    fleet.until(lambda: all(fleet.is_everywhere(name, "finished") for name in "abcde"))
    assert fleet.finished == dict.fromkeys("abcde", 1)
    assert fleet.status("b").finished_s > fleet.status("a").finished_s
    assert len({fleet.status(name).arm for name in "abcde"}) > 1, "one arm did it all"
    again, other, lost = fleet.submit(first, job("b", 7), job("z", after=("nothing",)))
    assert (again.accepted, other.accepted, lost.accepted) == (True, False, False)
    assert again.reason == "It is finished already, and is not done again."


def test_jobs_that_no_arm_can_do_hold_up_no_others(fleet, monkeypatch):
    plans = SimulatedEstimator.plans
    monkeypatch.setattr(
        SimulatedEstimator, "plans", lambda self, job: () if job.name.startswith("heavy") else plans(self, job)
    )
    fleet.submit(*(job(f"heavy_{k}", 1) for k in range(100)))
    fleet.run(20.0)
    fleet.submit(*(job(f"light_{k}", 1) for k in range(12)))
    fleet.until(lambda: all(fleet.finished.get(f"light_{k}") == 1 for k in range(12)), 30.0)
    assert re.match("No arm (that has answered )?can do it: arm_0: infeasible", fleet.status("heavy_7").reason)


@pytest.mark.parametrize("seed", range(2))
def test_the_job_of_an_offline_arm_goes_to_another_after_the_lease(fleet_of, alone, seed):
    """Not before: the clocks of the processes differ in rate."""
    fleet = fleet_of(alone, seed=seed)
    fleet.submit(job("a", 1000))
    fleet.until(lambda: fleet.status("a").cycles > 3)
    arm, cycles, cut_s = fleet.holder("a"), fleet.status("a").cycles, fleet.world.now_s
    fleet.cut(arm)
    fleet.until(lambda: fleet.holder("a") not in ("", arm))
    assert fleet.world.now_s > cut_s + TIMING.lease_s * 2 / 3
    fleet.cut()
    fleet.until(lambda: not fleet.node(arm).executor.active)
    assert fleet.status("a").cycles >= cycles


def test_the_job_of_a_killed_arm_is_returned_with_its_cycles(fleet):
    fleet.submit(job("a", 30))
    fleet.until(lambda: fleet.status("a").cycles > 3)
    before = fleet.status("a")
    fleet.restart(before.arm)
    fleet.until(lambda: fleet.status("a").award != before.award)
    assert fleet.status("a").cycles >= before.cycles
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))


@pytest.mark.parametrize(("exits", "state"), [(False, "finished"), (True, "unfinished")])
def test_an_arm_that_is_stopped_in_its_last_cycle_finishes_the_job_or_leaves_it_unfinished(fleet, exits, state):
    fleet.submit(job("a", 1, **LONG))
    fleet.until(lambda: bool(fleet.begun))
    (arm,) = fleet.away
    fleet.call(arm, lambda: fleet.node(arm).retire(fleet.world.processes[arm].real_s))
    fleet.run(1.0)
    if exits:
        fleet.restart(arm)
    fleet.until(lambda: fleet.is_everywhere("a", state))
    fleet.run(TIMING.lease_s + 5.0)
    assert (fleet.begun, fleet.states("a")) == ({"a": 1}, {state})


def test_a_job_that_still_waits_at_its_hard_due_date_is_given_up_with_its_successors(fleet):
    fleet.submit(job("begun", 30, due_s=60.0, expires=True), job("soft", 2, place="place of begun", due_s=60.0))
    fleet.until(lambda: bool(fleet.away))
    fleet.submit(job("late", 2, place="place of begun", due_s=60.0, expires=True), job("z", after=("late",)))
    if not fleet.alone:
        fleet.restart()
    fleet.until(lambda: fleet.is_everywhere("begun", "finished") and fleet.is_everywhere("soft", "finished"))
    known = fleet.known()[0]
    assert (known["late"].state, known["z"].state) == ("given_up", "given_up")
    assert known["late"].reason == "expired: its due date passed while it waited."
    assert known["z"].reason == "Given up, because it waits for 'late', which is given up or cancelled."
    assert known["begun"].finished_s > 60.0


# Faults


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("arms", [1, 4])
def test_a_job_in_which_arms_fault_too_often_is_given_up_by_all_and_others_go_on(fleet_of, alone, arms, restarts):
    fleet = fleet_of(alone, arms)
    fleet.submit(job("j", 500), job("k", after=("j",)), job("other", 3))
    faults: list[str] = []
    while fleet.status("j").state != "given_up":
        fleet.until(lambda: fleet.holder("j") in fleet.away)
        faults.append(fleet.holder("j"))
        fleet.fault(faults[-1])
        fleet.until(lambda: fleet.holder("j") != faults[-1])
        fleet.run(0.5)
        if restarts:
            fleet.restart(*((fleet.arms[0],) if alone else ()))
            fleet.run(1.0)
    fleet.until(lambda: fleet.is_everywhere("j", "given_up") and fleet.is_everywhere("k", "given_up"))
    assert reason_to_give_up(faults)
    assert not reason_to_give_up(faults[:-1])
    assert {known["j"].reason for known in fleet.known()} == {reason_to_give_up(faults)}
    fleet.until(lambda: fleet.is_everywhere("other", "finished"))


def test_an_arm_that_was_away_learns_that_a_job_is_given_up(fleet_of):
    fleet = fleet_of(True, 4)
    fleet.submit(job("j", 500, release_s=60.0), job("k", after=("j",)))
    fleet.cut("arm_0")
    while fleet.status("j").state != "given_up":
        fleet.until(lambda: fleet.holder("j") in fleet.away)
        arm = fleet.holder("j")
        fleet.fault(arm)
        fleet.until(lambda arm=arm: fleet.holder("j") != arm)
        fleet.run(0.5)
    fleet.cut()
    fleet.until(lambda: fleet.is_everywhere("j", "given_up") and fleet.is_everywhere("k", "given_up"))


def test_an_arm_that_was_away_learns_that_a_job_has_left(fleet_of):
    """The simulation keeps the outcomes of five jobs."""
    fleet = fleet_of(True)
    names = [f"job {number}" for number in range(9)]
    fleet.cut("arm_2")
    for name in names:
        fleet.submit(job(name, 2))
        fleet.until(lambda name=name: name in fleet.finished)
    fleet.until(lambda: len(fleet.known()[0]) <= 6)
    fleet.cut()
    fleet.until(lambda: fleet.known()[2].keys() == fleet.known()[0].keys())
    fleet.run(5.0)
    assert fleet.finished == dict.fromkeys(names, 1)


# Disks


def test_nothing_is_accepted_or_permitted_without_space_on_the_disk(fleet):
    disks = [fleet.world.processes[name].disk for name in (fleet.arms if fleet.alone else (AUCTIONEER,))]

    def fill(full: bool) -> None:
        for disk in disks:
            disk.full = full

    fill(True)
    assert "no space left" in refused(lambda: fleet.submit(job("a", 1)))
    fill(False)
    fleet.submit(job("a", 2, dwell_s=10.0))
    fleet.until(lambda: bool(fleet.away))
    fill(True)
    fleet.run(8.0)
    assert not fleet.begun
    fill(False)
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))


# Space


def test_plans_that_exclude_each_other_are_done_one_after_the_other(fleet_of, alone):
    fleet = fleet_of(alone, excludes=always)
    fleet.submit(*(job(name, 2) for name in "abcd"))
    fleet.until(lambda: all(fleet.is_everywhere(name, "finished") for name in "abcd"), 120.0)
    assert fleet.finished == dict.fromkeys("abcd", 1)


def test_an_arm_that_was_never_online_keeps_all_its_space(fleet_of, alone):
    running = ("arm_0", "arm_1", *(() if alone else (AUCTIONEER,)))
    fleet = fleet_of(alone, excludes=unless_known, only=running)
    fleet.run(25.0 if alone else 1.0)  # without an auctioneer a majority waits for the third arm at first
    fleet.submit(job("a", 2))
    fleet.run(6.0)
    assert fleet.states("a") == {"waiting"}
    if not alone:
        assert fleet.status("a").reason == "It waits until arm_2 is out of the way. arm_2 is not present."
    fleet.world.processes["arm_2"].start()
    fleet.until(lambda: fleet.is_everywhere("a", "finished"))


def test_the_space_of_an_offline_arm_stays_taken_until_a_person_frees_it(fleet_of, alone):
    fleet = fleet_of(alone, excludes=always)
    fleet.submit(job("a", 1000), job("b", 1000))
    fleet.until(lambda: bool(fleet.away))
    (arm,) = fleet.away
    assert "present" in refused(lambda: fleet.free_space(arm))
    fleet.stop(arm)
    fleet.cut(arm)
    fleet.run(1.0)
    assert "present" in refused(lambda: fleet.free_space(arm)) or alone
    for restarted in (False, True):
        fleet.run(15.0)
        if restarted:
            fleet.restart(*(each for each in fleet.arms if alone and each != arm))
            fleet.run(25.0)  # two of three arms wait for the third one at first
        assert not any(fleet.holder(name) for name in "ab")
    fleet.move_home(arm)
    for _ in range(2):
        assert fleet.free_space(arm).arm == arm
    fleet.until(lambda: fleet.holder("a") not in ("", arm) or fleet.holder("b") not in ("", arm))


def test_space_is_freed_only_after_the_lease_of_its_arm(fleet_of, alone):
    fleet = fleet_of(alone, excludes=always)
    fleet.submit(job("a", 1000))
    fleet.until(lambda: bool(fleet.away))
    (arm,) = fleet.away
    fleet.world.processes[arm].kill("is killed")
    fleet.run(0.5)
    assert f"lease of '{arm}' has not ended" in refused(lambda: fleet.free_space(arm))
    fleet.until(lambda: not refused(lambda: fleet.free_space(arm)))


def test_the_space_of_an_arm_lost_in_its_last_cycle_stays_taken(fleet_of, alone):
    fleet = fleet_of(alone, excludes=always)
    fleet.submit(job("a", 1, **LONG), job("b", 2))
    fleet.until(lambda: bool(fleet.begun))
    (arm,) = fleet.away
    fleet.stop(arm)
    fleet.cut(arm)
    fleet.run(20.0)
    assert (fleet.status("a").state, fleet.status("b").state) == ("unfinished", "waiting")
    fleet.move_home(arm)
    for _ in range(2):
        fleet.free_space(arm)
    fleet.until(lambda: fleet.status("b").state == "finished")
    (freed,) = (each for each in fleet.messages(Operation) if isinstance(each.request.action, Clear))
    assert (freed.request.action.arm, freed.request.by, freed.note) == (arm, "ann", "")
    assert fleet.status("a").state == "unfinished"


@pytest.mark.parametrize(("outcome", "state"), [("done", "finished"), ("redo", "waiting")])
def test_an_arm_that_lost_its_journal_in_its_last_cycle_frees_its_space_at_home(fleet_of, outcome, state):
    """Its job stays unfinished until a person settles it; other jobs go on."""
    fleet = fleet_of(False, excludes=always)
    fleet.submit(job("a", 1, **LONG))
    fleet.until(lambda: bool(fleet.begun))
    (arm,) = fleet.away
    fleet.world.processes[arm].kill("is killed")
    fleet.move_home(arm)
    fleet.until(lambda: fleet.status("a").state == "unfinished")
    fleet.submit(job("b", 2))
    fleet.run(3.0)
    assert fleet.status("b").state == "waiting"
    fleet.world.processes[arm].disk.names.clear()
    fleet.world.processes[arm].start()
    fleet.until(lambda: fleet.status("b").state == "finished")
    reason = f"'{arm}' is at home and no longer has it; its last cycle may have been done."
    assert (fleet.status("a").state, fleet.status("a").reason) == ("unfinished", reason)
    fleet.restart()
    settled = fleet.control(Settle("a", outcome)).job
    assert settled is not None
    assert settled.state == state


@pytest.mark.parametrize("finishes", [False, True])
def test_an_arm_that_is_online_again_after_it_was_cleared_takes_its_space_until_it_is_home(fleet_of, alone, finishes):
    """The person was wrong: the arm is still in its last cycle."""
    fleet = fleet_of(alone, excludes=always)
    fleet.submit(job("a", 1, dwell_s=300.0))
    fleet.until(lambda: bool(fleet.begun))
    (arm,) = fleet.away
    fleet.cut(arm)
    fleet.until(lambda: not refused(lambda: fleet.free_space(arm)))
    fleet.cut()
    if finishes:
        fleet.until(lambda: bool(fleet.finished))
        fleet.submit(job("b", 2))
    else:
        fleet.run(1.5)
        fleet.cut(arm)  # only some messages arrived, and no quote
        fleet.submit(job("b", 2))
        fleet.run(5.0)
        assert fleet.status("b").state == "waiting"
        fleet.cut()
    fleet.until(lambda: fleet.finished == {"a": 1, "b": 1})
    fleet.until(lambda: fleet.is_everywhere("a", "finished") and fleet.is_everywhere("b", "finished"))


def test_an_arm_learns_the_end_of_a_job_that_its_peers_have_forgotten(fleet_of):
    """Otherwise it would never begin a job that waits for it, which its peers may not be able to do."""
    fleet = fleet_of(True)
    fleet.cut(fleet.arms[-1])
    fleet.submit(job("a", 1), *(job(f"job {number}", 1) for number in range(book_module.MAX_SETTLED)))
    books = [fleet.node(arm).work_source.book for arm in fleet.arms]
    fleet.until(lambda: all("a" in book.past for book in books[:-1]))
    fleet.submit(job("d", after=("a",), release_s=1e6))
    assert not books[-1].is_known("a")
    fleet.cut()
    fleet.until(lambda: books[-1].is_known("d") and books[-1].is_finished("a"))


def test_the_space_of_an_arm_that_is_not_known_cannot_be_cleared(fleet_of, alone):
    fleet = fleet_of(alone, excludes=always)
    reason = refused(lambda: fleet.free_space("arm_7"))
    assert reason.startswith("'arm_7' is no arm of this fleet." if alone else "There is no arm 'arm_7'.")
    assert reason.endswith("Arms: arm_0, arm_1, arm_2.")


# Rounds of an auctioneer


def rounds(fleet: SimulatedFleet) -> list[float]:
    """Real seconds from the announcement of each round to its first award."""
    awards = [each for each in fleet.messages(Result) if each.status.state == "awarded"]
    begins = {each.auction: each.time_s for each in fleet.messages(Announcement)}
    return [(each.time_s - begins[each.auction]) / SPEED for each in awards]


@pytest.mark.parametrize("second", ["replies", "hangs", "is absent"])
def test_a_round_closes_with_the_last_quote_or_at_its_time_limit(auctioned, second):
    """It does not wait for an absent arm."""
    if second == "hangs":
        auctioned.stop("arm_1")
    elif second == "is absent":
        auctioned.world.processes["arm_1"].kill("is killed")
        auctioned.run(1.0)
    auctioned.submit(job("a", 2))
    auctioned.until(lambda: bool(auctioned.holder("a")))
    (took_s,) = rounds(auctioned)
    limit_s = TIMING.window_s - 1e-6
    assert (limit_s <= took_s < limit_s + auctioned.world.late_s) if second == "hangs" else took_s < limit_s


def test_a_round_does_not_wait_for_an_arm_that_leaves(fleet_of):
    fleet = fleet_of(alone=False, timing=Timing(window_s=20.0))
    fleet.stop("arm_1")
    fleet.submit(job("a", 2))
    fleet.until(lambda: bool(fleet.holder("a")))
    assert rounds(fleet)[0] < 10.0


def test_an_award_without_an_answer_is_sent_three_times_and_then_dropped(auctioned):
    begin_s, lost = auctioned.world.now_s, auctioned.lose("award")
    auctioned.submit(job("a"))
    auctioned.until(lambda: any("did not answer" in each.status.reason for each in auctioned.messages(Result)))
    assert [award.award for award in lost].count(lost[0].award) == 3
    assert auctioned.world.now_s > begin_s + TIMING.lease_s


def test_a_refused_job_goes_to_another_arm_at_once(auctioned):
    awards: list[tuple[str, str]] = []
    times_s: list[float] = []

    def answer(arm, award, reply_to):
        if (arm, award.award) not in awards:
            awards.append((arm, award.award))
            times_s.append(auctioned.world.now_s)
        return Ack(arm, award.award, False, "not now") if arm == awards[0][0] else reply_to(award)

    for arm in auctioned.arms:
        auctioned.intercept(arm, "award", partial(answer, arm))
    auctioned.submit(job("a", 2))
    auctioned.until(lambda: auctioned.is_everywhere("a", "finished"))
    assert any("refused it: not now" in each.status.reason for each in auctioned.messages(Result))
    assert len({arm for arm, _ in awards}) == 2
    assert times_s[1] - times_s[0] < TIMING.refused_s[0]


def record_quotes(fleet: SimulatedFleet) -> list:
    """Requests for quotes, as the first arm gets them from now on."""
    asked = []

    def note(request, reply_to):
        asked.append(request)
        return reply_to(request)

    fleet.intercept("arm_0", "quote", note)
    return asked


def test_quotes_are_requested_for_the_cycles_that_are_left(auctioned):
    asked = record_quotes(auctioned)
    auctioned.submit(job("a", 500))
    auctioned.until(lambda: auctioned.status("a").cycles > 3)
    assert all(request.cycles == {} for request in asked)
    auctioned.control(Pause(ALL_ARMS))
    auctioned.until(lambda: auctioned.status("a").state == "waiting")
    cycles, before = auctioned.status("a").cycles, len(asked)
    auctioned.control(Resume())
    auctioned.until(lambda: len(asked) > before)
    assert asked[-1].cycles == {"a": cycles}


def test_jobs_at_busy_stations_are_named_when_another_job_can_begin(auctioned):
    """Policies observe them, as in simulation."""
    auctioned.submit(job("a", 500, place="rack"))
    auctioned.until(lambda: bool(auctioned.holder("a")))
    asked = record_quotes(auctioned)
    auctioned.submit(job("b", place="rack"))
    auctioned.run(3.0)
    assert not asked
    auctioned.submit(job("c"))
    auctioned.until(lambda: bool(asked))
    assert [each.name for each in asked[0].jobs] == ["b", "c"]


def test_an_allocation_against_the_bids_is_not_awarded(auctioned, caplog):
    arms = {"a": "unknown", "b": "arm_0", "c": "arm_0", "x": "arm_0"}
    allocate = lambda bidding: {name: Assignment(arm) for name, arm in arms.items()}  # noqa: E731
    auctioned.node(AUCTIONEER).auctioneer.rounds.allocate = allocate
    auctioned.submit(*(job(name) for name in "abc"))
    auctioned.until(lambda: bool(auctioned.holder("b")))
    auctioned.run(2.0)
    assert not auctioned.holder("a")
    assert not auctioned.holder("c")


def test_reports_and_leases_are_taken_only_from_the_arm_of_the_award(auctioned):
    auctioned.submit(job("a", 1000))
    auctioned.until(lambda: auctioned.status("a").cycles > 3)
    status = auctioned.status("a")
    other = next(arm for arm in auctioned.arms if arm != status.arm)

    def send(arm: str, topic: str, message: object, kind: type) -> object:
        return auctioned.ask(keys.asked_by("f", AUCTIONEER, topic, arm), message, kind)

    report = Report(other, status.award, "a", "finished", 3, 1.0)
    assert refused(lambda: send(other, "report", report, Receipt)).endswith(
        f"gives 'a' to '{status.arm}', not 'a' to '{other}'."
    )
    entries = (LeaseEntry(status.award, "a", 2, "finishing"),)
    lease = send(other, "lease", LeaseRequest(other, entries), Lease)
    assert (lease.granted, lease.revoked, lease.may_commit) == ((), (status.award,), ())
    unknown = Report(other, "old", "a", "finished", 3, 1.0)
    assert send(other, "report", unknown, Receipt) == Receipt(AUCTIONEER, "old")
    assert auctioned.status("a").state == "awarded"
    returned = Report(status.arm, status.award, "a", "returned", 4, 1.0)
    auctioned.stop(status.arm)
    first = send(status.arm, "report", returned, Receipt)
    written = len(auctioned.world.processes[AUCTIONEER].disk.names["auction"].data)
    assert send(status.arm, "report", returned, Receipt) == first
    assert len(auctioned.world.processes[AUCTIONEER].disk.names["auction"].data) - written < 500


@pytest.mark.parametrize("proceeds", [False, True])
def test_a_job_whose_arm_renews_its_lease_and_reports_no_cycle_makes_no_progress(auctioned, proceeds, monkeypatch):
    monkeypatch.setattr(machine, "PlanQuote", partial(PlanQuote, duration_s=10.0))
    auctioned.submit(job("a", 1000))
    auctioned.until(lambda: auctioned.status("a").cycles > 3)
    status = auctioned.status("a")
    auctioned.stop(status.arm)
    for count in range(20):
        entry = LeaseEntry(status.award, "a", status.cycles + 2 + count * proceeds, "working")
        request = LeaseRequest(status.arm, (entry,))
        auctioned.ask(keys.asked_by("f", AUCTIONEER, "lease", status.arm), request, Lease)
        auctioned.run(1.0)
    reason = "" if proceeds else f"'{status.arm}' has reported no cycle of it for more than 2 min, though it renews its"
    assert auctioned.status("a").reason.startswith(reason)
    assert bool(auctioned.status("a").reason) == (not proceeds)
    now = FleetSnapshot("f", (), (), {}, (auctioned.status("a"),))
    kinds = [("warning", "no_progress", "a")] * (not proceeds)
    assert [(each.level, each.kind, each.subject) for each in check_jobs(now)] == kinds


def test_an_award_outlasts_a_pause_of_the_auctioneer_longer_than_a_lease(auctioned):
    auctioned.submit(job("a", 1000))
    auctioned.until(lambda: auctioned.status("a").cycles > 3)
    award = auctioned.status("a").award
    auctioned.world.processes[AUCTIONEER].pause(1.5 * TIMING.lease_s)
    auctioned.run(10.0)
    assert auctioned.status("a").award == award


def test_at_the_end_of_the_shift_open_jobs_are_reported_unfinished(auctioned):
    auctioned.submit(job("a", 1000), job("b", release_s=1e6))
    auctioned.until(lambda: bool(auctioned.holder("a")))
    auctioned.call(AUCTIONEER, auctioned.node(AUCTIONEER).end)
    assert auctioned.states("a") == auctioned.states("b") == {"unfinished"}
    auctioned.until(lambda: not auctioned.node("arm_0").executor.active and not auctioned.away)
    assert not auctioned.begun
    reply = auctioned.ask(keys.of_jobs("f", "status"), StatusRequest(), Status)
    assert [each.state for each in reply.jobs] == ["unfinished"] * 2
    assert "over" in auctioned.submit(job("c"))[0].reason
    assert "over" in refused(lambda: auctioned.control(Settle("a", "redo")))
    assert auctioned.control(Settle("b", "done")).job.state == "finished"
    auctioned.restart()
    auctioned.until(lambda: auctioned.is_everywhere("b", "finished"))
