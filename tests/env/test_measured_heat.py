"""Arms correct their predictions by the heat that they measure at work, and tell each other."""

from dataclasses import replace
from typing import Any  # what scipy's stubs do not tell

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

from agents.schedules import Schedules
from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import Exchange
from fleet.difficulty import KNOWN, Difficulty, Forecast
from fleet.engine.batch import RewardWeights
from fleet.engine.shift import Episode
from fleet.engine.world import CYCLES_S
from fleet.env.lookahead import CellSimulator
from fleet.env.vector import BatchEnv, Library
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import ThermalModel, gen3_network, temperature_steps, thermal_model
from fleet.motion import Drive, drive, static_drive
from fleet.robot import JOINTS, ThermalLimits
from tests.engine.test_compiled import check_equal

GAIN_K = 20.0


class Expects:
    """A peak of 30 °C for every plan; with twice the assumed heat it is 20 K higher."""

    version = "expects"

    def score(self, plan, repetitions: int) -> Difficulty:
        peak = Forecast(np.array([30.0]), np.zeros((1, KNOWN)), gain=np.array([GAIN_K]))
        return Difficulty(np.full(JOINTS, 0.1), peak=peak)


def env_of(
    small, *, learns: bool = True, copper: float = 1.3, channel: Channel | None = None, shares_heat: bool = True
) -> BatchEnv:
    """Three arms; holds at the bench make `copper` times the heat in arm 0 that it expects."""
    bench, rack = small.work("bench", small.WARM), small.work("rack", small.WARM)
    arms = []
    for i in range(3):
        own = small.arm(i, [bench, rack], model=Expects(), times=small.Times(approach=10.0, cycle=50.0, retreat=10.0))
        expected = own.plans[bench][0]
        harder = replace(expected, cycle=small.phase(50.0, np.sqrt(copper) * small.torque(small.WARM)))
        arms.append(
            replace(
                own, executed={expected: harder} if i == 0 else {}, learns=learns, known=(own.thermal, gen3_motors())
            )
        )
    jobs = [small.job(f"j{j}", (bench, rack)[j % 2], repetitions=2) for j in range(6)]
    world, _ = small.shop([jobs], arms=arms, ticks=60, slots=6)
    tables, shift = world.tables, replace(world.shifts[0], noise_key=7)
    names = tuple(f"arm_{i}" for i in range(3))
    exchanges = None if channel is None else [Exchange(names, channel)]
    return BatchEnv(
        Library(names, 6, tables, lambda _: shift), 1, seed=0, scaled=False, exchanges=exchanges, ahead_s=np.inf,
        shares_heat=shares_heat,
    )  # fmt: skip


def peaks(env: BatchEnv, obs) -> np.ndarray:
    """Predicted peaks of arms 0 to 2 for the jobs in the slots, °C, [arm, slot], and their stations' parity."""
    return env.layout.read_parts(obs["shared"], obs["own"], obs["action_mask"]).peak_c[0]


def test_a_measured_excess_raises_the_predictions_for_that_work_of_all_arms(small) -> None:
    env = env_of(small)
    obs, _ = env.reset()
    assert peaks(env, obs) == pytest.approx(np.full((3, 6), 30.0))
    obs, *_ = env.step(np.array([[1, 0, 0]]))  # the bench: its approach ends in this step
    job_c = env.layout.read_parts(obs["shared"], obs["own"], obs["action_mask"]).job_peak_c[0, 0]
    hotter = 30.0 + 0.3 * GAIN_K
    assert job_c == pytest.approx(hotter, abs=0.01)
    # Five jobs are left: rack, bench, rack, bench, rack.
    assert peaks(env, obs)[:, :5] == pytest.approx(np.tile([30.0, hotter, 30.0, hotter, 30.0], (3, 1)), abs=0.01)
    obs, _ = env.reset()  # a new shift begins without measurements
    assert peaks(env, obs) == pytest.approx(np.full((3, 6), 30.0))


def test_the_excess_is_of_the_hottest_motor(small) -> None:
    """Friction heats the housing, so its watts count less than those of copper; a cooler joint does not count."""
    arm = replace(small.arm(0, [small.work("bench", small.WARM)]), known=(thermal_model(gen3_network()), gen3_motors()))
    (plan,), (thermal, motors) = next(iter(arm.plans.values())), arm.known
    planned = drive(plan.cycle.profile, motors)

    def rise_k(load: Drive) -> np.ndarray:
        watts = np.concatenate([motors.copper_w_per_a2 * load.current_sq, load.friction_w])

        def warming(_, rise):
            return (watts - thermal.laplacian @ rise) / thermal.capacity

        return solve_ivp(warming, (0.0, CYCLES_S), np.zeros(2 * JOINTS), rtol=1e-9, atol=1e-9).y[:JOINTS, -1]

    hottest, coolest = rise_k(planned).argmax(), rise_k(planned).argmin()
    for joint, watts in ((hottest, 2.0), (coolest, 0.5)):
        rubs = replace(planned, friction_w=planned.friction_w + watts * np.eye(JOINTS)[joint])
        assert arm.excess(plan, rubs) == pytest.approx(rise_k(rubs).max() / rise_k(planned).max() - 1.0, abs=1e-6)
        assert (arm.excess(plan, rubs) > 0.01) == (joint == hottest)


def test_an_arm_believes_its_own_measurement_and_the_others_their_mean(small) -> None:
    env = env_of(small)
    env.reset()
    obs, *_ = env.step(np.array([[1, 0, 0]]))
    while env.state.mode[0, 0] == 1:
        obs, *_ = env.step(np.zeros((1, 3), int))
    seen = env.layout.read_parts(obs["shared"], obs["own"], obs["action_mask"])
    bench = int(np.flatnonzero(peaks(env, obs)[1, :5] > 31.0)[0])
    assert seen.action_mask[0, 1, 1 + bench]
    obs, *_ = env.step(np.array([[0, 1 + bench, 0]]))
    found = peaks(env, obs)
    left = int(np.flatnonzero(found[0, :4] > 31.0)[0])
    assert found[:, left] == pytest.approx([36.0, 30.0, 33.0], abs=0.02)  # .3, 0, and their mean


@pytest.mark.parametrize("apart", [{"channel": Channel(delay_s=30.0)}, {"shares_heat": False}], ids=["late", "none"])
def test_arms_whose_messages_take_time_know_what_they_measured_themselves(small, apart) -> None:
    env = env_of(small, **apart)
    env.reset()
    obs, *_ = env.step(np.array([[1, 0, 0]]))
    assert peaks(env, obs)[:, 1] == pytest.approx([36.0, 30.0, 30.0], abs=0.01)


@pytest.mark.parametrize(("learns", "copper"), [(False, 1.3), (True, 1.0)])
def test_without_a_difference_or_without_learning_nothing_changes(small, learns, copper) -> None:
    env = env_of(small, learns=learns, copper=copper)
    env.reset()
    obs, *_ = env.step(np.array([[1, 0, 0]]))
    assert peaks(env, obs)[:, :5] == pytest.approx(np.full((3, 5), 30.0), abs=1e-4)


def test_a_planner_simulates_the_heat_that_arms_have_measured(small) -> None:
    """The copper losses of one more job: 1.3 times those of its two cycles and its ways, by I² R."""
    env = env_of(small)
    obs, _ = env.reset()
    obs, *_ = env.step(np.array([[1, 0, 0]]))
    known = env.layout.read_each(env.agents, obs["shared"][0], obs["own"][0], obs["action_mask"][0])
    believed, energy_wh = env_of(small, learns=False, copper=1.0), []
    weights = RewardWeights(finished_value=0.0, tardiness=0.0, above_warning=0.0, faults=0.0, energy=-1.0)
    simulator = CellSimulator(believed.engine.tables, 3, 6, weights)
    rest_w = heat_w(small.torque(0.0) / 3.0)
    cell = env.lookahead(simulator, 0)
    for job, cycles_s in ((2, 120.0), (1, 120.0)):  # at the bench, where arm 0 has measured, and at the rack
        cell.look(known)
        nobody = np.zeros((2, 6), int)
        order = np.full((2, 6), np.inf)
        order[1, job] = 0.0
        schedules = Schedules(nobody + 1, nobody, order, np.zeros((2, 6)))
        reward = simulator.run(schedules, np.ones(59)).reward
        energy_wh.append(reward[0] - reward[1] + rest_w * cycles_s / 3600.0)
    one_wh = heat_w(small.torque(small.WARM)) * 120.0 / 3600.0
    assert energy_wh == pytest.approx([1.3 * one_wh, one_wh], rel=0.05)  # warm copper, and the rest, differ


def heat_w(torque: np.ndarray) -> float:
    """Copper losses of holding some torques at 25 °C, W."""
    motors = gen3_motors()
    load = static_drive(torque, motors)
    return float((motors.copper_w_per_a2 * load.current_sq).sum())


class Continues:
    """A peak at the present temperature of the hottest motor; with twice the assumed heat it is 20 K higher."""

    version = "continues"

    def score(self, plan, repetitions: int) -> Difficulty:
        weight = np.eye(JOINTS, KNOWN)
        peak = Forecast(np.zeros(JOINTS), weight, gain=np.full(JOINTS, GAIN_K))
        return Difficulty(np.full(JOINTS, 0.1), peak=peak)


def idle_env(small, *, true: ThermalModel, believed: ThermalModel, drift_k_per_s: float = 0.0) -> BatchEnv:
    """One arm that never works, as its jobs come after the shift."""
    bench = small.work("bench", small.WARM)
    arm = replace(
        small.arm(0, [bench], model=Continues(), thermal=true),
        learns=True,
        known=(believed, gen3_motors()),
        drift_k_per_s=drift_k_per_s,
        motors=replace(gen3_motors(), sensor_noise_k=np.zeros(JOINTS)),
    )
    world, _ = small.shop([[small.job("later", bench, release_s=10.0)]], arms=[arm], ticks=400, slots=1)
    tables, shift = world.tables, replace(world.shifts[0], noise_key=7)
    return BatchEnv(Library(("arm_0",), 1, tables, lambda _: shift), 1, seed=0, scaled=False, ahead_s=np.inf)


def course(small, thermal: ThermalModel, ticks: int) -> np.ndarray:
    """Motor temperatures of the idle arm at the end of each tick, by the ODE, °C, [tick, joint]."""
    motors, rest_tau = gen3_motors(), small.torque(0.0) / 3.0
    load = static_drive(rest_tau, motors)
    cold_c = np.full(2 * JOINTS, 25.0)
    steps = temperature_steps([load] * ticks, 10.0, motors=motors, thermal=thermal, start_c=cold_c, ambient_c=25.0)
    return np.stack(list(steps))[1:, :JOINTS]


def line(measured_c: np.ndarray, expected_c: np.ndarray) -> tuple[float, float]:
    """Ratio of heat and offset by weighted least squares over all joints and ticks, [tick, joint], and the priors.

    Second method: the rows of all ticks instead of smoothed moments; the time constant is 100 s, 10 ticks.
    """
    weight = 0.1 * 0.9 ** np.arange(len(measured_c))[::-1, None] / 2.0**2
    root = np.sqrt(np.broadcast_to(weight, measured_c.shape)).ravel()
    rows = np.column_stack([root * (expected_c - 25.0).ravel(), root])
    rows = np.vstack([rows, [1.0 / 0.5, 0.0], [0.0, np.sqrt(1.0 / 6.0**2 + 7.0 * 0.9 ** len(measured_c) / 2.0**2)]])
    values = np.append(root * (measured_c - expected_c).ravel(), [0.0, 0.0])

    def cost(offset_k: float) -> float:
        """Least sum of squares with this offset and a slope of at least 0."""
        slope = max(np.linalg.lstsq(rows[:, :1], values - rows[:, 1] * offset_k)[0][0], 0.0)
        return float(np.sum((values - rows @ [slope, offset_k]) ** 2))

    best: Any = minimize_scalar(cost, bounds=(-200.0, 200.0), options={"xatol": 1e-6})
    offset_k = float(best.x)
    if offset_k > 0.0:  # where the cost rises by 2², the square of two standard errors, or 0
        least = cost(offset_k) + 4.0
        root: Any = brentq(lambda k: cost(k) - least, -200.0, offset_k)
        offset_k = max(float(root), 0.0)
    slope = np.linalg.lstsq(rows[:, :1], values - rows[:, 1] * offset_k)[0][0]
    return float(np.clip(1.0 + slope - 1.0 / np.linalg.norm(rows[:, 0]), 1.0, 2.0)), float(offset_k)


@pytest.mark.parametrize("drift_k_per_s", [0.0, -0.003, 0.003])
def test_motors_that_are_warmer_than_assumed_count_as_more_heat_and_what_sensors_drift_does_not(
    small, drift_k_per_s
) -> None:
    still, fan = thermal_model(gen3_network()), thermal_model(gen3_network(cooling="forced_air"))
    env = idle_env(small, true=still, believed=fan, drift_k_per_s=drift_k_per_s)
    obs, _ = env.reset()
    for _ in range(300):
        obs, *_ = env.step(np.zeros((1, 1), int))
    drift_k = drift_k_per_s * 10.0 * np.arange(300)[:, None]
    read_c, assumed_c = course(small, still, 300) + drift_k, course(small, fan, 300)
    ratio, offset_k = line(read_c, assumed_c)
    assert 1.05 < ratio <= 2.0
    assert -4.0 < offset_k - min(drift_k[-1], 0.0) < 6.0
    now_c = read_c[-1].max() + 10.0 * drift_k_per_s
    assert peaks(env, obs)[0, 0] == pytest.approx(now_c - offset_k + (ratio - 1.0) * GAIN_K, abs=0.05)


def test_motors_that_are_as_warm_as_assumed_or_cooler_are_believed(small) -> None:
    still, fan = thermal_model(gen3_network()), thermal_model(gen3_network(cooling="forced_air"))
    env = idle_env(small, true=fan, believed=fan)
    other = idle_env(small, true=fan, believed=still)
    for each, least_k, most_k in ((env, -0.05, 0.05), (other, -0.05, 3.0)):
        obs, _ = each.reset()
        for _ in range(100):
            obs, *_ = each.step(np.zeros((1, 1), int))
        assert least_k <= peaks(each, obs)[0, 0] - course(small, fan, 100)[-1].max() <= most_k


@pytest.mark.parametrize(("drift_k_per_s", "least_k", "most_k"), [(-0.01, -20.0, -17.0), (0.01, 8.0, 20.0)])
def test_an_idle_arm_finds_by_how_much_its_sensors_have_drifted(small, drift_k_per_s, least_k, most_k) -> None:
    """Of 20 K: too low but for what the offset lags; too high, it may also be heat of motors that are hardly warm."""
    still = thermal_model(gen3_network())
    env = idle_env(small, true=still, believed=still, drift_k_per_s=drift_k_per_s)
    env.reset()
    for _ in range(200):
        env.step(np.zeros((1, 1), int))
    assert least_k <= env.engine.measured(0, [0])[1][0] <= most_k


def test_compiled_and_uncompiled_agree_with_measured_heat_and_faults(small) -> None:
    """Random claims of heavy jobs in hot air: arms fault, recover, and go home without a job."""
    works = [small.work(place, payload) for place in ("bench", "rack") for payload in (small.WARM, small.HOT)]
    fan = thermal_model(gen3_network(cooling="forced_air"))
    arms = []
    for i in range(3):
        own = small.arm(i, works, model=Continues())
        harder = {plans[0]: replace(plans[0], cycle=small.phase(10.0, 1.1 * small.torque(work.payload_kg)))
                  for work, plans in own.plans.items()} if i else {}  # fmt: skip
        arms.append(replace(own, executed=harder, learns=True, known=(fan, gen3_motors())))
    jobs = [small.job(f"j{j}", works[j % 4], repetitions=60, release_s=30.0 * j) for j in range(24)]
    limits = ThermalLimits(warning_c=56.0, error_c=60.0, restart_c=54.0, clear_s=25.0)
    world, plant = small.shop([jobs], arms=arms, ticks=200, slots=6, ambient_c=45.0, limits=limits)
    run = check_equal(Episode(world, plant, ("t",) * 3, np.random.SeedSequence(7)), 3)
    assert run.state.faults.sum() > 2
    assert {"return", "recover", "home"} <= {event.kind for event in run.env.events}
