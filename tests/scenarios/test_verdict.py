"""The first lines of a report: who faulted, why, and what would have avoided it."""

import pytest

from fleet.events import Event
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.run.records import Offer, ShiftLog
from scenarios.show.run_page import verdict

ARMS = ("hot", "cool")
MIN = 60.0


def event(minute, kind, arm, job, **more):
    return Event(time_s=minute * MIN, kind=kind, arm=arm, job=job, **more)


EVENTS = (
    event(0, "award", "hot", "hold-1"),
    event(20, "finish", "hot", "hold-1", value=0.0),
    event(20, "home", "hot", "hold-1"),
    event(20.5, "award", "hot", "hold-2"),
    event(25, "award", "cool", "sort-1"),
    event(30, "fault", "hot", "hold-2", joint=2, value=75.0, reason="motor 2 passed 75 °C"),
    event(30, "return", "hot", "hold-2", value=1.0),
    event(50, "recover", "hot", ""),
    event(55, "finish", "cool", "sort-1", value=0.0),
    event(55, "home", "cool", "sort-1"),
)


def offer(arm, peak_c, *, at=20.5, **more):
    of = {"state": "idle", "feasible": True, "free": True, "difficulty": 5.0, "duration_s": 600.0, "p_saturation": 1.0}
    return Offer(time_s=at * MIN, job="hold-2", arm=arm, awarded=arm == "hot", peak_c=peak_c, **{**of, **more})


def sentences(*offers, events=EVENTS, end=60):
    return told({"status": "finished", "time_s": end * MIN}, events, offers)


def told(card, events=(), offers=()):
    readings = Telemetry.empty(len(ARMS))
    log = ShiftLog(card=card, arms=ARMS, limits=ThermalLimits(), readings=readings, events=events, offers=offers)
    return verdict(log).sentences


def test_a_fault_is_told_with_its_arm_joint_time_and_cause():
    fault, why, _, remedy = sentences(offer("hot", 78.2), offer("cool", 50.0))
    assert fault == "0:30:00: hot stopped during hold-2, out for 20 min: the motor of joint 2 passed 75 °C."
    assert why.startswith("Why: at work without a pause since 0:00:00; at the award, 0:20:30, predicted peak 78 °C ")
    assert remedy.startswith("The fault was predicted")
    assert len(sentences(offer("hot", 74.0), offer("cool", 50.0))) == 3


@pytest.mark.parametrize(
    ("own_c", "other", "end", "told"),
    [
        (78.0, {"peak_c": 50.0}, 60, "giving the job to cool, predicted peak 50 °C: it was free."),
        (78.0, {"peak_c": 72.0, "free": False}, 60, "predicted peak 72 °C, but its place or space was taken."),
        (78.0, {"peak_c": 73.0}, 60, "until hot had cooled: no other arm could do the job cooler."),
        (78.0, {"peak_c": None, "feasible": False}, 60, "had cooled: no other arm could do the job."),
        (70.0, {"peak_c": 68.0}, 60, "below the limit, and no other arm could do the job cooler."),
    ],
)  # fmt: skip
def test_the_choice_that_would_have_avoided_a_fault(own_c, other, end, told):
    assert sentences(offer("hot", own_c), offer("cool", **other), end=end)[2].endswith(told)


@pytest.mark.parametrize(("end", "told"), [(60, "once it was free, at 0:55:00."), (55, "which was busy to the end.")])
def test_a_cooler_arm_at_work_is_named_with_the_end_of_its_job(end, told):
    events = (EVENTS[0], event(10, "award", "cool", "sort-1"), *EVENTS[1:4], *EVENTS[5:])
    busy = offer("cool", 50.0, free=False, state="working")
    assert sentences(offer("hot", 78.0), busy, events=events, end=end)[2].endswith(told)


def test_without_offers_only_the_work_before_a_fault_is_told():
    assert sentences()[1:] == ("Why: at work without a pause since 0:00:00; no prediction was recorded.",)


def test_the_hottest_motor_of_a_shift_without_a_fault():
    assert told({"metrics": {"peak_c": {"hot": 68.2, "cool": float("nan")}}}) == (
        "No motor reached its fault limit; the hottest, in hot, reached 68 °C.",
    )
