"""Posture recovery: its search against the true law, and what the hottest motor does with and without."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import spearmanr

from fleet.arm.model import ArmModel
from fleet.heat.motor import gen3_motors, reference_current
from fleet.heat.thermal import HOUSING, WINDING, advance, drive_heat, gen3_network, simulate_temperatures, thermal_model
from fleet.job import Fixture
from fleet.motion import static_drive
from fleet.robot import Robot
from scenarios.motion.generate import Verification, bare_arm
from scenarios.motion.recover import (
    TICK_S,
    Nearby,
    RecoveryError,
    hold_until,
    holding,
    housing_estimate,
    parse_posture,
    recover,
    recovery_summary,
)
from twin.thermal.checkpoint import save as save_network
from twin.thermal.identify import Identified, ParameterVector, nominal_heat_model
from twin.vae.twin import save

HOLDS = {
    "reaching": ((0.0, 60.0, 180.0, -30.0, 0.0, 55.0, 90.0), 3.0, 57.0),
    "turned": ((-90.0, 70.0, 170.0, -50.0, 10.0, 40.0, 0.0), 2.5, 55.0),
}


@pytest.mark.parametrize("name", HOLDS)
def test_the_hottest_motor_cools_and_is_cooler_than_without(subject, asked, name):
    degrees, payload_kg, until_c = HOLDS[name]
    q = np.deg2rad(degrees)
    start_c = hold_until(subject.arm, q, payload_kg, ambient_c=23.0, until_c=until_c)
    hold = {"start_c": start_c, "verification": asked, "hold_s": 150.0, "nearby": Nearby(candidates=200)}
    found = recover(subject.twin, subject.arm, q, payload_kg, seed=len(name), **hold)
    hot = found.hottest
    assert hot == 1
    np.testing.assert_allclose(found.with_c[0], start_c[WINDING], rtol=1e-6)  # kept as float32
    np.testing.assert_array_equal(found.without_c[0], found.with_c[0])
    assert found.with_c[0, hot] == pytest.approx(until_c, abs=0.2)
    assert found.with_c[-1, hot] < found.with_c[0, hot]
    watched, gone = (found.time_s <= 30.0), (found.time_s >= 40.0)
    # The hold without recovery begins with taking up the payload, a second longer at rest.
    np.testing.assert_allclose(found.with_c[watched], found.without_c[watched], atol=0.1)
    assert np.all(found.with_c[gone, hot] < found.without_c[gone, hot])
    assert found.without_c[-1, hot] > found.without_c[0, hot]
    assert found.cooled_k > 0
    assert found.spared_k > 3.0
    # Nearby, and held there with less torque: that is why.
    card, model = recovery_summary(found), ArmModel(subject.arm.robot)
    assert card["difficulty_after"][hot] < card["difficulty_before"][hot]
    assert card["most_moved_rad"] <= 0.6 + 1e-9
    postures = [np.array(card[name]) for name in ("q_before_rad", "q_after_rad")]
    away = model.tool_pose(postures[1])[0] - model.tool_pose(postures[0])[0]
    assert np.linalg.norm(away) == pytest.approx(card["tool_moved_m"])
    assert card["tool_moved_m"] <= 0.3
    before, after = (np.abs(model.gravity_torque(posture, payload_kg)[hot]) for posture in postures)
    assert after < before
    assert found.error_rad < 1e-3


@pytest.mark.ci_slow
def test_nothing_better_near_is_said(subject, asked):
    q = np.deg2rad(HOLDS["reaching"][0])
    start_c = hold_until(subject.arm, q, 3.0, ambient_c=23.0, until_c=50.0)
    with pytest.raises(RecoveryError, match=r"No better posture near: of \d+ within 0.01 rad per joint") as said:
        recover(subject.twin, subject.arm, q, 3.0, start_c=start_c, verification=asked, nearby=Nearby(joint_rad=0.01))
    assert "would not cool" in str(said.value)
    assert "put the payload down" in str(said.value)


@pytest.mark.ci_slow
@pytest.mark.parametrize("hold_s", [120.0, pytest.param(600.0, marks=pytest.mark.slow)])
def test_every_allowed_time_of_a_hold_can_be_recovered(subject, asked, hold_s):
    """Also those longer than a hand takes to close or open, LONGEST_GRASP_S."""
    q = np.deg2rad(HOLDS["reaching"][0])
    start_c = hold_until(subject.arm, q, 3.0, ambient_c=23.0, until_c=57.0)
    near = Nearby(candidates=100, cooling_k=0.01)
    how = {"start_c": start_c, "verification": asked, "nearby": near}
    found = recover(subject.twin, subject.arm, q, 3.0, hold_s=hold_s, **how)
    assert found.time_s[-1] == pytest.approx(hold_s, abs=TICK_S)
    assert np.all(np.isfinite(found.with_c))
    assert found.with_c[-1, 1] <= found.without_c[-1, 1] + 0.1


@pytest.mark.parametrize(("hold_s", "said"), [(30.01, r"30 s before .* \(got 30.01 s\)"), (3601.0, "3600 s at most")])
def test_a_hold_of_another_time_is_refused(subject, asked, hold_s, said):
    q = np.deg2rad(HOLDS["reaching"][0])
    with pytest.raises(RecoveryError, match=said):
        recover(subject.twin, subject.arm, q, 3.0, start_c=np.full(14, 50.0), verification=asked, hold_s=hold_s)


@pytest.mark.ci_slow
def test_the_documented_command_recovers_an_arm(thermofleet, small_toml, subject, tmp_path):
    """`thermofleet twin recover quickstart --payload 3 --posture raised`, with a small cell and a small twin."""
    save(replace(subject.twin, arm="left"), tmp_path / "left.twin")
    out = tmp_path / "recovery"
    recover_left = ("twin", "recover", small_toml, "--twins", tmp_path / "left.twin", "--payload", 3)
    said = thermofleet(*recover_left, "--posture", "raised", "--out", out).succeeded()
    assert "in 600 s; without the new posture to" in said.out
    assert json.loads((out / "recovery.json").read_text(encoding="utf-8"))["payload_kg"] == 3.0
    for option, value, sentence in (
        ("--hold", 86_400, "--hold must be > 0 and at most 3600 (got 86400)"),
        ("--warm", 190, "does not get warm"),
        ("--warm", 10, "A motor is never at 10 °C in air of 22 °C"),
        ("--network", tmp_path / "none", "No identified arm in"),
    ):
        assert thermofleet(*recover_left, option, value, "--out", tmp_path / "other").refused(sentence)
        assert not (tmp_path / "other").exists()


@pytest.mark.ci_slow
def test_an_arm_of_logs_needs_no_scenario(thermofleet, subject, tmp_path):
    """With the network of a nominal Gen3 it is predicted as one, with its tilt and tool."""
    vector = ParameterVector(nominal_heat_model())
    about = {"arm": "arm", "rms_k": {}, "memory_s": (), "seconds": 0.0, "data_hash": "", "source": "current"}
    about |= {"parameters": (), "ambient_c": 25.0, "ambient_sd_k": 1.0}
    network = Identified(heat_model=vector.heat_model(vector.mean), **about)
    save(subject.twin, tmp_path / "arm.twin")
    save_network(network, tmp_path / "rc")
    known = ("--twins", tmp_path / "arm.twin", "--network", tmp_path / "rc", "--tool", 0.5)
    out = tmp_path / "recovery"
    thermofleet("twin", "recover", *known, "--payload", 3, "--posture", "raised", "--out", out).succeeded()
    robot = Robot(name="arm", tool_kg=0.5)
    q = parse_posture("raised")
    start_c = hold_until(bare_arm(robot, gen3_motors(), Verification.nominal(robot, 25.0).thermal), q, 3.0,
                         ambient_c=25.0, until_c=50.0)  # fmt: skip
    card = json.loads((out / "recovery.json").read_text(encoding="utf-8"))
    assert card["start_c"] == pytest.approx(start_c[:7].max())
    out = tmp_path / "generated"
    stops = ("--posture", "0,20,180,-90,0,-20,90", "--posture", "20,30,180,-60,0,-30,90")
    thermofleet("twin", "generate", *known, *stops, "--count", 2, "--s", 0, "--out", out).succeeded()
    assert json.loads((out / "generated.json").read_text(encoding="utf-8"))["handed_out"] == 2
    for wrong, sentence in (
        (known[2:], "Give a SCENARIO, or --twins and --network of an arm that is known by its logs"),
        (known, "Without a SCENARIO no motion is known: give --posture at least twice"),
        ((*known, *stops[:2]), "A motion has at least two different postures (got 0,20,180,-90,0,-20,90)."),
        ((*known, *stops, "--tilt", "0,90"), "The tilt is three angles in degrees, as 0,90,0 (got '0,90'"),
        (("quickstart", "--tilt", "0,90,0"), "--tilt and --tool are for an arm without a scenario"),
    ):
        assert thermofleet("twin", "generate", *wrong, "--out", tmp_path / "other").refused(sentence)
        assert not (tmp_path / "other").exists()


def test_a_light_hold_does_not_get_warm(subject):
    with pytest.raises(RecoveryError, match=r"does not get warm: holding 0.5 kg there for 30 min"):
        hold_until(subject.arm, np.zeros(7), 0.5, ambient_c=23.0, until_c=55.0, most_s=1800.0)


def test_a_fixture_in_the_way_is_seen(subject, asked):
    q = np.deg2rad(HOLDS["reaching"][0])
    at_m = tuple(ArmModel(subject.arm.robot).tool_pose(q)[0])
    box = Fixture(name="oven", position_m=at_m, size_m=(0.1, 0.1, 0.1))
    with pytest.raises(RecoveryError, match=r"cannot hold 3 kg there: collision: .* fixture .oven"):
        recover(subject.twin, subject.arm, q, 3.0, start_c=np.full(14, 50.0), verification=asked, fixtures=[box])


@pytest.mark.parametrize(
    ("q", "payload_kg", "said"),
    [
        (np.zeros(7), 5.0, r"rated for a payload of 0 … 4.5 kg \(got 5\)"),
        (np.zeros(7), np.nan, r"rated for a payload"),
        (np.full(7, 2.5), 1.0, r"Joint 2 turns from -2.24 to 2.24 rad.*at 2.50"),
        (np.zeros(6), 1.0, r"7 finite joint angles"),
        (np.array([0, 2.2, np.pi, 0, 0, 0, 0]), 1.0, r"cannot hold 1 kg there: collision"),
    ],
)
def test_a_hold_that_cannot_be_is_refused(subject, asked, q, payload_kg, said):
    with pytest.raises(RecoveryError, match=said):
        recover(subject.twin, subject.arm, q, payload_kg, start_c=np.full(14, 50.0), verification=asked)


MOTORS, THERMAL = gen3_motors(), thermal_model(gen3_network())
Q = np.deg2rad([0.0, 60.0, 180.0, -60.0, 0.0, 55.0, 90.0])


def simulated(start_c, tau, motors, thermal, seconds):
    """Winding temperatures after holding a torque in 23 °C."""
    drive = static_drive(tau, motors)
    done = simulate_temperatures(drive, [seconds], motors=motors, thermal=thermal, start_c=start_c, ambient_c=23.0)
    return done.end_c[0, WINDING]


def held(temp_c, tau, seconds):
    """The true temperatures of all nodes after holding so long."""
    steps = max(1, round(seconds))
    phi, gamma = THERMAL.step_matrices(seconds / steps)
    current_sq = reference_current(tau, np.zeros(7), MOTORS) ** 2
    for _ in range(steps):
        heat_w = drive_heat(temp_c, current_sq, np.zeros(7), MOTORS)
        temp_c = advance(temp_c, heat_w, 23.0, phi, gamma, THERMAL.to_ambient)
    return temp_c


@settings(max_examples=10)
@given(st.floats(0.0, 2400.0), st.floats(15.0, 45.0))
def test_hidden_housings_follow_from_how_fast_windings_warm(seconds, load_nm):
    tau = np.array([1.0, -load_nm, 1.0, 0.4 * load_nm, 0.5, 4.0, 0.0])
    before = held(np.full(14, 23.0), tau, seconds)
    now = held(before, tau, 30.0)
    guess_c = housing_estimate(before[WINDING], now[WINDING], 30.0, tau, MOTORS, THERMAL, 23.0)
    middle_c = 0.5 * (before[HOUSING] + now[HOUSING])
    # Over 30 s the mean of an exponential with 70 s lies 3.6 % of its rise above the mean of its ends.
    rise_k = np.abs(now[WINDING] - before[WINDING]).max()
    np.testing.assert_allclose(guess_c, middle_c, atol=0.04 * rise_k + 0.1)


def test_the_hottest_motors_torque_error_ranks_postures_as_their_heat_does(subject):
    rng = np.random.default_rng(0)
    model = ArmModel(subject.arm.robot)
    near = Q + rng.uniform(-0.6, 0.6, (60, 7))
    error = holding(subject.twin, model, near, 3.0).one_sided[:, 1]
    start_c = np.full(14, 50.0)
    arm = subject.arm
    end_c = [simulated(start_c, model.gravity_torque(q, 3.0), arm.motors, arm.thermal, 600.0)[1] for q in near]
    assert spearmanr(error, end_c).statistic > 0.9


def test_more_payload_is_never_easier_for_the_shoulder(subject):
    model = ArmModel(subject.arm.robot)
    loads = [float(holding(subject.twin, model, Q[None], kg).one_sided[0, 1]) for kg in (1.0, 2.0, 3.0, 4.0)]
    assert np.all(np.diff(loads) > 0)
