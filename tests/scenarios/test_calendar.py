"""Breaks, recurring jobs and failures: times of day and summer time by hand, availability in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.breaks import break_at, break_in_s, breaks_of
from fleet.engine.state import BROKEN, FINISH_CYCLE, FINISH_JOB
from fleet.errors import ScenarioError
from scenarios.evaluate.rollout import outcomes
from scenarios.prepare.fleet import prepare
from scenarios.run.shift import run
from scenarios.show.run_page import report_html
from scenarios.show.words import clock
from scenarios.spec.calendar import absences_of, begin_of
from scenarios.spec.options import RunSpec
from scenarios.spec.parse import parse_scenario
from scenarios.spec.schema import Failures, Scenario
from tests.scenarios.test_evaluate import check_equal, one_by_one
from tests.scenarios.test_load import FILE, small

HOUR_S = 3600.0
SEED = np.random.SeedSequence(1)


def with_breaks(*breaks: dict, **fields: object) -> Scenario:
    return parse_scenario({**small(), "horizon_s": 48 * HOUR_S, **fields, "breaks": list(breaks)}, FILE)


def hours(scenario: Scenario) -> list[tuple[float, float]]:
    return [(each.begin_s / HOUR_S, each.end_s / HOUR_S) for each in scenario.breaks]


@pytest.mark.parametrize(
    ("begin", "end", "fields", "expected"),
    [
        (1800, "0:45", {}, (0.5, 0.75)),
        ("12:00", "12:30", {}, (12.0, 12.5)),
        ("12:00", "12:30", {"shift_begin": "2026-11-23T06:00+01:00"}, (6.0, 6.5)),
        ("22:00", "5:00", {"shift_begin": "2026-11-23T06:00+01:00"}, (16.0, 23.0)),
        ("2026-11-24T06:00", "2026-11-24T07:00", {"shift_begin": "2026-11-23T06:00+01:00"}, (24.0, 25.0)),
        ("2026-11-24T06:00Z", "2026-11-24T07:00Z", {"shift_begin": "2026-11-23T06:00+01:00"}, (25.0, 26.0)),
        # The clocks are put forward at 2:00 of 29 March.
        (
            "2026-03-29T06:00", "2026-03-29T07:00",
            {"shift_begin": "2026-03-28T20:00", "time_zone": "Europe/Berlin"}, (9.0, 10.0),
        ),
        ("6:00", "7:00", {"shift_begin": "2026-03-29T00:00+01:00", "time_zone": "Europe/Berlin"}, (5.0, 6.0)),
        ("6:00", "7:00", {"shift_begin": "2026-10-25T00:00+02:00", "time_zone": "Europe/Berlin"}, (7.0, 8.0)),
        ("22:00", "24:00", {"shift_begin": "2026-11-23T06:00Z"}, (16.0, 18.0)),
        ("8:00", "0:00", {"shift_begin": "2026-11-23T06:00Z"}, (2.0, 18.0)),
        ("24:00", "5:00", {"shift_begin": "2026-11-23T06:00Z"}, (18.0, 23.0)),
    ],
)  # fmt: skip
def test_a_break_has_the_times_that_are_meant(begin, end, fields, expected) -> None:
    scenario = with_breaks({"name": "lunch", "begin": begin, "end": end}, horizon_s=26 * HOUR_S, **fields)
    assert hours(scenario) == [expected]


@pytest.mark.parametrize(
    ("shift_begin", "expected"),
    [
        ("2026-03-27T20:00", [(33.0, 34.0)]),  # Friday evening before summer time begins: 34 h by the clock
        ("2026-10-23T20:00", [(35.0, 36.0)]),  # before it ends
        ("2026-11-27T20:00", [(34.0, 35.0)]),
    ],
)
def test_a_weekly_break_knows_summer_time(shift_begin, expected) -> None:
    entry = {"name": "service", "begin": "6:00", "end": "7:00", "weekdays": ["sunday"]}
    assert hours(with_breaks(entry, shift_begin=shift_begin, time_zone="Europe/Berlin")) == expected


@pytest.mark.parametrize(
    ("date", "sentence"),
    [
        ("29 Mar 2026", "02:30 does not exist: summer time leaves out this hour, so it counts as 03:30."),
        ("25 Oct 2026", "02:30 occurs twice, as summer time ends: 2026-10-25T02:30+02:00 is taken, not"),
    ],
)
def test_a_recurring_time_of_day_that_occurs_never_or_twice_is_told(date, sentence, caplog) -> None:
    month = "03-28" if "Mar" in date else "10-24"
    begin = {"shift_begin": f"2026-{month}T20:00", "time_zone": "Europe/Berlin", "horizon_s": 20 * HOUR_S}
    assert hours(with_breaks({"name": "tea", "begin": "2:30", "end": "3:45"}, **begin))[0][0] == 6.5
    assert f"breaks[0]: {date} {sentence}" in caplog.text
    caplog.clear()
    stream = small()["jobs"][0] | {"arrivals": {"kind": "weekly", "at": ["2:30"]}}
    parse_scenario(small() | begin | {"jobs": [stream]}, FILE)
    assert f"jobs[0].arrivals: {date} {sentence}" in caplog.text


def test_breaks_of_more_than_12_h_are_given_as_the_error_advises() -> None:
    def spans(begin: str, *breaks: dict) -> list[tuple[float, float]]:
        raw = small() | {"horizon_s": 40 * HOUR_S, "shift_begin": begin, "breaks": list(breaks)}
        return [(each.begin_s / HOUR_S, each.end_s / HOUR_S) for each in parse_scenario(raw, FILE).breaks]

    dates = {"name": "long", "begin": "2026-11-23T14:00", "end": "2026-11-24T06:00"}
    assert spans("2026-11-23T05:00Z", dates) == [(9.0, 25.0)]
    evening = {"name": "long", "begin": "14:00", "end": "24:00", "weekdays": ["monday"]}
    night = {"name": "long", "begin": "0:00", "end": "6:00", "weekdays": ["tuesday"]}
    assert spans("2026-11-23T05:00Z", evening, night) == [(9.0, 19.0), (19.0, 25.0)]


def test_a_daily_night_break_covers_the_begin_of_the_shift() -> None:
    entry = {"name": "night", "begin": "22:00", "end": "6:00"}
    assert hours(with_breaks(entry, shift_begin="2026-11-23T05:00Z", horizon_s=30 * HOUR_S)) == [(-7, 1), (17, 25)]


def test_a_break_between_times_of_day_recurs_every_day_without_weekdays_and_one_with_dates_does_not() -> None:
    begin = {"shift_begin": "2026-03-28T20:00", "time_zone": "Europe/Berlin", "horizon_s": 30 * HOUR_S}
    spans = {
        ("19:30", "20:30"): [(-0.5, 0.5), (22.5, 23.5)],
        ("19:00", "20:00"): [(22.0, 23.0)],
        ("23:00", "24:00"): [(3.0, 4.0), (26.0, 27.0)],
        ("2026-03-28T23:00", "2026-03-29T00:00"): [(3.0, 4.0)],
    }
    for (first, last), expected in spans.items():
        assert hours(with_breaks({"name": "tea", "begin": first, "end": last}, **begin)) == expected


def test_a_break_may_be_a_whole_day_or_within_the_hour_that_summer_time_leaves_out() -> None:
    begin = {"shift_begin": "2026-03-28T22:00", "time_zone": "Europe/Berlin", "horizon_s": 48 * HOUR_S}
    sunday = {"name": "closed", "begin": "0:00", "end": "24:00", "weekdays": ["sunday"]}
    assert hours(with_breaks(sunday, **begin)) == [(2.0, 25.0)]  # of 23 hours
    assert (
        hours(with_breaks({"name": "gap", "begin": "2:30", "end": "3:00"}, **begin | {"horizon_s": 20 * HOUR_S})) == []
    )


def test_times_of_a_shift_are_times_of_day_with_summer_time() -> None:
    begin = begin_of("2026-03-28T20:00+01:00", "Europe/Berlin")
    assert [clock(hours_in * HOUR_S, begin) for hours_in in (0.0, 3.9, 5.0, 6.5)] == [
        "20:00:00", "23:54:00", "Sun 29 Mar 01:00:00", "Sun 29 Mar 03:30:00",
    ]  # fmt: skip
    assert clock(6.5 * HOUR_S) == "6:30:00"
    back = begin_of("2026-10-25T01:00+02:00", "Europe/Berlin")
    assert [clock(hours_in * HOUR_S, back) for hours_in in (0.5, 1.5, 2.5, 3.5)] == [
        "01:30:00", "02:30:00 CEST", "02:30:00 CET", "03:30:00",
    ]  # fmt: skip


def test_recurring_jobs_arrive_at_their_times_of_day() -> None:
    raw = small() | {"horizon_s": 48 * HOUR_S, "shift_begin": "2026-03-27T20:00", "time_zone": "Europe/Berlin"}
    stream = raw["jobs"][0] | {"arrivals": {"kind": "weekly", "at": ["14:30", "6:00"], "weekdays": ["sunday"]}}
    arrivals = parse_scenario(raw | {"jobs": [stream]}, FILE).jobs[0].arrivals
    assert arrivals.times_s == (33.0 * HOUR_S, 41.5 * HOUR_S)
    every_day = raw["jobs"][0] | {"arrivals": {"kind": "weekly", "at": ["6:00"]}}
    assert len(parse_scenario(raw | {"jobs": [every_day]}, FILE).jobs[0].arrivals.times_s or ()) == 2


def test_a_time_of_day_that_summer_time_moves_onto_another_is_still_a_job() -> None:
    raw = small() | {"horizon_s": 20 * HOUR_S, "shift_begin": "2026-03-28T20:00", "time_zone": "Europe/Berlin"}
    stream = raw["jobs"][0] | {"arrivals": {"kind": "weekly", "at": ["2:30", "3:30"]}}
    arrivals = parse_scenario(raw | {"jobs": [stream]}, FILE).jobs[0].arrivals
    assert arrivals.times_s == (6.5 * HOUR_S, 6.5 * HOUR_S)


BREAK = {"name": "lunch", "begin": "4:00", "end": "5:00"}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"breaks": [BREAK | {"begin": "0:00", "end": "48:00"}]},
            "breaks: every arm has a break in the whole shift, 0 to 172800 s, so no job can be done",
        ),
        ({"breaks": [BREAK | {"end": "3:00"}]}, r"breaks\[0\].end_s must be after begin_s \(got 14400, 10800\)"),
        ({"breaks": [{"name": "lunch", "begin": "4:00"}]}, r"breaks\[0\]: 'end' is missing; a break has begin and end"),
        ({"breaks": [BREAK | {"begin": "noon"}]}, r"breaks\[0\]: expected seconds, h:mm, h:mm:ss, or a date"),
        ({"breaks": [BREAK | {"arms": ["lefty"]}]}, r"breaks\[0\].arms: there is no arm 'lefty'; did you mean 'left'"),
        ({"breaks": [BREAK | {"begn": 3}]}, r"breaks\[0\]: unknown key 'begn'; did you mean 'begin_s'"),
        ({"breaks": [BREAK | {"weekdays": ["sunday"]}]}, r"weekdays need shift_begin, the begin of the shift"),
        (
            {"breaks": [BREAK, BREAK | {"name": "late", "begin": "90:00", "end": "91:00"}]},
            r"breaks\[1\]: 'late', 324000 to 327600 s, lies outside the shift, 0 to 172800 s: change its times",
        ),
        (
            {"breaks": [BREAK | {"begin": "2026-11-30T10:00", "end": "2026-11-30T11:00"}],
             "shift_begin": "2026-11-23T06:00Z"},
            "30 Nov 2026 10:00 to 30 Nov 2026 11:00, lies outside the shift, 23 Nov 2026 06:00 to 25 Nov 2026 06:00:",
        ),
        (
            {"breaks": [BREAK], "shift_begin": "2026-11-23T06:00Z", "horizon_s": 12 * HOUR_S},
            "4:00 to 5:00 is outside the shift, which begins at 06:00 and ends 12 h later",
        ),
        (
            {"breaks": [BREAK, BREAK | {"begin": "4:30", "arms": ["left"]}]},
            r"breaks\[1\].name: 'lunch' is also the name of breaks\[0\], which overlaps it on 'left': rename one",
        ),
        ({"breaks": [BREAK | {"begin": "11.30"}]}, r"breaks\[0\]: is this 11:30\? Give times as h:mm"),
        (
            {"breaks": [BREAK | {"begin": "11:30", "end": "11:00"}], "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\]: 11:30 to 11:00 lasts 23.5 h over midnight, but at most 12 h are taken: are begin and end "
            r"exchanged\? Give a longer break as two, to 24:00 and from 0:00 on the next days, or with dates for a",
        ),
        (
            {"breaks": [BREAK | {"begin": "14:00", "end": "6:00", "weekdays": ["monday"]}],
             "shift_begin": "2026-11-23T06:00Z"},
            r"14:00 to 6:00 lasts 16 h .* Give a longer break as two, to 24:00 and from 0:00 on the next days, or",
        ),
        (
            {"breaks": [BREAK | {"begin": "9:00", "end": "9:00"}], "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\]: 9:00 to 9:00 begins and ends at the same time of day; a whole day is 0:00 to 24:00\.",
        ),
        (
            {"breaks": [BREAK | {"begin": "24:00", "end": "0:00"}], "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\]: 24:00 to 0:00 begins and ends at the same time of day",
        ),
        ({"breaks": [BREAK | {"begin_s": 14400}]}, r"breaks\[0\]: begin and begin_s are the same time; keep one"),
        ({"breaks": [BREAK | {"arms": []}]}, r"breaks\[0\].arms is empty: name the arms, or leave it out"),
        ({"breaks": [BREAK | {"begin": 480, "end": 510}]}, r"breaks\[0\] lasts 30 s: are its times minutes"),
        (
            {"shift_begin": "2026-03-29T02:30", "time_zone": "Europe/Berlin"},
            "shift_begin = 2026-03-29T02:30 does not exist: summer time leaves out this hour",
        ),
        ({"places": [{**small()["places"][0], "name": "a\nb"}]}, r"heat.toml: places\[0\].name must have 1 to 128"),
        ({"time_zone": "Europe/Berln"}, "there is no time zone 'Europe/Berln'; give a name as Europe/Berlin"),
        (
            {"breaks": [BREAK | {"begin": "2026-11-23T10:00", "end": "2026-11-23T09:00"}],
             "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\].end_s must be after begin_s",
        ),
        ({"shift_begin": "9999-12-31T06:00Z"}, "shift_begin must be a date"),
        (
            {"breaks": [BREAK | {"weekdays": ["sun"]}], "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\].weekdays: there is no day 'sun'",
        ),
        (
            {"breaks": [BREAK | {"begin": "4:75", "weekdays": ["sunday"]}], "shift_begin": "2026-11-23T06:00Z"},
            r"breaks\[0\].begin: expected a time of day, as '6:00' \(got '4:75'\)",
        ),
        (
            {"arms": [{"name": "a", "fails": {"every_s": 10, "repair_s": 60}}]},
            r"arms\[0\].fails.every_s must be between 60",
        ),
    ],
)  # fmt: skip
def test_mistakes_are_named(changes, expected) -> None:
    with pytest.raises(ScenarioError, match=expected):
        parse_scenario({**small(), "horizon_s": 48 * HOUR_S} | changes, FILE)


def test_weekly_arrivals_that_cannot_be_are_named() -> None:
    raw = small() | {"shift_begin": "2026-11-23T06:00Z"}
    for arrivals, expected in (
        ({"at": ["6:00"], "every_s": 5}, "arrivals of kind 'weekly' take no 'every_s'; they take at, weekdays"),
        ({}, r"jobs\[0\].arrivals.at must be a list of times of day"),
        ({"at": ["5:59"], "weekdays": ["monday"]}, "none of these times lies within the shift"),
    ):
        stream = raw["jobs"][0] | {"arrivals": {"kind": "weekly", **arrivals}}
        with pytest.raises(ScenarioError, match=expected):
            parse_scenario(raw | {"jobs": [stream]}, FILE)


def test_breaks_begin_and_end_with_decisions() -> None:
    scenario = with_breaks(
        {"name": "one", "begin": "0:01:35", "end": "0:02:10"},
        {"name": "two", "begin": "0:03:20", "end": "0:03:21", "arms": [small()["arms"][1]["name"]], "finish": "job"},
        {"name": "three", "begin_s": -50, "end_s": 20, "arms": [small()["arms"][0]["name"]]},
    )
    assert scenario.decision_interval_s == 10.0
    assert absences_of(scenario, SEED).tolist() == [
        *((a, 10, 13, FINISH_CYCLE) for a in range(len(scenario.arms))),
        (1, 20, 21, FINISH_JOB),
        (0, 0, 2, FINISH_CYCLE),
    ]
    first, second = (breaks_of(scenario.breaks, arm.name) for arm in scenario.arms[:2])
    now = break_at(second, 200.5)
    assert now is not None
    assert now.name == "two"
    assert break_at(first, 200.5) is None
    assert [break_in_s(second, time_s) for time_s in (0.0, 100.0, 130.0, 201.0)] == [95.0, 0.0, 70.0, None]


def test_availability_is_mean_time_between_failures_over_that_with_the_repair() -> None:
    """MTBF / (MTBF + MTTR) = 0.8, in 200 shifts within four standard errors; arms are independent."""
    base = with_breaks(horizon_s=200 * HOUR_S, telemetry_interval_s=10.0)
    fails = Failures(every_s=4 * HOUR_S, repair_s=HOUR_S)
    scenario = replace(base, arms=tuple(replace(arm, fails=fails) for arm in base.arms))
    down = np.zeros((200, len(scenario.arms)))
    for seed in range(len(down)):
        found = absences_of(scenario, np.random.SeedSequence(seed))
        assert set(found["kind"].tolist()) == {BROKEN}
        np.add.at(down[seed], found["arm"], (found["end"] - found["begin"]) / scenario.ticks)
    for arm in range(len(scenario.arms)):
        error = down[:, arm].std() / np.sqrt(len(down))
        assert abs(down[:, arm].mean() - 0.2) < 4 * error
    covariance = np.cov(down.T)
    assert abs(covariance[0, 1]) < 0.25 * np.sqrt(covariance[0, 0] * covariance[1, 1])
    one = replace(scenario, arms=(scenario.arms[0], base.arms[1], *scenario.arms[2:]))
    both, own = (absences_of(each, SEED) for each in (scenario, one))
    np.testing.assert_array_equal(own[own["arm"] == 0], both[both["arm"] == 0])


def test_a_shift_with_breaks_and_failures_is_the_same_in_a_batch_and_alone(scenario) -> None:
    base = scenario
    arms = tuple(replace(arm, fails=Failures(every_s=600.0, repair_s=120.0)) for arm in base.arms)
    scenario = replace(with_breaks(BREAK | {"begin": "0:05", "end": "0:10"}), arms=arms, horizon_s=1800.0)
    scenario = replace(scenario, jobs=base.jobs, places=base.places, fixtures=base.fixtures, name=base.name)
    fleet = prepare(scenario, difficulty="blind")
    done = run(fleet, RunSpec(policy="wspt", seed=3, bus="memory", difficulty="blind"))
    kinds = {event.kind for event in done.events}
    assert {"break", "break_end", "failure", "recover"} <= kinds
    assert not any(300.0 <= event.time_s < 600.0 for event in done.events if event.kind == "award")
    drawn = absences_of(scenario, np.random.SeedSequence(3))
    broken_s = {10.0 * begin for begin in drawn["begin"][drawn["kind"] == BROKEN].tolist()}
    assert {event.time_s for event in done.events if event.kind == "failure"} <= broken_s
    page = report_html(done)
    assert "failed, not by heat" in page
    assert "has a break" in page
    check_equal(outcomes(fleet, "wspt", [3]), one_by_one(fleet, "wspt", [3]))
