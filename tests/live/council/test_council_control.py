"""Requests of people to arms without an auctioneer, abandoned and settled jobs, also after restarts."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobEstimate, JobSpec
from fleet.bus.protocol.consensus import Claim, ClaimEntry, JobOutcome
from fleet.bus.protocol.messages import encode
from fleet.bus.protocol.operator import Cancel, Change, Pause, Resume, Settle
from fleet.errors import Refused
from fleet.live.consensus import jobs
from fleet.live.consensus.grants import Granter
from fleet.live.consensus.jobs import JobSettled, Register
from fleet.live.journal import JobsAccepted
from tests.live.disk import Disk


def job(name: str, repetitions: int = 100, **more) -> JobSpec:
    return JobSpec(name=name, kind="hold", places=(f"place of {name}",), repetitions=repetitions, **more)


def states(fleet, name: str) -> set[str]:
    """State of a job, as each arm knows it."""
    return {
        status.state
        for arm in fleet.arms.values()
        for status in arm.participant.status([], arm.real_s)
        if status.job == name
    }


def run_until(fleet, condition, stopped: str = "", patience_s: float = 40.0) -> None:
    for _ in range(round(patience_s / 0.1)):
        if condition():
            return
        fleet.run(0.1, stopped=stopped)
    raise AssertionError("the condition was never met")


def holder(fleet, name: str):
    """Name of the arm that has a job; "" for none."""
    has = (arm.name for arm in fleet.arms.values() for active in arm.executor.active if active.job == name)
    return next(has, "")


def silent(fleet, name: str = "a") -> str:
    """Run until an arm has permission to commit, then isolate it until the others call the job unfinished."""
    run_until(fleet, lambda: any(arm.cycle_ends_s is not None for arm in fleet.arms.values()))
    one = holder(fleet, name)
    fleet.cut = {one}
    others = [arm for arm in fleet.arms.values() if arm.name != one]
    run_until(
        fleet,
        lambda: all(s.state == "unfinished" for a in others for s in a.participant.status([], a.real_s)),
        stopped=one,
    )
    return one


def test_a_waiting_job_is_cancelled_at_all_arms_and_its_followers_are_given_up(council):
    fleet = council.Fleet([1.0] * 3, [job("a", release_s=1e6), job("b", after=("a",))])
    reply = fleet.control(Cancel("a"), "one")
    assert (reply.changed, reply.job.state, reply.job.reason) == (True, "cancelled", "Cancelled by 'ann'.")
    assert not fleet.control(Cancel("a"), "one").changed
    fleet.run(1.0)
    assert (states(fleet, "a"), states(fleet, "b")) == ({"cancelled"}, {"given_up"})
    assert [operation.request.by for operation in fleet.operations] == ["ann"]
    for arm in fleet.arms.values():
        arm.start()
    assert states(fleet, "a") == {"cancelled"}
    assert not fleet.control(Cancel("a"), "one").changed
    with pytest.raises(Refused, match="no job 'x'"):
        fleet.control(Cancel("x"), "two")


def test_a_job_at_work_is_cancelled_after_the_cycle_in_progress_and_never_done(council):
    fleet = council.Fleet([1.0] * 3, [job("a")])
    run_until(fleet, lambda: any(a.cycles > 3 for arm in fleet.arms.values() for a in arm.executor.active))
    other = next(name for name in fleet.names if name != holder(fleet, "a"))
    reply = fleet.control(Cancel("a"), "one", other)
    assert (reply.changed, reply.job.state, reply.job.repetitions) == (True, "awarded", 100)
    assert "ends the cycle" in reply.note
    run_until(fleet, lambda: states(fleet, "a") == {"cancelled"}, patience_s=5.0)
    assert not any(arm.executor.active or arm.executor.has_pending_reports for arm in fleet.arms.values())
    fleet.run(5.0)
    assert "a" not in fleet.last_cycles


@pytest.mark.parametrize("cancels", [True, False])
def test_the_cycle_in_progress_counts_when_a_job_is_stopped(council, cancels):
    fleet = council.Fleet([1.0] * 3, [job("a", 3)])
    fleet.cycle_s = 8.0  # longer than a lease
    run_until(fleet, lambda: any(arm.cycle_ends_s is not None for arm in fleet.arms.values()))
    one = holder(fleet, "a")
    fleet.control(Cancel("a") if cancels else Pause(), "one", next(name for name in fleet.names if name != one))
    fleet.run(6.0)
    assert states(fleet, "a") == {"awarded"}
    run_until(fleet, lambda: states(fleet, "a") == {"cancelled" if cancels else "waiting"})
    fleet.run(1.0)
    assert {s.cycles for arm in fleet.arms.values() for s in arm.participant.status([], arm.real_s)} == {1}
    if not cancels:
        fleet.cycle_s = 0.2
        fleet.control(Resume(), "two")
        run_until(fleet, lambda: states(fleet, "a") == {"finished"})
        assert fleet.cycles_done == 3
    assert fleet.last_cycles == ({} if cancels else {"a": 1})


def test_a_job_in_its_last_cycle_is_finished_in_spite_of_a_cancellation(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 1)])
    run_until(fleet, lambda: bool(fleet.last_cycles))
    assert "last cycle" in fleet.control(Cancel("a"), "one").note
    run_until(fleet, lambda: states(fleet, "a") == {"finished"})


def test_an_arm_that_is_cut_off_carries_a_cancellation_out_when_it_is_heard_again(council):
    fleet = council.Fleet([1.0] * 3, [job("a")])
    run_until(fleet, lambda: bool(holder(fleet, "a")))
    one = holder(fleet, "a")
    fleet.cut = {one}
    fleet.control(Cancel("a"), "one", next(name for name in fleet.names if name != one))
    run_until(fleet, lambda: "cancelled" in states(fleet, "a"), stopped=one)
    fleet.cut = set()
    run_until(fleet, lambda: states(fleet, "a") == {"cancelled"})
    run_until(fleet, lambda: not fleet.arms[one].executor.active)
    assert "a" not in fleet.last_cycles


def test_an_unfinished_job_is_settled_as_done_and_stays_so(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 1)])
    one = silent(fleet)
    first = next(name for name in fleet.names if name != one)
    with pytest.raises(Refused, match="settle it"):
        fleet.control(Cancel("a"), "x", first)
    assert fleet.control(Settle("a", "done"), "y", first).job.state == "finished"
    assert not fleet.control(Settle("a", "done"), "z", first).changed
    fleet.cut = set()
    run_until(fleet, lambda: states(fleet, "a") == {"finished"})
    fleet.run(3.0)
    assert fleet.last_cycles == {"a": 1}


def test_an_unfinished_job_is_redone_only_after_its_arm_was_stopped_and_cleared(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 1)])
    one = silent(fleet)
    first = next(name for name in fleet.names if name != one)
    with pytest.raises(Refused, match=f"'{one}' may still do the last cycle"):
        fleet.control(Settle("a", "redo"), "x", first)
    fleet.arms[one].break_off()
    fleet.arms[one].crash()  # it is unsure, and will report that
    for name in fleet.names:
        if name != one:
            fleet.arms[name].clear(one)
    assert fleet.control(Settle("a", "redo"), "y", first).job.state == "waiting"
    run_until(fleet, lambda: "finished" in states(fleet, "a"), stopped=one)
    fleet.cut = set()
    run_until(fleet, lambda: states(fleet, "a") == {"finished"})
    assert fleet.last_cycles == {"a": 1}


def test_a_late_unsure_report_does_not_stop_a_job_that_is_redone(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 1, release_s=0.0)])
    one = silent(fleet)
    others = [name for name in fleet.names if name != one]
    for name in others:
        fleet.arms[name].clear(one)
        fleet.arms[name].hot = True  # nobody can redo it yet
    fleet.control(Settle("a", "redo"), "y", others[0])
    fleet.arms[one].break_off()
    fleet.arms[one].crash()
    fleet.arms[one].hot = True
    fleet.cut = set()
    fleet.run(5.0)
    assert states(fleet, "a") == {"waiting"}
    for arm in fleet.arms.values():
        arm.start()
        arm.hot = False
    run_until(fleet, lambda: states(fleet, "a") == {"finished"})


def test_a_paused_arm_gives_its_job_back_and_gets_none_until_it_is_resumed(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 400)])
    run_until(fleet, lambda: bool(holder(fleet, "a")))
    one = holder(fleet, "a")
    other = next(name for name in fleet.names if name != one)
    assert fleet.control(Pause(one), "1", other).paused == {one: "ann"}
    run_until(fleet, lambda: holder(fleet, "a") not in ("", one))
    assert fleet.control(Pause(), "2").paused == {one: "ann", "*": "ann"}
    with pytest.raises(Refused, match="All arms are paused"):
        fleet.control(Resume(one), "3")
    for arm in fleet.arms.values():
        arm.start()
    run_until(fleet, lambda: not holder(fleet, "a"))
    fleet.run(5.0)
    assert states(fleet, "a") == {"waiting"}
    assert fleet.control(Resume(), "4").paused == {}
    run_until(fleet, lambda: bool(holder(fleet, "a")))
    with pytest.raises(Refused, match="no arm 'x'"):
        fleet.control(Pause("x"), "5")


def test_due_date_and_value_change_at_all_arms_and_the_latest_counts(council):
    fleet = council.Fleet([1.0] * 3, [job("a", release_s=1e6, due_s=2e6, expires=True)])
    fleet.cut = {fleet.names[0]}
    fleet.control(Change("a", value=2.0), "1", fleet.names[0])
    fleet.true_s += 1.0
    fleet.control(Change("a", value=3.0), "2", fleet.names[1])
    fleet.control(Change("a", due_s=3e6), "3", fleet.names[2])
    with pytest.raises(Refused, match="due_s must be >= release_s"):
        fleet.control(Change("a", due_s=5.0), "4")
    fleet.cut = set()
    fleet.run(6.0)
    for arm in fleet.arms.values():
        arm.start()
        spec = arm.participant.known.current["a"]
        assert (spec.due_s, spec.value) == (3e6, 3.0)
        assert arm.participant.known.submitted["a"].value == 1.0


def test_a_status_names_the_last_arm_and_why_a_job_waits(council):
    fleet = council.Fleet([1.0] * 3, [job("a", 1)])
    one = silent(fleet)
    first = next(name for name in fleet.names if name != one)
    done = fleet.control(Settle("a", "done"), "1", first).job
    assert (done.state, done.arm, done.cycles) == ("finished", one, 1)

    fleet = council.Fleet([1.0] * 3, [job("a")])
    run_until(fleet, lambda: bool(holder(fleet, "a")))
    one = holder(fleet, "a")
    fleet.control(Pause(one), "1")
    run_until(fleet, lambda: holder(fleet, "a") not in ("", one))
    one = holder(fleet, "a")
    for name in fleet.names:
        fleet.control(Pause(name), f"pause {name}")
    run_until(fleet, lambda: states(fleet, "a") == {"waiting"})
    for restarted in (False, True):
        for arm in fleet.arms.values():
            if restarted:
                arm.start()
            (status,) = arm.participant.status([], arm.real_s)
            assert (status.arm, status.reason) == (one, "Its arm was paused by 'ann'.")
    fleet.control(Cancel("a"), "cancel")
    fleet.run(5.0)
    assert states(fleet, "a") == {"cancelled"}
    assert {s.arm for arm in fleet.arms.values() for s in arm.participant.status([], arm.real_s)} == {one}


def test_a_status_says_why_no_arm_can_do_a_job(council):
    fleet = council.Fleet([1.0] * 3, [job("a")])
    fleet.offer = lambda arm, job: JobEstimate(job.name, reason=f"too far for {arm}")
    fleet.run(3.0)
    expected = "No arm can do it: arm_0: too far for arm_0; arm_1: too far for arm_1; arm_2: too far for arm_2."
    reasons = [s.reason for arm in fleet.arms.values() for s in arm.participant.status([], arm.real_s)]
    assert reasons == [expected] * 3


JOB = JobSpec(name="j", kind="hold", places=("x",), repetitions=50)


@settings(max_examples=20)
@given(st.integers(1, 5), st.lists(st.booleans(), max_size=5), st.data())
def test_a_job_that_always_faults_is_given_up_by_all_and_others_go_on(council, arms, restarts, data):
    other = JobSpec(name="other", kind="hold", places=("y",), repetitions=3)
    fleet = council.Fleet([1.0] * arms, [JOB, other])
    restarts = iter(restarts)
    for _ in range(400):
        at_work = [a for a in fleet.arms.values() if a.executor.active and a.executor.active[0].job == "j"]
        if at_work:
            fleet.run(0.3)
            at_work[0].fault()
            fleet.run(0.3)  # the majority has its report
            if next(restarts, False):
                data.draw(st.sampled_from(list(fleet.arms.values()))).crash()
        fleet.run(0.3)
        if "given_up" in fleet.settled().values():
            break
    fleet.run(8.0)
    faults = fleet.faults["j"]
    assert len(faults) == 3 or len(faults) > len(set(faults))
    assert len(faults[:-1]) == len(set(faults[:-1])) < 3, "not one attempt more"
    for arm in fleet.arms.values():
        register = arm.participant.granter.register
        assert register.settled["j"].outcome == "given_up"
        assert register.settled["other"].outcome in ("finished", "unfinished")  # a crash in its last cycle
        (status,) = [each for each in arm.participant.status([], arm.real_s) if each.job == "j"]
        assert status.state == "given_up"
        assert all(f"'{name}' {faults.count(name)} time" in status.reason for name in faults)


@pytest.mark.parametrize("lost", [0, 1])
def test_an_arm_that_was_away_learns_that_a_job_is_given_up(council, lost):
    successor = JobSpec(name="k", kind="hold", places=("y",), after=("j",))
    fleet = council.Fleet([1.0] * 4, [JOB, successor])
    away = fleet.names[lost]
    fleet.cut = {away}
    for _ in range(200):
        fleet.run(0.3)
        at_work = [a for a in fleet.arms.values() if a.executor.active and a.name != away]
        if at_work:
            at_work[0].fault()
        if "given_up" in fleet.settled().values():
            break
    assert "j" not in fleet.arms[away].participant.granter.register.settled
    fleet.cut = set()
    fleet.run(5.0)
    for arm in fleet.arms.values():
        assert {status.job: status.state for status in arm.participant.status([], arm.real_s)} == {
            "j": "given_up",
            "k": "given_up",
        }
        assert arm.participant.all_settled(arm.real_s)


def numbered(number: int) -> JobSpec:
    return JobSpec(name=f"job {number}", kind="hold", places=("x",), repetitions=3)


def outcome(number: int, kind: str = "finished", time_s: float | None = None) -> JobOutcome:
    return JobOutcome(f"job {number}", f"a-{number}", "a", kind, 3, float(number) if time_s is None else time_s)


def entry(number: int) -> ClaimEntry:
    return ClaimEntry(f"b-{number}", f"job {number}", ("x",), 0, "requested", "home")


kinds = st.sampled_from(["finished", "given_up", "cancelled"])


@given(st.lists(st.tuples(st.integers(0, 9), kinds)), st.randoms())
def test_arms_with_the_same_outcomes_keep_the_same_ones_in_any_order(several, rng):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "MAX_SETTLED", 3)
        digests, kept = set(), set()
        for _ in range(3):
            register = Register().replay([JobsAccepted(tuple(map(numbered, range(10))))])
            for _ in range(2):  # peers send their outcomes again until all agree
                rng.shuffle(several)
                for each in several:
                    if register.is_news(outcome(*each)):
                        register.apply(JobSettled(outcome(*each)))
            again = Register().replay(register.compact())
            assert (again.digest, dict(again.settled), again.past) == (
                register.digest,
                dict(register.settled),
                register.past,
            )
            digests.add(register.digest)
            kept.add(tuple(sorted((name, each.outcome) for name, each in register.settled.items())))
        assert (len(digests), len(kept)) == (1, 1)


def test_a_long_run_takes_bounded_memory_and_disk_and_no_job_is_granted_again():
    disk, register = Disk(), Register()
    granter = Granter("a", ("a", "b"), register, disk.keep, real_s=0.0)
    sizes = []
    for number in range(6000):
        granter.add_jobs((numbered(number),))
        granter.answer_claim(Claim("b", number, (), (outcome(number),), space=()), 0.0)
        register.take_gone()
        if number in (2999, 5999):
            records = register.compact()
            sizes.append(sum(len(encode(record)) for record in records) - len(register.past.packed()) * 4 / 3)
    assert sizes[1] < 1.1 * sizes[0]
    for content in (register.settled, register.jobs, register.cycles, register.faults, register.returned_s):
        assert len(content) <= jobs.MAX_SETTLED
    assert (len(register.past), register.settled.left) == (4000, {"finished": 4000})
    again = Register().replay(register.compact())
    for number in random.Random(0).sample(range(6000), 50):
        reply = Granter("a", ("a", "b"), again, disk.keep, real_s=0.0).answer_claim(
            Claim("b", 10_000 + number, (entry(number),), space=()), 0.0
        )
        again.numbers.clear()
        assert reply.denied[0].outcome.outcome == "finished"
    granter.add_jobs((numbered(3),))
    assert "job 3" not in register.jobs


def test_an_arm_that_was_away_learns_that_a_job_has_left(council, monkeypatch):
    monkeypatch.setattr(jobs, "MAX_SETTLED", 2)
    fleet = council.Fleet([1.0] * 3, [JobSpec(f"job {n}", "hold", (f"p{n}",), 2) for n in range(8)])
    fleet.cut = {"arm_2"}
    for _ in range(100):
        fleet.run(0.2, stopped="arm_2")
        if fleet.arms["arm_0"].participant.all_settled(fleet.arms["arm_0"].real_s):
            break
    assert len(fleet.arms["arm_0"].participant.granter.register.past) == 6
    assert len(fleet.arms["arm_0"].participant.known.current) == 2
    fleet.cut = set()
    fleet.run(8.0)
    assert fleet.arms["arm_2"].participant.open_jobs(fleet.arms["arm_2"].real_s) == []
    assert set(fleet.last_cycles.values()) == {1}
