"""Why jobs were late, and what a report states of jobs that waited at the end beside idle arms."""

import math
from dataclasses import replace
from typing import Any

import pytest

from fleet.events import Event
from fleet.telemetry import Telemetry
from scenarios.run.records import Halt, ShiftLog
from scenarios.show.late_jobs import late_jobs, lateness_text, standstill, standstill_text
from scenarios.show.run_page import verdict
from tests.recorded_shifts import IN_ORDER, done, event, offered, record, row_of_table, shift


def why_late(log: ShiftLog) -> str:
    """What the report says of its late jobs."""
    return lateness_text(log, late_jobs(log))


FAULTED = (
    event(100.0, "award", job="long-1"),
    event(150.0, "fault", job="long-1", reason="joint 2 passed 75 °C"),
    event(150.0, "return", job="long-1", value=0.0),
    event(300.0, "recover", job=""),
)
OUT = (event(10.0, "fault", job="", reason="joint 2 passed 75 °C"), event(590.0, "recover", job=""))
NOT_RECORDED = "it was never awarded, and no offer for it or for a job with the same work is recorded"
PLACE_TAKEN = "arm_a was idle: the job's place was taken, or the policy let the job wait"
RELEASE, LATE = event(0.0, "release", job="long-1"), done("long-1", 600, 900, 60.0)
HOLDS = {"name": "hold", "kind": "hold", "places": ["a"], "payload_kg": [0.5, 2.5]}


@pytest.mark.parametrize(
    ("before", "temp_c", "reason"),
    [
        ((*done("short-1", 0, 200), *done("short-2", 200, 400), *done("long-2", 400, 590)), 30.0,
         "3 other jobs went first on arm_a, 2 of them shorter; at 0:06:40, still in time, arm_a began long-2"),
        (done("long-2", -10, 590), 30.0,
         "arm_a was at work since before its release; no arm was free by 0:09:00, its latest begin"),
        (OUT, 30.0, "arm_a was out after a fault"),
        (FAULTED, 30.0, "arm_a faulted during it at 0:02:30"),
        ((), 62.0, "arm_a was idle above the warning limit"),
        ((), 30.0, PLACE_TAKEN),
        ((), math.nan, "arm_a was absent, or no state was recorded"),
    ],
)  # fmt: skip
def test_the_reason_of_a_late_job_is_what_took_most_of_its_wait(before, temp_c: float, reason: str) -> None:
    lengths_s = {"short-1": 200.0, "short-2": 200.0, "long-2": 400.0, "long-1": 300.0}
    events = (RELEASE, *before, *LATE)
    offers = tuple(offered(e.job, e.time_s, lengths_s[e.job]) for e in events if e.kind == "award")
    log = shift(*events, temp_c=temp_c, jobs=tuple(record(job, 840.0) for job in lengths_s), offers=offers)
    log.readings.mode[:] -= math.isnan(temp_c)
    assert why_late(log) == f"long-1 finished 1 min late: {reason}."


def test_the_reason_of_a_late_job_names_only_the_arms_that_it_holds_for() -> None:
    at_work = replace(offered("long-2", -10, 310), arm="arm_b")
    able = tuple(replace(offered("long-1", 600.0, 300.0), arm=arm) for arm in ("arm_a", "arm_b"))
    jobs, before = (record("long-1", 840.0), record("long-2", 840.0)), done("long-2", -10, 300, arm="arm_b")
    log = shift(RELEASE, *before, *OUT, *LATE, jobs=jobs, offers=(at_work, *able))
    assert why_late(log).endswith(": arm_a was out after a fault.")
    out = replace(log, events=(*log.events, event(400.0, "fault", "arm_b", ""), event(500.0, "recover", "arm_b", "")))
    assert why_late(out).endswith(": arm_a and arm_b were out after a fault.")


def test_pauses_of_all_arms_that_can_do_a_late_job_count_together() -> None:
    """Each pause is shorter than the idle time of both arms; an arm that cannot do the job is left out."""
    arms, jobs = ("arm_a", "arm_b", "arm_c"), (record("long-1", 840.0),)
    able = tuple(replace(offered("long-1", 600.0, 300.0), arm=arm, feasible=arm != "arm_c") for arm in arms)
    halts = tuple(Halt(arm=arm, start_s=0.0, end_s=350.0, reason=f"{arm} was paused by ann") for arm in arms)
    log = shift(RELEASE, *LATE, temp_c=30.0, arms=arms, jobs=jobs, offers=able, halts=halts)
    paused = "arm_a was paused by ann from 0:00:00 to 0:05:50 and arm_b was paused by ann from 0:00:00 to 0:05:50"
    assert why_late(log) == f"long-1 finished 1 min late: {paused}."


def test_late_jobs_turn_the_badge_red_and_abandoned_ones_come_last() -> None:
    jobs = (record("long-1", 840.0), record("gone-1", 100.0, "expired"), record("open-1", 500.0, "waiting"))
    log = shift(RELEASE, *done("long-1", 0, 900, 60.0), card={"status": "finished"}, jobs=jobs)
    unread = replace(log, readings=Telemetry.empty(2), offers=(offered("open-1", 500.0, 9.0),), events=(
        event(0.0, "release", job="open-1"), event(1000.0, "warning", job="")))  # fmt: skip
    assert lateness_text(unread, late_jobs(unread)[:1]).endswith("what arm_a did meanwhile is not recorded.")
    judged = verdict(log)
    assert (judged.badge, judged.good) == ("3 late jobs, 1 job left waiting", False)
    assert [late.job for late in late_jobs(log)] == ["open-1", "long-1", "gone-1"]
    assert judged.moments[judged.sentences[-1]].time_s == 500.0
    assert lateness_text(log, late_jobs(log)[1:2]) == (
        "long-1 finished 1 min late: its work takes 15 min, and it was due 14 min after its release."
    )


@pytest.mark.parametrize(
    ("card", "finished_s", "reason"),
    [
        (IN_ORDER, 900.0, "it waited for A1, which finished at 0:15:00"),
        (IN_ORDER, None, "it waits for A1, which is not finished (waiting)"),
        (IN_ORDER, 300.0, PLACE_TAKEN),
        ({"jobs": [row_of_table("A1"), row_of_table("A2")], "slots": 1}, None,
         f"{PLACE_TAKEN}, or it had no slot (1 for up to 2 waiting jobs)"),
        ({"jobs": [row_of_table("A1"), row_of_table("A2", kind="pick_place")]}, 300.0,
         NOT_RECORDED),
        ({}, 300.0, NOT_RECORDED),
    ],
)  # fmt: skip
def test_a_row_of_a_table_that_was_never_awarded_has_a_reason(card, finished_s: float | None, reason: str) -> None:
    first = replace(record("A1", 2000.0, "waiting" if finished_s is None else "finished"), finished_s=finished_s)
    jobs, offers = (first, record("A2", 500.0, "waiting")), (offered("A1", 10.0, 100.0),)
    log = shift(temp_c=30.0, card={"scenario": card}, jobs=jobs, offers=offers)
    assert why_late(log) == f"A2 is unfinished 8 min 20 s after its due date: {reason}."


@pytest.mark.parametrize(
    ("policy", "due_s", "rule"),
    [
        ("bid_price", 900.0, "; bid_price begins no job that would end 100 min late"),
        ("limited:wsept", 900.0, "; limited:wsept begins no job that would end 100 min late"),
        ("bid_price", 2000.0, ""),
        ("fifo", 900.0, ""),
        ("bus:wsept", 900.0, ""),
    ],
)
def test_a_policy_that_begins_no_very_late_job_is_named_with_its_rule(policy: str, due_s: float, rule: str) -> None:
    """The shift ends 2 h after its begin."""
    card, jobs = {"policy": policy}, (record("open-1", due_s, "waiting"),)
    log = shift(temp_c=30.0, samples=7200, card=card, jobs=jobs, offers=(offered("open-1", 50.0, 9.0),))
    assert why_late(log).endswith(f": {PLACE_TAKEN}{rule}.")


def test_a_predecessor_is_no_reason_for_a_job_that_waits_on_for_longer() -> None:
    """Both were due before A1 was done, but A2 waits from 5 min on, for 11 min 40 s."""
    first = replace(record("A1", 2000.0, "finished"), finished_s=300.0)
    jobs, offers = (first, record("A2", 200.0, "waiting")), (offered("A1", 10.0, 100.0),)
    log = shift(temp_c=30.0, card={"scenario": IN_ORDER}, jobs=jobs, offers=offers)
    assert why_late(log) == f"A2 is unfinished 13 min 20 s after its due date: {PLACE_TAKEN}."


@pytest.mark.parametrize(
    ("streams", "payload_kg", "reason"),
    [
        ([], 2.5, NOT_RECORDED),
        ([HOLDS], 2.5, PLACE_TAKEN),
        ([HOLDS], 0.5, NOT_RECORDED),
        ([HOLDS | {"name": "hold-250"}, HOLDS | {"name": "hold-251"}], 2.5, PLACE_TAKEN),
        ([HOLDS | {"name": "hold-250"}, HOLDS | {"name": "hold-251", "places": ["b"]}], 2.5, NOT_RECORDED),
    ],
    ids=["submitted jobs", "a stream", "another payload", "rows alike", "another place"],
)
def test_offers_for_another_job_count_only_if_its_recorded_work_is_the_same(
    streams: list[dict[str, Any]], payload_kg: float, reason: str
) -> None:
    waits = replace(record("hold-250", 500.0, "waiting"), payload_kg=2.5)
    jobs, offers = (waits, replace(record("hold-251", 900.0), payload_kg=payload_kg)), (offered("hold-251", 10.0, 9.0),)
    log = shift(temp_c=30.0, card={"scenario": {"jobs": streams}}, jobs=jobs, offers=offers)
    assert why_late(log).endswith(f": {reason}.")


def test_an_arm_that_was_awarded_a_job_can_do_it_without_a_recorded_offer() -> None:
    assert why_late(shift(RELEASE, *OUT, *LATE, jobs=(record("long-1", 840.0),))).endswith(
        ": arm_a was out after a fault."
    )


@pytest.mark.parametrize(
    ("done_s", "state", "able", "status", "stands"),
    [
        (100.0, "waiting", True, "finished", True),
        (200.0, "waiting", True, "finished", False),
        (100.0, "expired", True, "finished", False),
        (100.0, "waiting", False, "finished", False),
        (100.0, "waiting", True, "interrupted", False),
    ],
    ids=["at a standstill", "not for long", "no job waits", "no arm can do it", "not to the end"],
)
def test_a_fleet_at_a_standstill_is_told(done_s: float, state: str, able: bool, status: str, stands: bool) -> None:
    offers = (replace(offered("open-1", 50.0, 9.0), feasible=able), replace(offered("done-1", 0.0, 9.0), arm="arm_b"))
    unable = replace(offers[0], arm="arm_b", feasible=False)
    jobs = (record("done-1", 840.0), record("open-1", 5000.0, state))
    events = done("done-1", 0.0, done_s)
    judged = verdict(shift(*events, card={"status": status}, jobs=jobs, offers=(*offers, unable)))
    sentence = "1 job still waited at the end, though arm_a was idle from 0:01:40 to the end: run another policy."
    assert (sentence in judged.sentences) == stands
    assert ("1 job left waiting beside idle arms" in judged.badge) == stands
    assert judged.good == (status == "finished" and not stands)


def test_a_row_of_a_table_waits_for_the_named_rows_only() -> None:
    card = {"scenario": {"jobs": [row_of_table("A"), row_of_table("A-2"), row_of_table("B-2", "A")]}}
    jobs = (replace(record("A", 900.0), finished_s=100.0), record("A-2", 900.0, "waiting"), record("B-2", 900.0))
    assert shift(card=card, jobs=jobs).last_before["B-2"] == (jobs[0], 100.0)


def test_an_arm_without_recorded_states_at_the_end_is_not_idle_beside_waiting_jobs() -> None:
    log = shift(arms=("arm_a",), card={"status": "finished"}, jobs=(record("open-1", 5000.0, "waiting"),))
    log.readings.mode[500:, 0] = -1
    assert standstill(log) is None


def test_jobs_that_no_record_gives_an_arm_are_no_jobs_beside_idle_arms() -> None:
    jobs = (record("open-1", 5000.0, "waiting"), record("open-2", 5000.0, "waiting"))
    log = shift(card={"status": "finished"}, jobs=jobs)
    judged = verdict(log)
    assert (judged.badge, judged.good) == ("2 jobs left waiting", False)
    unknown = "waited for at least 15 min; which arms can do"
    assert f"2 jobs still waited at the end. 2 jobs {unknown} them is not recorded." in judged.sentences
    partly = verdict(replace(log, offers=(offered("open-1", 50.0, 9.0),)))
    assert (partly.badge, partly.good) == ("2 jobs left waiting, 1 of them beside idle arms", False)
    assert (
        "2 jobs still waited at the end, 1 of them though arm_a was idle from 0:00:00 to the end: run another policy. "
        f"1 job {unknown} it is not recorded."
    ) in partly.sentences


def test_all_jobs_that_waited_at_the_end_are_counted_not_only_those_beside_idle_arms() -> None:
    """Beside the job at a standstill one waits for a job before it, and five came less than 15 min before the end."""
    jobs = [record("A1", 5000.0, "waiting"), record("A2", 5000.0, "waiting")]
    jobs += [replace(record(f"new-{n}", 5000.0, "waiting"), release_s=900.0) for n in range(5)]
    jobs += [replace(record("future", 5000.0, "waiting"), release_s=2000.0)]
    offers = tuple(offered(job.job, 950.0, 9.0) for job in jobs)
    log = shift(card={"status": "finished", "scenario": IN_ORDER}, jobs=tuple(jobs), offers=offers)
    stood = standstill(log)
    assert stood is not None
    assert stood.badge == "7 jobs left waiting, 1 of them beside idle arms"
    assert standstill_text(log, stood) == (
        "7 jobs still waited at the end, 1 of them though arm_a was idle from 0:00:00 to the end: run another policy."
    )


def test_a_job_that_was_due_before_its_release_and_never_taken_has_no_time_of_work() -> None:
    events = (event(300.0, "release", job="open-1"), event(1000.0, "warning", job=""))
    jobs = (replace(record("open-1", 60.0, "waiting"), release_s=300.0),)
    assert why_late(shift(*events, jobs=jobs)).endswith(": it was due 4 min before its release.")


@pytest.mark.parametrize(
    ("kind", "reason"), [("break", "had a break at 0:03:20"), ("failure", "failed, not by heat, at 0:03:20")]
)
def test_a_job_that_came_back_for_a_break_or_a_failure_is_late_by_that(kind: str, reason: str) -> None:
    events = (
        RELEASE,
        event(100.0, "award", job="long-1"),
        event(200.0, kind, job="", value=400.0),
        event(250.0, "give_back" if kind == "break" else "return", job="long-1", value=2.0),
        event(260.0, "home", job="long-1"),
        *LATE,
    )
    assert why_late(shift(*events, jobs=(record("long-1", 840.0),))) == f"long-1 finished 1 min late: arm_a {reason}."


def test_a_job_that_is_given_up_with_another_one_says_so() -> None:
    reason = "it waited for b, which was given up"
    events = (event(0.0, "release", job="a"), event(300.0, "give_up", "", "a", reason=reason))
    log = shift(*events, jobs=(record("a", 500.0, "given_up"),))
    assert why_late(log).endswith(f": {reason}.")
    assert why_late(replace(log, events=())).endswith(": a job that it waited for was abandoned.")


@pytest.mark.parametrize(("state", "how"), [("expired", "expired"), ("given_up", "was given up")])
def test_a_job_that_is_given_up_with_another_one_names_it_also_without_the_reason(state: str, how: str) -> None:
    card = {"scenario": {"jobs": [row_of_table("A0"), row_of_table("A1"), row_of_table("A2", "A0", "A1")]}}
    jobs = (record("A0", 900.0, "waiting"), record("A1", 2000.0, state), record("A2", 500.0, "given_up"))
    events = (event(300.0, "give_up", "", "A2", reason="a job before it was given up"),)  # as earlier versions have it
    log = shift(*events, card=card, jobs=jobs)
    (late,) = (each for each in late_jobs(log) if each.job == "A2")
    assert lateness_text(log, [late]).endswith(f": it waited for A1, which {how}.")


def test_a_break_after_the_due_date_is_no_reason_to_be_late() -> None:
    pause = event(300.0, "break", job="", value=600.0), event(900.0, "break_end", job="")
    offers = (offered("late-1", 1.0, 100.0), offered("other-1", 1.0, 249.0))
    after, before = (
        why_late(
            shift(
                *done("other-1", 1.0, 250.0),
                *pause,
                jobs=(replace(record("late-1", due_s, "waiting"), release_s=release_s), record("other-1", 900.0)),
                offers=offers,
            )
        )
        for release_s, due_s in ((0.0, 200.0), (300.0, 500.0))
    )
    assert "break" not in after
    assert before.endswith("arm_a had a break; no arm was free by 0:06:40, its latest begin.")


def late_beside(*events: Event, lengths_s: dict[str, float], due_s: float = 840.0, card: Any = None) -> str:
    """What is said of `long-1`, which takes 300 s, was released at 0 s, and began 10 min later."""
    every = (RELEASE, *events, *done("long-1", 600, 900, 900 - due_s))
    awards = [each for each in every if each.kind == "award"]
    offers = [replace(offered(e.job, e.time_s, lengths_s.get(e.job, 300.0)), arm=e.arm) for e in awards]
    jobs = [replace(record(each.job, due_s), payload_kg=0.2) for each in awards]
    log = shift(*every, temp_c=30.0, jobs=tuple(jobs), offers=tuple(offers), card={"scenario": card or {}})
    text = lateness_text(log, [each for each in late_jobs(log) if each.job == "long-1"])
    return text.removeprefix("long-1 finished 1 min late: ")


def test_an_arm_that_was_free_in_time_and_began_another_job_is_the_reason_however_long_it_was_at_work_before() -> None:
    """The job is due at 0:14:00 and takes 5 min: until 0:09:00 its begin is in time."""
    at_work = "arm_a was at work since before its release; no arm was free by 0:09:00, its latest begin"
    for free_s, reason in (
        (539.0, "at 0:08:59, still in time, arm_a was free and began long-3 instead."),
        (541.0, f"{at_work}; then 1 other job went first on arm_a, which was shorter."),
    ):
        before = (*done("long-2", -10, free_s), *done("long-3", free_s, 599))
        assert late_beside(*before, lengths_s={"long-3": 58.0}) == reason


def test_work_that_differs_by_less_than_a_hundredth_is_not_shorter() -> None:
    before = (*done("long-2", 0, 280), *done("long-3", 280, 590))
    for length_s, trait in ((299.98, ""), (290.0, ", all of them shorter")):
        reason = late_beside(*before, lengths_s={"long-2": length_s, "long-3": length_s})
        assert reason == f"2 other jobs went first on arm_a{trait}; at 0:04:40, still in time, arm_a began long-3."


def test_another_job_is_no_reason_if_the_arm_had_a_break_before_the_late_one_was_finished() -> None:
    before = (*done("short-1", 0, 200), event(200.0, "break", job="", value=380.0), event(580.0, "break_end", job=""))
    assert "short-1" not in late_beside(*before, lengths_s={"short-1": 200.0})


def test_another_job_is_no_reason_while_a_third_one_has_the_place_of_the_late_one() -> None:
    rows = [row_of_table("long-1"), row_of_table("third") | {"places": [["a", "c"]]}, row_of_table("short-1")]
    before = (*done("third", -10, 550, arm="arm_b"), *done("short-1", 100, 300))
    lengths_s = {"short-1": 200.0, "third": 560.0}
    free = late_beside(*before, lengths_s=lengths_s)
    assert free == "at 0:01:40, still in time, arm_a was free and began short-1 instead."
    assert "in time" not in late_beside(*before, lengths_s=lengths_s, card={"jobs": rows})


def test_a_predecessor_that_finished_in_time_is_no_reason() -> None:
    """A1 took most of the wait of A2, but A2, which takes 5 min and is due at 0:15:00, could have begun then."""
    for finished_s, reason in (
        (599.0, "at 0:09:59, still in time, arm_a was free and began B1 instead."),
        (
            601.0,
            "it waited for A1, which finished at 0:10:01; then 1 other job went first on arm_a, which was shorter.",
        ),
    ):
        events = (*done("A1", 0, finished_s), *done("B1", finished_s, 700), *done("A2", 700, 1000, 100.0))
        jobs = (replace(record("A1", 2000.0), finished_s=finished_s), record("A2", 900.0), record("B1", 2000.0))
        offers = (offered("A1", 0.0, 600.0), offered("B1", finished_s, 100.0), offered("A2", 700.0, 300.0))
        log = shift(*events, temp_c=30.0, samples=1200, card={"scenario": IN_ORDER}, jobs=jobs, offers=offers)
        assert why_late(log) == f"A2 finished 1 min 40 s late: {reason}"
