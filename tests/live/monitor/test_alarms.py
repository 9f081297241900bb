"""Alarms begin once, end once, survive a restart from their messages, and keep who has seen them."""

from datetime import UTC, datetime
from itertools import product
from unittest.mock import MagicMock

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.protocol.auction import JobStatus, Status
from fleet.bus.protocol.operator import Alarm
from fleet.errors import Refused
from fleet.live.clock import FleetClock
from fleet.live.monitor.alarms import HOLD_S, AlarmList
from fleet.live.monitor.async_bridge import AsyncBridge
from fleet.live.monitor.health import Finding, check_arm, check_awards, check_connection, check_jobs
from fleet.live.monitor.snapshot import MAX_ALARMS, FleetSnapshot, FleetView
from scenarios.live.recorder import Recorder
from scenarios.live.recording import alarms_of
from tests.live.monitor.messages import state

HOT = Finding("warning", "a is faulted.", "fault", "a")
NOON = datetime(2026, 1, 31, 12, 0, tzinfo=UTC)


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_an_alarm_lasts_from_the_first_finding_until_a_pause_longer_than_the_hold(there):
    """By hand: one check a second; a run of more than `HOLD_S` checks without the finding separates two alarms."""
    alarms = AlarmList("m", {})
    changes = [alarms.update([HOT] if each else [], float(s), float(s)) for s, each in enumerate(there)]
    text = "".join("x" if each else " " for each in there)
    runs = [run for run in text.split(" " * (int(HOLD_S) + 1)) if "x" in run]
    began = [change for each in changes for change in each if change.ended_s is None]
    assert len(began) == len(runs)
    assert [each.began_s for each in began][:1] == ([float(text.index("x"))] if runs else [])
    ended = [change for each in changes for change in each if change.ended_s is not None]
    assert len(ended) == len(runs) - (len(text) - len(text.rstrip(" ")) <= HOLD_S and bool(runs))
    numbers = [change.number for each in changes for change in each]
    assert numbers == list(range(1, len(numbers) + 1))


def test_a_restart_continues_the_alarms_of_its_messages():
    """The same finding raises no second alarm; who has seen it is kept; one that is gone ends after the hold."""
    first = AlarmList("m", {})
    sent = first.update([HOT, Finding("fault", "no one works", "webhook", "space")], 10.0, 1000.0)
    sent.append(first.acknowledge(sent[0].alarm, " ann ", 12.0, NOON))
    again = AlarmList("m", {}, sent)
    assert again.update([HOT], 20.0, 3000.0) == []
    (ended,) = again.update([HOT], 26.0 + HOLD_S, 3006.0 + HOLD_S)
    assert (ended.kind, ended.ended_s, ended.number) == ("webhook", 20.0, 4)  # when it was last there
    kept = again.alarms[sent[0].alarm]
    assert (kept.by, kept.acknowledged, kept.ended_s) == ("ann", "2026-01-31T12:00:00Z", None)
    with pytest.raises(Refused, match="'ann' has acknowledged it at 2026-01-31T12:00:00Z"):
        again.acknowledge(kept.alarm, "bob", 31.0, NOON)
    for name, by, reason in (("none", "ann", "no alarm 'none'"), (ended.alarm, "  ", "name of a person")):
        with pytest.raises(Refused, match=reason):
            again.acknowledge(name, by, 31.0, NOON)


def test_a_recording_keeps_the_alarms_of_a_gateway_that_starts_again_beside_a_new_fleet(tmp_path):
    """Fleet time begins anew, the gateway knows nothing of its last start, and no alarm is missing or dropped."""
    recorder = Recorder.open(tmp_path, "f")
    sent = [
        change
        for start_s, time_s in ((1.76e9, 500.0), (1.76e9 + 9, 0.0))
        for alarms in [AlarmList("gateway", {}, start_s=start_s)]
        for step in (0, 1)
        for change in alarms.update([HOT, Finding("fault", "no one", "webhook", str(step))], time_s + step, step)
    ]
    for change in sent:
        recorder.add("gateway", change)
    recorder.write(status="finished")
    assert len(sent) == 6
    assert len(alarms_of(tmp_path)) == 6
    assert not recorder.missing


def test_the_list_is_bounded_and_keeps_what_lasts():
    alarms = AlarmList("m", FleetView("f").alarms)
    every = [Finding("warning", str(n), "given_up", str(n)) for n in range(5 * MAX_ALARMS)]
    alarms.update([HOT], 0.0, 0.0)
    for n, finding in enumerate(every):
        alarms.update([HOT, finding], 0.0, 10.0 * n)
    assert len(alarms.alarms) == MAX_ALARMS
    assert [each.subject for each in alarms.alarms.values() if each.kind == "fault"] == ["a"]
    alarms.update(every, 0.0, 1e6)
    assert len(alarms.alarms) == MAX_ALARMS


def test_two_monitors_raise_acknowledge_and_end_one_alarm():
    """Both hear each other: one name, whoever raises it; nothing is sent twice, and who has seen it is kept."""
    views = FleetView("f"), FleetView("f")
    lists = [AlarmList(name, view.alarms) for name, view in zip("mn", views, strict=True)]

    def send(*changes):
        for change, view in product(changes, views):
            view.update(change.monitor, change, 0.0)

    (both,) = {each.update([HOT], 10.0, 0.0)[0].alarm for each in lists}  # in the same second
    send(*views[0].alarms.values(), *views[1].alarms.values())
    send(lists[1].acknowledge(both, "ann", 12.0, NOON))
    with pytest.raises(Refused, match="'ann' has acknowledged it"):
        lists[0].acknowledge(both, "bob", 13.0, NOON)
    changes = lists[0].update([], 20.0, HOLD_S + 0.1)
    send(*changes)
    assert [each.update([], 21.0, HOLD_S + 1.0) for each in lists] == [[], []]
    for view in views:
        (alarm,) = view.snapshot(0.0).alarms
        assert (alarm.alarm, alarm.by, alarm.ended_s) == (both, "ann", pytest.approx(14.9))  # last found 5.1 s before
    (again,) = lists[0].update([HOT], 30.0, 30.0)
    send(again)
    assert lists[1].update([HOT], 31.0, 31.0) == []
    assert (again.by, again.began_s, again.ended_s) == ("", 30.0, None)


def test_a_monitor_that_joins_takes_up_the_alarms_of_another_and_ends_only_what_it_has_found():
    view = FleetView("f")
    for finding in (HOT, Finding("warning", "b is faulted.", "fault", "b")):
        for change in AlarmList("m", {}).update([finding], 1.0, 0.0):
            view.update("m", change, 0.0)
    joined = AlarmList("n", view.alarms)
    assert joined.update([HOT], 20.0, 20.0) == []
    assert [each.subject for each in joined.update([], 30.0, 30.0)] == ["a"]
    assert [each.subject for each in view.alarms.values() if each.ended_s is None] == ["b"]
    joined.take_up("m")  # it has exited
    assert [joined.update([], s, s) for s in (31.0, 36.0)] == [[], []]
    assert [(each.subject, each.ended_s) for each in joined.update([], 37.0, 37.0)] == [("b", 31.0)]


def test_a_late_message_of_an_alarm_changes_nothing_and_a_new_epoch_does():
    view = FleetView("f")
    ended, begun = (Alarm("m", number, time_s, "a", "fault", "?", ended_s=time_s if number == 2 else None)
                    for number, time_s in ((2, 50.0), (1, 40.0)))  # fmt: skip
    for message in (ended, begun, msgspec.structs.replace(begun, monitor="n")):
        view.update(message.monitor, message, 0.0)
        assert view.alarms["a"] is ended
    fresh = msgspec.structs.replace(begun, number=3, time_s=1.0)
    view.update("m", fresh, 0.0)
    assert view.alarms["a"] is fresh


def test_an_alarm_about_no_participant_ends_with_its_finding():
    waits = Finding("fault", "no one works", "webhook", "space")
    alarms = AlarmList("m", {})
    alarms.update([waits], 0.0, 0.0, heard={"a"})
    (ended,) = alarms.update([], 9.0, 9.0, heard={"a"})
    assert (ended.time_s, ended.ended_s) == (9.0, 0.0)


def test_findings_without_a_kind_raise_no_alarm():
    assert AlarmList("m", {}).update([Finding("fault", "The router is slow.")], 0.0, 0.0) == []


@pytest.mark.parametrize(
    ("change", "waiting", "paused", "says"),
    [
        ({"job": "j", "mode": "working"}, {}, {}, ""),
        ({}, {}, {"*": "ann"}, "It is paused by 'ann'."),
        ({"mode": "faulted"}, {}, {}, "It is faulted."),
        ({"headroom_k": -1.0}, {"j": "x"}, {}, "It is above its warning limit."),
        ({"temp_c": (30.0, -300.0, 40.0), "headroom_k": -1.0}, {"j": "x"}, {}, "Its temperatures are impossible."),
        ({}, {}, {}, "No job waits."),
        (
            {},
            {"j": "It waits until a is out of the way."},
            {},
            "It has bids for 0 of 1 waiting jobs. j: It waits until a is out of the way.",
        ),
        ({}, {"j": "It waits until a2, ba are out of the way."}, {}, "It has bids for 0 of 1 waiting jobs."),
    ],
)
def test_an_arm_without_a_job_says_why(change, waiting, paused, says):
    view = FleetView("f")
    view.set_token("arm", "a", True)
    view.update("a", state(**change), 0.0)
    jobs = tuple(JobStatus(job, "waiting", reason=reason) for job, reason in waiting.items())
    view.update_jobs(Status("au", 1.0, jobs, paused=paused), 0.0)
    (arm,) = view.snapshot(0.0).arms
    assert arm.idle == says


def test_an_idle_arm_names_the_arms_that_may_be_in_its_way():
    view = FleetView("f")
    view.set_token("arm", "a", True)
    view.update("a", state(), 0.0)
    reply = Status("au", 1.0, (JobStatus("j", "waiting", reason="It waits until a is out of the way."),))
    for space, says in (
        ({"a": ("s",)}, ""),
        ({"a": ("t",), "c": ("*",)}, "Space is closed by c, which may be in its way."),
    ):
        view.update_jobs(msgspec.structs.replace(reply, space=space), 0.0)
        assert view.snapshot(0.0).arms[0].idle == f"It has bids for 0 of 1 waiting jobs. {says}".strip()


@pytest.mark.parametrize(
    ("ticks", "doubled"),
    [
        ((100, 3, 101, 4, 102, 5), True),
        ((100, 101, 1, 2, 3, 4), False),  # one restart
        ((1, 1, 2, 2, 3, 3, 4, 4), True),  # both have just started
        ((7, 7, 7, 7, 7, 7), True),
        ((9, 8, 7, 6, 5, 4), True),
    ],
)
def test_two_processes_under_the_name_of_one_arm_are_noticed(ticks, doubled):
    view = FleetView("f")
    view.set_token("arm", "a", True)
    for number, tick in enumerate(ticks):
        view.update("a", state(tick=tick, time_s=float(number)), 0.5 * number)
    (arm,) = view.snapshot(3.0).arms
    assert [each.what[:31] for each in check_arm(arm, None)] == doubled * ["The ticks of a do not count up:"]
    assert not view.snapshot(9.0).arms[0].doubled


def test_the_time_between_the_last_two_states_is_known():
    view = FleetView("f")
    gaps_s = []
    for second in (0.0, 10.0, 10.1):
        view.update("a", state(), second)
        gaps_s.append(view.snapshot(second).arms[0].state_gap_s)
    assert gaps_s == [None, 10.0, pytest.approx(0.1)]


def test_work_and_heat_are_sums_over_the_time_between_states():
    """By hand: 10 s at work with torques 3 and 4 Nm, then 5 s idle with 2 Nm: 10 s of work, 10 · 25 + 5 · 4 N²m²s."""
    view = FleetView("f")
    for time_s, mode, tau in (
        (0.0, "working", (3.0, 4.0, 0.0)),
        (10.0, "idle", (2.0, 0.0, 0.0)),
        (15.0, "idle", (1.0, 1.0, 1.0)),
    ):
        view.update("a", state(time_s=time_s, mode=mode, tau=tau), 0.0)
    view.update("a", state(time_s=500.0, epoch="new", tau=(9.0, 9.0, 9.0)), 0.0)  # another epoch has another clock
    (arm,) = view.snapshot(0.0).arms
    assert (arm.worked_s, arm.heat_n2m2s) == (10.0, 270.0)


def test_an_alarm_of_an_unheard_arm_lasts_until_somebody_has_seen_it():
    """A monitor that begins anew does not know the arm that fell silent before, so its silence tells nothing."""
    silent = Alarm("m", 1, 10.0, "a1", "absent", "arm_2 is absent", "arm_2", 10.0)
    alarms = AlarmList("m", {}, [silent])
    for second in range(20):
        assert alarms.update([], 20.0 + second, float(second), heard={"arm_1"}) == []
    alarms.acknowledge("a1", "ada", 41.0, NOON)
    ended = [each for second in range(20, 40) for each in alarms.update([], 60.0, float(second), heard={"arm_1"})]
    assert [each.ended_s for each in ended] == [60.0 - (HOLD_S + 1.0)]


def test_the_alarm_of_a_silence_begins_with_the_last_reply():
    """By hand: 20 s without a reply, at 60 fleet seconds a second, before fleet time 2000 s."""
    view = FleetView("f")
    view.set_token("arm", "a", True)
    view.set_token("auction", "au", True)
    view.update_jobs(Status("au", 800.0, ()), 0.0)
    view.update("a", state(time_s=2000.0), 20.0)
    findings = check_awards(view.snapshot(20.0))
    alarms = AlarmList("m", {})
    assert alarms.update(findings, 2000.0, 20.0, speed=60.0) == []  # after an outage of the router it is asked anew
    view.update("a", state(time_s=2360.0), 26.0)
    findings = check_awards(view.snapshot(26.0))
    (alarm,) = alarms.update(findings, 2360.0, 26.0, speed=60.0)
    assert (alarm.kind, alarm.subject, alarm.time_s, alarm.began_s) == ("silent", "au", 2360.0, 800.0)


def test_a_job_that_is_given_up_raises_one_alarm_which_ends_when_somebody_has_seen_it():
    lost = Finding("warning", "'a' is abandoned: three faults", "given_up", "a")
    alarms = AlarmList("m", {})
    (begun,) = alarms.update([lost], 5.0, 5.0)
    assert alarms.update([lost], 60.0, 60.0) == []
    seen = alarms.acknowledge(begun.alarm, "ann", 70.0, NOON)
    assert (seen.by, seen.ended_s) == ("ann", 70.0)
    assert alarms.update([lost], 80.0, 80.0) == alarms.update([lost], 90.0, 90.0) == []
    again = AlarmList("m", {}, [seen])
    assert again.update([lost], 100.0, 1.0) == []


def test_a_listener_says_who_does_not_reply_and_why_nobody_awards_jobs():
    """Also if nobody has ever replied; without a connection nothing is known."""
    view = FleetView("f", began_s=0.0)
    view.set_token("arm", "a", True)
    view.update("a", state(), 15.0)
    assert check_awards(view.snapshot(15.0)) == []
    view.update("a", state(), 16.0)
    (silent,) = check_awards(view.snapshot(16.0))
    assert (silent.kind, silent.subject, silent.since_s) == ("silent", "", 16.0)
    assert silent.what == "Nobody has replied about the jobs for 16 s: no job is awarded."
    assert view.snapshot(16.0).arms[0].idle == "Nobody has replied about the jobs."
    view.update_jobs(Status("au", 1.0, (), trouble="The disk is full."), 17.0)
    (stopped,) = check_awards(view.snapshot(17.0))
    assert (stopped.level, stopped.kind, stopped.subject) == ("fault", "stopped", "au")
    assert stopped.what == view.snapshot(17.0).arms[0].idle == "The disk is full."
    view.update_jobs(Status("au", 2.0, ()), 18.0)
    assert check_awards(view.snapshot(18.0)) == check_connection(view.snapshot(18.0)) == []
    view.set_token("arm", "b", True)
    view.heard_s = 18.0
    for connected, second, lost_s in ((True, 25.0, None), (False, 26.0, 26.0), (True, 27.0, None)):
        view.follow_connection(connected, second)
        assert view.lost_s == lost_s
    view.update("b", state(), 18.0)
    for second, lost_s in ((20.5, None), (20.6, 20.6), (22.0, 20.6)):  # the router hangs
        view.follow_connection(True, second)
        assert view.lost_s == lost_s
    view.heard_s = 23.0
    view.follow_connection(True, 23.0)
    assert view.lost_s is None
    view.lost_s = 18.0
    (lost,) = check_connection(view.snapshot(20.0))
    assert (lost.kind, lost.since_s) == ("connection", 2.0)
    assert lost.what.endswith("What is shown is from before, 2 s ago.")
    for arm in "ab":
        view.update(arm, state(arm, leaving=True), 18.0)
    assert [(each.level, each.kind) for each in check_connection(view.snapshot(20.0))] == [("note", "")]
    view.set_token("arm", "a", False)
    view.set_token("arm", "b", False)
    late = view.snapshot(60.0)
    assert (late.arms, [each.level for each in check_connection(late)]) == ((), ["note"])
    view.update("a", state("a", tick=2), 18.0)
    view.expiry = "The certificate of 'm' expired."
    assert check_connection(view.snapshot(20.0))[0].what.startswith("The certificate of 'm' expired. What is shown is")


def test_an_absence_raises_an_alarm_once_it_lasts_and_the_end_of_the_shift_raises_none():
    lasting = Finding("fault", "arm_1 is stale: 9 s", "absent", "arm_1", lasting="arm_1 is absent.")
    closed = Finding("fault", "The space of arm_1 stays closed; 5 job(s) wait for it", "space", "arm_1")
    alarms = AlarmList("m", {})
    for real_s in (0.0, 1.0, 2.5):  # as while a router restarts
        assert alarms.update([lasting, closed], 300.0 + 60 * real_s, real_s, speed=60.0) == []
    assert alarms.update([], 480.0, 3.0) == []
    for real_s in (5.0, 7.0):
        assert alarms.update([lasting, closed], 300.0 + 60 * real_s, real_s, speed=60.0) == []
    waiting = Finding("fault", "2 jobs wait though no arm works and a is idle.", "no_progress", "busy")
    begun, space = alarms.update([waiting, lasting, closed], 780.0, 8.0, speed=60.0)
    assert alarms.update([waiting, lasting, closed], 1320.0, 17.0, speed=60.0) == []
    assert [each.began_s for each in alarms.update([waiting, lasting, closed], 1380.0, 18.0, speed=60.0)] == [780.0]
    assert (begun.began_s, space.began_s) == (600.0, 600.0)
    assert (begun.what, space.what) == ("arm_1 is absent.", closed.what)
    jobs = (JobStatus("a", "unfinished", shift_ended=True), JobStatus("b", "unfinished", reason="An arm stopped."))
    fleet = FleetSnapshot("f", (), (), {}, jobs)
    assert [finding.subject for finding in check_jobs(fleet)] == ["b"]


@pytest.mark.parametrize(("lost_s", "kinds"), [(102.0, {"connection"}), (104.5, {"absent", "connection"})])
def test_no_absence_begins_while_there_is_no_connection(lost_s, kinds):
    """The token of an arm goes at 100 s; an absence is an alarm after 3 s, and the connection is lost before or after.

    The clock of the fleet, at speed 60, goes on: the alarm begins when the connection was lost.
    """
    link = MagicMock(fleet="f", participant="", complaints=lambda _: {})
    link.objection.return_value = ""
    bridge = AsyncBridge(link, lambda: None)
    bridge._loop, view = MagicMock(), bridge._listener.view
    view.clock = FleetClock(60.0).set_to(0.0, 0.0, 0.0)
    view.set_token("arm", "a", True)
    view.update("a", state("a", 6000.0), 99.9)
    view.set_token("arm", "a", False)
    for step in range(100, 112):
        view.lost_s = lost_s if step >= lost_s else None
        bridge._check_alarms(float(step))
    lasting = [alarm for alarm in bridge._alarms.alarms.values() if alarm.ended_s is None]
    assert {alarm.kind for alarm in lasting} == kinds
    assert [alarm.began_s for alarm in lasting if alarm.kind == "connection"] == [pytest.approx(60.0 * lost_s)]
