"""Cool motion: chosen by what a whole horizon makes of it, by an independent integration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import NODES, WINDING, drive_heat, gen3_network, thermal_model
from fleet.motion import drive
from fleet.robot import Robot
from scenarios.prepare.arms import ArmHardware
from scenarios.prepare.twins import cold_peaks, cool_plans, require_cool_plans
from scenarios.spec.load import library, load

HARDWARE = ArmHardware(Robot(name="arm_0"), gen3_motors(), thermal_model(gen3_network()))
PAYLOADS_KG = (0.0, 1.0, 2.0, 3.0, 4.0)


@pytest.fixture
def scenario():
    return load(library()["quickstart"])


@pytest.fixture
def plans(small):
    """Holds with more and more in the hand; all of them begin cool."""
    works = [small.work(f"place_{i}", payload_kg=kg) for i, kg in enumerate(PAYLOADS_KG)]
    return [variants[0] for variants in small.arm(0, works).plans.values()]


@pytest.fixture
def courses(plans, scenario):
    """Second method: Runge-Kutta over the horizon, winding temperatures [joint, time] of each plan."""
    _, motors, thermal = HARDWARE
    spec = scenario.twin
    found = []
    for plan in plans:
        load_ = drive(plan.cycle.profile, motors)

        def slope(_t, temp, load_=load_):
            heat = drive_heat(temp, load_.current_sq, load_.friction_w, motors)
            return (heat + thermal.to_ambient * spec.ambient_c - thermal.laplacian @ temp) / thermal.capacity

        cold_c = np.full(NODES, spec.ambient_c)
        run = solve_ivp(slope, (0.0, spec.horizon_s), cold_c, rtol=1e-8, atol=1e-8, max_step=60.0)
        found.append(run.y[WINDING])
    return found


def test_peaks_from_a_cold_start_are_those_of_an_independent_integration(plans, courses, scenario):
    spec = scenario.twin
    found = cold_peaks(plans, *HARDWARE[1:], ambient_c=spec.ambient_c, horizon_s=spec.horizon_s)
    assert found == pytest.approx(np.array([course.max(axis=1) for course in courses]), abs=0.1)


def test_what_gets_hot_within_the_horizon_is_left_out_although_it_begins_cool(plans, courses, scenario):
    spec = scenario.twin
    assert all(course[:, 0].max() < spec.cool_c for course in courses)
    stays = [bool(course.max() <= spec.cool_c) for course in courses]
    assert 0 < sum(stays) < len(plans)
    kept = cool_plans(plans, HARDWARE, spec)
    assert list(kept) == [plan for plan, cool in zip(plans, stays, strict=True) if cool]
    assert require_cool_plans(plans, HARDWARE, scenario) == kept


def test_a_shorter_horizon_lets_more_pass_and_none_of_nothing_is_cool(plans, scenario):
    brief = replace(scenario.twin, horizon_s=10.0)
    assert cool_plans(plans, HARDWARE, brief) == tuple(plans)
    assert cool_plans([], HARDWARE, brief) == ()


def test_an_arm_without_cool_motion_is_told_what_to_change(plans, scenario):
    strict = replace(scenario, twin=replace(scenario.twin, cool_c=22.5))
    with pytest.raises(FleetError, match=r"quickstart: arm 'arm_0' has no motion .* below 22.5 °C for 1800 s.*cool_c"):
        require_cool_plans(plans, HARDWARE, strict)
