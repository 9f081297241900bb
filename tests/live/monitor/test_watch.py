"""The `watch` screen and command."""

import os
import re
import signal
import subprocess
from io import StringIO
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.console import Console

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.router import Router
from fleet.live.monitor.snapshot import ArmSnapshot, FleetSnapshot, JobScore
from scenarios.live.fleet_processes import free_port
from scenarios.show.watch import GONE_S, RESTORED_S, ShiftEnd, format_age, format_scores, screen
from tests import commands
from tests.waiting import PATIENCE_S


def shown(now, width=80, height=24, events=(), **more):
    console = Console(file=StringIO(), width=width, height=height, force_terminal=False)
    console.print(screen(now, list(events), height, width=width, **more))
    return console.file.getvalue()


def fleet_of(arms):
    return FleetSnapshot("f", tuple(arms), (), {"waiting": 2, "finished": 1}, (), time_s=3661.0)


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


EXPIRY = "The certificate of 'monitor' expired on 2026-11-29 21:00 UTC, so it has no connection: renew it."


def test_a_fleet_of_which_nobody_is_present_has_no_time():
    assert "1:01:01" not in shown(fleet_of([arm_now(token=False, present=False)]))


def test_the_heading_counts_the_arms_that_left_in_order_apart():
    assert "1 of 1 arms present, 2 left" in shown(replace(fleet_of([arm_now()]), left=("b", "c")))


def test_the_screen_tells_why_there_is_no_connection():
    told = shown(replace(fleet_of([arm_now()]), lost_s=40.0, expiry=EXPIRY))
    assert "no connection to the router for 40 s" in told
    assert EXPIRY in " ".join(told.split())


def test_an_event_is_one_line():
    assert "a\\nb" in shown(fleet_of([arm_now()]), events=["a\nb"])


def test_the_screen_tells_who_has_paused_arms():
    assert "All arms are paused by 'root'." in shown(replace(fleet_of([arm_now()]), paused={"*": "root"}))


@given(
    arms=st.integers(0, 40),
    width=st.integers(60, 200),
    height=st.integers(8, 50),
    events=st.integers(0, 20),
    expiry=st.sampled_from(["", EXPIRY, 9 * EXPIRY]),
)
def test_the_screen_fits_the_terminal(arms, width, height, events, expiry):
    names = [arm_now(f"arm_{number}", headroom_k=float(number), job="j" * 60) for number in range(arms)]
    fleet = replace(fleet_of(names), lost_s=40.0 if expiry else None, expiry=expiry)
    told = shown(fleet, width, height, ["an event " * 20] * events).splitlines()
    assert len(told) <= height
    assert max(map(len, told)) <= width


def test_without_colour_a_screen_of_80_columns_tells_heat_jobs_and_the_rest_of_the_shift():
    """The warning limit is 60 °C: 52.5 °C is 81% of the way from 20 °C."""
    hot = {"hottest_c": 61.0, "headroom_k": -1.0, "busy_s": 0.0}
    fleet = fleet_of([arm_now(busy_s=50.0), arm_now("b", **hot), arm_now("c", token=False)])
    told = shown(replace(fleet, speed=60.0), end_s=7200.0)
    assert re.search(r"^█{10}·{10} 1:01:01 of 2:00:00, 0:58:59 left \(59 s at 60 ×\)$", told, re.M)
    assert re.search(r"^a +working +█{8}·· +52\.5 J2 +7\.5 crate 1 +50 s +0\.1 s$", told, re.M)
    assert re.search(r"^b +working +█{10}!! +61\.0 J2 +-1\.0 crate 1", told, re.M)
    assert re.search(r"^c +gone ", told, re.M)


def test_all_joints_are_shown_on_demand_with_marks_of_little_headroom():
    arm = arm_now(temp_c=(30.0, 52.5, 57.0, 61.0, 40.0, 41.0, 42.0), hottest_c=61.0, headroom_k=-1.0)
    told = shown(fleet_of([arm]), joints=True)
    assert re.search(r"^a +working +30\.0 +52\.5 +57\.0! +61\.0!! +40\.0 +41\.0 +42\.0$", told, re.M)


def test_a_small_screen_shows_the_arms_with_least_headroom_and_an_empty_fleet_says_so():
    names = [arm_now(f"arm_{number}", headroom_k=float(number)) for number in range(30)]
    told = shown(fleet_of(names), height=12)
    assert "arm_0 " in told
    assert "arm_29" not in told
    assert "more with more headroom" in told
    told = shown(FleetSnapshot("f", (), (), {}, ()))
    assert "no auctioneer" in told
    assert "jobs: unknown\nspace closed by: unknown" in told


def test_ages_and_times_are_short():
    assert [format_age(value) for value in (None, -0.1, 0.04, 9.94, 12.4, 130.0)] == [
        "—",
        "0.0 s",
        "0.0 s",
        "9.9 s",
        "12 s",
        "2 min",
    ]
    assert format_scores(SimpleNamespace(scores={})) == ""


@pytest.mark.ci_slow
def test_without_a_terminal_tables_are_printed_until_stopped(fleet):
    for number, code in ((signal.SIGTERM, 0), (signal.SIGINT, 130)):
        env = {name: value for name, value in os.environ.items() if name != "COLUMNS"}  # as wide as it needs
        process = commands.start("bus", "watch", "--endpoint", fleet.endpoint, stderr=subprocess.DEVNULL, env=env)
        try:
            assert process.stdout.readline() == "a joined\n"
            fleet.say()
            while "52.5 J2" not in (told := process.stdout.readline()):
                assert told
            assert "j — °C, P — (d 0.50)" in told
            process.send_signal(number)
            assert process.wait(PATIENCE_S) == code
        finally:
            process.kill()
            process.communicate(timeout=PATIENCE_S)


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


def test_participants_that_are_gone_with_the_connection_have_not_left():
    end = ShiftEnd()
    arm = ArmSnapshot("a", token=True, present=True)
    present = FleetSnapshot("f", (arm,), (), {"finished": 4}, ())
    gone = replace(present, arms=(replace(arm, token=False),))
    assert end.check(present, 0.0) == ""
    assert end.check(gone, 0.25) == ""  # the tokens go before the listener notices the loss
    assert not any(end.check(replace(gone, lost_s=at_s - 0.25), at_s) for at_s in (0.5, 60.0))
    assert not any(end.check(gone, at_s) for at_s in (60.25, 60.0 + GONE_S, 59.0 + RESTORED_S))
    assert end.check(present, 60.0 + RESTORED_S) == ""
    assert not any(end.check(replace(gone, lost_s=at_s - 80.0), at_s) for at_s in (80.0, 85.0))
    assert not any(end.check(gone, at_s) for at_s in (85.25, 94.0))
    assert end.check(gone, 85.0 + RESTORED_S) == "The shift has ended: 4 of 4 jobs finished."


def test_participants_that_left_before_the_router_have_left():
    end = ShiftEnd()
    arm = ArmSnapshot("a", token=True, present=True)
    present = FleetSnapshot("f", (arm,), (), {"finished": 4}, ())
    gone = replace(present, arms=(replace(arm, token=False),))
    assert end.check(present, 0.0) == end.check(gone, 0.25) == end.check(replace(gone, lost_s=0.0), 1.5) == ""
    assert end.check(replace(gone, lost_s=1.75), 0.25 + GONE_S) == "The shift has ended: 4 of 4 jobs finished."


@pytest.mark.ci_slow
def test_watch_waits_for_a_router_and_a_fleet():
    port = free_port()
    with commands.start("bus", "watch", "--endpoint", f"tcp/127.0.0.1:{port}", stderr=None) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2.0)
        with Router(port) as router, BusClient(router.endpoint, "f") as link:
            link.declare_token(keys.of_arm("f", "arm_0", "alive"))
            assert "arm_0" in process.stdout.readline()
            process.terminate()
            process.communicate(timeout=PATIENCE_S)


@pytest.mark.parametrize("fleets", [(), ("f", "g")])
def test_an_ambiguous_fleet_is_an_error(fleets, token_reaches):
    with Router() as router, BusClient(router.endpoint, "m") as monitor:
        links = [BusClient(router.endpoint, name).open() for name in fleets]
        monitor.declare_token(keys.build("m", "monitor", "alive", "m"))  # makes no fleet
        token_reaches(monitor, keys.build("m", "monitor", "alive", "m"))
        for link in links:
            link.declare_token(keys.of_arm(link.fleet, "a", "alive"))
            token_reaches(links[0], keys.of_arm(link.fleet, "a", "alive"))
        done = commands.run("bus", "watch", "--endpoint", router.endpoint, "--json")
        for link in links:
            link.close()
    assert done.returncode == 2
    assert ("several fleets" if fleets else "no fleet") in done.stderr.replace("\n", " ")
