"""View of a fleet, its bounded memory, and the `watch` screen."""

import fcntl
import json
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from io import StringIO
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.console import Console

from fleet.bus.client.client import BusClient
from fleet.bus.client.router import Router
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, JobStatus, Result, Status, StatusRequest
from fleet.bus.protocol.messages import DifficultyScores, State
from fleet.events import EVENT_KINDS
from fleet.live.monitor import listener as listener_module
from fleet.live.monitor import snapshot as snapshot_module
from fleet.live.monitor.event_feed import HISTORY, MAX_WAITING, NEWEST_ONLY, EventFeed, ReaderBuffer
from fleet.live.monitor.listener import FleetListener
from fleet.live.monitor.snapshot import FRESH_S, ArmSnapshot, FleetSnapshot, FleetView, JobScore
from scenarios.cli.live.up import free_port
from scenarios.cli.live.watch import GONE_S, ShiftEnd
from scenarios.live.watch_screen import (
    PLAIN,
    JobBars,
    arm_line,
    format_age,
    format_scores,
    format_time,
    plain_event,
    screen,
)

PATIENCE_S = 20.0


def state(arm="a", time_s=1.0, **change):
    words = {"tick": 1, "mode": "idle", "temp_c": (30.0, 52.5, 40.0), "headroom_k": 7.5, **change}
    return State(arm=arm, time_s=time_s, **words)


def result(number, job="j", to="awarded"):
    return Result(auctioneer="au", number=number, time_s=1.0, status=JobStatus(job, to))


@given(token=st.booleans(), age_s=st.floats(0.0, 10.0), spoke=st.booleans())
def test_present_is_token_and_fresh_state(token, age_s, spoke):
    seen = FleetView("f")
    seen.set_token("arm", "a", token)
    if spoke:
        seen.update("a", state(), 100.0)
    (arm,) = seen.snapshot(100.0 + age_s).arms
    assert arm.present == (token and spoke and (100.0 + age_s) - 100.0 <= FRESH_S)
    assert arm.state_age_s == (pytest.approx(age_s, abs=1e-9) if spoke else None)


def test_the_hottest_motor_is_named_by_its_joint():
    seen = FleetView("f")
    seen.update("a", state(), 0.0)
    (arm,) = seen.snapshot(0.0).arms
    assert (arm.hottest_c, arm.joint) == (52.5, 2)


def scores(time_s, **difficulty):
    jobs, values = tuple(difficulty), tuple(difficulty.values())
    return DifficultyScores("a", 1, time_s, "v", jobs, values, (None,) * len(jobs))


@pytest.mark.parametrize(("speed", "age_s"), [(None, 2.0), (10.0, 7.0), (1.0, 61.0)])
def test_scores_from_a_cache_are_as_old_as_the_arm_made_them(speed, age_s):
    """Made at 40 s of fleet time, they arrive at 10 s; the state of 100 s arrives at 11 s; now it is 12 s."""
    seen = FleetView("f", speed=speed)
    seen.update("a", scores(40.0, x=0.5), 10.0)
    seen.update("a", state(time_s=100.0), 11.0)
    assert seen.snapshot(12.0).arms[0].difficulty_age_s == pytest.approx(age_s)


def test_scores_of_jobs_that_have_ended_are_not_shown():
    seen = FleetView("f")
    seen.update("a", scores(1.0, x=0.5, y=None, z=0.2), 0.0)
    seen.update_jobs(stands(1.0, "x"), 0.0)
    assert seen.snapshot(0.0).arms[0].scores == {"y": JobScore(), "z": JobScore(difficulty=0.2)}


def test_a_token_change_is_reported_once():
    seen = FleetView("f")
    assert [seen.set_token("arm", "a", there) for there in (True, True, False, False, True)] == [
        True,
        False,
        True,
        False,
        True,
    ]


def stands(time_s, *jobs, state="finished"):
    return Status("au", time_s, tuple(JobStatus(job, state) for job in jobs))


def test_jobs_unknown_to_the_auctioneer_are_dropped():
    seen = FleetView("f")
    for number, job in enumerate("ab"):
        seen.update("au", result(40 + number, job, "finished"), 0.0)
    seen.update("au", result(1, "new"), 2.0)  # said after the question was
    seen.update_jobs(stands(5.0, "b", state="waiting"), 3.0)
    seen.forget_other_jobs([stands(5.0, "b", state="waiting")], 1.0)
    assert {job.job: job.state for job in seen.snapshot(3.0).jobs} == {"b": "waiting", "new": "awarded"}
    seen.forget_other_jobs([], 9.0)  # nobody answered
    assert seen.snapshot(9.0).counts == {"waiting": 1, "awarded": 1}


def test_a_restarted_fleet_counts_its_results_anew():
    seen = FleetView("f")
    seen.update("au", result(40, "a", "finished"), 0.0)
    seen.update_jobs(stands(900.0, "a"), 1.0)
    seen.update_jobs(stands(3.0, "a", state="waiting"), 2.0)
    seen.update("au", result(0, "a", "awarded"), 3.0)
    assert seen.snapshot(3.0).counts == {"awarded": 1}


@pytest.mark.parametrize(("jobs", "letters"), [(128, 1), (20, 2000)])
def test_an_incomplete_status_reply_drops_no_job(jobs, letters):
    names = [f"{number:03d}{'x' * letters}" for number in range(jobs)]
    seen = FleetView("f")
    seen.update("au", result(0, "old", "finished"), 0.0)
    full = stands(5.0, *names)
    seen.update_jobs(full, 2.0)
    seen.forget_other_jobs([full], 1.0)
    assert sum(seen.snapshot(2.0).counts.values()) == jobs + 1
    seen.update_jobs(stands(1.0, *names), 3.0)  # but time that ran back does
    assert sum(seen.snapshot(3.0).counts.values()) == jobs


def test_a_listener_counts_only_the_jobs_of_the_present_fleet(monkeypatch):
    monkeypatch.setattr(listener_module, "STATUS_EVERY_S", 0.05)
    fleets = [stands(900.0, "a", "b"), stands(5.0, "c", state="waiting")]
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as auctioneer:
        auctioneer.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: fleets[0])
        seen = FleetListener(link)
        for fleet in ({"finished": 2}, {"waiting": 1}):
            deadline_s = time.monotonic() + PATIENCE_S
            while seen.view.snapshot(0.0).counts != fleet:
                assert time.monotonic() < deadline_s
                seen.serve(time.monotonic() + 0.02)
                auctioneer.serve(time.monotonic() + 0.02)
            del fleets[:-1]


def test_an_older_result_changes_nothing():
    seen = FleetView("f")
    for word in (result(2, to="finished"), result(1, to="awarded")):
        seen.update("au", word, 0.0)
    assert seen.snapshot(0.0).counts == {"finished": 1}


def test_the_auctioneers_status_adds_jobs_without_a_result():
    seen = FleetView("f")
    seen.update_jobs(Status("au", 1.0, (JobStatus("x", "waiting"), JobStatus("y", "finished"))), 0.0)
    assert seen.snapshot(4.0).counts == {"waiting": 1, "finished": 1}
    assert seen.snapshot(4.0).auctioneers[0].heard_age_s == 4.0


def test_too_many_names_drop_the_oldest(monkeypatch):
    monkeypatch.setattr(snapshot_module, "MAX_NAMES", 3)
    monkeypatch.setattr(snapshot_module, "MAX_JOBS", 3)
    seen = FleetView("f")
    for number in range(10):
        seen.update(f"a{number}", state(f"a{number}"), 0.0)
        seen.update("au", result(number, f"j{number}"), 0.0)
    now = seen.snapshot(0.0)
    assert [arm.arm for arm in now.arms] == ["a7", "a8", "a9"]
    assert [job.job for job in now.jobs] == ["j7", "j8", "j9"]


@given(
    st.lists(
        st.tuples(st.sampled_from(["state", "difficulty", "event", "result"]), st.sampled_from("ab")), max_size=60
    ),
    st.integers(0, 60),
)
def test_a_reader_gets_every_event_once_and_the_newest_state(said, after):
    """Taken in two helpings or one, in order: the letter box and the feed tell the same."""
    feed, box, got = EventFeed(), ReaderBuffer(), []
    for count, (topic, name) in enumerate(said):
        box.put(feed.add(topic, name, str(count)))
        if count == after:
            got += box.take()
    got += box.take()
    numbers = [entry.number for entry in got]
    assert numbers == sorted(set(numbers))
    events = [number for number, (topic, _) in enumerate(said, 1) if topic not in NEWEST_ONLY]
    assert [entry.number for entry in got if entry.topic not in NEWEST_ONLY] == events
    last = {where: number for number, where in enumerate(said, 1) if where[0] in NEWEST_ONLY}
    assert {(entry.topic, entry.name): entry.number for entry in got if entry.topic in NEWEST_ONLY} == last
    missed, gap = feed.since(0)
    assert not gap
    assert {entry.number for entry in missed} == {*events, *last.values()}


def test_bids_drop_no_event():
    feed, box = EventFeed(), ReaderBuffer()
    for topic in ("event", *["bid"] * (HISTORY + 1), "event"):
        box.put(feed.add(topic, "a", "{}"))
    missed, gap = feed.since(0)
    assert not gap
    assert [entry.topic for entry in missed] == [entry.topic for entry in box.take()] == ["event", "bid", "event"]


def test_a_full_reader_buffer_is_empty():
    feed, box = EventFeed(), ReaderBuffer()
    for _ in range(MAX_WAITING + 1):
        box.put(feed.add("event", "a", "{}"))
    assert box.full
    assert box.take() == []


def test_telemetry_never_fills_a_reader_buffer():
    feed, box = EventFeed(), ReaderBuffer()
    for number in range(10 * MAX_WAITING):
        box.put(feed.add("state", f"arm {number % 5}", "{}"))
    assert not box.full
    assert len(box.take()) == 5


def test_dropped_events_leave_a_gap():
    feed = EventFeed()
    for _ in range(1100):
        feed.add("event", "a", "{}")
    assert feed.since(10)[1]
    assert not feed.since(1000)[1]
    assert len(feed.since(1000)[0]) == 100


def shown(now, width=80, height=24, events=(), **more):
    console = Console(file=StringIO(), width=width, height=height, force_terminal=False)
    console.print(screen(now, list(events), height, width=width, **more))
    return console.file.getvalue()


def fleet_of(arms):
    return FleetSnapshot("f", tuple(arms), (), {"waiting": 2, "finished": 1}, ())


SCORES = {"x": JobScore(52.0, 0.02), "y": JobScore(), "z": JobScore(41.0, 0.25, 0.5)}


def arm_now(name="a", **change):
    known = {
        "token": True, "present": True, "mode": "working", "time_s": 3661.0, "hottest_c": 52.5, "joint": 2,
        "headroom_k": 7.5, "job": "crate 1", "scores": SCORES, "state_age_s": 0.1,
    }  # fmt: skip
    return ArmSnapshot(arm=name, **{**known, **change})


def test_the_screen_shows_the_fleet():
    told = shown(fleet_of([arm_now()]), width=190, events=["a came"])
    jobs = r"z 41 °C, P 0\.25 \(d 0\.50\); x 52 °C, P 0\.02 \(d —\); y — °C, P — \(d —\)"
    assert re.search(rf"a +working +█{{8}}·· +52\.5 J2 +7\.5 +crate 1 +{jobs} +— +yes +0\.1 s", told)
    assert "1:01:01" in told
    assert "1 of 1 arms present" in told
    assert "jobs: 2 waiting, 1 finished" in told
    assert "a came" in told


@given(arms=st.integers(0, 40), width=st.integers(60, 200), height=st.integers(8, 50), events=st.integers(0, 20))
def test_the_screen_fits_the_terminal(arms, width, height, events):
    names = [arm_now(f"arm_{number}", headroom_k=float(number), job="j" * 60) for number in range(arms)]
    told = shown(fleet_of(names), width, height, ["an event " * 20] * events).splitlines()
    assert len(told) <= height
    assert max(map(len, told)) <= width


def test_without_colour_a_screen_of_80_columns_tells_heat_jobs_and_the_rest_of_the_shift():
    """The warning limit is 60 °C: 52.5 °C is 81% of the way from 20 °C; the job took 200 s when it was first shown."""
    hot = {"hottest_c": 61.0, "headroom_k": -1.0, "busy_s": 0.0}
    fleet = fleet_of([arm_now(busy_s=200.0), arm_now("b", **hot), arm_now("c", token=False)])
    fleet = replace(fleet, speed=60.0)
    bars = JobBars()
    assert bars.update(fleet) == {"a": 0.0}
    later = replace(fleet, arms=(replace(fleet.arms[0], busy_s=50.0), *fleet.arms[1:]))
    done = bars.update(later)
    assert done == {"a": 0.75}
    told = shown(later, done=done, end_s=7200.0)
    assert re.search(r"^█{10}·{10} 1:01:01 of 2:00:00, 0:58:59 left \(59 s at 60 ×\)$", told, re.M)
    assert re.search(r"^a +working +█{8}·· +52\.5 J2 +7\.5 crate 1 +█{4}·· 50 s +0\.1 s$", told, re.M)
    assert re.search(r"^b +working +█{10}!! +61\.0 J2 +-1\.0 crate 1", told, re.M)
    assert re.search(r"^c +gone ", told, re.M)
    again = replace(fleet, arms=(replace(fleet.arms[0], job="crate 2", busy_s=40.0),))
    assert bars.update(again) == {"a": 0.0}


def test_all_joints_are_shown_on_demand_with_marks_of_little_headroom():
    arm = arm_now(temp_c=(30.0, 52.5, 57.0, 61.0, 40.0, 41.0, 42.0), hottest_c=61.0, headroom_k=-1.0)
    told = shown(fleet_of([arm]), joints=True)
    assert re.search(r"^a +working +30\.0 +52\.5 +57\.0! +61\.0!! +40\.0 +41\.0 +42\.0$", told, re.M)
    assert "motors 30.0 52.5 57.0 61.0 40.0 41.0 42.0" in arm_line(arm, joints=True)


def test_every_event_of_an_arm_is_told_in_words():
    def words(kind, **more):
        return plain_event(ArmEvent(arm="a", number=0, time_s=1.0, kind=kind, **more))

    assert words("warning", joint=2, value=60.04, job="j") == "motor 2 is above the warning limit (60.0 °C), j"
    assert words("give_back", job="j", reason="paused") == "gives j back after a cycle: paused"
    assert words("later_kind") == "later kind"
    assert set(PLAIN) <= set(EVENT_KINDS)


def test_the_key_j_shows_all_joints_and_q_ends(fleet):
    """In a terminal of 80 × 24 characters."""
    pty = pytest.importorskip("pty")  # Unix
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")} | {"TERM": "xterm"}
    process = subprocess.Popen(
        command("--endpoint", fleet.endpoint),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=env,
    )
    os.close(theirs)

    def read_until(words):
        told, deadline_s = "", time.monotonic() + PATIENCE_S
        while words not in told:
            assert time.monotonic() < deadline_s, told
            fleet.say()
            if select.select([ours], [], [], 0.1)[0]:
                told += os.read(ours, 65536).decode("utf-8", "replace")

    try:
        read_until("to warning")
        os.write(ours, b"j")
        read_until("J3 °C")
        os.write(ours, b"q")
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait(PATIENCE_S)
        os.close(ours)


def test_a_small_screen_shows_the_arms_with_least_headroom():
    names = [arm_now(f"arm_{number}", headroom_k=float(number)) for number in range(30)]
    told = shown(fleet_of(names), height=12)
    assert "arm_0 " in told
    assert "arm_29" not in told
    assert "more with more headroom" in told


def test_an_empty_fleet_is_shown_as_empty():
    told = shown(FleetSnapshot("f", (), (), {}, ()))
    assert "no auctioneer" in told
    assert "jobs: none" in told


def test_ages_and_times_are_short():
    assert [format_age(value) for value in (None, -0.1, 0.04, 9.94, 12.4, 130.0)] == [
        "—",
        "0.0 s",
        "0.0 s",
        "9.9 s",
        "12 s",
        "2 min",
    ]
    assert [format_time(value) for value in (0.0, 59.9, 3600.0, 86461.0)] == [
        "0:00:00",
        "0:00:59",
        "1:00:00",
        "24:01:01",
    ]
    assert format_scores(SimpleNamespace(scores={})) == ""
    assert "headroom 7.5 K  job crate 1" in arm_line(arm_now())
    assert "no token" in arm_line(arm_now(token=False))


@pytest.fixture
def fleet():
    """A fleet of one arm that says its words whenever it is asked to."""
    with Router() as router, BusClient(router.endpoint, "f") as link:
        link.declare_token(keys.of_arm("f", "a", "alive"))
        event = link.publisher(keys.of_arm("f", "a", "event"), ArmEvent)

        def say():
            link.publish(keys.of_arm("f", "a", "state"), state(headroom_k=7.5))
            link.publish(
                keys.of_arm("f", "a", "difficulty"), DifficultyScores("a", 1, 1.0, "t", ("j",), (0.5,), (None,))
            )

        yield SimpleNamespace(endpoint=router.endpoint, say=say, link=link, event=event)


def test_a_listener_receives_a_whole_fleet(fleet):
    heard, came = [], []
    fleet.event(ArmEvent(arm="a", number=0, time_s=1.0, kind="warning", joint=2))
    with BusClient(fleet.endpoint, "f") as link:
        listener = FleetListener(
            link, on_message=lambda *said: heard.append(said[:2]), on_presence=lambda *who: came.append(who)
        )
        deadline_s = time.monotonic() + PATIENCE_S
        while len({topic for topic, _ in heard}) < 3 and time.monotonic() < deadline_s:
            fleet.say()
            listener.serve(time.monotonic() + 0.05)
        (arm,) = listener.view.snapshot(time.monotonic()).arms
    assert {topic for topic, _ in heard} == {"state", "difficulty", "event"}  # the event was said before
    assert came == [("arm", "a", True)]
    assert arm.present
    assert arm.event == "warning joint 2"


def command(*arguments):
    return [sys.executable, "-u", "-c", "from scenarios.cli.main import main; main()", "watch", *arguments]


def test_without_a_terminal_lines_are_printed_until_stopped(fleet):
    for number, code in ((signal.SIGTERM, 0), (signal.SIGINT, 130)):
        process = subprocess.Popen(
            command("--endpoint", fleet.endpoint), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            assert process.stdout.readline() == "a joined\n"
            fleet.say()
            while "52.5 °C J2" not in (told := process.stdout.readline()):
                assert told
            assert "j — °C, P — (d 0.50)" in told
            process.send_signal(number)
            assert process.wait(PATIENCE_S) == code
        finally:
            process.kill()
            process.communicate(timeout=PATIENCE_S)


def test_a_snapshot_is_json(fleet):
    done = subprocess.run(
        command("--endpoint", fleet.endpoint, "--json"), capture_output=True, text=True, timeout=60, check=True
    )
    told = json.loads(done.stdout)
    assert told["fleet"] == "f"
    assert [(arm["arm"], arm["token"], arm["present"]) for arm in told["arms"]] == [("a", True, False)]


def test_the_end_of_a_shift_is_told_when_all_have_left():
    end = ShiftEnd()
    arm = ArmSnapshot("a", token=True, present=True)
    at_work = FleetSnapshot("f", (arm,), (), {"finished": 3, "awarded": 1}, ())
    left = replace(at_work, arms=(replace(arm, token=False),))
    settled = replace(left, counts={"finished": 3, "given_up": 1})
    assert end.check(settled, 0.0) == ""  # nobody has been seen
    assert [end.check(fleet, 1.0) for fleet in (at_work, left)] == ["", ""]
    assert end.check(left, 99.0) == end.check(at_work, 99.5) == end.check(settled, 100.0) == ""
    assert end.check(settled, 100.0 + GONE_S) == "The shift has ended: 3 of 4 jobs finished, 1 given up."


def test_watch_waits_for_a_router_and_a_fleet():
    port = free_port()
    with subprocess.Popen(command("--endpoint", f"tcp/127.0.0.1:{port}"), stdout=subprocess.PIPE, text=True) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2.0)
        with Router(port) as router, BusClient(router.endpoint, "f") as link:
            link.declare_token(keys.of_arm("f", "arm_0", "alive"))
            assert "arm_0" in process.stdout.readline()
            process.terminate()
            process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize("fleets", [(), ("f", "g")])
def test_an_ambiguous_fleet_is_an_error(fleets, token_reaches):
    with Router() as router:
        links = [BusClient(router.endpoint, name).open() for name in fleets]
        for link in links:
            link.declare_token(keys.of_arm(link.fleet, "a", "alive"))
            token_reaches(links[0], keys.of_arm(link.fleet, "a", "alive"))
        done = subprocess.run(
            command("--endpoint", router.endpoint, "--json"), capture_output=True, text=True, timeout=60
        )
        for link in links:
            link.close()
    assert done.returncode == 2
    assert ("several fleets" if fleets else "no fleet") in done.stderr.replace("\n", " ")
