"""The page of two runs side by side."""

import re

from fleet.events import Event
from fleet.robot import ThermalLimits
from fleet.telemetry import Telemetry
from scenarios.run.records import ShiftLog
from scenarios.show.run_page import other_choices, pair_page

ARMS = ("arm_a", "arm_b")


def side(policy, *events, **run):
    card = {"policy": policy, "status": "finished", "time_s": 1000.0, **run}
    return ShiftLog(card=card, arms=ARMS, limits=ThermalLimits(), readings=Telemetry.empty(2), events=events)


def reports(*sides):
    return {f"{each.policy}/report.html": each for each in sides}


def event(time_s, kind, arm="arm_a", job="crate", **more):
    return Event(time_s=time_s, kind=kind, arm=arm, job=job, **more)


BURNED = side(
    "round_robin",
    event(10.0, "award"),
    event(100.0, "fault", joint=2, reason="motor 2 passed 75 °C"),
    event(100.0, "return", value=1.0),
    event(900.0, "recover", job=""),
)
SPARED = side(
    "wsept", event(20.0, "award", "arm_b"), event(300.0, "finish", "arm_b", value=0.0), event(310.0, "home", "arm_b")
)


def test_each_side_says_what_happened_and_what_became_of_the_job_on_the_other():
    page = pair_page("two", "a shift", reports(BURNED, SPARED))
    burned, spared = re.findall(r"<section>(.*?)</section>", page, re.S)
    assert "<h2>round_robin</h2>" in burned
    assert "status bad" in burned
    assert "arm_a stopped during crate, out for 13 min: the motor of joint 2 passed 75 °C" in burned
    assert "Under wsept, arm_b finished crate at 0:05:00 without a fault." in burned
    assert 'href="round_robin/report.html"' in burned
    assert "status good" in spared
    assert "Under" not in spared
    assert other_choices(BURNED, BURNED) == ["Under round_robin, crate was not finished."]


def test_names_stay_text():
    odd = '<img src=x onerror="a()">\x1b[2J'
    page = pair_page(odd, odd, reports(side(odd, event(1.0, "fault", job=odd, reason=odd)), SPARED))
    assert "<img" not in page
    assert 'onerror="' not in page
    assert "\x1b" not in page
    assert len(re.findall(r'href="[^"<> ]+"', page)) == page.count("href=") == 2
