"""A schedule and metrics read from an event log."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.events import Event
from scenarios.run.metrics import gini
from scenarios.run.records import schedule

ARMS = ("arm_0", "arm_1")
HORIZON_S = 1000.0
ENDINGS = ("home", "fault", "late fault", "idle fault", "give back", "back fault", "failure")
gaps = st.integers(min_value=1, max_value=40).map(lambda n: n * 0.5)


@st.composite
def logs(draw: st.DrawFn) -> tuple[list[Event], dict[str, int]]:
    """A log of two arms told from a story the test knows, and how often each outcome occurs in it."""
    events: list[Event] = []
    told = {"finished": 0, "returned": 0, "running": 0, "outages": 0, "open": 0}
    for a, arm in enumerate(ARMS):
        now, job = 0.0, 0
        for ending in draw(st.lists(st.sampled_from(ENDINGS), max_size=8)):
            now += draw(st.just(0.0) | gaps)
            name = f"work-{a}{job:03d}"
            if ending != "idle fault":
                events.append(Event(time_s=now, kind="award", arm=arm, job=name, value=0.5))
                job += 1
            if ending in ("home", "late fault"):
                now += draw(gaps)
                events.append(Event(time_s=now, kind="finish", arm=arm, job=name, value=0.0))
            elif ending in ("give back", "back fault"):
                now += draw(gaps)
                events.append(Event(time_s=now, kind="give_back", arm=arm, job=name, value=3.0))
                told["returned"] += 1
            now += draw(gaps)
            told["finished"] += ending in ("home", "late fault")
            if ending in ("home", "give back"):
                events.append(Event(time_s=now, kind="home", arm=arm, job=name))
                continue
            held = "" if ending == "idle fault" else name
            kind = "failure" if ending == "failure" else "fault"
            events.append(Event(time_s=now, kind=kind, arm=arm, job=held, joint=0 if ending == "failure" else 2))
            if ending in ("fault", "failure"):
                events.append(Event(time_s=now, kind="return", arm=arm, job=name, value=3.0))
                told["returned"] += 1
            now += draw(gaps)
            events.append(Event(time_s=now, kind="recover", arm=arm))
            told["outages"] += 1
        last = draw(st.sampled_from(["nothing", "working", "faulted"]))
        if last == "working":
            events.append(Event(time_s=now, kind="award", arm=arm, job=f"work-{a}{job:03d}"))
            told["running"] += 1
        elif last == "faulted":
            events.append(Event(time_s=now + 1, kind="fault", arm=arm, joint=4))
            told["open"] += 1
    return draw(st.permutations(events)), told


@given(logs())
def test_every_award_is_one_assignment_and_every_fault_one_outage(log: tuple[list[Event], dict[str, int]]) -> None:
    events, told = log
    result = schedule(events, ARMS, HORIZON_S)
    awards = sorted((e.time_s, e.arm, e.job) for e in events if e.kind == "award")
    assert sorted((a.start_s, a.arm, a.job) for a in result.assignments) == awards
    faults = sorted((e.time_s, e.arm, e.joint) for e in events if e.kind in ("fault", "failure"))
    assert all((o.joint > 0) == (o.kind == "fault") for o in result.outages)
    assert sorted((o.start_s, o.arm, o.joint) for o in result.outages) == faults
    for outcome in ("finished", "returned", "running"):
        assert sum(a.outcome == outcome for a in result.assignments) == told[outcome]
    assert sum(o.recovered for o in result.outages) == told["outages"]
    assert sum(o.end_s == HORIZON_S and not o.recovered for o in result.outages) == told["open"]


def test_breaks_end_as_planned_where_a_failure_hides_their_end():
    """50 to 100 s, and 150 to 300 s whose end is told; a failure meanwhile repeats the begin of the second one."""
    log = [
        Event(time_s=50.0, kind="break", arm="arm_0", value=50.0),
        Event(time_s=150.0, kind="break", arm="arm_0", value=150.0),
        Event(time_s=200.0, kind="failure", arm="arm_0"),
        Event(time_s=230.0, kind="recover", arm="arm_0"),
        Event(time_s=230.0, kind="break", arm="arm_0", value=70.0),
        Event(time_s=300.0, kind="break_end", arm="arm_0"),
        Event(time_s=20.0, kind="break_end", arm="arm_1"),
    ]
    found = [(each.arm, each.start_s, each.end_s) for each in schedule(log, ARMS, HORIZON_S).breaks]
    assert found == [
        ("arm_0", 50.0, 100.0), ("arm_0", 150.0, 300.0), ("arm_0", 230.0, 300.0), ("arm_1", 0.0, 20.0),
    ]  # fmt: skip


def test_breaks_that_adjoin_are_one_with_the_end_of_the_last():
    """50 to 100 s and 100 to 200 s: the arm tells one begin and one end."""
    log = [
        Event(time_s=50.0, kind="break", arm="arm_0", value=50.0),
        Event(time_s=200.0, kind="break_end", arm="arm_0"),
    ]
    assert [(each.start_s, each.end_s) for each in schedule(log, ARMS, HORIZON_S).breaks] == [(50.0, 200.0)]


@pytest.mark.parametrize(
    ("home_s", "breaks"),
    [(250.0, [(250.0, 400.0)]), (450.0, []), (None, [])],
    ids=["ends in the break", "lasts beyond the break", "lasts to the end"],
)
def test_a_break_begins_once_the_job_of_its_arm_has_ended(home_s, breaks):
    """A job from 100 s on, a break of 200 to 400 s."""
    log = [
        Event(time_s=100.0, kind="award", arm="arm_0", job="a"),
        Event(time_s=200.0, kind="break", arm="arm_0", value=200.0),
        Event(time_s=400.0, kind="break_end", arm="arm_0"),
    ]
    if home_s:
        log += [Event(time_s=home_s - 5.0, kind="finish", arm="arm_0", job="a", value=0.0)]
        log += [Event(time_s=home_s, kind="home", arm="arm_0", job="a")]
    assert [(each.start_s, each.end_s) for each in schedule(log, ARMS, HORIZON_S).breaks] == breaks


@given(logs())
def test_an_arm_is_in_one_place_at_a_time(log: tuple[list[Event], dict[str, int]]) -> None:
    result = schedule(log[0], ARMS, HORIZON_S)
    for arm in ARMS:
        mine = [x for x in (*result.assignments, *result.outages) if x.arm == arm]
        spans = sorted((x.start_s, x.end_s) for x in mine)
        assert all(before[1] <= after[0] for before, after in pairwise(spans))
        assert all(start <= end for start, end in spans)


@given(logs(), st.randoms(use_true_random=False))
def test_the_order_of_the_log_does_not_matter(log: tuple[list[Event], dict[str, int]], random) -> None:
    events = list(log[0])
    random.shuffle(events)
    # repr, because the difficulty of an award may be NaN.
    assert repr(schedule(events, ARMS, HORIZON_S)) == repr(schedule(log[0], ARMS, HORIZON_S))


@given(logs())
def test_finished_work_has_its_moment_inside_the_assignment(log: tuple[list[Event], dict[str, int]]) -> None:
    for a in schedule(log[0], ARMS, HORIZON_S).assignments:
        assert (a.outcome == "finished") == (a.finished_s is not None) == (a.late_s is not None)
        assert a.finished_s is None or a.start_s <= a.finished_s <= a.end_s
        assert (a.cycles_kept == 3) if a.outcome == "returned" else (a.cycles_kept is None)


def test_home_and_next_award_may_differ_in_the_last_bit() -> None:
    home_s, award_s = 0.1 + 0.2, 0.3
    assert home_s > award_s
    log = [
        Event(time_s=0.0, kind="release", job="a-1"),  # no assignment, nor is a lost claim
        Event(time_s=0.0, kind="lost", arm="arm_1", job="a-1"),
        Event(time_s=0.0, kind="award", arm="arm_0", job="a-1"),
        Event(time_s=0.2, kind="finish", arm="arm_0", job="a-1", value=0.0),
        Event(time_s=home_s, kind="home", arm="arm_0", job="a-1"),
        Event(time_s=award_s, kind="award", arm="arm_0", job="a-2"),
    ]
    assert [a.job for a in schedule(log, ARMS, 1.0).assignments] == ["a-1", "a-2"]


def test_a_job_done_before_the_horizon_counts_as_finished_on_the_way_home() -> None:
    log = [
        Event(time_s=0.0, kind="award", arm="arm_0", job="a-1"),
        Event(time_s=90.0, kind="finish", arm="arm_0", job="a-1", value=12.0),
    ]
    (only,) = schedule(log, ARMS, 100.0).assignments
    assert (only.outcome, only.finished_s, only.end_s, only.late_s) == ("finished", 90.0, 100.0, 12.0)


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        (("award", "award"), "is awarded 'a-1' while at 'a-1'"),
        (("home",), "is home from 'a-1'"),
        (("award", "home"), "did not finish"),
        (("finish",), "was not awarded"),
        (("fault", "fault"), "faults while it is faulted"),
        (("recover",), "recovers without a fault"),
    ],
)
def test_an_impossible_log_is_refused_with_its_reason(kinds: tuple, words: str) -> None:
    log = [Event(time_s=float(t), kind=kind, arm="arm_0", job="a-1") for t, kind in enumerate(kinds)]
    with pytest.raises(ValueError, match=words):
        schedule(log, ARMS, 100.0)


def test_an_arm_of_another_fleet_is_refused() -> None:
    with pytest.raises(ValueError, match=r"No arm 'arm_9' in this fleet.*arm_0, arm_1"):
        schedule([Event(time_s=0.0, kind="award", arm="arm_9", job="a-1")], ARMS, 100.0)


shares = st.lists(st.floats(0.0, 1e6), min_size=1, max_size=12)


@pytest.mark.parametrize("arms", [1, 2, 5, 64])
def test_everything_with_one_arm_equal_shares_and_shares_1_to_n_have_closed_forms(arms) -> None:
    assert gini(np.eye(arms)[0]) == pytest.approx(1 - 1 / arms)
    assert gini(np.full(arms, 3.7)) == pytest.approx(0.0)
    assert gini(np.zeros(arms)) == 0.0
    # Of 1 to n: Σ|i − j| = n (n² − 1)/3 and mean (n + 1)/2, so G = (n − 1)/(3 n).
    assert gini(np.arange(1, arms + 1)) == pytest.approx((arms - 1) / (3 * arms))


@given(shares, st.floats(1e-3, 1e3), st.randoms())
def test_it_knows_neither_unit_nor_order(values, scale, random) -> None:
    g = gini(np.array(values))
    assert 0.0 <= g < 1.0
    mixed = [scale * v for v in values]
    random.shuffle(mixed)
    assert gini(np.array(mixed)) == pytest.approx(g, abs=1e-9)


@pytest.mark.parametrize(("values", "says"), [([1.0, -0.1], "must be >= 0"), ([], "at least one")])
def test_shares_that_cannot_be_are_refused(values, says) -> None:
    with pytest.raises(ValueError, match=says):
        gini(np.array(values))
