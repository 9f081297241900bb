"""The environment's contract: PettingZoo's own checks, and ours, which are stricter."""

import pickle
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

from fleet.bus.channel import Channel
from fleet.bus.memory import MemoryExchange
from fleet.bus.session import ZenohExchange
from fleet.env import allocation_v0
from fleet.env.allocation_v0 import AllocationEnv, Episode, parallel_env
from fleet.robot import ThermalLimits
from fleet.telemetry import FAULTED

Trace = list[tuple[Any, ...]]


def wild(env: AllocationEnv, rng: np.random.Generator) -> dict[str, int]:
    """Mostly legal actions, some not."""
    actions = {}
    for arm, seen in env.knowledge().items():
        legal = np.flatnonzero(seen.action_mask)
        actions[arm] = int(rng.choice(legal)) if rng.random() < 0.9 else int(rng.integers(env.world.slots + 1))
    return actions


def go_on(env: AllocationEnv, rng: np.random.Generator, steps: int = 10_000) -> Trace:
    """Everything the env gives until the end of the episode, or for so many steps."""
    trace: Trace = []
    while env.agents and len(trace) < steps:
        trace.append(env.step(wild(env, rng)))
    return trace


def plain(trace: Any) -> Any:
    """The same in lists and numbers, so that two can be compared with ==."""
    if isinstance(trace, dict):
        return {key: plain(value) for key, value in trace.items()}
    if isinstance(trace, list | tuple):
        return [plain(value) for value in trace]
    return trace.tolist() if isinstance(trace, np.ndarray) else trace


@pytest.fixture
def make(small) -> Callable[..., AllocationEnv]:
    """Makes a small environment; `shift` are the options of its shifts."""

    def make_env(shift: dict[str, Any] | None = None, **options: Any) -> AllocationEnv:
        return parallel_env(small.Shifts(**(shift or {})), **options)

    return make_env


# PettingZoo's checks


@pytest.mark.parametrize("arms", [1, 2, 4])
def test_it_is_a_parallel_env(make, arms) -> None:
    parallel_api_test(make({"arms": arms}), num_cycles=200)


def test_the_same_seed_gives_the_same_episode_to_pettingzoo(make) -> None:
    parallel_seed_test(make, num_cycles=100)


def test_it_is_an_aec_env(small) -> None:
    env = allocation_v0.env(small.Shifts())
    with warnings.catch_warnings():
        # A dictionary of vector and mask is the layout the field agrees on; api_test says so of every such env.
        warnings.filterwarnings("ignore", message="Observation space for each agent probably should be")
        warnings.filterwarnings("ignore", message="Observation is not a NumPy array")
        # Its wrapper of parallel envs has these properties, and reading them warns.
        warnings.filterwarnings("ignore", message="The `(observation|action)_spaces` dictionary is deprecated")
        api_test(env, num_cycles=120)
    assert env.metadata["name"] == "allocation_v0"


# Observations, masks and infos


@pytest.mark.parametrize("seed", range(4))
def test_every_observation_is_finite_and_in_its_space_and_every_info_alike(make, seed) -> None:
    env = make({"arms": 3, "ambient_c": 38.0})
    observations, infos = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    keys = list(infos["arm_0"])
    terminated = truncated = dict.fromkeys(env.agents, False)
    while True:
        for arm, seen in observations.items():
            assert env.observation_space(arm).contains(seen)
            assert np.isfinite(seen["observation"]).all()
            assert seen["action_mask"][0] == 1
        assert env.state_space.contains(env.state())
        for info in infos.values():
            assert list(info) == keys
            assert all(type(value) is float and np.isfinite(value) for value in info.values())
        if not env.agents:
            break
        observations, rewards, terminated, truncated, infos = env.step(wild(env, rng))
        assert len(set(rewards.values())) == len(set(terminated.values())) == len(set(truncated.values())) == 1
        parts = [v for k, v in infos["arm_0"].items() if k.startswith("reward_")]
        assert rewards["arm_0"] == pytest.approx(sum(parts))
    assert terminated["arm_0"] != truncated["arm_0"]


def test_legal_claims_are_awarded_or_lost_and_illegal_ones_only_counted(make) -> None:
    env = make({"jobs": 12, "ticks": 80})
    env.reset(seed=5)
    rng, seen = np.random.default_rng(5), {"won": 0, "lost": 0, "illegal": 0}
    while env.agents:
        before, masks = env.truth, {a: o.action_mask for a, o in env.knowledge().items()}
        actions = {arm: int(rng.integers(env.world.slots + 1)) for arm in env.possible_agents}
        _, _, _, _, infos = env.step(actions)
        for a, arm in enumerate(env.possible_agents):
            legal = masks[arm][actions[arm]] == 1
            assert infos[arm]["illegal"] - before.illegal[0, a] == (not legal)
            award = env.truth.last_award[0, a]
            assert award == 0 if not legal or actions[arm] == 0 else award in (1, -1)
            seen["won"] += award == 1
            seen["lost"] += award == -1
            seen["illegal"] += not legal
    assert min(seen.values()) > 0


@pytest.mark.parametrize("winner", [0, 1, 2])
def test_of_two_claims_that_of_the_lower_shared_difficulty_wins(small, winner) -> None:
    content = small.work()
    arms = [small.arm(i, [content], model=small.ByPayload(1.0 if i == winner else 2.0)) for i in range(3)]
    world, plant = small.shop([[small.job("a", content)]], arms=arms)
    env = parallel_env(lambda seed: Episode(world, plant, ("by payload",) * 3, seed))
    env.reset(seed=0)
    env.step(dict.fromkeys(env.possible_agents, 1))
    assert env.truth.last_award[0].tolist() == [1 if i == winner else -1 for i in range(3)]


def test_a_wait_differs_in_nothing_from_an_illegal_action(make) -> None:
    one, other = make(), make()
    one.reset(seed=3)
    other.reset(seed=3)
    for _ in range(20):
        masks = {a: o.action_mask for a, o in one.knowledge().items()}
        lazy = dict.fromkeys(masks, 0)
        wrong = {arm: int(np.flatnonzero(mask == 0)[-1]) if (mask == 0).any() else 0 for arm, mask in masks.items()}
        here, there = plain(one.step(lazy)), plain(other.step(wrong))
        for info in (*here[-1].values(), *there[-1].values()):
            del info["illegal"]
        assert here == there


# How it ends


def test_it_ends_at_the_horizon_for_all_at_once(make) -> None:
    env = make({"ticks": 12})
    env.reset(seed=1)
    ends = [env.step(dict.fromkeys(env.possible_agents, 0)) for _ in range(12)]
    assert [(set(t.values()), set(u.values())) for _, _, t, u, _ in ends] == [({False}, {False})] * 11 + [
        ({False}, {True})
    ]
    assert env.agents == []


def test_max_cycles_ends_it_earlier(make) -> None:
    env = make({"ticks": 50}, max_cycles=7)
    env.reset(seed=1)
    assert len(go_on(env, np.random.default_rng(0))) == 7


def test_it_ends_when_all_work_is_done(make, small) -> None:
    env = make({"arms": 2, "jobs": 1, "ticks": 400, "ambient_c": 20.0})
    env.reset(seed=2)
    trace = go_on(env, np.random.default_rng(2))
    assert set(trace[-1][2].values()) == {True}
    assert set(trace[-1][3].values()) == {False}
    assert trace[-1][4]["arm_0"]["jobs_done"] == 1.0
    assert env.world.jobs.due_s[0, 0] < env.world.horizon_s


def test_work_done_in_the_last_step_is_done_and_not_cut_short(make) -> None:
    def last(max_cycles: int | None = None) -> tuple[int, bool, bool]:
        env = make({"arms": 2, "jobs": 1, "ticks": 400, "ambient_c": 20.0}, max_cycles=max_cycles)
        env.reset(seed=2)
        trace = go_on(env, np.random.default_rng(2))
        return len(trace), trace[-1][2]["arm_0"], trace[-1][3]["arm_0"]

    steps, *_ = last()
    assert last() == last(steps) == (steps, True, False)
    assert last(steps - 1) == (steps - 1, False, True)


def test_a_shift_without_jobs_is_stood_through(make) -> None:
    env = make({"jobs": 0, "ticks": 9})
    env.reset(seed=0)
    trace = go_on(env, np.random.default_rng(0))
    assert len(trace) == 9
    assert set(trace[-1][3].values()) == {True}


def test_a_faulted_arm_stays_and_may_only_wait(make) -> None:
    limits = ThermalLimits(warning_c=40.0, error_c=45.0, restart_c=38.0, clear_s=10.0)
    env = make({"jobs": 20, "ticks": 80, "limits": limits})
    observations, _ = env.reset(seed=4)
    rng, faulted = np.random.default_rng(4), 0
    while env.agents:
        observations, *_ = env.step(wild(env, rng))
        for a, arm in enumerate(env.possible_agents):
            if env.truth.mode[0, a] == FAULTED:
                faulted += 1
                assert observations[arm]["action_mask"].tolist() == [1, 0, 0, 0, 0]
    assert faulted > 3


# The same again


@pytest.mark.parametrize("seed", [0, 7, 2**40])
def test_a_seed_repeats_a_whole_episode(make, seed) -> None:
    env, other = make(), make()
    one = [env.reset(seed=seed), *go_on(env, np.random.default_rng(1))]
    again = [env.reset(seed=seed), *go_on(env, np.random.default_rng(1))]
    elsewhere = [other.reset(seed=seed), *go_on(other, np.random.default_rng(1))]
    assert plain(one) == plain(again) == plain(elsewhere)


def test_resets_without_a_seed_differ_and_follow_the_last_seed(make) -> None:
    env, other = make(), make()
    rows = [[plain(e.reset(seed=3)), plain(e.reset()), plain(e.reset())] for e in (env, other)]
    assert rows[0] == rows[1]
    assert rows[0][0] != rows[0][1] != rows[0][2] != rows[0][0]
    assert plain(env.reset(seed=0)) != plain(env.reset(seed=1))


def test_two_processes_with_other_hash_seeds_agree(small) -> None:
    code = textwrap.dedent("""
        import hashlib, importlib.util, sys
        import numpy as np
        from fleet.env.allocation_v0 import parallel_env
        spec = importlib.util.spec_from_file_location("small_worlds", sys.argv[1])
        module = sys.modules["small_worlds"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        env, rng, told = parallel_env(module.Shifts()), np.random.default_rng(0), hashlib.sha256()
        env.reset(seed=11)
        while env.agents:
            seen, rewards, *_, infos = env.step({a: int(rng.integers(5)) for a in env.possible_agents})
            for arm in env.possible_agents:
                told.update(seen[arm]["observation"].tobytes() + repr((rewards[arm], infos[arm])).encode())
        print(told.hexdigest())
    """)
    runs = [
        subprocess.run(
            [sys.executable, "-W", "error", "-c", code, small.PATH],
            env={"PYTHONHASHSEED": hash_seed, "PYTHONPATH": ":".join(p for p in sys.path if p)},
            capture_output=True, text=True, timeout=120, check=False,
        )
        for hash_seed in ("0", "4711")
    ]  # fmt: skip
    assert [r.stderr for r in runs] == ["", ""]
    assert len(runs[0].stdout) == 65
    assert runs[0].stdout == runs[1].stdout


def test_a_pickle_in_the_middle_goes_on_the_same(make) -> None:
    env = make()
    env.reset(seed=9)
    go_on(env, np.random.default_rng(0), steps=15)
    twin = pickle.loads(pickle.dumps(env))
    assert plain(go_on(env, np.random.default_rng(1))) == plain(go_on(twin, np.random.default_rng(1)))
    assert plain(env.reset()) == plain(twin.reset())


def test_zenoh_and_memory_give_the_same_episode(make) -> None:
    memory = make({"ticks": 12}, keep_events=True)  # both by the plain kernel: to the last bit
    over_zenoh = make(
        {"ticks": 12}, exchange=ZenohExchange(memory.possible_agents, fleet="same episode", timeout_s=20.0)
    )
    try:
        traces = [[env.reset(seed=6), *go_on(env, np.random.default_rng(6))] for env in (memory, over_zenoh)]
        assert plain(traces[0]) == plain(traces[1])
        assert over_zenoh.messages == memory.messages > 0
    finally:
        over_zenoh.close()


# What a caller may do wrong, and what is nobody's to change


def test_actions_may_be_numpy_integers(make) -> None:
    env, other = make(), make()
    env.reset(seed=1)
    other.reset(seed=1)
    arrays = {"arm_0": np.array(1), "arm_1": np.int64(2), "arm_2": np.array([0], dtype=np.uint8)}
    assert plain(env.step(arrays)) == plain(other.step({"arm_0": 1, "arm_1": 2, "arm_2": 0}))


@pytest.mark.parametrize("action", [1.0, np.array(0.0), "1", None, True, np.array([0, 1]), 2**70])
def test_an_action_that_is_no_integer_is_refused(make, action) -> None:
    env = make()
    env.reset(seed=1)
    with pytest.raises(ValueError, match="The action of 'arm_1' must be one integer"):
        env.step({"arm_1": action})


def test_errors_say_what_is_allowed(make) -> None:
    env = make()
    for call in (lambda: env.step({}), env.state, env.knowledge, lambda: env.truth):
        with pytest.raises(RuntimeError, match=r"No episode has begun: call reset\(\) before"):
            call()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"No agent 'arm_9' in this fleet\. Agents: arm_0, arm_1, arm_2\."):
        env.step({"arm_9": 0})
    go_on(env, np.random.default_rng(0))
    with pytest.raises(RuntimeError, match="The episode is over"):
        env.step({})
    with pytest.raises(ValueError, match="render_mode must be"):
        make(render_mode="tv")
    with pytest.raises(ValueError, match="max_cycles must be >= 1"):
        make(max_cycles=0)


def test_nothing_that_is_handed_out_is_the_env_s_own(make) -> None:
    env, untouched = make(), make()
    rng, other = np.random.default_rng(2), np.random.default_rng(2)
    handed, kept = env.reset(seed=2), untouched.reset(seed=2)
    for _ in range(15):
        assert plain(handed) == plain(kept)
        for arm in env.possible_agents:
            handed[0][arm]["observation"][:] = -1.0
            handed[0][arm]["action_mask"][:] = 0
        for part in handed:
            part["__all__"] = part.pop("arm_0")
        env.state()[:] = 0.0
        for seen in env.knowledge().values():
            seen.temp_c[:] = 0.0
            seen.action_mask[:] = 0
        assert plain(env.state()) == plain(untouched.state())
        for arm, seen in untouched.knowledge().items():
            assert plain(vars(env.knowledge()[arm])) == plain(vars(seen))
        env.agents.reverse()
        handed, kept = env.step(wild(env, rng)), untouched.step(wild(untouched, other))


def test_spaces_are_the_same_objects_at_every_call(make) -> None:
    env = make()
    for arm in env.possible_agents:
        assert env.observation_space(arm) is env.observation_space(arm) is env.observation_spaces[arm]
        assert env.action_space(arm) is env.action_space(arm) is env.action_spaces[arm]


def test_the_fleet_can_be_seen_as_text(make) -> None:
    env = make(render_mode="ansi")
    env.reset(seed=0)
    lines = (env.render() or "").splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [[f"arm_{i}", "idle"] for i in range(3)]
    assert make().render() is None


def test_watcher_and_event_log_see_every_step(make) -> None:
    steps = []
    env = make(watch=steps.append, keep_events=True)
    env.reset(seed=8)
    trace = go_on(env, np.random.default_rng(8))
    assert len(steps) == len(trace)
    assert steps[-1].state is env.truth
    kinds = [e.kind for e in env.events]
    assert kinds.count("finish") == trace[-1][4]["arm_0"]["jobs_done"]
    assert {"award", "release", "finish", "home"} <= set(kinds)


def test_an_episode_with_losses_and_delay_repeats_by_seed(small):
    """Also when the same env has run another one in between."""
    make = small.Shifts(arms=3, jobs=6, ticks=30)
    names = make(np.random.SeedSequence(0)).world.arms
    exchange = MemoryExchange(names, Channel(loss=0.4, delay_s=20.0))
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
