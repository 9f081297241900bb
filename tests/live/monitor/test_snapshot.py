"""View of a fleet, from its messages, in bounded memory, and its events for slow readers."""

import time

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.bus.client import BusClient
from fleet.bus.protocol import keys
from fleet.bus.protocol.auction import ArmEvent, Clock, ClockRequest, JobState, JobStatus, Status, StatusRequest
from fleet.bus.protocol.messages import DifficultyScores
from fleet.bus.router import Router
from fleet.live.clock import FleetClock
from fleet.live.monitor import snapshot as listener_module
from fleet.live.monitor import snapshot as snapshot_module
from fleet.live.monitor.async_bridge import HISTORY, NEWEST_ONLY, EventFeed
from fleet.live.monitor.health import check_jobs
from fleet.live.monitor.snapshot import FRESH_S, FleetListener, FleetView, JobScore
from tests.live.many_jobs import ManyJobs, entries
from tests.live.monitor.messages import result, stands, state
from tests.waiting import PATIENCE_S, serve_until, serving, wait_until


@given(token=st.booleans(), age_s=st.floats(0.0, 10.0), spoke=st.booleans())
def test_present_is_token_and_fresh_state(token, age_s, spoke):
    seen = FleetView("f")
    seen.set_token("arm", "a", token)
    if spoke:
        seen.update("a", state(), 100.0)
    (arm,) = seen.snapshot(100.0 + age_s).arms
    assert arm.present == (token and spoke and (100.0 + age_s) - 100.0 <= FRESH_S)
    assert arm.state_age_s == (pytest.approx(age_s, abs=1e-9) if spoke else None)


def test_events_of_unknown_kinds_are_counted_together():
    seen = FleetView("f")
    for number in range(200):
        seen.update("a", ArmEvent("a", number, 1.0, f"kind {number}" if number else "fault"), 0.0)
    assert seen.snapshot(0.0).arms[0].events == {"fault": 1, "other": 199}


def scores(time_s, **difficulty):
    jobs, values = tuple(difficulty), tuple(difficulty.values())
    return DifficultyScores("a", 1, time_s, "v", jobs, values, (None,) * len(jobs))


@pytest.mark.parametrize(("speed", "age_s"), [(None, 2.0), (10.0, 7.0), (1.0, 61.0)])
def test_scores_from_a_cache_are_as_old_as_the_arm_made_them(speed, age_s):
    """Made at 40 s of fleet time, they arrive at 10 s; the state of 100 s arrives at 11 s; now it is 12 s."""
    seen = FleetView("f", clock=speed and FleetClock(speed))
    seen.update("a", scores(40.0, x=0.5), 10.0)
    seen.update("a", state(time_s=100.0), 11.0)
    assert seen.snapshot(12.0).arms[0].difficulty_age_s == pytest.approx(age_s)


def test_scores_of_jobs_that_have_ended_are_not_shown():
    seen = FleetView("f")
    seen.update("a", scores(1.0, x=0.5, y=None, z=0.2), 0.0)
    seen.update_jobs(stands(1.0, "x"), 0.0)
    assert seen.snapshot(0.0).arms[0].scores == {"y": JobScore(), "z": JobScore(difficulty=0.2)}


TIMES_S = {"a": 100.0, "b": 100.0, "ahead": 5100.0}


@pytest.mark.parametrize("replied", [False, True])
@pytest.mark.parametrize("left", [False, True])
def test_fleet_time_is_that_of_the_fleet_though_one_arm_has_a_wrong_clock(left, replied):
    """All states came at 10 s; a reply gives 90 s at the real second 9, at speed 2; now it is 13 s."""
    seen = FleetView("f", clock=FleetClock(2.0).set_to(9.0, 9.0, 90.0) if replied else None)
    for name, time_s in TIMES_S.items():
        seen.set_token("arm", name, True)
        seen.update(name, state(name, time_s), 10.0)
    if left:
        seen.set_token("arm", "ahead", False)
        seen.set_token("arm", "b", False)
    assert seen.snapshot(13.0).time_s == (98.0 if replied else 100.0)


def test_fleet_time_goes_on_after_all_have_left_and_is_unknown_of_nobody():
    seen = FleetView("f", clock=FleetClock(60.0).set_to(0.0, 0.0, 600.0))
    assert seen.snapshot(10.0).time_s == 1200.0
    assert FleetView("f").snapshot(10.0).time_s is None


def test_a_token_change_is_reported_once():
    seen = FleetView("f")
    assert [seen.set_token("arm", "a", there) for there in (True, True, False, False, True)] == [
        True,
        False,
        True,
        False,
        True,
    ]


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


@pytest.mark.parametrize(
    "change",
    [{"counts": {"finished": 128}, "next": "3 1.0 x"}, {"counts": {}}, {"counts": {"finished": 129}}],
    ids=["more follow", "jobs are not counted", "a job has changed between two pages"],
)
def test_an_incomplete_status_reply_drops_no_job(change):
    names = [f"{number:03d}" for number in range(128)]
    seen = FleetView("f")
    seen.update("au", result(0, "old", "finished"), 0.0)
    full = msgspec.structs.replace(stands(5.0, *names), **change)
    seen.update_jobs(full, 2.0)
    seen.forget_other_jobs([full], 1.0)
    assert sum(seen.snapshot(2.0).counts.values()) == 129
    seen.update_jobs(msgspec.structs.replace(full, time_s=1.0), 3.0)  # but time that ran back does
    assert sum(seen.snapshot(3.0).counts.values()) == 128


def test_jobs_beyond_those_that_are_kept_are_counted(monkeypatch):
    """By hand: of 9 jobs 4 are kept; the job in work of an earlier reply is one of the others now."""
    monkeypatch.setattr(snapshot_module, "MAX_JOBS", 4)
    seen = FleetView("f")
    before = Status("au", 1.0, (JobStatus("stale", "finishing"),), counts={"finishing": 1})
    seen.update_jobs(before, 0.0)
    waiting = tuple(JobStatus(f"w{n}", "waiting") for n in range(3))
    counts: dict[JobState, int] = {"unfinished": 1, "waiting": 5, "finished": 3}
    reply = Status("au", 5.0, (JobStatus("u", "unfinished"), *waiting), counts=counts, next="2 0.0 w2")
    seen.update_jobs(reply, 5.0)
    seen.forget_other_jobs([reply], 4.0)
    now = seen.snapshot(5.0)
    assert now.counts == counts
    assert [status.job for status in now.jobs] == ["u", "w0", "w1", "w2"]
    whole = Status("au", 6.0, reply.jobs, counts={"unfinished": 1, "waiting": 3})
    seen.update_jobs(whole, 6.0)
    seen.forget_other_jobs([whole], 5.5)
    assert seen.snapshot(6.0).counts == {"unfinished": 1, "waiting": 3}


def test_a_short_list_has_the_jobs_that_need_somebody_though_others_changed_later():
    seen = FleetView("f")
    for number, to in enumerate(("unfinished", "waiting", "finishing", "given_up", "finished", "finished")):
        seen.update("au", result(number, f"j{number}", to), 0.0)
    shown = [[status.job for status in seen.snapshot(0.0, jobs).jobs] for jobs in (0, 1, 2, 4, 9)]
    whole = ["j0", "j2", "j1", "j5", "j4", "j3"]
    assert shown == [whole[:jobs] for jobs in (0, 1, 2, 4, 6)]


@pytest.mark.parametrize("results_first", [True, False])
def test_a_listener_lists_jobs_in_the_order_of_the_status_pages_whatever_it_has_received_first(results_first):
    """Of nine ended jobs the last three are in cached results; those that wait are by release."""
    ended = [JobStatus(f"e{number}", "cancelled" if number % 2 else "finished") for number in range(9)]
    waiting = tuple(JobStatus(f"w{number}", "waiting", release_s=number) for number in range(3))
    page = Status("au", 9.0, (*waiting, *reversed(ended)))
    results = [msgspec.structs.replace(result(number), status=ended[number]) for number in (6, 7, 8)]
    seen = FleetView("f")
    for message in [*results, page] if results_first else [page, *results]:
        if isinstance(message, Status):
            seen.update_jobs(message, 0.0)
        else:
            seen.update("au", message, 0.0)
    seen.update("au", result(9, "w1", "finished"), 1.0)
    order = ["w0", "w2", "w1", "e8", "e7", "e6", "e5", "e4", "e3", "e2", "e1", "e0"]
    for jobs in (4, 6, 12):
        assert [status.job for status in seen.snapshot(1.0, jobs).jobs] == order[:jobs]


def test_an_older_result_changes_nothing_and_a_status_adds_jobs_without_one():
    seen = FleetView("f")
    for word in (result(2, to="finished"), result(1, to="awarded")):
        seen.update("au", word, 0.0)
    assert seen.snapshot(0.0).counts == {"finished": 1}
    seen = FleetView("f")
    seen.update_jobs(Status("au", 1.0, (JobStatus("x", "waiting"), JobStatus("y", "finished"))), 0.0)
    assert seen.snapshot(4.0).counts == {"waiting": 1, "finished": 1}
    assert seen.snapshot(4.0).auctioneers[0].heard_age_s == 4.0


def test_changes_of_jobs_are_counted_beyond_those_that_are_kept(monkeypatch):
    """By hand: 20 jobs are awarded and finished; an older result, and a status of a dropped job, count nothing."""
    monkeypatch.setattr(snapshot_module, "MAX_JOBS", 3)
    seen = FleetView("f")
    for number in range(20):
        seen.update("au", result(2 * number, f"j{number}"), 0.0)
        seen.update("au", result(2 * number + 1, f"j{number}", "finished"), 0.0)
    seen.update("au", result(3, "j1", "finished"), 0.0)
    seen.update_jobs(stands(5.0, "j2"), 0.0)
    now = seen.snapshot(0.0)
    assert now.changes == {"awarded": 20, "finished": 20}
    assert sum(now.counts.values()) == 3
    seen.update("au", msgspec.structs.replace(result(0, "k"), epoch="new"), 0.0)
    assert seen.snapshot(0.0).changes["awarded"] == 21


def test_jobs_that_have_ended_are_dropped_before_those_that_wait(monkeypatch):
    monkeypatch.setattr(snapshot_module, "MAX_JOBS", 3)
    seen = FleetView("f")
    for number in range(10):
        seen.update("au", result(number, f"j{number}", "finished" if number else "waiting"), 0.0)
    assert [job.job for job in seen.snapshot(0.0).jobs] == ["j0", "j9", "j8"]


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
    """Read in two parts or in one, in order."""
    feed, got = EventFeed(), []
    for count, (topic, name) in enumerate(said):
        feed.add(topic, name, str(count))
        if count == after:
            got += feed.since(0)[0]
    got += feed.since(got[-1].number if got else 0)[0]
    numbers = [entry.number for entry in got]
    assert numbers == sorted(set(numbers))
    events = [number for number, (topic, _) in enumerate(said, 1) if topic not in NEWEST_ONLY]
    assert [entry.number for entry in got if entry.topic not in NEWEST_ONLY] == events
    last = {where: number for number, where in enumerate(said, 1) if where[0] in NEWEST_ONLY}
    assert {(entry.topic, entry.name): entry.number for entry in got if entry.topic in NEWEST_ONLY} == last
    entries, gap = feed.since(0)
    assert not gap
    assert {entry.number for entry in entries} == {*events, *last.values()}


def test_telemetry_and_bids_drop_no_event():
    feed = EventFeed()
    for topic in ("event", *["bid", "state"] * (HISTORY + 1), "event"):
        feed.add(topic, "a", "{}")
    entries, gap = feed.since(0)
    assert not gap
    assert [entry.topic for entry in entries] == ["event", "bid", "state", "event"]


def test_dropped_events_leave_a_gap():
    feed = EventFeed()
    for _ in range(1100):
        feed.add("event", "a", "{}")
    assert feed.since(10)[1]
    assert not feed.since(1000)[1]
    assert len(feed.since(1000)[0]) == 100


def test_a_listener_counts_only_the_jobs_of_the_present_fleet(monkeypatch):
    monkeypatch.setattr(listener_module, "STATUS_EVERY_S", 0.05)
    fleets = [stands(900.0, "a", "b"), stands(5.0, "c", state="waiting")]
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as auctioneer:
        auctioneer.reply_to(keys.of_jobs("f", "status"), StatusRequest, lambda _: fleets[0])
        seen = FleetListener(link)
        for fleet in ({"finished": 2}, {"waiting": 1}):
            serve_until(lambda fleet=fleet: seen.view.snapshot(0.0).counts == fleet, seen, auctioneer)
            del fleets[:-1]


def test_a_listener_asks_for_the_time_of_the_fleet():
    """The reply is read within the seconds that the test may take."""
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as auctioneer:
        auctioneer.reply_to(keys.of_clock("f"), ClockRequest, lambda _: Clock(5000.0, 2.0))
        seen = FleetListener(link)
        serve_until(lambda: seen.view.clock is not None, seen, auctioneer)
        now = seen.view.snapshot(time.monotonic())
        assert now.speed == 2.0
        assert 5000.0 <= (now.time_s or 0.0) < 5000.0 + 2.0 * PATIENCE_S


def test_a_listener_finds_an_unfinished_job_among_300_finished_ones_without_results(monkeypatch):
    monkeypatch.setattr(listener_module, "STATUS_EVERY_S", 0.5)
    desk = ManyJobs(*entries(300), *entries(1, "finishing"))
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as arm:
        desk.reply_on(arm)
        seen = FleetListener(link)
        with serving(arm):
            serve_until(lambda: seen.view.snapshot(0.0).counts == {"finished": 300, "finishing": 1}, seen)
            assert not check_jobs(seen.view.snapshot(0.0))
            desk.move("finishing_0000", "unfinished", reason="arm_1 is silent")
            serve_until(lambda: seen.view.snapshot(0.0).counts == {"finished": 300, "unfinished": 1}, seen)
        (finding,) = check_jobs(seen.view.snapshot(0.0))
    assert (finding.kind, finding.subject) == ("unfinished", "finishing_0000")


def test_a_listener_knows_why_each_of_481_jobs_waits(monkeypatch):
    desk = ManyJobs(*entries(481, "waiting", reason="Its place is in use."))
    with Router() as router, BusClient(router.endpoint, "f") as link, BusClient(router.endpoint, "f") as arm:
        desk.reply_on(arm)
        seen = FleetListener(link)
        serve_until(lambda: sum(seen.view.snapshot(0.0).counts.values()) == 481, seen, arm)
        assert all(status.reason for status in seen.view.snapshot(0.0).jobs)


def test_a_listener_receives_a_whole_fleet(fleet):
    heard, came = [], []
    fleet.event(ArmEvent(arm="a", number=0, time_s=1.0, kind="warning", joint=2))
    with BusClient(fleet.endpoint, "f") as link:
        listener = FleetListener(
            link, on_message=lambda *said: heard.append(said[:2]), on_presence=lambda *who: came.append(who)
        )
        wait_until(
            lambda: len({topic for topic, _ in heard}) >= 3,
            lambda: (fleet.say(), listener.serve(time.monotonic() + 0.05)),
        )
        (arm,) = listener.view.snapshot(time.monotonic()).arms
    assert {topic for topic, _ in heard} == {"state", "difficulty", "event"}  # the event was said before
    assert came == [("arm", "a", True)]
    assert arm.present
    assert arm.event == "warning joint 2"
