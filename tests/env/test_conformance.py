"""The contract of the environment: PettingZoo's tests, what they do not check, and the entry points."""

import subprocess
import sys
import warnings
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pettingzoo
import pytest
from gymnasium.spaces import Dict
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
    state_test,
)
from scipy.stats import chisquare

import scenarios
from fleet.engine.batch import TERMS
from fleet.env import allocation_v2
from fleet.env.allocation_v2 import AllocationEnv
from fleet.env.random_actions import random_legal
from fleet.observation import FIELDS

HOT = {"arms": 3, "ambient_c": 38.0}


@pytest.fixture
def quiet() -> Iterator[None]:
    """Ignore warnings that PettingZoo's tests give for every Dict observation."""
    with warnings.catch_warnings():
        # api_test warns of every Dict observation, the usual layout of vector and mask.
        warnings.filterwarnings("ignore", message="Observation space for each agent probably should be")
        warnings.filterwarnings("ignore", message="Observation is not a NumPy array")
        # PettingZoo's wrapper of parallel envs warns when these properties are read.
        warnings.filterwarnings("ignore", message="The `(observation|action)_spaces` dictionary is deprecated")
        yield


@pytest.fixture
def module(small) -> SimpleNamespace:
    """Return an environment of small shifts with the entry points of a PettingZoo module."""
    shifts = small.Shifts()
    return SimpleNamespace(
        env=lambda **options: allocation_v2.env(shifts, **options),
        raw_env=lambda **options: allocation_v2.raw_env(shifts, **options),
        parallel_env=lambda **options: allocation_v2.parallel_env(shifts, **options),
    )


@pytest.mark.parametrize("arms", [1, 4])
def test_pettingzoo_parallel_test_passes(make, arms) -> None:
    parallel_api_test(make({"arms": arms}), num_cycles=200)


@pytest.mark.parametrize("door", ["env", "raw_env"])
def test_pettingzoo_aec_test_passes(module, quiet, door) -> None:
    env = getattr(module, door)()
    api_test(env, num_cycles=120)
    assert env.metadata["name"] == "allocation_v2"


def test_pettingzoo_seed_max_cycles_render_and_state_tests_pass(module, quiet, monkeypatch) -> None:
    monkeypatch.setattr("matplotlib.get_backend", lambda: "agg")  # opens no window
    parallel_seed_test(module.parallel_env, num_cycles=100)
    seed_test(module.env, num_cycles=100)
    max_cycles_test(module)
    render_test(module.env, {"ansi": lambda text: text.startswith("t = ")})
    state_test(module.env(), module.parallel_env(), num_cycles=50)


@pytest.mark.parametrize("options", [{}, {"keep_events": True}, {"mask_in": "both"}, {"mask_in": "info"}])
def test_results_of_a_parallel_env_are_in_its_spaces(make, play, options) -> None:
    env = make(HOT, **options)
    observations, infos = env.reset(seed=0)
    rng, keys, ended = np.random.default_rng(0), list(infos["arm_0"]), []
    while True:
        assert list(observations) == list(infos) == env.possible_agents
        for arm, observed in observations.items():
            fits(env.observation_space(arm), observed)
            masks = [each["action_mask"] for each in (observed, infos[arm]) if "action_mask" in each]
            assert len(masks) == (2 if options.get("mask_in") == "both" else 1)
            for mask in masks:
                assert mask.dtype == np.int8
                assert mask[0] == 1
                np.testing.assert_array_equal(mask, env.knowledge()[arm].action_mask)
        assert env.state_space.contains(env.state())
        for info in infos.values():
            assert list(info) == keys
            numbers = [value for name, value in info.items() if name != "action_mask"]
            assert all(type(value) is float and np.isfinite(value) for value in numbers)
        if not env.agents:
            break
        observations, rewards, terminated, truncated, infos = env.step(play.wild(env, rng))
        for each in (rewards, terminated, truncated):
            assert list(each) == env.possible_agents
            assert len(set(each.values())) == 1
        assert [type(each["arm_0"]) for each in (rewards, terminated, truncated)] == [float, bool, bool]
        assert rewards["arm_1"] == pytest.approx(sum(infos["arm_1"][f"reward_{name}"] for name in TERMS), abs=1e-12)
        ended.append(terminated["arm_0"] + truncated["arm_0"])
    assert ended == [0] * (len(ended) - 1) + [1]


def test_infos_of_a_reset_are_of_the_new_shift(batch, small) -> None:
    env = batch(4, HOT, seed=0)
    for _ in range(2):
        _, info = env.reset()
        np.testing.assert_array_equal(info["peak_c"], env.state.peak_c)
        assert info["peak_c"].min() > 0.0
        assert not any(info[name].any() for name in ("faults", "illegal", "above_warning_s", "jobs_done"))
        for _ in range(20):
            env.step(np.full((4, 3), -1))
    _, info = env.reset(rows=[0, 2])
    assert (info["illegal"] > 0).any(axis=1).tolist() == [False, True, False, True]
    single = allocation_v2.parallel_env(small.Shifts(arms=2))
    _, infos = single.reset(seed=0)
    assert [info["peak_c"] for info in infos.values()] == single.truth.peak_c[0].tolist()


def fits(space: Any, observed: Any) -> None:
    assert space.contains(observed)
    assert np.isfinite(observed["observation"] if isinstance(space, Dict) else observed).all()


def test_spaces_are_the_same_objects_at_every_call(make) -> None:
    env = make()
    for arm in env.possible_agents:
        assert env.observation_space(arm) is env.observation_space(arm) is env.observation_spaces[arm]
        assert env.action_space(arm) is env.action_space(arm) is env.action_spaces[arm]
    before = [*env.observation_spaces.values(), *env.action_spaces.values(), env.state_space]
    assert env.metadata["is_parallelizable"]
    assert (env.max_num_agents, env.num_agents) == (3, 0)
    env.reset(seed=0)
    assert env.num_agents == 3
    env.step({})
    after = [*env.observation_spaces.values(), *env.action_spaces.values(), env.state_space]
    assert all(one is other for one, other in zip(before, after, strict=True))
    assert len(set(map(id, before))) == len(before)  # seeding the space of one agent seeds no other


@pytest.mark.parametrize("keep_events", [False, True])
def test_returned_objects_belong_to_the_caller(make, play, keep_events) -> None:
    options = {"keep_events": keep_events, "mask_in": "both"}
    env, untouched = make(**options), make(**options)
    rng, other = np.random.default_rng(2), np.random.default_rng(2)
    handed, kept = env.reset(seed=2), untouched.reset(seed=2)
    for _ in range(15):
        assert play.plain(handed) == play.plain(kept)
        for arm in env.possible_agents:
            handed[0][arm]["observation"][:] = -1.0
            handed[0][arm]["action_mask"][:] = 0
            handed[-1][arm]["action_mask"][:] = 0
            handed[-1][arm]["peak_c"] = -1.0
        for part in handed:
            part["__all__"] = part.pop("arm_0")  # as RLlib does
        env.state()[:] = 0.0
        known, others = env.knowledge(), untouched.knowledge()
        for field in FIELDS:
            np.asarray(getattr(known["arm_0"], field.name))[...] = 0.0
        known["arm_0"].peers[:] = known["arm_0"].action_mask[:] = 0
        for arm in env.possible_agents[1:]:  # what an arm writes into its own observation, no other arm observes
            assert play.plain(play.named(known[arm])) == play.plain(play.named(others[arm]))
        assert play.plain(env.state()) == play.plain(untouched.state())
        for arm, observed in untouched.knowledge().items():
            assert play.plain(play.named(env.knowledge()[arm])) == play.plain(play.named(observed))
        env.agents.reverse()
        handed, kept = env.step(play.wild(env, rng)), untouched.step(play.wild(untouched, other))


def test_returned_arrays_of_a_batch_belong_to_the_caller(batch, play) -> None:
    env, untouched = (batch(6, {"jobs": 4, "ticks": 12}, seed=3) for _ in range(2))
    rng, handed, kept = np.random.default_rng(2), env.reset(), untouched.reset()
    for step in range(30):
        play.same(play.rows(handed, range(6)), play.rows(kept, range(6)))
        actions = play.chosen(kept[0]["action_mask"], rng.random((6, 3, 2)))
        for part in (handed[0], handed[-1], handed[-1]["final_obs"]):
            for name in list(part):
                if isinstance(part[name], np.ndarray):
                    part[name][...] = 1
                part[f"{name} of mine"] = None
        for values in (*handed[1:-1], *env.state):
            values[...] = 1
        if step % 3 == 0:  # reading may refresh cached arrays
            for values in play.named(env.knowledge()).values():
                if values.flags.writeable:
                    values[...] = 1
            play.same(play.named(env.knowledge()), play.named(untouched.knowledge()))
        play.same(env.state.named(), untouched.state.named())
        if step % 7 == 3:
            some = {"rows": [1, 4]}
            handed, kept = env.reset(**some), untouched.reset(**some)
            play.same(play.rows(handed, range(6)), play.rows(kept, range(6)))
            actions = np.where(np.isin(np.arange(6), [1, 4])[:, None], 0, actions)
        handed, kept = env.step(actions), untouched.step(actions)
    assert not np.shares_memory(env.state.temp_c, env.state.temp_c)


NAME = "thermofleet/allocation_v2"


def test_pettingzoo_makes_the_env_by_name(cell, plans, play) -> None:
    options = {"scenario": cell, "difficulty": "blind", "cache": plans, "max_cycles": 5}
    env = pettingzoo.make("parallel", NAME, **options, mask_in="both")
    assert isinstance(env, ParallelEnv)
    assert isinstance(env.unwrapped, AllocationEnv)
    ours = scenarios.make_env(cell, difficulty="blind", cache=plans, max_cycles=5, mask_in="both")
    assert play.plain(env.reset(seed=1)) == play.plain(ours.reset(seed=1))
    for _ in range(5):
        assert play.plain(env.step({"left": 1})) == play.plain(ours.step({"left": 1}))
    assert env.agents == []
    turns = pettingzoo.make("aec", NAME, **options)
    assert isinstance(turns, AECEnv)
    turns.reset(seed=1)
    assert turns.possible_agents == ["left", "right", "far"]
    first, *_ = turns.last()
    np.testing.assert_array_equal(first["observation"], ours.reset(seed=1)[0]["left"]["observation"])


@pytest.mark.parametrize(
    "first",
    [
        "import pettingzoo, thermofleet",
        "import scenarios, pettingzoo; scenarios.make_env",
    ],
)
def test_importing_scenarios_registers_the_name(first) -> None:
    code = f"{first}; import pettingzoo as p; print([p.spec(kind, {NAME!r}).name for kind in ('parallel', 'aec')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.strip() == "['allocation', 'allocation']", done.stderr


masks = npst.arrays(
    np.int8, st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 9)), elements=st.integers(0, 1)
)


@given(mask=masks, seed=st.integers(0, 2**32))
def test_every_action_is_legal_if_one_is(mask, seed) -> None:
    actions = random_legal(mask, np.random.default_rng(seed))
    assert actions.shape == mask.shape[:-1]
    assert actions.dtype == np.int64
    chosen = np.take_along_axis(mask, actions[..., None], axis=-1)[..., 0]
    np.testing.assert_array_equal(chosen == 1, mask.any(axis=-1))
    assert (actions[~mask.any(axis=-1)] == 0).all()


def test_legal_actions_are_equally_likely() -> None:
    mask = np.zeros((60_000, 9), np.int8)
    legal = [0, 3, 4, 8]
    mask[:, legal] = 1
    counts = np.bincount(random_legal(mask, np.random.default_rng(3)), minlength=9)
    assert counts.sum() == counts[legal].sum() == len(mask)
    assert chisquare(counts[legal]).pvalue > 0.001
