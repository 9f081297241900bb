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
from fleet.robot import ThermalLimits
from scenarios.policy_loader import policy_of
from scenarios.prepare.fleet import env_of, prepare

COPIES: dict[str, Callable[[Any], Any]] = {"pickle": lambda env: pickle.loads(pickle.dumps(env)), "copy": copy.deepcopy}
WHOLE = """
import importlib.util, sys
import numpy as np
loaded = []
for name, path in zip(("small_worlds", "playing"), sys.argv[1:]):
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    loaded.append(module)
worlds, playing = loaded
from fleet.env.allocation_v2 import env as aec_env, parallel_env
from fleet.env.vector import BatchEnv

def results():
    shifts = worlds.Shifts(ambient_c=40.0)
    for options in ({}, {"keep_events": True}):
        env = parallel_env(shifts, **options)
        yield env.reset(seed=0)
        yield playing.go_on(env, np.random.default_rng(0))
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
        given = batch.step(playing.chosen(given[0]["action_mask"], rng.random((5, 3, 2))))

for each in results():
    print(playing.digest(each))
"""
"""Prints a hash of everything that a single env (with and without events), an AEC env and a batch return."""

# Seeds


@pytest.mark.parametrize("keep_events", [False, True])
@pytest.mark.parametrize("seed", [0, 7, 2**40])
def test_a_seed_repeats_a_whole_episode(make, play, seed, keep_events) -> None:
    env, other = make(keep_events=keep_events), make(keep_events=keep_events)
    one = [env.reset(seed=seed), *play.go_on(env, np.random.default_rng(1))]
    again = [env.reset(seed=seed), *play.go_on(env, np.random.default_rng(1))]
    elsewhere = [other.reset(seed=np.int64(seed)), *play.go_on(other, np.random.default_rng(1))]
    assert play.plain(one) == play.plain(again) == play.plain(elsewhere)
    assert len(one) > 10


def test_resets_without_a_seed_differ_and_follow_the_last_seed(make, play) -> None:
    env, other = make(), make()
    rows = [[play.plain(e.reset(seed=3)), play.plain(e.reset()), play.plain(e.reset())] for e in (env, other)]
    assert rows[0] == rows[1]
    assert rows[0][0] != rows[0][1] != rows[0][2] != rows[0][0]
    assert play.plain(env.reset(seed=0)) != play.plain(env.reset(seed=1))


def test_zero_is_a_seed_and_none_is_not(make, batch, play) -> None:
    assert play.plain(make().reset(seed=0)) == play.plain(make().reset(seed=0))
    assert play.plain(make().reset()) != play.plain(make().reset())
    for seeded in ({"seed": 0}, {"seed": [0, 0]}):
        play.same(batch(2, **seeded).reset()[0], batch(2, **seeded).reset()[0])
    assert (batch(2).reset()[0]["own"] != batch(2).reset()[0]["own"]).any()
    obs, _ = batch(2).reset(seed=0)
    play.same(obs, batch(2, seed=0).reset()[0])


def test_global_generators_are_neither_read_nor_changed(make, batch, play) -> None:
    """An env neither uses nor changes NumPy's global generator."""
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
def test_processes_with_different_hash_seeds_agree(small, play) -> None:
    runs = [
        subprocess.run(
            [sys.executable, "-W", "error", "-c", WHOLE, small.PATH, play.PATH],
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


def test_an_episode_with_losses_and_delay_repeats_by_seed(small) -> None:
    """Also if the env has run another episode in between."""
    make = small.Shifts(arms=3, jobs=6, ticks=30)
    names = make(np.random.SeedSequence(0)).world.arms
    exchange = Exchange(names, Channel(loss=0.4, delay_s=20.0))
    env = parallel_env(make, exchange=exchange)

    def trace(seed: int) -> list[np.ndarray]:
        env.reset(seed=seed)
        out = [env.state()]
        while env.agents:
            env.step(dict.fromkeys(env.agents, 0))
            out.append(env.state())
        return out

    first, messages = trace(4), env.messages
    trace(5)
    np.testing.assert_array_equal(trace(4), first)
    assert env.messages == messages


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


@pytest.mark.parametrize("keep_events", [False, True])
@pytest.mark.parametrize("order", [(2, 0, 1), (0, 2, 1), (2, 1, 0)])
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


@pytest.mark.slow
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
