"""The load of a shift, where it can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.engine.tables import drive_of
from fleet.heat.thermal import WINDING, drive_heat, gen3_network, thermal_model
from scenarios.prepare.load_factor import LoadFactor, load_factor

TICKS = 60
HORIZON_S = 600.0
ONE_JOB_S = 3.0 + 3 * 10.0 + 2.0
"""Approach, three cycles, retreat of a job of `small.job`."""


def load_of(small, jobs, arms, **more) -> LoadFactor:
    world, _ = small.shop([jobs], arms=arms, ticks=TICKS, **more)
    return load_factor(world)


def equal_arms(small, count, content):
    return [small.arm(i, [content]) for i in range(count)]


def test_one_arm_and_one_job_take_its_time_over_the_horizon(small):
    content = small.work(payload_kg=small.WARM)
    found = load_of(small, [small.job("a", content)], equal_arms(small, 1, content))
    assert found.time == pytest.approx(ONE_JOB_S / HORIZON_S)


def test_the_thermal_load_is_the_share_of_time_at_which_the_cycle_settles_at_the_warning(small):
    """Second method: mix working and standing in the ratio the factor names, and settle: the hottest motor is at 60."""
    content = small.work(payload_kg=small.HOT)
    world, _ = small.shop([[small.job("a", content)]], arms=equal_arms(small, 1, content), ticks=TICKS)
    share = load_factor(world).thermal * HORIZON_S / ONE_JOB_S
    limit_c = np.full((1, 14), 60.0)
    row = world.tables.work["plan"][0, 0, 0]
    working, standing = (
        drive_heat(limit_c, current_sq, friction_w, world.motors)
        for current_sq, friction_w in (
            (each[:, 1] for each in drive_of(world.tables.plans[row])),
            drive_of(world.tables.start[0]),
        )
    )
    mixed = working / share + (1 - 1 / share) * standing
    settled = world.thermal.steady(mixed, world.tables.ambient_c[0].mean(axis=0))[..., WINDING]
    assert settled.max() == pytest.approx(60.0, abs=1e-6)
    assert share > 1.0  # it cannot go on for ever, as its name says


def test_breaks_leave_less_time_and_the_same_heat(small):
    """Two that overlap take 200 of 600 s of one of two arms, so both have 1,000 s together."""
    content = small.work(payload_kg=small.WARM)
    jobs, arms = [small.job(f"j{i}", content) for i in range(8)], equal_arms(small, 2, content)
    whole, less = load_of(small, jobs, arms), load_of(small, jobs, arms, absences=[(0, 10, 20, 1), (0, 15, 30, 2)])
    assert whole.time == pytest.approx(8 * ONE_JOB_S / (2 * HORIZON_S))
    assert less.time == pytest.approx(8 * ONE_JOB_S / 1000.0)
    assert (less.thermal, less.blind) == pytest.approx((whole.thermal, whole.blind))


@pytest.mark.parametrize("count", [2, 4])
def test_equal_arms_share_the_load_evenly(small, count):
    content = small.work(payload_kg=small.WARM)
    alone = load_of(small, [small.job("a", content)], equal_arms(small, 1, content))
    together = load_of(small, [small.job("a", content)], equal_arms(small, count, content))
    assert together.thermal == pytest.approx(alone.thermal / count)
    assert together.time == pytest.approx(alone.time / count)


def test_unequal_arms_share_one_job_as_resistors_in_parallel(small):
    """λ with h₁x = h₂(1 − x) is h₁h₂ / (h₁ + h₂)."""
    content = small.work(payload_kg=small.WARM)
    arms = [small.arm(0, [content]), small.arm(1, [content], times=small.Times(cycle=20.0))]
    found = load_of(small, [small.job("a", content)], arms)
    one, two = ONE_JOB_S, ONE_JOB_S + 3 * 10.0
    assert found.time == pytest.approx(one * two / (one + two) / HORIZON_S)


def test_splitting_a_job_costs_only_the_way_there_and_back(small):
    content = small.work(payload_kg=small.WARM)
    arms = equal_arms(small, 2, content)
    whole = load_of(small, [replace(small.job("a", content), repetitions=6)], arms)
    halves = load_of(small, [small.job("a", content), small.job("b", content)], arms)
    way_s = 3.0 + 2.0
    assert halves.time - whole.time == pytest.approx(way_s / 2 / HORIZON_S)
    share = whole.thermal / whole.time
    assert halves.thermal - whole.thermal == pytest.approx(share * way_s / 2 / HORIZON_S)


def test_a_job_that_one_arm_cannot_do_loads_the_other_and_twice_the_jobs_are_twice_the_load(small):
    content, other = small.work(payload_kg=small.WARM), small.work("rack", payload_kg=small.WARM)
    arms = [small.arm(0, [content, other]), small.arm(1, [other])]
    found = load_of(small, [small.job("a", content)], arms)
    assert found.time == pytest.approx(ONE_JOB_S / HORIZON_S)
    assert found.able == 0.5
    content = small.work(payload_kg=small.WARM)
    arms = equal_arms(small, 2, content)
    jobs = [small.job(f"job_{i}", content) for i in range(4)]
    assert load_of(small, jobs, arms).thermal == pytest.approx(2 * load_of(small, jobs[:2], arms).thermal)
    assert load_of(small, [], arms) == LoadFactor(thermal=0.0, blind=0.0, time=0.0, able=0.0)


def test_the_best_assignment_is_one_that_the_arms_have_time_for(small):
    """Arm 1 heats more; alone, arm 0 would take both jobs, but it has time for one only."""
    content = small.work(payload_kg=small.WARM)
    cycles = int((HORIZON_S - 5.0) / 10.0)
    whole = replace(small.job("a", content), repetitions=cycles)
    poor = thermal_model(gen3_network(cooling_factor=0.8))
    arms = [small.arm(0, [content]), small.arm(1, [content], thermal=poor)]
    both = load_of(small, [whole, replace(whole, name="b")], arms)
    length = (5.0 + 10.0 * cycles) / HORIZON_S
    assert both.time == pytest.approx(length)
    alone = [load_of(small, [whole], [arm]).thermal for arm in (small.arm(0, [content]), arms[1])]
    left = 2 - 1 / length  # jobs' worth of work that does not fit on arm 0
    assert alone[1] * left > alone[0] / length  # so arm 1 is the one that decides
    assert both.thermal == pytest.approx(alone[1] * left)
    assert both.blind == pytest.approx(max(alone))


@pytest.mark.parametrize(
    ("thermal", "blind", "time", "word"),
    [
        (0.3, 0.5, 0.9, "time decides"),
        (0.3, 0.5, 0.5, "nothing decides"),
        (0.3, 0.8, 0.9, "heat decides"),
        (0.78, 0.8, 0.9, "time decides"),
        (0.78, 0.8, 0.3, "nothing decides"),
        (1.3, 1.5, 0.5, "hopeless"),
        (0.1, 0.1, 1.3, "hopeless"),
    ],
)
def test_the_regime_in_a_word(thermal, blind, time, word):
    assert LoadFactor(thermal=thermal, blind=blind, time=time, able=1.0).regime == word
