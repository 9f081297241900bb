"""Reproducibility: by seed, in another process, from a copy, in another order, by every entry point."""

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleet.bus.exchange.channel import Channel
from fleet.bus.exchange.memory import Exchange
from fleet.engine.state import DONE
from fleet.env.allocation_v2 import Episode, parallel_env
from fleet.heat.motor import gen3_motors
from fleet.heat.thermal import WINDING
from fleet.offered_plans import PLANS
from fleet.robot import ThermalLimits
from scenarios.prepare.fleet import Fleet, env_of, prepare
from scenarios.run.shift import RunLog, run
from scenarios.spec.options import RunSpec

COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}
WHOLE = """
import numpy as np
from fleet.env.allocation_v2 import env as aec_env, parallel_env
from fleet.env.vector import BatchEnv
from tests.conftest import Shifts
from tests.env.conftest import chosen, digest, go_on

def results():
    shifts = Shifts(ambient_c=40.0)
    for options in ({}, {"keep_events": True}):
        env = parallel_env(shifts, **options)
        yield env.reset(seed=0)
        yield go_on(env, np.random.default_rng(0))
        yield env.reset(), [str(event) for event in env.events]
    env = aec_env(shifts)
    env.reset(seed=0)
    for arm in env.agent_iter():
        *_, terminated, truncated, _ = last = env.last()
        yield arm, last
        env.step(None if terminated or truncated else 1)
    batch, rng = BatchEnv(shifts.library(), 5, seed=0), np.random.default_rng(0)
    given = batch.reset()
    for _ in range(90):
        yield given
        given = batch.step(chosen(given[0]["action_mask"], rng.random((5, 3, 2))))

for each in results():
    print(digest(each))
"""
"""Prints a hash of everything that a single env (with and without events), an AEC env and a batch return."""

# Seeds


LATE = Channel(loss=0.4, delay_s=20.0)


@pytest.mark.parametrize(
    ("seed", "keep_events", "channel"), [(0, False, None), (7, True, None), (2**32 - 1, False, LATE)]
)
def test_a_seed_repeats_a_whole_episode(make, play, seed, keep_events, channel) -> None:
    arms = ("arm_0", "arm_1", "arm_2")
    env, other = (make(keep_events=keep_events, exchange=channel and Exchange(arms, channel)) for _ in range(2))
    one = [env.reset(seed=seed), *play.go_on(env, np.random.default_rng(1))]
    again = [env.reset(seed=seed), *play.go_on(env, np.random.default_rng(1))]
    elsewhere = [other.reset(seed=np.int64(seed)), *play.go_on(other, np.random.default_rng(1))]
    assert play.plain(one) == play.plain(again) == play.plain(elsewhere)
    assert env.messages == other.messages
    assert len(one) > 10


def test_resets_without_a_seed_differ_and_follow_the_last_seed_and_zero_is_a_seed(make, batch, play) -> None:
    env, other = make(), make()
    rows = [[play.plain(e.reset(seed=0)), play.plain(e.reset()), play.plain(e.reset())] for e in (env, other)]
    assert rows[0] == rows[1]
    assert rows[0][0] != rows[0][1] != rows[0][2] != rows[0][0]
    assert rows[0][0] != play.plain(env.reset(seed=1))
    assert play.plain(make().reset()) != play.plain(make().reset())
    for seeded in ({"seed": 0}, {"seed": [0, 0]}):
        play.same(batch(2, **seeded).reset()[0], batch(2, **seeded).reset()[0])
    assert (batch(2).reset()[0]["own"] != batch(2).reset()[0]["own"]).any()
    obs, _ = batch(2).reset(seed=0)
    play.same(obs, batch(2, seed=0).reset()[0])


def test_global_generators_are_neither_read_nor_changed(make, batch, play) -> None:
    results = []
    for seed in (1, 2):
        np.random.seed(seed)  # noqa: NPY002  # the global one is what this is about
        before = repr(np.random.get_state())  # noqa: NPY002
        env = make()
        results.append([play.plain(env.reset(seed=0)), play.plain(play.go_on(env, np.random.default_rng(0)))])
        batch(3, seed=0).reset()
        assert repr(np.random.get_state()) == before  # noqa: NPY002
    assert results[0] == results[1]


@pytest.mark.ci_slow
def test_processes_with_different_hash_seeds_agree() -> None:
    runs = [
        subprocess.run(
            [sys.executable, "-W", "error", "-c", WHOLE],
            env={"PYTHONHASHSEED": hash_seed, "PYTHONPATH": ":".join(p for p in sys.path if p)},
            capture_output=True, text=True, timeout=300, check=False,
        )
        for hash_seed in ("0", "4711")
    ]  # fmt: skip
    said = [line for run in runs for line in run.stderr.splitlines()]
    assert [line for line in said if not line.startswith("Compiling")] == []
    lines = [run.stdout.split() for run in runs]
    assert lines[0] == lines[1]
    assert len(set(lines[0])) > 150


@pytest.mark.parametrize("options", [{}, {"keep_events": True}, {"mask_in": "info"}], ids=["default", "events", "info"])
@pytest.mark.parametrize("way", COPIES)
def test_a_copy_within_an_episode_continues_identically(make, play, way, options) -> None:
    env = make({"ambient_c": 40.0}, **options)
    env.reset(seed=9)
    play.go_on(env, np.random.default_rng(0), steps=15)
    other = COPIES[way](env)
    before = play.plain(env.state())
    ahead = play.plain(play.go_on(other, np.random.default_rng(1)))
    assert play.plain(env.state()) == before  # nothing is shared
    assert play.plain(play.go_on(env, np.random.default_rng(1))) == ahead
    assert play.plain(env.reset()) == play.plain(other.reset())
    assert COPIES[way](make(**options)).possible_agents == env.possible_agents  # also before a reset


@pytest.mark.parametrize("way", COPIES)
def test_a_copy_of_a_batch_continues_identically(batch, play, way) -> None:
    def go_on(env, obs) -> list[Any]:
        rng, given = np.random.default_rng(1), []
        for _ in range(60):
            given.append(env.step(play.chosen(obs["action_mask"], rng.random((4, 3, 2)))))
            obs = given[-1][0]
        return [play.rows(each, range(4)) for each in given]

    env, rng = batch(4, {"jobs": 3, "ambient_c": 20.0}, seed=9), np.random.default_rng(0)
    obs, _ = env.reset()
    for _ in range(50):
        obs, *_ = env.step(play.chosen(obs["action_mask"], rng.random((4, 3, 2))))
    other, untouched = COPIES[way](env), COPIES[way](obs)
    ahead = go_on(other, obs)
    for one, two in zip(go_on(env, untouched), ahead, strict=True):
        play.same(one, two)
    play.same(env.reset()[0], other.reset()[0])


@pytest.mark.parametrize(("order", "keep_events"), [((2, 0, 1), False), ((2, 1, 0), True)])
def test_the_order_of_arms_does_not_matter(small, play, order, keep_events) -> None:
    """Without sensor noise, which depends on the order of the arms."""
    exact = replace(gen3_motors(), sensor_noise_k=np.zeros(7))
    works = [small.work(place, kg) for place in ("bench", "rack") for kg in (small.LIGHT, small.HOT)]
    arms = [
        small.arm(i, works[i:] if i else works, times=small.Times(cycle=10.0 + i), motors=exact) for i in range(3)
    ]  # of different speed, ability and score, so that there are no ties
    jobs = [
        small.job(f"j{i}", works[i % 4], release_s=40.0 * i, due_s=60.0 * i, repetitions=i % 3 + 2) for i in range(9)
    ]
    limits = ThermalLimits(warning_c=40.0, error_c=45.0, restart_c=38.0, clear_s=20.0)

    def env_of(which):
        world, plant = small.shop([jobs], arms=[arms[i] for i in which], limits=limits, ticks=70, ambient_c=30.0)
        return parallel_env(lambda seed: Episode(world, plant, ("t",) * 3, seed), keep_events=keep_events)

    one, other, rng = env_of(range(3)), env_of(order), np.random.default_rng(0)
    one.reset(seed=0)
    other.reset(seed=0)
    names, lost = one.possible_agents, 0
    assert other.possible_agents == [names[i] for i in order]
    while one.agents:
        for arm in names:
            mine, its = one.knowledge()[arm], other.knowledge()[arm]
            place = [other.possible_agents.index(name) for name in names]
            for field, values in play.named(mine).items():
                actual = getattr(its, field)
                if field == "peers":
                    actual, values = (
                        {env.possible_agents[m] for m in each} for env, each in ((other, actual), (one, values))
                    )
                    assert actual == values == set(names) - {arm}
                    continue
                ordered = actual[place] if field.startswith("fleet_") and len(actual) else actual  # without bids none
                np.testing.assert_array_equal(ordered, values, field)
        actions = {arm: int(rng.choice([1, 1, 1, 0, 2, 3, 4])) for arm in names}  # so that claims compete
        given, actual = one.step(actions), other.step(actions)
        for arm in names:
            assert actual[1][arm] == pytest.approx(given[1][arm], rel=1e-12, abs=1e-12)
            assert [actual[i][arm] for i in (2, 3)] == [given[i][arm] for i in (2, 3)]
            assert actual[4][arm] == pytest.approx(given[4][arm], rel=1e-12, abs=1e-12)
        lost += int((one.truth.last_award == -1).sum())
    assert one.truth.faults.sum() > 0
    np.testing.assert_array_equal(one.truth.finished_s, other.truth.finished_s)
    assert lost > 0


SEED = 2


@pytest.fixture(scope="module", params=["blind", "oracle", pytest.param("twin", marks=pytest.mark.slow)])
def fleet(request, cell, plans) -> Fleet:
    return prepare(cell, difficulty=request.param, cache=plans)


@pytest.fixture(scope="module", params=["random", "round_robin"])
def recorded(request, fleet) -> RunLog:
    return run(fleet, RunSpec(policy=request.param, seed=SEED, bus="memory"))


def actions_of(result: RunLog, offered: list[str], arms: list[str], now_s: float) -> dict[str, int]:
    """Return the claims of the arms at a step, won and lost ones, from the record; each arm has one plan a job."""
    claims = [e for e in result.events if e.time_s == now_s and e.kind in ("award", "lost")]
    return {arm: next((1 + PLANS * offered.index(e.job) for e in claims if e.arm == arm), 0) for arm in arms}


def test_an_env_repeats_a_recorded_run(fleet, recorded, play) -> None:
    env = env_of(fleet, keep_events=True)
    env.reset(seed=SEED)
    reward, value, arms, shift = 0.0, 0.0, env.possible_agents, env.world.shifts[0]
    while env.agents:
        names = [shift.names[j] if j >= 0 else "" for j in play.slots_of(env.world, env.truth)]
        _, rewards, *_, infos = env.step(actions_of(recorded, names, arms, float(env.truth.tick[0] * env.world.dt_s)))
        reward += rewards["left"]
        value += infos["left"]["reward_finished_value"]
    happened = [(e.time_s, e.kind, e.arm, e.job) for e in sorted(env.events, key=lambda e: e.time_s)]
    assert happened == [(e.time_s, e.kind, e.arm, e.job) for e in recorded.events]
    assert (reward, value) == pytest.approx((recorded.reward, recorded.metrics.value), rel=1e-9)
    finished, truth = {e.job: e.time_s for e in recorded.events if e.kind == "finish"}, env.truth
    actual = {n: truth.finished_s[0, j] for j, n in enumerate(shift.names) if truth.status[0, j] == DONE}
    assert actual == pytest.approx(finished, rel=1e-9)
    assert truth.faults.sum() == sum(e.kind == "fault" for e in recorded.events) == recorded.metrics.faults > 0
    assert dict(zip(arms, truth.peak_c[0].tolist(), strict=True)) == pytest.approx(recorded.metrics.peak_c, rel=1e-9)
    measured = recorded.readings.temp_c[-1]
    np.testing.assert_allclose(measured, truth.temp_c[0, :, WINDING], atol=6 * env.world.motors.sensor_noise_k.max())
