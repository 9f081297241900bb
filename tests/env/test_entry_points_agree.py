"""Every entry point repeats a recorded run, given its actions."""

from dataclasses import replace

import numpy as np
import pytest

from fleet.engine.state import DONE, State, World
from fleet.engine.tables import Tables
from fleet.env.vector import BatchEnv
from fleet.heat.thermal import WINDING
from fleet.offered_plans import PLANS
from fleet.robot import JOINTS, ThermalLimits
from scenarios.policy_loader import policy_of
from scenarios.prepare.fleet import Fleet, env_of, library_of, prepare
from scenarios.run.shift import RunLog, run
from scenarios.spec.jobs import weights_of
from scenarios.spec.options import RunSpec

SEED = 2


@pytest.fixture(scope="module", params=["blind", "oracle", pytest.param("twin", marks=pytest.mark.slow)])
def fleet(request, cell, plans) -> Fleet:
    """Return the prepared cell."""
    return prepare(cell, difficulty=request.param, cache=plans)


@pytest.fixture(scope="module", params=["random", "round_robin"])
def recorded(request, fleet) -> RunLog:
    """Return a run as recorded by `thermofleet run`."""
    return run(fleet, RunSpec(policy=request.param, seed=SEED, bus="memory"))


def actions_of(result: RunLog, offered: list[str], arms: list[str], now_s: float) -> dict[str, int]:
    """Return the claims of the arms at a step, won and lost ones, from the record; each arm has one plan a job."""
    claims = [e for e in result.events if e.time_s == now_s and e.kind in ("award", "lost")]
    return {arm: next((1 + PLANS * offered.index(e.job) for e in claims if e.arm == arm), 0) for arm in arms}


def check_equal(actual: State, expected: State, jobs: int) -> None:
    """Assert that the states of one env are equal, apart from unused job entries and the rows of plans."""
    for name, values in expected._replace(plan=expected.plan >= 0)._asdict().items():
        own = actual.plan >= 0 if name == "plan" else getattr(actual, name)
        if name in ("status", "queued_s", "cycles", "returns", "failed_arm", "finished_s"):
            own, values = own[:, :jobs], values[:, :jobs]
        np.testing.assert_array_equal(own, values, err_msg=name)


def check_plans(tables: Tables, actual: np.ndarray, world: World, expected: np.ndarray) -> None:
    """Assert that arms away from home follow equal plans, int [arm]; each table has rows of its own."""
    one, other = actual[actual >= 0], expected[expected >= 0]
    np.testing.assert_array_equal(tables.times_s[one], world.plans.times_s[other])
    np.testing.assert_array_equal(tables.current_sq[one, :, :JOINTS], world.plans.current_sq[other])


def test_every_entry_point_repeats_a_recorded_run(fleet, recorded, play) -> None:
    logged, single = env_of(fleet, keep_events=True), env_of(fleet)
    library = library_of(fleet)
    batch = BatchEnv(library, 3, seed=[SEED - 1, SEED, SEED + 1], weights=weights_of(fleet.scenario))
    logged.reset(seed=SEED)
    single.reset(seed=SEED)
    obs, _ = batch.reset()
    rewards, arms, terms = np.zeros(3), logged.possible_agents, {}
    jobs = len(logged.world.jobs.names[0])
    while logged.agents:
        slots = play.slots_of(logged.world, logged.truth)
        names = [logged.world.jobs.names[0][j] if j >= 0 else "" for j in slots]
        actions = actions_of(recorded, names, arms, float(logged.truth.tick[0] * logged.world.dt_s))
        check_equal(single.truth, logged.truth, jobs)
        np.testing.assert_array_equal(single.truth.plan, logged.truth.plan)
        check_equal(batch.state.copy(slice(1, 2)), logged.truth, jobs)
        check_plans(library.tables, batch.state.plan[1], logged.world, logged.truth.plan[0])
        for a, arm in enumerate(arms):
            np.testing.assert_array_equal(obs["observation"][1, a], logged.state().reshape(3, -1)[a])
            np.testing.assert_array_equal(obs["action_mask"][1, a], logged.knowledge()[arm].action_mask)
        together = np.zeros((3, 3), int)
        together[1] = list(actions.values())
        one, other, many = logged.step(actions), single.step(actions), batch.step(together)
        obs = many[0]
        assert one[2] == other[2] == dict.fromkeys(arms, bool(many[2][1]))
        assert one[3] == other[3] == dict.fromkeys(arms, bool(many[3][1]))
        rewards += [one[1]["left"], other[1]["left"], many[1][1]]
        np.testing.assert_array_equal(rewards, rewards[0])
        for name, value in one[4]["left"].items():
            if name.startswith("reward_"):
                assert value == other[4]["left"][name] == many[4][name][1]
                terms[name] = terms.get(name, 0.0) + value
    # All of them equal the record.
    happened = [(e.time_s, e.kind, e.arm, e.job) for e in sorted(logged.events, key=lambda e: e.time_s)]
    assert happened == [(e.time_s, e.kind, e.arm, e.job) for e in recorded.events]
    np.testing.assert_allclose(rewards, recorded.reward, rtol=1e-9)
    finished = {e.job: e.time_s for e in recorded.events if e.kind == "finish"}
    truth, world = single.truth, single.world
    actual = {n: truth.finished_s[0, j] for j, n in enumerate(world.jobs.names[0]) if truth.status[0, j] == DONE}
    assert actual == pytest.approx(finished, rel=1e-9)
    assert truth.faults.sum() == sum(e.kind == "fault" for e in recorded.events) == recorded.metrics.faults > 0
    assert dict(zip(arms, truth.peak_c[0].tolist(), strict=True)) == pytest.approx(recorded.metrics.peak_c, rel=1e-9)
    measured = recorded.readings.temp_c[-1]
    np.testing.assert_allclose(measured, truth.temp_c[0, :, WINDING], atol=6 * logged.world.motors.sensor_noise_k.max())
    assert terms["reward_finished_value"] == pytest.approx(recorded.metrics.value, rel=1e-9)


def test_bus_and_watcher_do_not_change_a_run(fleet, recorded) -> None:
    over_zenoh = run(fleet, RunSpec(policy=recorded.card["policy"], seed=SEED, bus="zenoh"), record=False)
    assert list(map(repr, over_zenoh.events)) == list(map(repr, recorded.events))  # as text, because NaN != NaN
    assert over_zenoh.reward == recorded.reward


@pytest.mark.ci_slow
def test_both_plants_agree_over_half_an_hour(cell, plans) -> None:
    """All arms in MuJoCo, with the actions recorded with the profile plant."""
    streams = tuple(replace(s, arrivals=replace(s.arrivals, stop_s=None)) for s in cell.jobs[:2])
    longer = replace(cell, horizon_s=1800.0, jobs=streams, limits=ThermalLimits())
    fleet = prepare(longer, difficulty="blind", cache=plans)
    profile, simulated = env_of(fleet), env_of(fleet, plant="mujoco")
    policy = policy_of("least_difficulty")
    policy.reset(np.random.default_rng(0))
    profile.reset(seed=0)
    simulated.reset(seed=0)
    apart_k = 0.0
    while profile.agents:
        actions = policy.act(profile.knowledge())
        one, other = profile.step(actions), simulated.step(actions)
        assert one[2:4] == other[2:4]
        apart_k = max(apart_k, float(np.abs(profile.truth.temp_c - simulated.truth.temp_c).max()))
        np.testing.assert_array_equal(profile.truth.status, simulated.truth.status)
    assert apart_k <= 0.5
    assert profile.truth.tick[0] == 180
    np.testing.assert_allclose(profile.truth.finished_s, simulated.truth.finished_s, atol=1e-9)
    assert (profile.truth.status == DONE).sum() > 20
    assert profile.truth.peak_c.max() > 40.0
    simulated.close()
