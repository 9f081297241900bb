"""Errors of the environment: each says what was given, what is allowed, and what to do."""

from typing import Any

import numpy as np
import pytest

from fleet.env import allocation_v2
from fleet.env.adapters.gymnasium_view import DispatcherEnv, DispatcherVectorEnv
from fleet.errors import FleetError, ScenarioError
from scenarios.prepare.batch import make_batch
from scenarios.prepare.fleet import Randomisation, make_env

MAKERS = (make_env, lambda scenario, **options: make_batch(scenario, 2, **options))
NO_SEEDS = (-1, 2**32, 1.5, "a", True, [1, 2], np.array(3.0))


def test_actions_may_be_numpy_integers(make, play) -> None:
    env, other = make(), make()
    env.reset(seed=1)
    other.reset(seed=1)
    arrays = {"arm_0": np.array(1), "arm_1": np.int64(2), "arm_2": np.array([0], dtype=np.uint8)}
    assert play.plain(env.step(arrays)) == play.plain(other.step({"arm_0": 1, "arm_1": 2, "arm_2": 0}))


@pytest.mark.parametrize("action", [1.0, np.array(0.0), "1", None, True, np.array([0, 1]), [], [1], (1,)])
def test_non_integer_actions_are_refused_without_effect(make, play, action) -> None:
    env, other = make(), make()
    env.reset(seed=1)
    other.reset(seed=1)
    with pytest.raises(ValueError, match="The action of 'arm_1' must be one integer"):
        env.step({"arm_0": 1, "arm_1": action})
    assert play.plain(env.step({"arm_0": 1})) == play.plain(other.step({"arm_0": 1}))


@pytest.mark.parametrize(
    "action",
    [np.int64(-1), np.uint8(200), -(2**63), 2**64, -(10**30), np.uint64(2**64 - 1), np.array(2**63)],
)
def test_integers_outside_the_space_are_waits(make, action) -> None:
    env = make()
    env.reset(seed=1)
    *_, infos = env.step({"arm_1": action})
    assert [info["illegal"] for info in infos.values()] == [0, 1, 0]


@pytest.mark.parametrize("actions", [None, [1, 0, 0], np.zeros(3, int)])
def test_actions_must_be_a_dictionary(make, actions) -> None:
    env = make()
    env.reset(seed=1)
    for call in (env.step, env.advance):
        with pytest.raises(ValueError, match=r"actions must be a dictionary of agents and their actions \(got "):
            call(actions)


@pytest.mark.parametrize("name", ["arm_9", 0, None])
def test_unknown_agents_are_refused_with_the_valid_names(make, name) -> None:
    env = make()
    env.reset(seed=0)
    for call in (lambda: env.step({name: 0}), lambda: env.observation_space(name), lambda: env.action_space(name)):
        with pytest.raises(ValueError, match=rf"No agent '{name}' in this fleet\. Agents: arm_0, arm_1, arm_2\."):
            call()


def test_errors_before_reset_and_after_the_end_name_the_call_to_make(make, play) -> None:
    env = make(render_mode="ansi")
    calls = (lambda: env.step({}), env.state, env.knowledge, env.render, lambda: env.truth, lambda: env.messages)
    for call in calls:
        with pytest.raises(RuntimeError, match=r"No episode has started: call reset\(\) before .+\."):
            call()
    env.reset(seed=0)
    play.go_on(env, np.random.default_rng(0))
    with pytest.raises(RuntimeError, match=r"The episode is over: call reset\(\) before step\(\)\."):
        env.step({})
    env.state()
    env.render()


@pytest.mark.parametrize("seed", NO_SEEDS)
def test_invalid_seeds_are_refused(make, seed) -> None:
    with pytest.raises(ValueError, match=r"seed must be an integer from 0 to 4294967295 \(got "):
        make().reset(seed=seed)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render_mode": "tv"}, r"render_mode must be one of None, 'ansi', 'rgb_array', 'human' \(got 'tv'\)\."),
        ({"mask_in": "none"}, r"mask_in must be one of 'obs', 'info', 'both' \(got 'none'\)\."),
        ({"max_cycles": 0}, r"max_cycles must be an integer from 1 to 2\*\*62 \(got 0\)\."),
        ({"max_cycles": 10**30}, r"max_cycles must be an integer from 1 to 2\*\*62 \(got 10+\)\."),
        ({"max_cycles": 2.5}, r"max_cycles must be an integer from 1 to 2\*\*62 \(got 2\.5\)\."),
        ({"scaled": "no"}, r"scaled must be True or False \(got 'no'\)\."),
        ({"ahead_s": -1}, r"ahead_s must be a number of seconds >= 0, or inf \(got -1\)\."),
        ({"ahead_s": float("nan")}, r"ahead_s must be a number of seconds >= 0, or inf \(got nan\)\."),
        ({"ahead_s": "1"}, r"ahead_s must be a number of seconds >= 0, or inf \(got '1'\)\."),
    ],
)
def test_invalid_options_are_refused(make, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_the_aec_env_refuses_wrong_actions(small) -> None:
    env = allocation_v2.env(small.Shifts(ticks=2))
    env.reset(seed=0)
    first, second = env.possible_agents[:2]
    env.step(0)
    with pytest.raises(ValueError, match=rf"The action of '{second}' must be one integer \(got 1\.5\)"):
        env.step(1.5)
    assert env.agent_selection == second  # it may choose again
    for _ in range(5):
        env.step(0)
    with pytest.raises(
        ValueError, match=rf"The episode is over for '{first}': step\(None\), or reset\(\) .+ \(got 0\)"
    ):
        env.step(0)
    while env.agents:
        env.step(None)


@pytest.mark.parametrize(
    "actions",
    [
        None, 0, "x", {"arm_0": 1}, np.zeros((2, 3)), np.zeros((2, 3), bool), np.zeros((3, 2), int), np.zeros(6, int),
        np.zeros((2, 3, 1), int), [[0, 0, 0], [0, 0]], [[0, 0, 0], [0, 0, 2**70]], [[0, 0, None]] * 2,
    ],
)  # fmt: skip
def test_actions_of_wrong_type_or_shape_are_refused_without_effect(batch, play, actions) -> None:
    env, other = batch(2, seed=0), batch(2, seed=0)
    env.reset()
    other.reset()
    with pytest.raises(ValueError, match=r"actions must be integers \[env, arm\] of shape \(2, 3\) \(got "):
        env.step(actions)
    nobody = np.zeros((2, 3), int)
    play.same(play.rows(env.step(nobody), range(2)), play.rows(other.step(nobody), range(2)))


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int32, np.uint64])
def test_actions_may_have_any_integer_type_and_memory_order(batch, play, kind) -> None:
    env, other = batch(2, seed=0), batch(2, seed=0)
    env.reset()
    other.reset()
    actions = np.array([[1, 2, 0], [0, 3, 100]])
    given = [env.step(np.asfortranarray(actions.astype(kind))), other.step(actions.tolist())]
    play.same(play.rows(given[0], range(2)), play.rows(given[1], range(2)))
    assert given[0][-1]["illegal"][1, 2] == given[1][-1]["illegal"][1, 2] == 1


def test_batch_errors_before_reset_and_after_the_end_name_the_call_to_make(batch) -> None:
    env = batch(2, {"ticks": 3}, seed=0, autoreset=False)
    nobody = np.zeros((2, 3), int)
    for call in (lambda: env.step(nobody), env.knowledge, lambda: env.state):
        with pytest.raises(RuntimeError, match=r"No episode has started: call reset\(\) before "):
            call()
    with pytest.raises(RuntimeError, match=r"call reset\(\) for all envs before reset\(rows=…\)"):
        env.reset(rows=[0])
    env.reset()
    for _ in range(3):
        env.step(nobody)
    over = r"The shift of 2 env\(s\) is over \(first: env 0\): call reset\(rows=…\) before step\(\)\."
    with pytest.raises(RuntimeError, match=over):
        env.step(nobody)
    env.reset(rows=[0])
    with pytest.raises(RuntimeError, match=r"The shift of 1 env\(s\) is over \(first: env 1\)"):
        env.step(nobody)
    env.reset(rows=[1])
    env.step(nobody)


@pytest.mark.parametrize(
    "seed", [*(each for each in NO_SEEDS if np.ndim(each) == 0), [1], [1, 2, 3], [1, -2], [1, "x"]]
)
def test_invalid_batch_seeds_are_refused(batch, seed) -> None:
    message = r"seed must be (an integer from 0 to 4294967295|one integer or one for each of 2 envs) \(got "
    with pytest.raises(ValueError, match=message):
        batch(2, seed=seed)
    env = batch(2)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=seed)


@pytest.mark.parametrize("seed", [np.uint8(255), np.array(127, dtype=np.int8), np.uint32(2**31), 2**32 - 1])
def test_seeds_count_up_past_the_largest_integer_of_their_type(batch, play, seed) -> None:
    counted, listed = batch(2, seed=seed), batch(2, seed=[int(seed), (int(seed) + 1) % 2**32])
    for env in (counted, listed):
        env.reset()
    nobody = np.zeros((2, 3), int)
    play.same(play.rows(counted.step(nobody), range(2)), play.rows(listed.step(nobody), range(2)))
    assert counted.state.temp_c.tolist() == listed.state.temp_c.tolist()


@pytest.mark.parametrize("options", [3, "x", [], {"horizon_s": 3}])
def test_a_reset_refuses_options(make, batch, options) -> None:
    dispatchers = DispatcherEnv(make()), DispatcherVectorEnv(batch(2))
    for env in (make(), batch(2), *dispatchers):
        with pytest.raises(
            ValueError, match=r"options must be a dictionary or None|reset\(\) has no option 'horizon_s'"
        ):
            env.reset(seed=0, options=options)
        env.reset(options={})
        env.reset(options=None)


@pytest.mark.parametrize("rows", [[2], [-1], 1, "x", [[0]], [0.5], np.array([True])])
def test_rows_out_of_range_or_of_wrong_shape_or_beside_a_seed_are_refused(batch, rows) -> None:
    env = batch(2, seed=0)
    env.reset()
    number = isinstance(rows, list) and all(type(row) is int for row in rows)
    said = r"rows must be from 0 to 1 \(got " if number else r"rows must be int \[n\] or bool \[2\] \(got "
    with pytest.raises(ValueError, match=said):
        env.reset(rows=rows)
    with pytest.raises(ValueError, match="give seed or rows, not both"):
        env.reset(seed=0, rows=[0])


@pytest.mark.parametrize("count", [0, 2.5, None, True])
def test_num_envs_and_max_cycles_must_be_positive(batch, count) -> None:
    with pytest.raises(ValueError, match=r"num_envs must be an integer from 1 to 2\*\*62 \(got "):
        batch(count)
    if count is not None:
        with pytest.raises(ValueError, match=r"max_cycles must be an integer from 1 to 2\*\*62 \(got "):
            batch(2, max_cycles=count)


def test_unknown_overrides_are_refused_with_the_nearest_name(cell, plans) -> None:
    for make in MAKERS:
        with pytest.raises(ScenarioError, match=r"unknown key 'horizon'; did you mean 'horizon_s'"):
            make(cell, difficulty="blind", cache=plans, horizon=60)
        with pytest.raises(ScenarioError, match="No difficulty 'twins'; did you mean 'twin'"):
            make(cell, difficulty="twins", cache=plans)
    with pytest.raises(ScenarioError, match="unknown key 'render_mod'; did you mean 'render_mode'"):
        make_env(cell, difficulty="blind", cache=plans, render_mod="ansi")
    with pytest.raises(ScenarioError, match="unknown key 'scenari'; did you mean 'scenario'"):
        make_env(cell, scenari="x")
    with pytest.raises(ScenarioError, match="unknown key 'randomize'; did you mean 'randomise'"):
        make_batch(cell, 2, difficulty="blind", cache=plans, randomize=None)
    single = {"plant": "mujoco", "bus": "zenoh", "channel": None, "render_mode": "ansi", "mask_in": "info"}
    for name, value in single.items():
        with pytest.raises(ScenarioError, match=rf"make_batch\(\) takes no {name}; only make_env\(\) does\."):
            make_batch(cell, 2, difficulty="blind", cache=plans, **{name: value})
    with pytest.raises(ScenarioError, match=r"make_env\(\) takes no threads; only make_batch\(\) does\."):
        make_env(cell, difficulty="blind", cache=plans, threads=2)


def test_a_seed_override_and_a_batch_that_cannot_fit_are_refused_and_a_cache_may_be_a_string(cell, plans) -> None:
    with pytest.raises(ScenarioError, match=r"make_env\(\) takes no seed: give it to reset\(seed=…\)"):
        make_env(cell, difficulty="blind", cache=plans, seed=3)
    with pytest.raises(ValueError, match=r"num_envs must be at most \d+, as this machine has \d+ GB: the observations"):
        make_batch(cell, 10**9, difficulty="blind", cache=plans)
    make_env(cell, difficulty="blind", cache=str(plans)).reset(seed=0)
    make_batch(cell, 1, difficulty="blind", cache=str(plans)).reset()


def test_overrides_may_be_numpy_numbers(cell, plans) -> None:
    own, numpys = (
        make_env(cell, difficulty="blind", cache=plans, horizon_s=horizon_s, slots=slots, ambient={"points": points})
        for horizon_s, slots, points in ((60, 3, [[0.0, 30.0]]), (np.int64(60), np.uint8(3), np.array([[0.0, 30.0]])))
    )
    for env in (own, numpys):
        env.reset(seed=0)
    assert own.episode.world.ticks == numpys.episode.world.ticks == 6
    assert own.observation_space("left") == numpys.observation_space("left")
    with pytest.raises(ScenarioError, match="expected numbers, texts, lists and tables, got <object"):
        make_env(cell, difficulty="blind", cache=plans, horizon_s=object())


def test_options_of_wrong_type_are_refused_with_the_valid_type(cell, plans) -> None:
    wrong: Any = 0.3
    with pytest.raises(FleetError, match=r"channel must be of type Channel, for example .*Channel\(.*\) \(got 0\.3\)"):
        make_env(cell, difficulty="blind", cache=plans, channel=wrong)
    for make in MAKERS:
        with pytest.raises(ScenarioError, match=r"cache must be the path of a folder \(got 0\.3\)"):
            make(cell, difficulty="blind", cache=wrong)
        with pytest.raises(ScenarioError, match=r"progress must be a function of .* \(got 0\.3\)"):
            make(cell, difficulty="blind", cache=plans, progress=wrong)
    for name in ("autoreset", "stagger"):
        with pytest.raises(ValueError, match=rf"{name} must be True or False \(got 0\.3\)"):
            make_batch(cell, 2, difficulty="blind", cache=plans, **{name: wrong})
    for make in (make_env, lambda scenario: make_batch(scenario, 2)):
        with pytest.raises(ScenarioError, match=r"scenario must be a library name, .+ \(got 0\.3\)"):
            make(wrong)
    with pytest.raises(
        ScenarioError, match=r"randomise must be a scenarios\.prepare\.randomisation\.Randomisation \(got 0\.3\)"
    ):
        make_batch(cell, 2, difficulty="blind", cache=plans, randomise=wrong)


def test_variants_with_other_arms_are_refused(cell, plans) -> None:
    arms = [
        {"name": a.name, "position_m": list(a.position_m), "tilt_deg": list(a.tilt_deg), "home": a.home}
        for a in cell.arms
    ]
    other = [dict(arms[0], name="west"), *arms[1:]]
    stream = {"name": "x", "kind": "hold", "places": ["bench"], "arrivals": {"kind": "batch", "count": 1}}
    refused = {
        "the names of arms": [{"arms": arms[::-1]}, {"arms": other}, {"arms": arms[:2]}],
        "the jobs": [{"jobs": [stream]}],
        "the slots": [{"slots": 3}],
        "dt_s": [{"decision_interval_s": 20.0}],
        "ticks": [{"horizon_s": 300.0}],
        "error_c": [{"limits": {"warning_c": 34.5, "error_c": 36.0, "restart_c": 34.0, "clear_s": 15.0}}],
    }
    for what, variants in refused.items():
        for variant in variants:
            randomise = Randomisation(variants=[variant])
            with pytest.raises(ScenarioError, match=what):
                make_batch(cell, 2, difficulty="blind", cache=plans, randomise=randomise)


def test_too_low_ambient_temperatures_are_refused(cell, plans) -> None:
    randomise = Randomisation(ambient_k=(-1000.0, 0.0))
    with pytest.raises(ScenarioError, match=r"ambient_k \(.+\) goes too far: .+ between -40 and 60 °C \(got \["):
        make_batch(cell, 2, difficulty="blind", cache=plans, randomise=randomise)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ambient_k": (2.0, 1.0)}, r"Randomisation\.ambient_k must be two finite numbers, low <= high \(got \(2\.0,"),
        ({"arrivals": (0.0, 1.0)}, r"Randomisation\.arrivals must be > 0"),
        ({"ambient_k": 3.0}, r"Randomisation\.ambient_k must be two finite numbers, .* \(got 3\.0\)"),
        ({"arrivals": (float("nan"), 1.0)}, r"Randomisation\.arrivals must be two finite numbers, low <= high"),
        ({"arrivals": (1.0, 1e9)}, r"Randomisation\.arrivals must be > 0 and at most 100 \(got \(1\.0, 1000000000\.0"),
        ({"ambient_k": ("a", "b")}, r"Randomisation\.ambient_k must be two finite numbers, .* \(got \('a', 'b'\)\)"),
        ({"variants": 3}, r"Randomisation\.variants must be a list of dictionaries, .+ \(got 3\)"),
        ({"variants": {"spread": {"seed": 1}}}, r"Randomisation\.variants must be a list of dictionaries"),
    ],
)
def test_invalid_ranges_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        Randomisation(**options)
