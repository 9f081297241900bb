"""How long an arm may hold: the published table, an independent solver, and what a person may type wrongly."""

import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

from fleet.errors import FleetError
from fleet.heat.motor import gen3_motors, reference_current
from fleet.heat.thermal import NODES, drive_heat, gen3_network, thermal_model
from fleet.robot import JOINTS
from scenarios.cli.main import app
from scenarios.motion.hold import LIMITS_C, as_json, courses, hold

J2, J4 = 1, 3


def run(*arguments: str):
    return CliRunner().invoke(app, ["show", *arguments])


# Scenario check of the identification at 25 °C: torque of joints 2 and 4, current of joint 2, minutes to 60 and 75 °C
# from cold and from idle-warm.
PUBLISHED = [
    ("outstretched", 0.0, 23.5, 7.1, 2.30, None, None, None, None),
    ("outstretched", 1.1, 33.2, 12.3, 3.25, 100.0, None, 71.0, None),
    ("outstretched", 2.0, 41.2, 16.6, 4.03, 33.0, 88.0, 16.0, 68.0),
    ("outstretched", 3.0, 50.1, 21.3, 4.89, 12.6, 30.0, 5.0, 18.0),
    ("outstretched", 4.0, 58.9, 26.0, 5.76, 5.5, 12.7, 2.7, 6.5),
    ("raised", 4.0, 51.0, 22.5, 4.99, 11.4, 27.0, 4.5, 16.0),
    ("raised", 3.0, 43.3, 18.4, 4.24, 26.0, 63.0, 11.0, 46.0),
    ("home", 4.0, 26.7, 18.1, 2.60, None, None, None, None),
    ("home", 0.0, 8.7, 4.5, 0.85, None, None, None, None),
]


@pytest.mark.parametrize(("posture", "kg", "tau2", "tau4", "amps2", "cold60", "cold75", "warm60", "warm75"), PUBLISHED)
def test_published_table(posture, kg, tau2, tau4, amps2, cold60, cold75, warm60, warm75):
    result = hold(kg, posture, 25.0)
    assert result.cold.torque_nm[J2] == pytest.approx(tau2, abs=0.1)
    assert result.cold.torque_nm[J4] == pytest.approx(tau4, abs=0.1)
    assert result.cold.current_a[J2] == pytest.approx(amps2, abs=0.015)
    found = (result.cold.t60_min, result.cold.t75_min, result.idle_warm.t60_min, result.idle_warm.t75_min)
    for times, published in zip(found, (cold60, cold75, warm60, warm75), strict=True):
        if published is None:
            assert times[J2] is None
        else:
            assert times[J2] == pytest.approx(published, rel=0.03)


def test_the_rated_continuous_payload_settles_at_63():
    # Kinova rates 1.1 kg at full reach as continuous, 4 kg in the mid-range.
    assert hold(1.1, "outstretched").cold.steady_c[J2] == pytest.approx(63.0, abs=1.5)
    assert hold(4.0, "home").cold.steady_c[J2] == pytest.approx(52.0, abs=1.5)
    assert hold(0.0, "outstretched").cold.steady_c[J2] == pytest.approx(48.0, abs=1.5)


@pytest.mark.parametrize(
    ("posture", "kg", "start"),
    [("outstretched", 4.0, "idle_warm"), ("raised", 3.0, "cold"), ("outstretched", 9.0, "idle_warm")],
)
def test_times_agree_with_a_general_ode_solver_to_a_thousandth(posture, kg, start):
    result = hold(kg, posture, 25.0, beyond_rating=True)
    model, motors, rest = thermal_model(gen3_network()), gen3_motors(), np.zeros(JOINTS)
    current_sq = reference_current(np.array(result.cold.torque_nm), rest, motors) ** 2
    idle = np.concatenate([rest, motors.idle_w])
    start_c = np.full(NODES, 25.0)
    if start == "idle_warm":
        start_c = 25.0 + np.linalg.solve(model.laplacian, idle)

    def slope(_: float, temp_c: np.ndarray) -> np.ndarray:
        flow = model.to_ambient * 25.0 - model.laplacian @ temp_c
        return (flow + drive_heat(temp_c, current_sq, rest, motors)) / model.capacity

    def warns(_: float, temp_c: np.ndarray) -> float:
        return temp_c[J2] - LIMITS_C[0]

    def faults(_: float, temp_c: np.ndarray) -> float:
        return temp_c[J2] - LIMITS_C[1]

    course = getattr(result, start)
    span_s = (0.0, 1.05 * 60.0 * course.t75_min[J2])  # No longer: a runaway ends in finite time.
    solved = solve_ivp(slope, span_s, start_c, events=[warns, faults], rtol=1e-9, atol=1e-9, method="LSODA")
    assert course.t60_min[J2] == pytest.approx(solved.t_events[0][0] / 60.0, rel=0.001)
    assert course.t75_min[J2] == pytest.approx(solved.t_events[1][0] / 60.0, rel=0.001)


def test_a_limit_is_passed_exactly_when_the_arm_settles_above_it():
    for kg in (0.8, 0.85, 0.9, 1.8):
        result = hold(kg, "outstretched")
        for course in (result.cold, result.idle_warm):
            for limit_c, times in zip(LIMITS_C, (course.t60_min, course.t75_min), strict=True):
                for steady_c, minutes in zip(course.steady_c, times, strict=True):
                    assert steady_c is not None
                    assert (minutes is not None) == (steady_c > limit_c)


def test_runaway_has_no_settling_temperature_but_has_times():
    result = hold(7.0, "outstretched", beyond_rating=True)
    assert result.cold.steady_c == (None,) * JOINTS
    assert result.cold.t75_min[J2] is not None
    assert "has no steady temperature" in result.note
    assert "torque warning of 56.7" in result.note


def test_nothing_is_said_of_the_time_after_a_motor_burnt():
    # Joint 2 melts within minutes here; what its heat would do to joint 1 half an hour later is no prediction.
    result = hold(7.0, "raised", 60.0, beyond_rating=True)
    assert result.idle_warm.t75_min[J2] is not None
    assert result.idle_warm.t75_min[0] is None


def test_a_start_above_the_limit_passes_at_once():
    hot, _ = courses(np.zeros(JOINTS), 60.0, thermal_model(gen3_network()), gen3_motors())
    assert hot.t60_min == (0.0,) * JOINTS


def test_better_cooling_buys_time_and_a_tool_weighs_as_a_payload():
    base, forced = hold(3.0).cold, hold(3.0, cooling="forced_air").cold
    assert (forced.t75_min[J2] or math.inf) > (base.t75_min[J2] or math.inf)
    assert hold(2.0, tool_kg=1.0).cold.torque_nm == base.torque_nm  # both are point masses at the flange
    assert hold(3.0, "0,90,0,0,0,0,0").cold.torque_nm == pytest.approx(base.torque_nm, abs=1e-3)  # outstretched


def test_json_has_lists_of_seven_and_nulls():
    printed = run("--hold", "3", "--posture", "outstretched", "--ambient", "25", "--json")
    data = json.loads(printed.stdout)
    assert data == as_json(hold(3.0, "outstretched", 25.0))
    assert (data["payload"], data["posture"], data["ambient_c"]) == (3.0, "outstretched", 25.0)
    for start in ("cold", "idle_warm"):
        assert all(len(values) == JOINTS for values in data[start].values())
        assert data[start]["t60_min"][0] is None
        assert data[start]["t75_min"][J2] > data[start]["t60_min"][J2] > 0


def test_the_table_has_every_joint_in_eighty_columns_and_states_where_it_extrapolates():
    printed = run("--hold", "4", "--posture", "0,90,0,0,0,0,0")
    assert printed.exit_code == 0
    assert [line[0] for line in printed.stdout.splitlines() if line[:1].isdigit()] == list("1234567")
    assert max(len(line) for line in printed.stdout.splitlines()) <= 80
    assert "…" not in printed.stdout
    text = " ".join(printed.stdout.split())
    assert "Above 55 °C the model extrapolates" in text
    assert "5.5 | 2.7" in text
    assert "12.7 | 6.5" in text


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--hold", "0", "--posture", "outstreched"], "did you mean 'outstretched'?"),
        (["--hold", "0", "--posture", "1,2,3"], "7 comma-separated angles"),
        (["--hold", "0", "--posture", "0,nan,0,0,0,0,0"], "7 comma-separated angles"),
        (["--hold", "0", "--posture", "0,130,0,0,0,0,0"], "Joint 2 turns from"),
        (["--hold", "9", "--tool-kg", "4"], "at most 104 N·m"),
        (["--hold", "4.6"], "4.6 kg is beyond the rating of the Gen3: 4.5 kg for a short time, 1.1 kg continuously"),
        (["--hold", "4", "--tool-kg", "1"], "add --beyond-rating"),
        (["--hold", "0", "--cooling", "forced"], "did you mean 'forced_air'?"),
    ],
)
def test_a_hold_that_cannot_be_is_refused(arguments, says):
    answer = run(*arguments)
    assert isinstance(answer.exception, FleetError)
    assert says in str(answer.exception)
    assert answer.stdout == ""


def test_a_load_beyond_the_rating_is_computed_on_request():
    assert run("--hold", "4.6", "--beyond-rating").exit_code == 0
    assert "4.6 kg at 0.90 m reach is above the continuous rating of 1.1 kg" in hold(4.6, beyond_rating=True).note
    assert "rating" not in hold(1.0).note
