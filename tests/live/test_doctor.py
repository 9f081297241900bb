"""The doctor reports each fault of a fleet, and no fault of a healthy one."""

import json
import socket
import time
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.client import BusClient, under
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import Clock, ClockRequest, JobStatus, Status
from fleet.bus.protocol.messages import State
from fleet.bus.protocol.operator import Alarm
from fleet.bus.router import Router
from fleet.live.monitor.health import (
    OFFSET_S,
    ClockProbe,
    check_arm,
    check_fleet,
    check_health,
    check_left_out,
    check_progress,
)
from fleet.live.monitor.snapshot import FRESH_S, ArmSnapshot, AuctioneerSnapshot, FleetSnapshot, FleetView
from scenarios.live.doctor import reach_of, show
from scenarios.show.watch import space_line
from tests import commands
from tests.waiting import serving

ASKED = ClockProbe(asked_s=100.0, answered_s=100.01, time_s=5000.0, speed=60.0)
"""The fleet's time is 5000 s at the real second 100.005."""

ALONE = (AuctioneerSnapshot("au", True, 0.1),)


def arm(**change):
    known = {"arm": "a", "token": True, "present": True, "mode": "idle", "time_s": 5060.0, "state_age_s": 0.5}
    return ArmSnapshot(**{**known, **change})


def fleet(*arms, auctioneers=ALONE, counts=None, jobs=(), **more):
    return FleetSnapshot("f", arms, auctioneers, counts or {}, jobs, **more)


def test_an_absent_arm_that_keeps_its_space_is_a_warning():
    now = fleet(arm(away=True), space={"a": ("s",), "b": ("*",)})
    (finding,) = check_health(now, 101.505, [ASKED]).findings
    assert finding.level == "warning"
    assert "The space of b stays closed" in finding.what
    assert "thermofleet arm clear b" in finding.what
    assert space_line(now).plain == "space closed by: a (away from home), b (not present, may be anywhere)"


def test_an_idle_arm_that_quotes_space_is_not_said_to_have_a_job():
    now = fleet(arm(), arm(arm="b", job="j"), space={"a": ("s",), "b": ("t",)})
    assert space_line(now).plain == "space closed by: a (has no job), b (has a job)"


def faults(now, *probes, **more):
    found = check_health(now, 101.505, probes or [ASKED], **more)
    return [finding.what for finding in found.findings if finding.level == "fault"], found


@pytest.mark.parametrize(
    ("ages_s", "present", "silent"),
    [
        ({"au": 15.1}, True, "au"),
        ({"au": 14.9}, True, ""),
        ({"au": None}, True, ""),
        ({"arm_0": 90.0, "arm_1": 20.0}, True, "arm_1"),
        ({"arm_0": 90.0, "arm_1": 2.0}, True, ""),
        ({"au": 60.0}, False, ""),
    ],
    ids=["hung", "in time", "not heard yet", "no arm replies", "another arm replies", "all have left"],
)
def test_a_fleet_in_which_nobody_replies_about_jobs_raises_an_alarm(ages_s, present, silent):
    auctioneers = tuple(AuctioneerSnapshot(name, True, age_s) for name, age_s in ages_s.items())
    findings = check_fleet(fleet(arm(present=present), auctioneers=auctioneers), None)
    assert [each.subject for each in findings if each.kind == "silent"] == [silent] * bool(silent)


WAY = "It waits until gone one is out of the way."


@pytest.mark.parametrize(
    ("reason", "level", "counts", "before", "says"),
    [
        (WAY, "fault", {}, 2, f"2 jobs wait though no arm works and a is idle. {WAY}"),
        ("The policy lets it wait: a could begin it.", "warning", {}, 2, "2 jobs wait though no arm works"),
        (WAY, "fault", {"awarded": 1}, 2, None),
        (WAY, "fault", {}, 0, None),  # they have just come
        ("It is released at 90 s of fleet time.", "fault", {}, 2, None),
        ("a has a break.", "fault", {}, 2, None),
    ],
)  # fmt: skip
def test_jobs_that_wait_in_vain_are_a_fault(reason, level, counts, before, says):
    jobs = tuple(JobStatus(name, "waiting", reason=reason) for name in ("j", "k"))
    now = fleet(arm(), counts={"waiting": 2, **counts}, jobs=jobs)
    found = check_health(now, 101.505, [ASKED], earlier=msgspec.structs.replace(now, jobs=jobs[:before])).findings
    assert [(finding.level, finding.what[: len(says or "")]) for finding in found] == ([(level, says)] if says else [])


@pytest.mark.parametrize(
    ("change", "in_vain"),
    [
        ({"mode": "working"}, False),
        ({"mode": "working", "present": False}, True),
        ({"mode": "faulted", "away": True}, True),
    ],
    ids=["on its way home", "gone", "faulted"],
)
def test_jobs_do_not_wait_in_vain_while_an_arm_moves_without_one(change, in_vain):
    jobs = (JobStatus("j", "waiting", reason="b has a job."),)
    now = fleet(arm(), arm(arm="b", **change), counts={"waiting": 1}, jobs=jobs)
    for before, after in ((now, now), (now, fleet(arm())), (fleet(arm()), now)):
        both = [msgspec.structs.replace(each, jobs=jobs) for each in (before, after)]
        waits = [each.kind for each in check_progress(both[1], both[0])] == ["no_progress"]
        assert waits == in_vain


@pytest.mark.parametrize("reason", [WAY, "It waits until a, gone one are out of the way. gone one is not present."])
def test_space_of_an_arm_that_has_gone_is_a_fault_if_jobs_wait_for_it(reason):
    jobs = (JobStatus("j", "waiting", reason=reason),)
    gone = arm(arm="gone one", token=False, present=False, state_age_s=5.2)
    now = fleet(arm(), gone, counts={"waiting": 1}, jobs=jobs, space={"gone one": ("s",)})
    output, _ = faults(now, earlier=now)
    assert any("not present for 5 s; 1 job(s) wait for it" in each for each in output)
    assert any(each.endswith("thermofleet arm clear 'gone one'") for each in output)
    assert sum(reason in each for each in output) == 1


@pytest.mark.parametrize(
    ("paused", "says"),
    [
        ({"*": "root"}, ["All arms are paused by 'root'."]),
        ({"*": "root", "a": "root"}, ["All arms are paused by 'root'."]),
        ({"a": "ann", "b": "ann", "c": ""}, ["a, b are paused by 'ann'.", "c is paused."]),
    ],
)
def test_a_pause_is_a_note(paused, says):
    found = check_health(fleet(arm(), paused=paused), 101.505, [ASKED])
    assert [(finding.level, finding.what) for finding in found.findings] == [("note", each) for each in says]
    assert found.healthy


def test_a_healthy_fleet_has_no_findings():
    output, found = faults(fleet(arm()))
    assert output == []
    assert found.healthy
    assert found.round_trip_s == pytest.approx(0.01)
    assert found.time_s == pytest.approx(5000.0 + 60.0 * 1.5)
    assert found.offsets_s["a"] == pytest.approx(0.0, abs=1e-9)  # 5060 s at the real second 101.005, as it should be


@pytest.mark.parametrize(
    ("now", "probe", "says"),
    [
        (fleet(), ASKED, "No arm is present"),
        (fleet(arm(), arm(arm="b", present=False, state_age_s=FRESH_S + 1.0, time_s=4850.0)), ASKED, "b is stale"),
        (
            fleet(arm(), arm(arm="b", present=False, state_age_s=None, time_s=None)),
            ASKED,
            "b shows its token but publishes no state",
        ),
        (fleet(arm(), arm(arm="b", present=False, token=False)), ASKED, "b publishes its state but shows no token"),
        (
            fleet(arm(), arm(arm="b", time_s=5060.0 + 60.0 * 3)),
            ASKED,
            "b is 3.0 real seconds ahead of fleet time: it does not set its clock",
        ),
        (
            fleet(arm(), arm(arm="b", time_s=5060.0 - 60.0 * 3)),
            ASKED,
            "b is 3.0 real seconds behind fleet time: it does not set its clock by the replies to clock/now, or its",
        ),
        (fleet(arm(), auctioneers=()), ClockProbe(1.0, 1.1), "No auctioneer"),
        (fleet(arm(), auctioneers=(AuctioneerSnapshot("au", True),)), ClockProbe(1.0, 1.1), "process may hang"),
        (
            fleet(arm(), auctioneers=(AuctioneerSnapshot("x", True), AuctioneerSnapshot("y", True))),
            ASKED,
            "2 auctioneers",
        ),
        (fleet(arm(), jobs=(JobStatus("x", "unfinished"),)), ASKED, "'x' is unfinished, so its outcome is unknown: no"),
    ],
)
def test_each_fault_is_one_finding(now, probe, says):
    output, found = faults(now, probe)
    assert len(output) == 1
    assert says in output[0]
    assert not found.healthy


def test_a_fleet_that_needs_no_auctioneer_is_healthy_without_one():
    silence = ClockProbe(100.0, 100.1)
    assert faults(fleet(arm(), auctioneers=()), silence)[0] == [
        "No auctioneer shows a token or answers: jobs are not awarded, and every arm keeps its own time. "
        "If this fleet needs none, give --no-auctioneer."
    ]
    output, found = faults(fleet(arm(), auctioneers=()), silence, auctioneer=False)
    assert (output, found.findings, found.time_s) == ([], (), None)
    output, found = faults(fleet(arm()), auctioneer=False)
    assert output == []
    assert "au is present, though" in found.findings[0].what
    assert "2 auctioneers" in faults(fleet(arm(), auctioneers=(*ALONE, *ALONE)), auctioneer=False)[0][0]


def test_no_auctioneer_is_missed_where_an_arm_replies_about_the_jobs():
    now = fleet(arm(), auctioneers=(AuctioneerSnapshot("a", False, 0.5, "1 of 4 arms present."),))
    assert faults(now, ClockProbe(100.0, 100.1))[0] == ["1 of 4 arms present."]


def test_malformed_messages_are_a_fault_with_each_reason_once():
    output, _ = faults(fleet(arm()), malformed=3, complaints={"a": "no JSON.", "b": "no State.", "c": "no JSON."})
    assert output == ["3 malformed message(s), the last: no JSON.; no State."]


@pytest.mark.parametrize(
    ("age_s", "says"),
    [
        (None, "b shows its token but publishes no valid state: its states are malformed."),
        (9.0, "b is stale, with a last state 9.0 s old: its states are malformed."),
    ],
)
def test_an_arm_whose_states_are_malformed_is_not_said_to_hang(age_s, says):
    now = fleet(arm(), arm(arm="b", present=False, state_age_s=age_s, time_s=None))
    place = under(keys.of_arm(now.fleet, "b", "state"))
    output, _ = faults(now, malformed=1, complaints={place: f"{place}: Not a thermofleet.State.v4: no JSON."})
    assert says in output


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"token": False, "state_age_s": 0.5}, "it publishes its state but shows no token"),
        ({"token": False, "state_age_s": 0.5, "leaving": True, "away": True}, "it was stopped away from home."),
        ({"token": False, "state_age_s": 9.5, "leaving": True, "job": "j"}, "it was stopped with a job."),
        ({"token": False, "state_age_s": 3.5}, "it has left, or its process hangs or has ended."),
        ({"state_age_s": 5.0, "state_gap_s": 10.0}, "its last two states came 10.0 s apart"),
        ({"state_age_s": 5.0, "state_gap_s": 0.1}, "it has left, or its process hangs or has ended."),
    ],
)
def test_the_alarm_of_an_absent_arm_names_its_cause(change, why):
    (finding,) = check_arm(arm(present=False, **change), None)
    assert finding.lasting.startswith(f"a is absent: {why}")


@pytest.mark.parametrize(
    ("change", "left"),
    [
        ({}, True),
        ({"leaving": False}, False),
        ({"job": "j"}, False),
        ({"space": "s"}, False),
    ],
)
def test_an_arm_that_has_left_in_order_is_no_fault(change, left):
    view = FleetView("f")
    view.set_token("arm", "a", True)
    last = State(arm="a", tick=0, time_s=0.0, mode="idle", temp_c=(), headroom_k=9.0, leaving=True)
    view.update("a", msgspec.structs.replace(last, **change), 100.0)
    assert not view.snapshot(100.0).arms[0].left  # its process runs
    view.set_token("arm", "a", False)
    (finding,) = check_arm(view.snapshot(101.0).arms[0], None)
    assert (finding.level, finding.kind) == (("note", "") if left else ("fault", "absent"))


def test_an_arm_that_left_in_order_is_listed_no_longer_unless_somebody_waits_for_it():
    """A second after it left it is listed, a minute later only with a job that it had or with space that is closed."""
    view = FleetView("f")
    view.update("a", State("a", 0, 0.0, "idle", (), 9.0, leaving=True), 100.0)
    view.update("b", State("b", 0, 0.0, "idle", (), 9.0), 100.0)
    view.update_jobs(Status("au", 0.0, (JobStatus("j", "finished", "a"),)), 100.0)
    at = view.snapshot(101.0)
    assert ([each.arm for each in at.arms], at.left) == (["a", "b"], ())
    at = view.snapshot(160.0)
    assert ([each.arm for each in at.arms], at.left) == (["b"], ("a",))
    _, found = faults(at)
    assert "Left in order: a." in [each.what for each in found.findings]
    view.set_token("auction", "au", True)
    alarm = Alarm("m", 1, 5.0, "absent a", "absent", "a is absent.", "a")
    assert not any("An alarm of" in each for each in faults(msgspec.structs.replace(at, alarms=(alarm,)))[0])
    needed = Status("au", 1.0, (JobStatus("j", "unfinished", "a"),)), Status("au", 2.0, (), space={"a": ("*",)})
    view.update_jobs(Status("au", 0.5, (JobStatus("j", "unfinished", "a", shift_ended=True),)), 160.0)
    assert view.snapshot(160.0).left == ("a",)
    for reply in needed:
        view.update_jobs(reply, 160.0)
        assert view.snapshot(160.0).left == ()
        view.update_jobs(Status("au", reply.time_s, (JobStatus("j", "finished", "a"),)), 160.0)
        assert view.snapshot(160.0).left == ("a",)


@pytest.mark.parametrize("role", ["auction", "arm"])
def test_the_space_of_an_arm_that_left_in_order_is_forgotten_with_who_kept_it_closed(role):
    """The last reply before the end of the shift; b left with its space."""
    view, last = FleetView("f"), State("a", 0, 0.0, "idle", (), 9.0, leaving=True)
    view.update("a", last, 100.0)
    view.update("b", msgspec.structs.replace(last, arm="b", space="s"), 100.0)
    view.update_jobs(Status("au", 1.0, (), space={"a": ("*",), "b": ("s",)}), 100.0)
    for there in (True, False):
        view.set_token(role, "au", there)
        at = view.snapshot(101.0)
        assert at.space.keys() == ({"a", "b"} if there else {"b"})
        assert [each.subject for each in check_fleet(at, None) if each.kind == "space"] == sorted(at.space)
    assert view.snapshot(160.0).left == ("a",)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"joints": 7, "temp_c": (30.0,) * 6}, "a has 6 temperatures in its state, but 7 joints in its info."),
        ({"joints": 7, "temp_c": (30.0,) * 7, "hottest_c": 30.0, "headroom_k": 30.0}, ""),
        ({"joints": 7}, ""),  # it has no thermometers
        (
            {"hottest_c": 30.6, "headroom_k": 500.0},
            "a reports a headroom of 500.0 K at 30.6 °C: its warning limit would",
        ),
    ],
)
def test_a_state_that_contradicts_itself_is_a_warning(change, what):
    findings = check_arm(arm(**change), None)
    assert [(each.level, each.what[: len(what)]) for each in findings] == [("warning", what)] * bool(what)


def test_an_arm_that_answers_no_awards_is_named():
    left_out = {"b": "has not answered the last 3 awards"}
    _, found = faults(fleet(arm(), arm(arm="b"), left_out=left_out))
    (finding,) = found.findings
    assert finding.what.startswith("b has not answered the last 3 awards: it is awarded no job for a while.")
    assert "hang" not in check_left_out("b", "gave no valid quote: 'peak_c' is NaN").what


def test_an_arm_that_left_earlier_is_missing_only_if_expected():
    assert faults(fleet(arm()))[0] == []
    assert faults(fleet(arm()), expected=("a", "b", "c"))[0] == ["Not present: b, c."]
    left = arm(arm="b", token=False, present=False, state_age_s=None, time_s=None)
    assert faults(fleet(arm(), left), expected=("a", "b"))[0] == ["Not present: b."]


def test_an_arm_that_left_earlier_is_missing_by_the_alarm_of_a_gateway():
    absent = Alarm("m", 1, 5.0, "absent b", "absent", "b is absent: its process has ended.", "b")
    says = ["An alarm of 'm' that nobody has acknowledged: b is absent: its process has ended."]
    assert faults(fleet(arm(), alarms=(absent,)))[0] == says
    assert faults(fleet(arm(), alarms=(absent,)), expected=("b",))[0] == ["Not present: b."]
    for change in ({"by": "ann"}, {"ended_s": 6.0}, {"kind": "space"}):
        assert faults(fleet(arm(), alarms=(msgspec.structs.replace(absent, **change),)))[0] == []
    assert faults(fleet(arm(), arm(arm="b"), alarms=(absent,)))[0] == []


@pytest.mark.parametrize("ahead_s", [(3.0,), (3.0, 2.5), (-3.0, -2.5)])
def test_arms_that_are_all_off_the_same_way_are_one_warning(ahead_s):
    """As after a restart of the auctioneer, whose clock continues from its journal."""
    arms = [arm(arm=f"a{number}", time_s=5060.0 + 60.0 * each) for number, each in enumerate(ahead_s)]
    output, found = faults(fleet(*arms))
    assert output == []
    way = "ahead of" if ahead_s[0] > 0 else "behind"
    assert [each.what.partition(" fleet time")[0] for each in found.findings] == [
        f"Every arm is {min(map(abs, ahead_s)):.1f} real seconds or more {way}"
    ]
    output, _ = faults(fleet(*arms, arm(arm="b", time_s=5060.0)))
    assert len(output) == len(ahead_s)
    near = [arm(arm=name, time_s=5060.0 + 60.0 * each) for name, each in (("a", 1.05), ("b", 0.95))]
    assert not faults(fleet(*near))[1].findings


def test_a_job_that_is_unfinished_by_the_end_of_the_shift_is_no_fault():
    assert faults(fleet(arm(), jobs=(JobStatus("x", "unfinished", shift_ended=True),)))[0] == []


def test_text_of_others_forges_no_line_of_the_report(capsys):
    paused = fleet(arm(), paused={"a": "ann'.\nfault: 'b"})
    show("tcp/127.0.0.1:1", paused, check_health(paused, 106.5, [ASKED]))
    assert "note: a is paused by 'ann'.\\nfault: 'b'." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("endpoint", "variables", "options"),
    [
        ("tcp/127.0.0.1:7447", {}, ""),
        ("tcp/127.0.0.1:7661", {}, " --endpoint tcp/127.0.0.1:7661 --fleet 'line 7'"),
        ("tcp/127.0.0.1:7661", {"THERMOFLEET_ENDPOINT": "tcp/127.0.0.1:7661", "THERMOFLEET_FLEET": "line 7"}, ""),
    ],
)
def test_a_command_that_the_report_names_reaches_the_fleet(monkeypatch, endpoint, variables, options):
    for name in ("THERMOFLEET_ENDPOINT", "THERMOFLEET_FLEET"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    reach = reach_of(endpoint, "line 7" if options or variables else "")
    (line,) = faults(fleet(arm(), space={"b": ("*",)}, jobs=()), reach=reach)[1].findings
    assert line.what.endswith(f"thermofleet arm clear b{options}")


def test_a_warning_is_no_fault():
    hot = arm(mode="faulted", hottest_c=76.0, joint=2)
    jobs = (JobStatus("y", "given_up", reason="two faults"), JobStatus("z", "finished"))
    now = fleet(hot, arm(arm="b", break_end_s=900.0), jobs=jobs)
    output, found = faults(now, ClockProbe(100.0, 100.4, 5000.0, 60.0), overrun=5)
    assert output == []
    warned = " ".join(finding.what for finding in found.findings)
    for word in ("joint 2 is at 76.0", "400 ms", "5 message(s)", "'y' is abandoned: two"):
        assert word in warned
    assert "'z'" not in warned
    assert [each.what for each in found.findings if each.level == "note"] == [
        "b is in a break until 0:15:00 of fleet time."
    ]


def test_an_abandoned_job_is_a_warning_until_somebody_has_acknowledged_its_alarm():
    jobs = tuple(JobStatus(name, "given_up", reason="It expired.") for name in "xy")
    begun = [Alarm("m", number, 5.0, f"alarm {name}", "given_up", "…", name) for number, name in enumerate("xy")]
    seen = msgspec.structs.replace(begun[0], by="ann", ended_s=6.0)
    other = msgspec.structs.replace(seen, kind="unfinished", subject="y")
    now = fleet(arm(), jobs=jobs, alarms=(seen, begun[1], other))
    _, found = faults(now)
    assert [(each.level, each.what) for each in found.findings] == [
        ("note", "'x' is abandoned, as ann has acknowledged: It expired."),
        ("warning", "'y' is abandoned: It expired."),
    ]


@given(
    delay_s=st.lists(st.tuples(st.floats(0, 0.4), st.floats(0, 0.4)), min_size=1, max_size=5),
    speed=st.floats(0.5, 200.0),
    ahead_s=st.floats(-5.0, 5.0),
)
def test_the_offset_of_a_clock_is_known_to_half_a_round_trip(delay_s, speed, ahead_s):
    """Cristian's bound, whatever the way there and the way back take."""
    probes = [
        ClockProbe(100.0 + k, 100.0 + k + there + back, speed * (100.0 + k + there), speed)
        for k, (there, back) in enumerate(delay_s)
    ]
    seen = arm(time_s=speed * (106.0 + ahead_s), state_age_s=0.5)
    found = check_health(fleet(seen), 106.5, probes)
    best_s = min(there + back for there, back in delay_s)
    assert abs(found.offsets_s["a"] - ahead_s) <= best_s / 2 + 1e-6
    if abs(ahead_s) > OFFSET_S + 0.41:
        assert found.findings


@contextmanager
def participants(endpoint, *, states=True, clocks=1):
    """One arm, and `clocks` auctioneers, on a thread."""
    began_s = time.monotonic()

    def now_s():
        return 10.0 * (time.monotonic() - began_s)

    with ExitStack() as stack:
        arm, *auctioneers = (stack.enter_context(BusClient(endpoint, "f")) for _ in range(1 + clocks))
        arm.declare_token(keys.of_arm("f", "a", "alive"))
        for number, link in enumerate(auctioneers):
            link.declare_token(keys.of_auction("f", f"au{number}", "alive"))
            link.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(time_s=now_s(), speed=10.0))

        ticks = count()

        def publish():
            if states:
                arm.publish(keys.of_arm("f", "a", "state"), State("a", next(ticks), now_s(), "idle", (30.0,), 30.0))

        with serving(arm, *auctioneers, meanwhile=publish):
            yield arm


def doctor(endpoint, *options):
    done = commands.run("bus", "doctor", "--endpoint", endpoint, "--seconds", "1", *options)
    return done.returncode, " ".join((done.stdout + done.stderr).split())


@pytest.mark.ci_slow
def test_a_healthy_fleet_gives_exit_code_0():
    with Router() as router, participants(router.endpoint):
        code, output = doctor(router.endpoint, "--json")
    found = json.loads(output)
    assert (code, found["healthy"]) == (0, True)
    assert all("The router is slow" in each["what"] for each in found["findings"])  # as on a busy machine
    assert abs(found["offsets_s"]["a"]) < 1.0


def test_an_unhealthy_fleet_gives_exit_code_1_and_all_reasons():
    with Router() as router, participants(router.endpoint, states=False, clocks=2) as arm:
        rubbish = partial(arm._session.put, keys.of_arm("f", "a", "state"), b"rubbish")
        with BusClient(router.endpoint, "f") as other, serving(other, meanwhile=rubbish):
            code, output = doctor(router.endpoint)
    assert code == 1
    for says in (
        "a shows its token but publishes no valid state",
        "2 auctioneers",
        "No arm is present",
        "malformed message",
    ):
        assert says in output


@pytest.mark.ci_slow
def test_the_option_no_auctioneer_expects_none():
    with Router() as router, participants(router.endpoint, clocks=0):
        code, output = doctor(router.endpoint, "--no-auctioneer")
    assert (code, "The fleet is healthy." in output, "time unknown" in output) == (0, True, True), output


def test_a_router_without_a_fleet_is_not_healthy():
    with Router() as router:
        code, output = doctor(router.endpoint)
    assert (code, "replies. No fleet found" in output) == (1, True), output


@pytest.mark.ci_slow
def test_a_missing_router_or_another_server_gives_exit_code_2_and_what_to_do():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        code, output = doctor(f"tcp/127.0.0.1:{port}")
    assert (code, "no thermofleet router listens on it" in output) == (2, True), output
    code, output = doctor(f"tcp/127.0.0.1:{port}")
    assert (code, f"thermofleet bus router --port {port}" in output) == (2, True), output


def test_invalid_options_give_exit_code_2():
    code, output = doctor("http://x")
    assert (code, "Error:" in output) == (2, True), output
